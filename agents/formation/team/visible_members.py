"""Members of the team in a vehicle's own scan: which returns are theirs, and how fast it may drive behind them.

On wheels, a follower with avoidance does not drive around vehicles with known reports (a team's members or its single leader):
it stays behind them. In the air it avoids them like other obstacles.

Returns within ``member_m`` plus the radius of a member's reported place are taken for the member. ``member_m`` must exceed
about three standard deviations of the difference between the own and the reported pose: 0.2 m suits errors of up to 4 cm in
each coordinate of either, 0.25 m suits 5 cm. With worse poses members are now and then taken for obstacles, and the team stays
narrow for longer, or for ever: then mount scanners above the members, or raise ``member_m``, though no more than needed:
obstacles that near to a member, such as the wall of the passage, are hidden.
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
    """Members with known reports in a vehicle's scan: a team's, or its single leader.

    Args:
        body: of the vehicle, assumed for the others too.
        settings: distance from the report at which a member is recognised, and lifetime of reports.
    """

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
        mine, ranges = self._of_members(view, obs, listening, estimator), view.ranges.copy()
        ranges[mine] = np.inf
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
            if obs.time_ns - report.t_ns <= self._report_ns and abs(height - z) <= 2.0 * self._body.radius_m:
                then = moved_to(obs, report, estimator)
                mates.append(Mate(*rotate2(then.x - x, then.y - y, -yaw), then.v * math.cos(then.th - yaw)))
        return mates

    def _of_members(self, view: View, obs: Observation, listening: ReportReceiver, estimator: Estimator) -> Array:
        """Indices of the beams that end at a member, or near enough to its estimated place.

        Only returns near the place of a member's own fresh report, at its height. This is safe: an obstacle that near to a
        member stands beside one with a scanner of its own, which reports its lane as not clear; larger obstacles are seen
        beside the circle; a lost or old report hides nothing. Returns below the measuring range, and NaN, belong to no member.
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
