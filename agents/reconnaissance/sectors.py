"""Strips of an area, the lanes along them, and a vehicle's way along its lanes.

The area is divided into vertical strips of equal width, one for each living member in the order of the names (2 before 10):
the set of living members determines all strips, without a message. When a member fails, the strips are divided anew.

Towards a way-point at a distance d a vehicle flies at ``min(speed, sqrt(2 a d))``, the speed from which it can still stop there
with an acceleration a; as a way-point counts as reached before that, it turns at a speed that it can turn at. Beside a lane
(after an avoidance or another task) it flies to a point of the lane that lies a second ahead.
"""

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from vcmvsp.agents.reconnaissance.probability_map import Rectangle
from vcmvsp.cosim.clock import seconds_to_ns

Point = tuple[float, float]


def strips(area: Rectangle, living: Iterable[str]) -> dict[str, Rectangle]:
    """The strip of each living member, left to right in the order of the names."""
    names = sorted(sorted(set(living)), key=_natural)
    width = (area.right - area.left) / len(names) if names else 0.0
    return {
        name: Rectangle(area.left + i * width, area.bottom, area.left + (i + 1) * width, area.top)
        for i, name in enumerate(names)
    }


def _natural(name: str) -> list[Any]:
    """Sort key of names: uav2 before uav10."""
    parts: list[Any] = re.split(r"([0-9]+)", name)  # words and numbers in turn
    parts[1::2] = map(int, parts[1::2])
    return parts


def lanes(area: Rectangle, radius: float, overlap: float = 0.2, start: Point | None = None) -> tuple[Point, ...]:
    """Way-points of a boustrophedon, two for each of ``ceil(width / (2 radius (1 - overlap)))`` lanes, evenly spaced.

    Lanes run along y and end ``radius / 2`` short of the border, in the middle of an area that is no longer than that.

    ``radius`` is the visible distance from the vehicle, m, ``overlap`` the share of that width that is visible from the next
    lane, too. Lanes begin at the end that is nearest to ``start``; default: bottom left.
    """
    if not (radius > 0.0 and 0.0 <= overlap < 1.0):
        raise ValueError(f"radius = {radius} m must be > 0 and overlap = {overlap} >= 0 and < 1")
    width, height = area.right - area.left, area.top - area.bottom
    count = max(1, math.ceil(width / (2.0 * radius * (1.0 - overlap)) - 1e-9))
    xs = [area.left + (i + 0.5) * width / count for i in range(count)]
    short = min(radius, height) / 2.0
    ends = (area.bottom + short, area.top - short)
    ways = [_way(columns, order) for columns in (xs, xs[::-1]) for order in (ends, ends[::-1])]
    if start is None:
        return ways[0]
    return min(ways, key=lambda way: math.dist(way[0], start))  # of equal ones the first


def _way(xs: list[float], ends: tuple[float, float]) -> tuple[Point, ...]:
    points = []
    for x in xs:
        points += [(x, end) for end in ends]
        ends = ends[::-1]
    return tuple(points)


@dataclass
class Comb:
    """One vehicle's path over its strip, repeated until the search ends: back and forth, or up and down and then across.

    Lanes across show what buildings hide from lanes along y.

    ``radius`` is the visible distance from the vehicle, ``across`` that from lanes along x (0: no such lanes), ``reached`` the
    distance at which a way-point is reached, m. ``is_open`` says whether a lane with these ends, m, world, is worth flying;
    others are skipped as long as there are such. ``came`` is the way-point at the start of the present line; None: none yet.
    """

    me: str
    area: Rectangle
    radius: float
    overlap: float = 0.2
    reached: float = 1.0
    across: float = 0.0
    is_open: Callable[[Point, Point], bool] = lambda *_: True
    came: Point | None = None
    _ways: dict[tuple[str, ...], "_Way"] = field(default_factory=dict)  # by living members
    _way: "_Way | None" = None

    def goal(self, position: Point, living: Iterable[str]) -> Point:
        """The next way-point, m, world; this vehicle always counts as living.

        The strip stays as long as the same members live. When they change, the vehicle begins at the nearest end of its new
        strip. When a former set of members lives again, it resumes that strip where it stopped.
        """
        names = tuple(sorted({*living, self.me}))
        if names not in self._ways:
            self._ways[names] = self._laid(strips(self.area, names)[self.me], position)
        way = self._ways[names]
        if way is not self._way:
            self._way, self.came = way, None
            if not self.is_open(*way.lane) and any(self.is_open(*lane) for lane in (*way.lanes, *way.across)):
                way.turn(self.is_open, position)
        if math.dist(position, way.goal) > self.reached:
            return way.goal
        self.came = way.goal
        way.go_on(self.is_open)
        return way.goal

    def _laid(self, strip: Rectangle, position: Point) -> "_Way":
        way = _pairs(lanes(strip, self.radius, self.overlap, position))
        if not self.across:
            return _Way(way)
        turned = lanes(Rectangle(strip.bottom, strip.left, strip.top, strip.right), self.across, self.overlap)
        return _Way(way, _pairs([(x, y) for y, x in turned]))

    def skip(self) -> None:
        """Skip the present way-point, which cannot be reached."""
        self.came = None
        if self._way is not None:
            self._way.go_on(self.is_open)


def _pairs(points: Sequence[Point]) -> list[tuple[Point, Point]]:
    return list(zip(points[::2], points[1::2], strict=True))


@dataclass
class _Way:
    """Parallel lanes, each flown from the nearer end, and the progress along them."""

    lanes: list[tuple[Point, Point]]
    across: list[tuple[Point, Point]] = field(default_factory=list)  # after the last lane, from the nearer side
    number: int = 0
    step: int = 1
    along: bool = False  # whether it flies along the lane, not to its start

    @property
    def lane(self) -> tuple[Point, Point]:
        return self.lanes[self.number]

    @property
    def goal(self) -> Point:
        return self.lane[1 if self.along else 0]

    def go_on(self, is_open: Callable[[Point, Point], bool]) -> None:
        """Advance after a way-point was reached."""
        if self.along:
            self.turn(is_open, self.goal)
        else:
            self.along = True

    def turn(self, is_open: Callable[[Point, Point], bool], position: Point) -> None:
        """Select the next open lane, in the order there, back or across; without an open one, the next lane.

        The last one is flown back at once, where there are none across.
        """
        first: _Way | None = None
        for _ in range(2 * (len(self.lanes) + len(self.across))):
            self._step(position)
            first = first or replace(self)
            if is_open(*self.lane):
                break
        else:
            assert first is not None  # noqa: S101
            self.lanes, self.across, self.number, self.step = first.lanes, first.across, first.number, first.step
        near, far = sorted(self.lane, key=lambda end: math.dist(position, end))
        self.lanes[self.number] = near, far
        self.along = math.dist(position, near) == 0.0

    def _step(self, position: Point) -> None:
        if 0 <= self.number + self.step < len(self.lanes):
            self.number += self.step
        elif self.across:
            self.lanes, self.across = self.across, self.lanes
            self.number, self.step = 0, 1
            if _away(self.lanes[-1], position) < _away(self.lanes[0], position):
                self.number, self.step = len(self.lanes) - 1, -1
        else:
            self.step = -self.step


def _away(lane: tuple[Point, Point], position: Point) -> float:
    """Distance of the nearer end of a lane, m."""
    return min(math.dist(position, end) for end in lane)


AHEAD_S = 1.0  # look-ahead time along a lane
PROGRESS_M = 1.0  # a smaller approach to the way-point is no progress


class LaneFollower:
    """Velocities along the lanes of a comb, at ``speed`` m/s, with an ``acceleration``, m/s2, that the vehicle can do for sure.

    A way-point is given up after ``stuck_s`` without progress. ``goal``, m, world: the present one; None: not begun, or paused.
    """

    def __init__(self, comb: Comb, *, speed: float, acceleration: float, stuck_s: float) -> None:
        self.comb, self.speed, self.acceleration = comb, speed, acceleration
        self.goal: Point | None = None
        self._stuck_ns = seconds_to_ns(stuck_s)
        self._progress_m = min(PROGRESS_M, 0.25 * speed * stuck_s)
        self._nearest_m, self._since_ns = math.inf, 0  # least distance so far, in steps of progress, and its time

    def pause(self) -> None:
        """Suspend the check of progress while another algorithm commands the vehicle."""
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
