"""VFH+: the cheapest direction among the openings of a polar histogram of obstacles.

I. Ulrich, J. Borenstein, VFH+: reliable obstacle avoidance for fast mobile robots, IEEE ICRA 1998, directly on a scan. There is
no grid: each return is certain, and the nearest one in a sector counts, not a sum: the number of beams has no effect. A
threshold of the magnitude ``a - b d^2`` is then a distance, which is how it is set here.
"""

import math
from collections.abc import Iterator
from functools import lru_cache
from typing import Annotated

import msgspec
import numpy as np

from vcmvsp.agents.avoidance.method import Decision, Method, Settings, Task
from vcmvsp.agents.avoidance.view import Point, View, half_angles, wrapped
from vcmvsp.cosim.agent import Body
from vcmvsp.cosim.frames import rotate2, wrap
from vcmvsp.cosim.types import Array, NonNegative, Positive, frozen

Angle = Annotated[float, msgspec.Meta(gt=0, le=360)]

CATCH_UP = 0.8  # 1/s: in the air, greatest speed towards a followed place per remaining distance
LEAST_M = 1e-3  # a nearer aim has no bearing


class Vfh(Settings, frozen=True, kw_only=True, tag="vfh"):
    """VFH+ (Ulrich, Borenstein 1998): a polar histogram, its openings, and the cheapest direction into one of them.

    The task is unchanged while its direction is the cheapest: towards its aim, or straight ahead without one; in the air along
    its velocity. On wheels, a direction must be reachable on circles of the present speed and the greatest yaw rate, and the
    vehicle must not head for a near obstacle. Directions outside the field of view are excluded; an aim there counts as being
    at its border. Obstacles beyond the aim do not count. For a follower, whose aim moves, that limit is larger by the distance
    at which vehicles slow down near obstacles. A hovering vehicle continues to hover. Without a free direction the vehicle
    turns on the spot.
    """

    REACH = "freed_m"

    sectors: Annotated[int, msgspec.Meta(ge=8, le=720)] = 72  # of the histogram, around a full turn: 5 degrees each
    blocked_m: Positive = 1.2  # a sector with an obstacle nearer than this is blocked (high threshold)
    freed_m: Positive = 1.4  # and is free again when nothing in it is nearer than that (the low threshold)
    wide_deg: Angle = 80.0  # from half of that beside an obstacle on, openings are entered anywhere; narrower: in the middle
    target_weight: NonNegative = 5.0  # of a direction's angle to where the task goes
    heading_weight: NonNegative = 2.0  # to where the vehicle heads; in the air to the direction chosen before
    previous_weight: NonNegative = 2.0  # to the direction chosen before
    gain: Positive = 1.5  # 1/s, rate of turning per angle left to the direction
    max_yaw_rate: Positive = 1.2  # rad/s; at it, a vehicle on wheels no longer drives ahead
    turn_rate: Positive = 0.6  # rad/s, where no direction is free

    def method(self, body: Body, period_s: float) -> Method:
        """Method of this kind for a vehicle on wheels or in the air; `ValueError`: the distances contradict each other."""
        keep = self.clearance_m(body)
        if self.freed_m < self.blocked_m:
            raise ValueError(f"freed_m = {self.freed_m:g} must not be less than blocked_m = {self.blocked_m:g}")
        if keep >= self.blocked_m:
            raise ValueError(f"blocked_m = {self.blocked_m:g} must exceed the distance kept from obstacles, {keep:g} m")
        return _Vfh(self, keep, period_s, flies=body.flies)


def histogram(view: View, keep: float, sectors: int, within: float = math.inf) -> Array:
    """Distance of the nearest return in each direction, (sectors,) m; inf: none.

    Sector k points ``k / sectors`` of a turn to the left. A return at the distance d and the bearing b counts in all directions
    within ``asin(keep / d)`` of b, a quarter turn if d is less than ``keep``: a disc of that radius would touch it there.
    Returns beyond ``within`` metres do not count.
    """
    near = np.flatnonzero(view.ranges < within)
    if not len(near):
        return np.full(sectors, math.inf)
    ranges = view.ranges[near]
    half = half_angles(ranges, keep)
    apart = _apart(len(view.ranges), float(view.bearings[0]), view.step, sectors)
    if len(near) < len(view.ranges):
        apart = apart[near]
    return np.where(apart <= half[:, None], ranges[:, None], math.inf).min(axis=0)


def openings(free: Array) -> Iterator[tuple[int, int]]:
    """First sector (the right-most) and number of sectors of each run of free ones, around the turn."""
    if free.all():
        yield 0, len(free)
        return
    begins, ends = (np.flatnonzero(free & ~np.roll(free, by)).tolist() for by in (1, -1))
    if begins and ends[0] < begins[0]:
        ends = [*ends[1:], ends[0] + len(free)]
    for begin, end in zip(begins, ends, strict=True):
        yield begin, end - begin + 1


class _Vfh:
    """State of one vehicle: blocked sectors, former direction and speed, and direction of a turn on the spot."""

    def __init__(self, settings: Vfh, keep: float, period_s: float, *, flies: bool) -> None:
        self._set, self._keep, self._period_s, self._flies = settings, keep, period_s, flies
        self._angle = math.tau / settings.sectors
        self._blocked: Array = np.zeros(settings.sectors, dtype=bool)
        self._turned = 0.0  # rad, since the sectors were last turned
        self._previous = 0.0  # rad
        self._cruise = 0.0  # m/s, of the task, when it last had a speed
        self._side = 0

    def decide(self, view: View, task: Task) -> Decision:
        self._remember(task.now[1] * self._period_s)
        decision = self._decided(view, task, self._update(view, task))
        if decision.mode != "turn":
            self._side = 0
        return decision

    def _remember(self, turned: float) -> None:
        """Rotate the remembered sectors by the commanded turn, rad."""
        self._previous = wrap(self._previous - turned)
        self._turned += turned
        steps = round(self._turned / self._angle)
        if steps:
            self._turned -= steps * self._angle
            self._blocked = np.roll(self._blocked, -steps)

    def _update(self, view: View, task: Task) -> Array:
        """Update the histogram; blocked sectors have hysteresis."""
        within = self._set.freed_m
        if task.aim is not None:  # obstacles behind a destination do not matter; a place in a formation moves on
            moving_m = math.hypot(*task.velocity) / self._set.approach if task.leader is not None else 0.0
            within = min(within, math.hypot(*task.aim) + moving_m + self._keep)
        near = histogram(view, self._keep, self._set.sectors, within)
        self._blocked = (near < self._set.blocked_m) | (self._blocked & (near < self._set.freed_m))
        return near

    def _decided(self, view: View, task: Task, near: Array) -> Decision:
        v = math.hypot(*task.velocity)
        stands, reverses = not v and (self._flies or not task.yaw_rate), not self._flies and task.velocity[0] < 0.0
        if stands or reverses:
            return Decision(task.velocity, task.yaw_rate, "task")
        if v:
            self._cruise = v
        visible = _covered_sectors(len(view.ranges), float(view.bearings[0]), view.step, self._set.sectors, cyclic=view.cyclic)
        free, target = visible & ~self._blocked, self._target(task)
        if free.sum() == visible.sum():  # also with the aim out of view
            self._previous = target
            return Decision(task.velocity, task.yaw_rate, "task")
        radius = 0.0 if self._flies else max(0.0, task.now[0]) / self._set.max_yaw_rate
        way = self._way(free & self._turnable(view, radius), visible, target)
        if way is None:
            return self._turning(view, self._way(free, visible, target) if radius else None, task)
        self._previous, to_target = way
        if to_target and (self._flies or not v or not self._blocked[0]):
            return Decision(task.velocity, task.yaw_rate, "task")
        speed = task.max_speed if task.leader is not None else min(task.max_speed, self._cruise)
        if self._flies:
            catch_up = v if task.aim is None else max(v, CATCH_UP * math.hypot(*task.aim))
            return Decision(rotate2(min(speed, catch_up), 0.0, way[0]), task.yaw_rate, "avoid")
        return Decision((speed * self._slowed(float(near[0]), way[0]), 0.0), self._rate(way[0]), "avoid")

    def _target(self, task: Task) -> float:
        """Direction of the task, rad: in the air of its velocity, on wheels of its aim, or straight ahead."""
        place: Point | None = task.velocity if self._flies else task.aim or task.leader
        return 0.0 if place is None or math.hypot(*place) < LEAST_M else math.atan2(place[1], place[0])

    def _turnable(self, view: View, radius: float) -> Array:
        """The directions, (sectors,), that are reached on circles of this radius without touching anything on that side.

        A return on the right at the bearing b blocks all directions further right than b if the disc of the vehicle would
        touch it on the circle to the right (the masked histogram of the paper).
        """
        if radius <= 0.0:
            return np.ones(self._set.sectors, dtype=bool)
        close = view.ranges < min(self._set.freed_m, 2.0 * radius + self._keep)  # none further can be touched
        x, y = (view.units[close] * view.ranges[close, None]).T
        bearings = wrapped(view.bearings[close])
        left = bearings[(bearings >= 0.0) & (np.hypot(x, y - radius) < radius + self._keep)]
        right = bearings[(bearings <= 0.0) & (np.hypot(x, y + radius) < radius + self._keep)]
        directions = _directions(self._set.sectors)
        return (directions <= left.min(initial=math.pi)) & (directions >= right.max(initial=-math.pi))

    def _way(self, free: Array, visible: Array, target: float) -> tuple[float, bool] | None:
        """The cheapest direction, rad, and whether the task goes there; else it is an edge of an opening, clear of obstacles.

        An opening is entered half of ``wide_deg`` beside an obstacle at its edge, in its middle if there are two and it is
        narrower. The edge of what is seen is no obstacle; a target beyond it counts as being there.
        """
        choices: list[tuple[float, bool]] = []
        target = self._into_view(target, visible)
        for first, count in openings(free):
            right, width = first * self._angle, (count - 1) * self._angle
            if count == len(free):
                return target, True
            clear = min(0.5 * math.radians(self._set.wide_deg), 0.5 * width)
            low = clear if visible[first - 1] else 0.0
            high = width - (clear if visible[(first + count) % len(free)] else 0.0)
            inside = wrap(target - right - 0.5 * width) + 0.5 * width
            if low - 1e-9 <= inside <= high + 1e-9:
                choices.append((target, True))
            choices += [(wrap(right + low), False), (wrap(right + high), False)]
        # Of equals, the target, then the left-most: the order is that of the sectors.
        return min(choices, key=lambda way: (round(self._cost(way[0], target), 9), not way[1]), default=None)

    def _into_view(self, target: float, visible: Array) -> float:
        if visible[round(target / self._angle) % len(visible)]:
            return target
        directions = _directions(len(visible))
        return float(directions[np.where(visible, np.abs(wrapped(directions - target)), math.inf).argmin()])

    def _cost(self, bearing: float, target: float) -> float:
        heading = self._previous if self._flies else 0.0  # what flies heads where it flies
        return (
            self._set.target_weight * abs(wrap(bearing - target))
            + self._set.heading_weight * abs(wrap(bearing - heading))
            + self._set.previous_weight * abs(wrap(bearing - self._previous))
        )

    def _rate(self, bearing: float) -> float:
        return max(-self._set.max_yaw_rate, min(self._set.gain * bearing, self._set.max_yaw_rate))

    def _slowed(self, ahead: float, bearing: float) -> float:
        """Share of the speed: less with nearer obstacles ahead (0 at contact), and less with faster turning.

        J. Borenstein, Y. Koren, The vector field histogram, IEEE Transactions on Robotics and Automation 7 (3), 1991; without
        their least speed.
        """
        far = self._set.freed_m
        room = (min(ahead, far) ** 2 - self._keep**2) / (far**2 - self._keep**2)
        return max(0.0, room) * (1.0 - abs(self._rate(bearing)) / self._set.max_yaw_rate)

    def _turning(self, view: View, way: tuple[float, bool] | None, task: Task) -> Decision:
        """Turn on the spot: to a free direction that no arc reaches, or to one side until there is one."""
        if way is not None:
            self._previous = way[0]
            return Decision((0.0, 0.0), self._rate(way[0]), "turn")
        if not self._side and abs(target := self._target(task)) > 0.5 * math.pi:  # the target is behind
            self._side = 1 if target > 0.0 else -1
        elif not self._side:
            self._side = view.roomier_side(self._set.freed_m)
        return Decision((0.0, 0.0), self._side * self._set.turn_rate, "turn")


@lru_cache(maxsize=16)
def _directions(sectors: int) -> Array:
    """Directions of the sectors, rad in (-pi, pi]."""
    numbers = np.arange(sectors)
    return frozen(math.tau / sectors * np.where(2 * numbers > sectors, numbers - sectors, numbers))


@lru_cache(maxsize=16)
def _apart(count: int, first: float, step: float, sectors: int) -> Array:
    """Angles between beams and sectors, (count, sectors) rad."""
    return frozen(np.abs(wrapped(first + step * np.arange(count)[:, None] - _directions(sectors))))


@lru_cache(maxsize=16)
def _covered_sectors(count: int, first: float, step: float, sectors: int, *, cyclic: bool) -> Array:
    """Sectors with beams in them, (sectors,) bool."""
    middle = first + 0.5 * (count - 1) * step
    return frozen(cyclic | (np.abs(wrapped(_directions(sectors) - middle)) <= 0.5 * count * step))
