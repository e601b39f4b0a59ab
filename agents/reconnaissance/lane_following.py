"""Lane following: speed and course along the lanes of a strip; unreachable way-points are skipped.

Towards a way-point at a distance d it flies at ``min(speed, sqrt(2 a d))``, the speed from which it can still stop there with
an acceleration a; as a way-point counts as reached before that, the vehicle turns at a speed that it can turn at. Beside a lane
(after it has got around something, or was busy elsewhere) it makes for a point of the lane that lies a second ahead.
"""

import math
from collections.abc import Iterable

from vcmvsp.agents.reconnaissance.sectors import Comb, Point
from vcmvsp.cosim.clock import seconds_to_ns

AHEAD_S = 1.0  # how far ahead it looks along a lane
PROGRESS_M = 1.0  # nearer to the way-point by less than that is no progress


class LaneFollower:
    """Velocities along the lanes of a comb.

    Args:
        comb: the lanes.
        speed: m/s, along them.
        acceleration: m/s2, that the vehicle can do for sure.
        stuck_s: a way-point is given up after so long without progress, s.

    Attributes:
        goal: the way-point that it flies to, m, world; None: it has not begun, or pauses.
    """

    def __init__(self, comb: Comb, *, speed: float, acceleration: float, stuck_s: float) -> None:
        self.comb, self.speed, self.acceleration = comb, speed, acceleration
        self.goal: Point | None = None
        self._stuck_ns = seconds_to_ns(stuck_s)
        self._progress_m = min(PROGRESS_M, 0.25 * speed * stuck_s)
        self._nearest_m, self._since_ns = math.inf, 0  # how near it has come, by steps of progress, and since when

    def pause(self) -> None:
        """The vehicle does something else: it is not to blame for making no progress."""
        self.goal = None

    def velocity(self, now_ns: int, position: Point, living: Iterable[str]) -> Point:
        """Velocity of a tick, m/s, world, at ``position``; ``living``: names of the members with a strip."""
        names = tuple(living)
        goal = self.comb.goal(position, names)
        if goal == self.goal and self._is_stuck(now_ns, math.dist(position, goal)):
            self.comb.skip()
            goal = self.comb.goal(position, names)
        if goal != self.goal:
            self.goal, self._nearest_m, self._since_ns = goal, math.dist(position, goal), now_ns
        speed = min(self.speed, math.sqrt(2.0 * self.acceleration * math.dist(position, goal)))
        aim = self._aim(position, goal)
        way = math.dist(position, aim)
        if way == 0.0:
            return 0.0, 0.0
        return speed * (aim[0] - position[0]) / way, speed * (aim[1] - position[1]) / way

    def _is_stuck(self, now_ns: int, away_m: float) -> bool:
        if away_m <= self._nearest_m - self._progress_m:
            self._nearest_m, self._since_ns = away_m, now_ns
        return now_ns - self._since_ns >= self._stuck_ns

    def _aim(self, position: Point, goal: Point) -> Point:
        """The way-point, or a point before it on the line to it."""
        came = self.comb.came
        length = 0.0 if came is None else math.dist(came, goal)
        if came is None or length == 0.0:
            return goal
        x, y = (goal[0] - came[0]) / length, (goal[1] - came[1]) / length
        along = (position[0] - came[0]) * x + (position[1] - came[1]) * y
        ahead = max(0.0, along) + AHEAD_S * self.speed
        return goal if ahead >= length else (came[0] + ahead * x, came[1] + ahead * y)
