"""Other members in a vehicle's own scan: which returns are theirs, and how fast it may drive behind them.

On wheels, a follower that has avoidance does not go around those whose reports it hears, a team's members or its one leader:
it keeps behind them. In the air it keeps off them as off all else.

Members are told by where their reports put them: a member is seen within ``member_m`` of there, besides its radius. That must
be more than about three standard deviations of the difference between two poses, the own one and the reported one: 0.2 m does
for errors of up to 4 cm in each coordinate of either, 0.25 m for 5 cm. Where poses are worse, members are now and then taken
for obstacles, and the team stays narrow for longer, or for ever: then let scanners look over the members, or make ``member_m``
greater, though not needlessly: what stands that near to a member goes unseen, be it the wall of the passage.
"""

import math
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from vcmvsp.agents.avoidance.view import View, view_of
from vcmvsp.agents.formation.reports.prediction import Estimator
from vcmvsp.agents.formation.reports.received import ReportReceiver
from vcmvsp.agents.formation.reports.report import LeaderState, Report, height_of
from vcmvsp.agents.formation.team.formation import Passage
from vcmvsp.cosim.agent import Body, Observation
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.frames import rotate2
from vcmvsp.cosim.types import Array, Readings, Scan

BESIDE_M = 0.05  # between bodies side by side that are not in each other's way


class Mate(NamedTuple):
    """Where another member is now, as far as its report tells."""

    x: float  # m ahead
    y: float  # m to the left
    away: float  # m/s, its speed in the direction in which this vehicle heads


class VisibleMembers:
    """The members whose reports a vehicle hears, as its scanner sees them: a team's, or its one leader.

    Args:
        body: of the vehicle, and taken to be that of the others too.
        settings: how near to its report a member is seen, and until when a report counts.
    """

    def __init__(self, body: Body, settings: Passage) -> None:
        self._body, self._member_m = body, settings.member_m
        self._report_ns = seconds_to_ns(settings.report_s)

    def without_members(self, obs: Observation, listening: ReportReceiver, estimator: Estimator, scanner: str) -> Observation:
        """The observation with a scan in which members are not to be seen, for one that is to keep its place close to them.

        Taken for obstacles, those ahead in a column would hold up whoever follows them, and those on their way to a new place
        would send each other astray. What keeps it off them is `behind_members`.
        """
        scan = obs.readings.get(scanner)
        view = view_of(scan)
        if not isinstance(scan, Scan) or view is None:
            return obs
        mine, ranges = self._of_members(view, obs, listening, estimator), view.ranges.copy()
        ranges[mine] = np.inf
        return replace(obs, readings=Readings({**obs.readings, scanner: replace(scan, ranges=ranges)}))

    def behind_members(
        self, obs: Observation, v: float, listening: ReportReceiver, estimator: Estimator, approach: float
    ) -> float:
        """As much of a speed (m/s) as a vehicle may have so as not to run into a member ahead of it, or back into one behind.

        It comes nearer to one in its way by no more than ``approach`` (1/s) times what is left between circles around both
        bodies. The law knows of places alone, not of who crosses whose way to them.
        """
        lane, apart = self._body.width_m + BESIDE_M, 2.0 * self._body.radius_m
        for x, y, away in self._mates(obs, listening, estimator):
            room = approach * (abs(x) - apart)
            if abs(y) < lane:
                v = min(v, max(0.0, away + room)) if x > 0.0 else max(v, min(0.0, away - room))
        return v

    def _mates(self, obs: Observation, listening: ReportReceiver, estimator: Estimator) -> list[Mate]:
        """Those of whom there is a fresh report, at the height of this vehicle."""
        (x, y, z), yaw, mates = obs.state.position, obs.state.yaw, []
        for report in listening.newest.values():
            height = height_of(report)
            if height is None:
                height = 0.0 if self._body.flies else z  # of one on wheels
            if obs.time_ns - report.t_ns <= self._report_ns and abs(height - z) <= 2.0 * self._body.radius_m:
                then = moved_to(obs, report, estimator)
                mates.append(Mate(*rotate2(then.x - x, then.y - y, -yaw), then.v * math.cos(then.th - yaw)))
        return mates

    def _of_members(self, view: View, obs: Observation, listening: ReportReceiver, estimator: Estimator) -> Array:
        """Which beams end at a member, or as near to where it is taken to be as it may be.

        Only close to where a member's own fresh report puts it now, and at its height. This is safe, since what else stands so
        near to a member stands beside one that is there itself, looks with a scanner of its own, and says that its lane is not
        clear; whatever is larger than that circle is seen next to it; and a report that is lost or old hides nothing. What is
        nearer than can be measured, or no number, is nobody's.
        """
        mates = self._mates(obs, listening, estimator)
        if not mates:
            return np.zeros(0, np.intp)
        (finite,) = np.nonzero(np.isfinite(view.ranges) & (view.ranges > 0.0))
        points = view.ranges[finite, None] * view.units[finite]
        away = np.hypot(*np.moveaxis(points[:, None] - np.array(mates)[:, :2], -1, 0))
        return np.asarray(finite[(away <= self._body.radius_m + self._member_m).any(axis=1)])


def moved_to(obs: Observation, report: Report, estimator: Estimator) -> LeaderState:
    """The sender of a report as it is estimated to be now."""
    return estimator.predict(report, max(0, obs.time_ns - report.t_ns) / 1e9)
