"""Consensus: members agree on the place of the formation from the reports of their neighbours, without a leader.

With ``delta_i`` the place of member i in the formation (turned to ``heading``), every member moves its point ``x_i`` at::

    u_i = kappa sum_j ((x_j - delta_j) - (x_i - delta_i)) + v_ref                over its neighbours j

the consensus protocol of Olfati-Saber and Murray ("Consensus problems in networks of agents with switching topology and
time-delays", IEEE Trans. Automatic Control 49(9), 2004), with formation offsets as in Ren ("Consensus strategies for
cooperative control of vehicle formations", IET Control Theory & Applications 1(2), 2007). With L the Laplacian of a connected
undirected graph, the disagreement decays at least as fast as ``exp(-kappa lambda_2(L) t)``.

Reports are old when they are used. Two forms of the protocol:

``fresh``    the neighbour's old point against the own present one, the neighbour having moved on at v_ref since: converges for
             every age, as long as kappa T times the number of neighbours is below 1 (diagonal dominance).
``delayed``  both points as old as the report: stable, at period T and an age of d ticks, if and only if
             ``kappa lambda_max(L) T < 2 sin(pi / (2 (2 d + 1)))``; for T -> 0, age < pi / (2 kappa lambda_max).
"""

import math
from bisect import bisect_left
from collections.abc import Mapping
from operator import attrgetter
from typing import Any, Literal, NamedTuple

from vcmvsp.agents.formation.followers.laws import axle_velocity, hand_point
from vcmvsp.agents.formation.reports.report import PLAUSIBLE
from vcmvsp.agents.formation.team.shape import Formation, ShapeName, slots
from vcmvsp.agents.formation.team.team import members_of
from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.frames import rotate2, wrap
from vcmvsp.cosim.types import Follows, NonNegative, Positive, Velocity

Graph = Literal["complete", "ring", "path", "star"]
Vec2 = tuple[float, float]


class NeighbourPoint(NamedTuple):
    """A member's point at a time."""

    t_ns: int
    x: float  # m, world
    y: float  # m, world


TIME = attrgetter("t_ns")


class Consensus(Agent):
    """Agree with the neighbours on the place of the formation, and move along with it at ``velocity``.

    At every tick it broadcasts ``t_ns``, ``x`` and ``y`` of its point; a member of another kind that reports
    these (a `Trajectory` does) is a neighbour like any other. A member without neighbours moves at ``velocity``.

    Noted at every tick: ``heard``, the number of neighbours in use; ``age_s``, the greatest age of their reports, and
    ``disagreement``, the root mean square over them of ``|(x_j - delta_j) - (x_i - delta_i)|`` as this member believes it (m);
    and, once there is one, the number of their messages that could not be used, ``refused``.

    Its formation error is measured against its first neighbour in the order of the members, if that one comes before it. On
    wheels that needs a ``velocity``, for a standing robot may head anywhere.

    Args:
        formation: shape, spacing, offsets, members and changes of the team, the same for all (its topology does not count);
            default: all members meet at one point.
        graph: neighbours by the order of the members; the hub of a ``star`` is the first.
        neighbours: instead of a graph, the names of this member's own neighbours.
        own: own point that a report is compared with: the ``fresh`` one, or the ``delayed`` one of the report's age.
        gain: kappa, 1/s.
        velocity: v_ref, x and y, m/s, world.
        heading: which way the formation faces, rad; members in the air turn there.
        handle: how far ahead of its axle a robot's point lies, m; default: it moves in any direction, as those in the air do.
        max_speed: limit of the point's speed, m/s; default: none but the vehicle's own.
        timeout_s: a neighbour whose newest report is so old does not count, s.
        clock_bound_s: how far ahead a neighbour's clock may be, s; a report from further in the future is refused.
    """

    def __init__(
        self,
        *,
        formation: Formation | None = None,
        graph: Graph = "complete",
        neighbours: tuple[str, ...] | None = None,
        own: Literal["fresh", "delayed"] = "fresh",
        gain: Positive = 1.0,
        velocity: Vec2 = (0.0, 0.0),
        heading: float = 0.0,
        handle: Positive | None = None,
        max_speed: Positive | None = None,
        timeout_s: Positive = 3.0,
        clock_bound_s: NonNegative = 0.0,
    ) -> None:
        self.formation, self.graph, self.neighbours = formation, graph, neighbours
        self.own, self.gain, self.velocity, self.heading, self.handle = own, gain, velocity, heading, handle
        self.max_speed = math.inf if max_speed is None else max_speed
        self.timeout_s = timeout_s
        self._clock_bound_ns, self._timeout_ns = seconds_to_ns(clock_bound_s), seconds_to_ns(timeout_s)
        self._newest: dict[str, NeighbourPoint] = {}
        self._past: list[NeighbourPoint] = []  # the own point at past ticks, up to the oldest usable report
        self._refused = 0
        self._places: dict[str, Vec2] = {}  # delta_j - delta_i of every neighbour
        self._changes: list[tuple[int, ShapeName]] = []  # still to come, the next one last

    def start(self, info: VehicleInfo) -> None:
        """Find the neighbours, and take the first shape; `ValueError`: a handle is missing, or names do not fit."""
        if self.handle is None and info.body is not None and not info.body.flies:
            raise ValueError("handle is missing: vehicles on wheels need one, e.g. handle = 0.3 (m, > 0)")
        members = members_of(self.formation or Formation(), info.vehicles, info.name)
        self._members, self._index = members, members.index(info.name)
        if self.neighbours is None:
            self._neighbours = neighbours_of(self.graph, self._index, len(members))
        else:
            self._neighbours = self._neighbours_by_name(info.name)
        if self.formation and self.formation.passage:
            raise ValueError("formation.passage needs a leader, and consensus has none; leave it out")
        if self.formation:
            self._changes = [(seconds_to_ns(at_s), to) for at_s, to in reversed(self.formation.changes)]
        self._take(self.formation.shape if self.formation else None)

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        """Move towards agreement with the neighbours that reported recently."""
        own_point = self._own_point(obs)
        radio.send(t_ns=own_point.t_ns, x=own_point.x, y=own_point.y)
        self._listen(obs)
        while self._changes and self._changes[-1][0] <= obs.time_ns:
            self._take(self._changes.pop()[1])
        if self.own == "delayed":
            self._remember(own_point)
        ux, uy = self._demand(own_point)
        if (speed := math.hypot(ux, uy)) > self.max_speed:
            ux, uy = ux / speed * self.max_speed, uy / speed * self.max_speed
        yaw = obs.state.yaw
        if self.handle is None:
            return Velocity(linear=(ux, uy, 0.0), yaw_rate=self.gain * wrap(self.heading - yaw))
        v, w = axle_velocity(ux, uy, yaw, self.handle)
        return Velocity(linear=(v, 0.0, 0.0), yaw_rate=w)

    def _demand(self, own_point: NeighbourPoint) -> Vec2:
        """The protocol: velocity of the own point, m/s, world."""
        (vx, vy), delayed = self.velocity, self.own == "delayed"
        sum_x = sum_y = squares = oldest_s = 0.0
        neighbours = 0
        for name, (dx, dy) in self._places.items():
            member = self._newest.get(name)
            if member is None or (age_s := max(0, own_point.t_ns - member.t_ns) / 1e9) >= self.timeout_s:
                continue
            if delayed:
                _, own_x, own_y = self._recall(member.t_ns)
            else:
                own_x, own_y = own_point.x - vx * age_s, own_point.y - vy * age_s
            ex, ey = member.x - own_x - dx, member.y - own_y - dy
            sum_x, sum_y, squares = sum_x + ex, sum_y + ey, squares + ex * ex + ey * ey
            neighbours, oldest_s = neighbours + 1, max(oldest_s, age_s)
        if neighbours:
            self.note(heard=neighbours, age_s=oldest_s, disagreement=math.sqrt(squares / neighbours))
        else:
            self.note(heard=0)
        return vx + self.gain * sum_x, vy + self.gain * sum_y

    def _own_point(self, obs: Observation) -> NeighbourPoint:
        x, y, _ = obs.state.position
        if self.handle is not None:
            x, y = hand_point(x, y, obs.state.yaw, self.handle)
        return NeighbourPoint(obs.clock_ns, x, y)

    def _listen(self, obs: Observation) -> None:
        latest_ns = obs.clock_ns + self._clock_bound_ns
        for sender, body in obs.heard.bodies(self._places):
            member = _parse(body, latest_ns)
            if member is None:
                self._refused += 1
            elif sender not in self._newest or member.t_ns > self._newest[sender].t_ns:
                self._newest[sender] = member
        if self._refused:
            self.note(refused=self._refused)

    def _remember(self, own_point: NeighbourPoint) -> None:
        self._past.append(own_point)
        end = bisect_left(self._past, own_point.t_ns - self._timeout_ns, key=TIME) - 1  # one from before, to interpolate
        if end > 0:
            del self._past[:end]

    def _recall(self, t_ns: int) -> NeighbourPoint:
        """The own point at a past time, interpolated between ticks."""
        i = min(bisect_left(self._past, t_ns, key=TIME), len(self._past) - 1)
        at = self._past[i]
        if at.t_ns <= t_ns or i == 0:
            return at
        (t0, x0, y0), (t1, x1, y1) = self._past[i - 1], at
        part = (t_ns - t0) / (t1 - t0)
        return NeighbourPoint(t_ns, x0 + part * (x1 - x0), y0 + part * (y1 - y0))

    def _take(self, shape: ShapeName | None) -> None:
        """Take a shape: places of the neighbours relative to the own one, and the reference of the formation error."""
        members, formation = self._members, self.formation
        if shape is None or formation is None:
            places: tuple[Vec2, ...] = ((0.0, 0.0),) * len(members)
        else:
            places = slots(shape, len(members), formation.spacing, formation.offsets)
        x, y = places[self._index]
        self._places = {members[j]: rotate2(places[j][0] - x, places[j][1] - y, self.heading) for j in self._neighbours}
        first, facing = min(self._neighbours, default=self._index), self._facing()
        if first < self._index and facing is not None:
            dx, dy = rotate2(*self._places[members[first]], -facing)
            self.follows = Follows(leader=members[first], slot=(-dx, -dy), handle_m=self.handle or 0.0)

    def _facing(self) -> float | None:
        """Heading of the members in agreement, rad: on wheels that of their motion."""
        if self.handle is None:
            return self.heading
        return math.atan2(self.velocity[1], self.velocity[0]) if any(self.velocity) else None

    def _neighbours_by_name(self, me: str) -> tuple[int, ...]:
        names = self.neighbours or ()
        if wrong := [name for name in names if name not in self._members or name == me]:
            others = ", ".join(name for name in self._members if name != me)
            raise ValueError(f"neighbours: {wrong[0]!r} is not another member of the formation; other members: {others}")
        return tuple(sorted({self._members.index(name) for name in names}))


def neighbours_of(graph: Graph, index: int, count: int) -> tuple[int, ...]:
    """The neighbours of member ``index`` of ``count``, in ascending order."""
    beside = (index - 1, index + 1)
    if graph == "ring":
        others = {place % count for place in beside}
    elif graph == "path":
        others = {place for place in beside if 0 <= place < count}
    elif graph == "star" and index > 0:
        others = {0}
    else:
        others = set(range(count))
    return tuple(sorted(others - {index}))


def _parse(body: Mapping[str, Any], latest_ns: int) -> NeighbourPoint | None:
    try:
        t_ns, x, y = body["t_ns"], body["x"], body["y"]
        if type(t_ns) is not int or t_ns > latest_ns or not abs(x) + abs(y) < PLAUSIBLE:
            return None
    except (KeyError, TypeError):
        return None
    return NeighbourPoint(t_ns, float(x), float(y))
