"""Passages of a team (``[agents.formation.passage]``): when its shape becomes narrow or wide, and its members' view of lanes.

The team needs a lane as wide as its wide shape, bodies included, and a margin on either side. The leader orders the narrow
shape as soon as its own scan shows anything in that lane, and the wide one by a policy. A lane is free up to a greater distance
than that at which the narrow shape is ordered, so that noise does not toggle the shape. If the leader is lost, the shape stays:
a member that leads in its place stands still and orders no shapes.

Widening is harder to time than narrowing: the last members are in the passage when the leader is out of it, and Toh 2012 (7.2)
leaves the question open:

============= ====================================================================================================
``immediate`` the leader's lane is free (Toh 2012): members behind are called out of the passage sideways
``timer``     it has been free for ``timer_s``: right for one length of the team at one speed only
``all-clear`` it is free, and all members report clear lanes, for ``steady_s`` on end; a silent member counts as not clear,
              and as gone after ``silence_s`` without any message
============= ====================================================================================================

The leader uses only reports that it receives itself: lane states are not relayed. Members beyond the reach of its radio, at
the end of a long chain, count as gone.

What the scans show of members themselves does not count. On wheels, a follower with avoidance does not drive around vehicles
with known reports (a team's members or its single leader): it stays behind them. In the air it avoids them like obstacles.

Returns within ``member_m`` plus the radius of a member's reported place are taken for the member. ``member_m`` must exceed
about three standard deviations of the difference between the own and the reported pose: 0.2 m suits errors of up to 4 cm in
each coordinate of either, 0.25 m suits 5 cm. With worse poses members are now and then taken for obstacles, and the team stays
narrow for longer, or for ever: then mount scanners above the members, or raise ``member_m``, though no more than needed:
obstacles that near to a member, such as the wall of the passage, are hidden.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from vcmvsp.agents.avoidance.method import Settings
from vcmvsp.agents.avoidance.view import ScanReader, View, view_of
from vcmvsp.agents.formation.reports.prediction import Estimator
from vcmvsp.agents.formation.reports.report import LeaderState, Report, ReportReceiver, height_of
from vcmvsp.agents.formation.team.shape import Formation, Passage, Slot
from vcmvsp.agents.formation.team.team import Team
from vcmvsp.cosim.agent import Body, Observation, VehicleInfo
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.frames import rotate2
from vcmvsp.cosim.types import Array, Readings, Scan

BESIDE_M = 0.05  # least gap between bodies side by side
NAMED = 3  # maximum number of names in the note ``waits_for``


class Mate(NamedTuple):
    """Estimated motion of another member, from its report."""

    x: float  # m ahead
    y: float  # m to the left
    away: float  # m/s, its speed along this vehicle's heading


class VisibleMembers:
    """Members with known reports in a vehicle's scan: a team's, or its single leader. All are assumed to have its ``body``."""

    def __init__(self, body: Body, settings: Passage) -> None:
        self._body, self._member_m = body, settings.member_m
        self._report_ns = seconds_to_ns(settings.report_s)

    def without_members(self, obs: Observation, listening: ReportReceiver, estimator: Estimator, scanner: str) -> Observation:
        """The observation without the members' returns in its scan, for keeping a place close to them.

        As obstacles, members ahead in a column would stop the ones behind, and members on their way to new places would
        deflect each other. `behind_members` prevents collisions.
        """
        scan = obs.readings.get(scanner)
        view = view_of(scan)
        if not isinstance(scan, Scan) or view is None:
            return obs
        beams, ranges = self._of_members(view, obs, listening, estimator), view.ranges.copy()
        ranges[beams] = np.inf
        return replace(obs, readings=Readings({**obs.readings, scanner: replace(scan, ranges=ranges)}))

    def behind_members(
        self, obs: Observation, v: float, listening: ReportReceiver, estimator: Estimator, approach: float
    ) -> float:
        """The part of a speed (m/s) that prevents running into a member ahead, or back into one behind.

        The approach speed is at most ``approach`` (1/s) times the gap between circles around both bodies. The law uses
        present places only, not crossing paths.
        """
        lane, apart = self._body.width_m + BESIDE_M, 2.0 * self._body.radius_m
        for x, y, away in self._mates(obs, listening, estimator):
            room = approach * (abs(x) - apart)
            if abs(y) < lane:
                v = min(v, max(0.0, away + room)) if x > 0.0 else max(v, min(0.0, away - room))
        return v

    def _mates(self, obs: Observation, listening: ReportReceiver, estimator: Estimator) -> list[Mate]:
        """Members with a fresh report, at the height of this vehicle."""
        (x, y, z), yaw, mates = obs.state.position, obs.state.yaw, []
        for report in listening.newest.values():
            height = height_of(report)
            if height is None:
                height = 0.0 if self._body.flies else z  # of one on wheels
            if obs.clock_ns - report.t_ns <= self._report_ns and abs(height - z) <= 2.0 * self._body.radius_m:
                then = moved_to(obs, report, estimator)
                mates.append(Mate(*rotate2(then.x - x, then.y - y, -yaw), then.v * math.cos(then.th - yaw)))
        return mates

    def _of_members(self, view: View, obs: Observation, listening: ReportReceiver, estimator: Estimator) -> Array:
        """Indices of the beams that end at a member, or near enough to its estimated place.

        Only returns near the place of a member's own fresh report, at its height, count. This is safe: an obstacle that near to
        a member stands beside one with a scanner of its own, which reports its lane as not clear; larger obstacles are seen
        beside the circle; a lost or old report hides nothing. Returns below the measuring range, and NaN, belong to no member.
        """
        mates = self._mates(obs, listening, estimator)
        if not mates:
            return np.zeros(0, np.intp)
        (finite,) = np.nonzero(np.isfinite(view.ranges) & (view.ranges > 0.0))
        points = view.ranges[finite, None] * view.units[finite]
        distance = np.hypot(*np.moveaxis(points[:, None] - np.array(mates)[:, :2], -1, 0))
        return np.asarray(finite[(distance <= self._body.radius_m + self._member_m).any(axis=1)])


def moved_to(obs: Observation, report: Report, estimator: Estimator) -> LeaderState:
    """Estimated present state of the sender of a report."""
    return estimator.predict(report, max(0, obs.clock_ns - report.t_ns) / 1e9)


class Widening:
    """Policy that makes a narrow team wide again; one object per leader.

    Attributes:
        waits_for: members that prevented widening at the last tick.
    """

    def __init__(self, passage: Passage) -> None:
        wait_s = {"immediate": 0.0, "timer": passage.timer_s, "all-clear": passage.steady_s}[passage.policy]
        self._wait_ns, self._for_all = seconds_to_ns(wait_s), passage.policy == "all-clear"
        self._report_ns, self._silence_ns = seconds_to_ns(passage.report_s), seconds_to_ns(passage.silence_s)
        self._since_ns: int | None = None  # since when everything is free
        self.waits_for: Sequence[str] = ()

    def widens(self, now_ns: int, free: bool, names: Iterable[str], listening: ReportReceiver) -> bool:
        """Whether to widen; called at every tick at which the team is narrow.

        ``free``: whether the leader's own lane is free; ``names``: the members behind it; ``listening``: their reports.
        """
        if self._for_all:
            self.waits_for = [name for name in names if not self._is_clear(now_ns, name, listening)]
            free = free and not self.waits_for
        if free and self._since_ns is None:
            self._since_ns = now_ns
        over = free and self._since_ns is not None and now_ns - self._since_ns >= self._wait_ns
        if over or not free:
            self._since_ns = None
        return over

    def _is_clear(self, now_ns: int, name: str, listening: ReportReceiver) -> bool:
        if listening.absent_ns(name, now_ns) >= self._silence_ns:
            return True  # it is gone
        report = listening.newest.get(name)
        return report is not None and now_ns - report.t_ns <= self._report_ns and report.body.get("cl") == 1


class Lookout(VisibleMembers):
    """One vehicle's view of the team's lane; `ValueError`: its scanner is missing, or its size unknown."""

    def __init__(self, passage: Passage, team: Team, info: VehicleInfo) -> None:
        self._looking = ScanReader(passage.scanner, passage.stale_s)
        self._looking.start(info, "formation.passage.scanner")
        if info.body is None:
            raise ValueError(f"formation.passage needs the size of {info.name}, but its kind has no body; choose another kind")
        super().__init__(info.body, passage)
        self.passage, self.team = passage, team

    def is_free(self, obs: Observation, listening: ReportReceiver, estimator: Estimator, ahead_m: float) -> bool:
        """Whether only members stand in the lane up to ``ahead_m``; False without a valid scan."""
        view = self._looking.look(obs)
        if view is None:
            return False
        across = [y for _, y in self.team.places(self.team.wide)]
        aside = 0.5 * self._body.width_m + self.passage.margin_m
        finite = np.isfinite(view.ranges)
        finite[self._of_members(view, obs, listening, estimator)] = False
        x, y = view.ranges[finite] * view.units[finite].T
        within = (y > min(across) - aside) & (y < max(across) + aside) & (x > -self.passage.behind_m) & (x < ahead_m)
        return not within.any()


class Guide:
    """Decides, for the leader, on the shape of the team at passages.

    Attributes:
        notes: changes of the last tick, for `cosim.agent.Agent.note`: ``lane``, ``narrow`` or ``free``, and ``waits_for``,
            up to three members for which a narrow team waits although the leader's lane is free.
    """

    def __init__(self, passage: Passage, team: Team, info: VehicleInfo) -> None:
        self._lookout, self._policy = Lookout(passage, team, info), Widening(passage)
        self._names = tuple(name for name in team.members if name != team.name)
        self._note = {"lane": "", "waits_for": ""}
        self.notes: dict[str, str] = {}

    def shape(self, obs: Observation, listening: ReportReceiver, estimator: Estimator) -> str:
        """The present shape or a new one; called once a tick."""
        passage, team = self._lookout.passage, self._lookout.team
        is_narrow = team.shape == passage.shape
        free = self._lookout.is_free(obs, listening, estimator, passage.free_m if is_narrow else passage.narrow_m)
        wide = self._policy.widens(obs.time_ns, free, self._names, listening) if is_narrow else free
        waits_for = self._policy.waits_for if is_narrow and free else ()
        now = {"lane": "free" if free else "narrow", "waits_for": ", ".join(waits_for[:NAMED])}
        self.notes = {name: value for name, value in now.items() if value != self._note[name]}
        self._note = now
        return team.wide if wide else passage.shape


def places_of(obs: Observation, reports: Mapping[str, Report], estimator: Estimator) -> dict[str, Slot]:
    """Estimated positions of the senders of reports: m in this vehicle's frame, x forward, y left."""
    (x, y, _), yaw = obs.state.position, obs.state.yaw
    now = {name: moved_to(obs, report, estimator) for name, report in reports.items()}
    return {name: rotate2(state.x - x, state.y - y, -yaw) for name, state in now.items()}


def scanners(avoidance: Settings | None, formation: Formation | None) -> tuple[str, ...]:
    """Names of the scanners that these passages use."""
    passage = None if formation is None else formation.passage
    return tuple(dict.fromkeys(each.scanner for each in (avoidance, passage) if each is not None))
