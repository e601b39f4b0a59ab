"""When a team makes itself narrow, as ``[agents.formation.passage]`` says, and what its members see of the lane that it needs.

The team needs a lane as wide as its wide shape, bodies included, and a margin on either side. Its leader calls the narrow shape
as soon as its own scan shows anything in that lane; when to change back, a policy says
(`agents.formation.team.passage_policy`).

Where the leader itself is lost, the team stays as it is: a member that leads in its place drives nowhere, and calls no shapes.

A lane is free up to a greater distance than that at which the narrow shape is called, so that noise does not switch to and fro.
What the scans show of members themselves does not count; on wheels, a member that has avoidance does not go around the others
either, but keeps behind them. In the air it keeps off them as off all else.

Members are told by where their reports put them: a member is seen within ``member_m`` of there, besides its radius. That must
be more than about three standard deviations of the difference between two poses, the own one and the reported one: 0.2 m does
for errors of up to 4 cm in each coordinate of either, 0.25 m for 5 cm. Where poses are worse, members are now and then taken
for obstacles, and the team stays narrow for longer, or for ever: then let scanners look over the members, or make ``member_m``
greater, though not needlessly: what stands that near to a member goes unseen, be it the wall of the passage.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from vcmvsp.agents.avoidance.settings import Settings
from vcmvsp.agents.avoidance.view import Looking, View, view_of
from vcmvsp.agents.formation.reports.prediction import Estimator
from vcmvsp.agents.formation.reports.received import Listening
from vcmvsp.agents.formation.reports.report import LeaderState, Report, height_of
from vcmvsp.agents.formation.team.formation import Formation, Passage
from vcmvsp.agents.formation.team.passage_policy import policy_of
from vcmvsp.agents.formation.team.shape import Slot
from vcmvsp.agents.formation.team.team import Team
from vcmvsp.cosim.agent import Body, Observation, VehicleInfo
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.frames import rotate2
from vcmvsp.cosim.types import Array, Readings, Scan

BESIDE_M = 0.05  # between bodies side by side that are not in each other's way
NAMED = 3  # at most: of those whom a narrow team waits for


class Mate(NamedTuple):
    """Where another member is now, as far as its report tells."""

    x: float  # m ahead
    y: float  # m to the left
    away: float  # m/s, its speed in the direction in which this vehicle heads


class Lookout:
    """What one vehicle sees of the lane that its team needs.

    Raises:
        ValueError: it has no such scanner, or nobody says how large it is.
    """

    def __init__(self, passage: Passage, team: Team, info: VehicleInfo) -> None:
        self._looking = Looking(passage.scanner, passage.stale_s)
        self._looking.start(info, "formation.passage.scanner")
        if info.body is None:
            raise ValueError(f"formation.passage: nobody says how large {info.name} is, so its team's lane is not known")
        self.passage, self.team = passage, team
        self._body: Body = info.body
        self._report_ns = seconds_to_ns(passage.report_s)

    def is_clear(self, obs: Observation, heard: Listening, estimator: Estimator) -> bool:
        """Whether a member is to say so."""
        return self.is_free(obs, heard, estimator, self.passage.clear_m)

    def is_free(self, obs: Observation, heard: Listening, estimator: Estimator, ahead_m: float) -> bool:
        """Whether nothing but members stands in the lane up to ``ahead_m``; a bad scan, or none, means that something may."""
        view = self._looking.look(obs)
        if view is None:
            return False
        across = [y for _, y in self.team.places(self.team.wide)]
        aside = 0.5 * self._body.width_m + self.passage.margin_m
        seen = np.isfinite(view.ranges)
        seen[self._of_members(view, obs, heard, estimator)] = False
        x, y = view.ranges[seen] * view.units[seen].T
        within = (y > min(across) - aside) & (y < max(across) + aside) & (x > -self.passage.behind_m) & (x < ahead_m)
        return not within.any()

    def without_members(self, obs: Observation, heard: Listening, estimator: Estimator, scanner: str) -> Observation:
        """The observation with a scan in which members are not to be seen, for one that is to keep its place close to them.

        Taken for obstacles, those ahead in a column would hold up whoever follows them, and those on their way to a new place
        would send each other astray. What keeps it off them is `behind_members`.
        """
        scan = obs.readings.get(scanner)
        view = view_of(scan)
        if not isinstance(scan, Scan) or view is None:
            return obs
        mine, ranges = self._of_members(view, obs, heard, estimator), view.ranges.copy()
        ranges[mine] = np.inf
        return replace(obs, readings=Readings({**obs.readings, scanner: replace(scan, ranges=ranges)}))

    def behind_members(self, obs: Observation, v: float, heard: Listening, estimator: Estimator, approach: float) -> float:
        """As much of a speed (m/s) as a vehicle may have so as not to run into a member ahead of it, or back into one behind.

        It comes nearer to one in its way by no more than ``approach`` (1/s) times what is left between circles around both
        bodies. The law knows of places alone, not of who crosses whose way to them.
        """
        lane, apart = self._body.width_m + BESIDE_M, 2.0 * self._body.radius_m
        for x, y, away in self._mates(obs, heard, estimator):
            room = approach * (abs(x) - apart)
            if abs(y) < lane:
                v = min(v, max(0.0, away + room)) if x > 0.0 else max(v, min(0.0, away - room))
        return v

    def _mates(self, obs: Observation, heard: Listening, estimator: Estimator) -> list[Mate]:
        """Those of whom there is a fresh report, at the height of this vehicle."""
        (x, y, z), yaw, mates = obs.state.position, obs.state.yaw, []
        for report in heard.newest.values():
            height = height_of(report)
            if height is None:
                height = 0.0 if self._body.flies else z  # of one on wheels
            if obs.time_ns - report.t_ns <= self._report_ns and abs(height - z) <= 2.0 * self._body.radius_m:
                then = moved_to(obs, report, estimator)
                mates.append(Mate(*rotate2(then.x - x, then.y - y, -yaw), then.v * math.cos(then.th - yaw)))
        return mates

    def _of_members(self, view: View, obs: Observation, heard: Listening, estimator: Estimator) -> Array:
        """Which beams end at a member, or as near to where it is taken to be as it may be.

        Only close to where a member's own fresh report puts it now, and at its height. This is safe, since what else stands so
        near to a member stands beside one that is there itself, looks with a scanner of its own, and says that its lane is not
        clear; whatever is larger than that circle is seen next to it; and a report that is lost or old hides nothing. What is
        nearer than can be measured, or no number, is nobody's.
        """
        mates = self._mates(obs, heard, estimator)
        if not mates:
            return np.zeros(0, np.intp)
        (seen,) = np.nonzero(np.isfinite(view.ranges) & (view.ranges > 0.0))
        points = view.ranges[seen, None] * view.units[seen]
        away = np.hypot(*np.moveaxis(points[:, None] - np.array(mates)[:, :2], -1, 0))
        return np.asarray(seen[(away <= self._body.radius_m + self.passage.member_m).any(axis=1)])


class Guide:
    """Says, for the leader, which shape the team is to have.

    Attributes:
        notes: what has changed at the last tick, for `cosim.agent.Agent.note`: ``lane``, ``narrow`` or ``free``, and
            ``waits_for``, for whom a narrow team waits though the leader's lane is free: three names at most, or none.
    """

    def __init__(self, passage: Passage, team: Team, info: VehicleInfo) -> None:
        self._lookout, self._policy = Lookout(passage, team, info), policy_of(passage)
        self._names = tuple(name for name in team.members if name != team.name)
        self._told = {"lane": "", "waits_for": ""}
        self.notes: dict[str, str] = {}

    def shape(self, obs: Observation, heard: Listening, estimator: Estimator) -> str:
        """That of now, or another one; asked once a tick."""
        passage, team = self._lookout.passage, self._lookout.team
        is_narrow = team.shape == passage.shape
        free = self._lookout.is_free(obs, heard, estimator, passage.free_m if is_narrow else passage.narrow_m)
        wide = self._policy.widens(obs.time_ns, free, self._names, heard) if is_narrow else free
        waits_for = self._policy.waits_for if is_narrow and free else ()
        now = {"lane": "free" if free else "narrow", "waits_for": ", ".join(waits_for[:NAMED])}
        self.notes = {name: value for name, value in now.items() if value != self._told[name]}
        self._told = now
        return team.wide if wide else passage.shape


def places_of(obs: Observation, reports: Mapping[str, Report], estimator: Estimator) -> dict[str, Slot]:
    """Where those are now who sent these reports, as estimated: m in this vehicle's frame, x forward, y left."""
    (x, y, _), yaw, places = obs.state.position, obs.state.yaw, {}
    for name, report in reports.items():
        then = moved_to(obs, report, estimator)
        places[name] = rotate2(then.x - x, then.y - y, -yaw)
    return places


def moved_to(obs: Observation, report: Report, estimator: Estimator) -> LeaderState:
    """The sender of a report as it is estimated to be now."""
    return estimator.predict(report, max(0, obs.time_ns - report.t_ns) / 1e9)


def scanners(avoidance: Settings | None, formation: Formation | None) -> tuple[str, ...]:
    """The names of the scanners that these look at."""
    passage = None if formation is None else formation.passage
    return tuple(dict.fromkeys(each.scanner for each in (avoidance, passage) if each is not None))
