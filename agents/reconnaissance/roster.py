"""Members of a mission, their tasks and their targets, from their own reports.

====== ===== ==============================================================
key    type  meaning
====== ===== ==============================================================
``do`` str   the task: ``search``, ``formation`` or ``track``
``ms`` int   time of that task, ms of simulated time
``tg`` str   the target that it tracks; absent: none
``at`` list  where that target is, x and y, m, world
``since`` int when it began to track that one, ms
====== ===== ==============================================================

Every message has the whole status, so that a loss costs one period. The newest by ``ms`` counts, in any order of arrival.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeGuard

from vcmvsp.agents.reconnaissance.state_table import TASKS, Task
from vcmvsp.cosim.agent import Observation, Radio, VehicleInfo
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.config.binding import unknown

Point = tuple[float, float]

SAME_M = 3.0  # targets without a name within this distance are one
APART_M = 20.0  # targets of one name beyond this distance are two
GIVEN_UP_NS = seconds_to_ns(60.0)  # time for which a place that was given up is ignored
FARTHEST_M = 1e9  # larger coordinates are invalid
LATEST_MS = 2**53  # of the clock; larger values are invalid
LONGEST_NAME = 100  # characters


class Claim(NamedTuple):
    """A target that a vehicle tracks."""

    target: str  # empty: it does not know yet which one it is
    place: Point  # m, world
    since_ns: int

    def same(self, other: "Claim") -> bool:
        """Whether two claims are for one target."""
        if self.target and other.target:
            return self.target == other.target and math.dist(self.place, other.place) <= APART_M
        return math.dist(self.place, other.place) <= SAME_M


class MemberStatus(NamedTuple):
    """Last status of a member."""

    ms: int
    task: Task
    claim: Claim | None


class Roster:
    """The mission from the view of one member.

    Each of ``sectors`` is searched together, led by its first; other members have a sector of their own. ``sector`` is that of
    this vehicle, named after its first. After ``alive_s`` of silence a member counts as lost; its claim stands for ``claim_s``,
    as most are only out of reach. Reports come every ``report_s``, and at once when task or target change. Other clocks lead by
    ``clock_bound_s`` at most. `ValueError`: members and sectors contradict each other.
    """

    def __init__(
        self,
        me: str,
        members: Sequence[str],
        *,
        sectors: Sequence[Sequence[str]] = (),
        alive_s: float = 5.0,
        claim_s: float = 30.0,
        report_s: float = 1.0,
        clock_bound_s: float = 0.0,
    ) -> None:
        if me not in members:
            raise ValueError(f"members must include {me}; members: {', '.join(members)}")
        if alive_s <= report_s:
            raise ValueError(f"alive_s = {alive_s} must be longer than the report period, {report_s} s")
        self.me, self.members = me, tuple(sorted(set(members)))
        self._sector_of = _by_sector(self.members, sectors)
        self._rank = {name: rank for sector in sectors for rank, name in enumerate(sector)}
        self.sector = self._sector_of[me]
        self._given_up: list[tuple[int, Point]] = []
        self._alive_ns, self._report_ns = seconds_to_ns(alive_s), seconds_to_ns(report_s)
        self._claim_ns = max(self._alive_ns, seconds_to_ns(claim_s))
        self.clock_bound_s, self._clock_bound_ns = clock_bound_s, seconds_to_ns(clock_bound_s)
        self._status_of: dict[str, MemberStatus] = {}
        self._there_ns: dict[str, int] = {}  # time of the newest message of its agent
        self._start_ns: int | None = None
        self._own_status: tuple[Task, str | None] | None = None
        self._own_status_ns = 0

    def hear(self, obs: Observation) -> None:
        """Process received statuses, once a tick. Any message of a member is a sign of life, except one of bytes."""
        self._start_ns = obs.clock_ns if self._start_ns is None else self._start_ns
        for sender, body in obs.heard.bodies(self._sector_of):
            if sender == self.me:
                continue
            self._there_ns[sender] = obs.clock_ns
            status = _parsed(body, (obs.clock_ns + self._clock_bound_ns) // 1_000_000)
            before = self._status_of.get(sender)
            if status is not None and (before is None or status.ms > before.ms):
                self._status_of[sender] = status

    def tell(self, obs: Observation, radio: Radio, task: Task, claim: Claim | None) -> None:
        """Send the own status if it is due, once a tick."""
        now = task, None if claim is None else claim.target
        if now == self._own_status and obs.clock_ns - self._own_status_ns < self._report_ns:
            return
        self._own_status, self._own_status_ns = now, obs.clock_ns
        body: dict[str, Any] = {"do": task, "ms": obs.clock_ns // 1_000_000}
        if claim is not None:
            body |= {"tg": claim.target, "at": list(claim.place), "since": claim.since_ns // 1_000_000}
        radio.send(body)

    def alive(self, now_ns: int) -> tuple[str, ...]:
        """Living members, including this one, in the order of their names."""
        return tuple(name for name in self.members if name == self.me or self._silent_ns(name, now_ns) < self._alive_ns)

    def searchers(self, now_ns: int) -> tuple[str, ...]:
        """Living members that search, alone or in formation, with this one; members of unknown task count as searching."""
        tracking = {name for name, status in self._status_of.items() if status.task == "track"}
        return tuple(name for name in self.alive(now_ns) if name == self.me or name not in tracking)

    def shared(self, now_ns: int) -> bool:
        """Whether a member before this one searches its sector, so that this one flies in formation."""
        before = self._rank.get(self.me, 0)
        return any(self._sector_of[name] == self.sector and self._rank.get(name, 0) < before for name in self.searchers(now_ns))

    def sectors(self, now_ns: int) -> tuple[str, ...]:
        """Sectors with a searching member, including this vehicle's, in the order of their names."""
        return tuple(sorted({self._sector_of[name] for name in self.searchers(now_ns)}))

    def claims(self, now_ns: int) -> Mapping[str, Claim]:
        """Unexpired claims of targets by the other members, by vehicle."""
        return {
            name: each.claim
            for name, each in sorted(self._status_of.items())
            if each.claim is not None and self._silent_ns(name, now_ns) < self._claim_ns
        }

    def has_prior_claim(self, claim: Claim, now_ns: int) -> bool:
        """Whether another member has priority for that target.

        Priority: a member with an identified target, then the earlier begin, then the first name.
        """
        own = _right(self.me, claim)
        return any(claim.same(other) and _right(name, other) < own for name, other in self.claims(now_ns).items())

    def give_up(self, place: Point, now_ns: int) -> None:
        """Ignore a place, m, world, for a while: its target was lost, or another member tracks it."""
        self._given_up.append((now_ns, place))

    def abandoned_places(self, now_ns: int) -> list[Point]:
        """Places given up in the last minute."""
        self._given_up = [each for each in self._given_up if now_ns - each[0] < GIVEN_UP_NS]
        return [place for _, place in self._given_up]

    def _silent_ns(self, name: str, now_ns: int) -> int:
        """Time since the last message of a member; without one, since the start."""
        return now_ns - self._there_ns.get(name, now_ns if self._start_ns is None else self._start_ns)


def members_of(info: VehicleInfo, members: Sequence[str]) -> tuple[str, ...]:
    """The given members; without any, all vehicles of the run. `ValueError`: a member is no vehicle of the run."""
    for name in members:
        if name not in info.vehicles:
            raise ValueError(f"members: {unknown('vehicle', name, info.vehicles)}")
    return tuple(members) or info.vehicles


def _right(name: str, claim: Claim) -> tuple[bool, int, str]:
    """Sort key of claims to one target."""
    return not claim.target, claim.since_ns // 1_000_000, name


def _by_sector(members: Sequence[str], sectors: Sequence[Sequence[str]]) -> dict[str, str]:
    """Sector name of each member: that of the first member in it."""
    of: dict[str, str] = {}
    for sector in sectors:
        if not sector:
            raise ValueError("sectors: a sector has no members; add one, or leave the sector out")
        for name in sector:
            if name not in members:
                raise ValueError(f"sectors: {unknown('member', name, members)}")
            if name in of:
                raise ValueError(f"sectors names {name} twice")
            of[name] = sector[0]
    return {name: of.get(name, name) for name in members}


def _parsed(body: Mapping[str, Any], latest_ms: int) -> MemberStatus | None:
    task, ms = body.get("do"), body.get("ms")
    if task not in TASKS or not _is_time(ms, min(latest_ms, LATEST_MS)):
        return None
    if "tg" not in body:
        return MemberStatus(ms, task, None)
    target, place, since = body["tg"], body.get("at"), body.get("since")
    if not isinstance(target, str) or len(target) > LONGEST_NAME or not _is_time(since, ms):
        return None
    if not isinstance(place, list) or len(place) != 2:
        return None
    if not all(type(each) is float and abs(each) <= FARTHEST_M for each in place):
        return None
    return MemberStatus(ms, task, Claim(target, (place[0], place[1]), since * 1_000_000))


def _is_time(value: Any, latest: int) -> TypeGuard[int]:
    return type(value) is int and 0 <= value <= latest
