"""A leader that drives from point to point, steered from its own pose."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from vcmvsp.agents.formation.leaders.leader import Leader
from vcmvsp.cosim.agent import Observation
from vcmvsp.cosim.frames import arc, rotate2
from vcmvsp.cosim.types import Positive

Point = tuple[float, float]

TURN_ON_THE_SPOT = 0.8  # rad: at larger bearings it turns before it drives on
TURN_GAIN = 1.5  # 1/s, of turning on the spot


class RouteStage(NamedTuple):
    """Progress along the route: the line between two points."""

    start: Point  # m
    number: int  # of the point that is next


class Route(Leader):
    """Visit points in turn along the straight lines between them, slow down at the last one, and stay there.

    Pure pursuit (Coulter, Implementation of the pure pursuit path tracking algorithm, CMU-RI-TR-92-01, 1992): the vehicle
    drives along the circle through a point of the path ``lookahead_m`` ahead, curvature ``2 sin(alpha) / distance`` for a
    point at the bearing alpha. That point never lies beyond the next way-point, so that no corner is cut by more than
    ``arrive_m``. At bearings above 0.8 rad the vehicle turns on the spot. Plans assume that commands take effect at once.

    Notes ``point``, the number of the next point, when it changes, and ``status`` ``arrived``.

    Args:
        way: points, x and y, m, world; the first line begins at the start position.
        loop: after the last point, drive to the first again.
        speed: m/s, on straight lines.
        yaw_rate: fastest turning, rad/s; narrow curves are driven more slowly.
        lookahead_m: a shorter one follows the path closely, a longer one is smoother and bears more lag: at least ``speed``
            times 1 s.
        arrive_m: distance at which a point is reached.
        deceleration: at the last point, m/s2.
        leading: tell, plan_ticks, estimator, horizon_s, fade_s, sending, formation, avoidance, clock_bound_s, as of `Leader`.
    """

    def __init__(
        self,
        way: tuple[Point, ...],
        *,
        loop: bool = False,
        speed: Positive = 0.3,
        yaw_rate: Positive = 0.8,
        lookahead_m: Positive = 0.6,
        arrive_m: Positive = 0.1,
        deceleration: Positive = 0.2,
        **leading: Any,
    ) -> None:
        super().__init__(**leading)
        if not way:
            raise ValueError("way needs at least one point")
        self.way, self.loop, self.speed, self.yaw_rate = way, loop, speed, yaw_rate
        self.lookahead_m, self.arrive_m, self.deceleration = lookahead_m, arrive_m, deceleration
        self._stage: RouteStage | None = None
        self._pose = (0.0, 0.0, 0.0)

    def speeds(self, obs: Observation) -> tuple[float, float]:
        """Speeds along the route."""
        x, y, _ = obs.state.position
        before = self._stage
        self._pose = x, y, obs.state.yaw
        self._stage, v, w = self._steered(self._pose, before or RouteStage((x, y), 0))
        if before is None or self._stage.number != before.number:
            self.note(point=self._stage.number)
        if self._stage.number == len(self.way):
            self.note(status="arrived")
        return v, w

    def aim(self, obs: Observation) -> Point | None:
        """The next point of the way, x, y, m, world; None: there is no next point."""
        if self._stage is None or self._stage.number == len(self.way):
            return None
        return self.way[self._stage.number]

    def led_astray(self, obs: Observation) -> None:
        """The line to the next point begins here."""
        if self._stage is not None:
            self._stage = RouteStage(obs.state.position[:2], self._stage.number)

    def ahead(self, count: int) -> Sequence[tuple[float, float]]:
        """Speeds that it would command after these."""
        if self._stage is None:
            return ()
        stage, v, w = self._steered(self._pose, self._stage)
        pose, plan = self._pose, []
        for _ in range(count):
            pose = arc(pose, v, w, self._period_s)
            stage, v, w = self._steered(pose, stage)
            plan.append((v, w))
        return plan

    def _steered(self, pose: tuple[float, float, float], stage: RouteStage) -> tuple[RouteStage, float, float]:
        """New stage of the route after ``stage``, and speeds, m/s and rad/s."""
        x, y, th = pose
        start, number = stage
        for _ in self.way:  # at most once round
            if number == len(self.way) or math.dist((x, y), self.way[number]) > self.arrive_m:
                break
            start, number = self.way[number], number + 1
            if self.loop:
                number %= len(self.way)
        stage = RouteStage(start, number)
        if number == len(self.way) or math.dist((x, y), self.way[number]) <= self.arrive_m:  # or all are one place
            return stage, 0.0, 0.0
        aim_x, aim_y = _aim((x, y), start, self.way[number], self.lookahead_m)
        ahead, left = rotate2(aim_x - x, aim_y - y, -th)
        distance, aside = math.hypot(ahead, left), math.atan2(left, ahead)
        if abs(aside) > TURN_ON_THE_SPOT:
            return stage, 0.0, self._turning(TURN_GAIN * aside)
        curvature = 2.0 * math.sin(aside) / distance
        v = min(self.speed, distance / self._period_s)
        if curvature:
            v = min(v, self.yaw_rate / abs(curvature))
        if number == len(self.way) - 1 and not self.loop:
            v = min(v, math.sqrt(2.0 * self.deceleration * math.dist((x, y), self.way[-1])))
        return stage, v, self._turning(v * curvature)

    def _turning(self, w: float) -> float:
        return max(-self.yaw_rate, min(w, self.yaw_rate))


def _aim(place: Point, start: Point, end: Point, lookahead: float) -> Point:
    """The point on the line from ``start`` to ``end`` at ``lookahead`` beyond the point nearest to ``place``."""
    length = math.dist(start, end)
    if length == 0.0:
        return end
    along_x, along_y = (end[0] - start[0]) / length, (end[1] - start[1]) / length
    passed = (place[0] - start[0]) * along_x + (place[1] - start[1]) * along_y
    reach = min(max(passed, 0.0) + lookahead, length)
    return start[0] + reach * along_x, start[1] + reach * along_y
