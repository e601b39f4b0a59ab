"""Two levels of avoidance by distance, and the speed limit of the second.

Level 1 begins where a method first considers obstacles, level 2 where a vehicle must brake for them: from there on its
approach speed is at most proportional to the remaining distance. Along one beam the distance then decays to ``keep_m``, and a
vehicle whose speed lags by tau does not overshoot, if ``approach`` <= 1/(4 tau).
"""

import math

import numpy as np

from vcmvsp.agents.avoidance.method import Point
from vcmvsp.agents.avoidance.settings import Settings
from vcmvsp.agents.avoidance.view import View
from vcmvsp.cosim.agent import Body
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.types import Array

SPARE_M = 0.03  # it comes to rest so much before it is as near as it may be
AROUND_M = 0.3  # beyond the distance to keep: latest begin of level 2
RELEASE_M, RELEASE_S = 0.15, 0.5  # so much further away, and for so long, before level 2 ends
BESIDE_M = 0.05  # on wheels: what passes the body at so much does not count
REVERSE = 0.1  # m/s: on wheels, the fastest way back at level 2
EXACT = 1e-9  # m/s, of limits
ROUNDS = 64  # of the search for the nearest velocity, which takes a handful


class ObstacleLevels:
    """How near things are to a vehicle: 0, 1 or 2, updated once a tick.

    Attributes:
        level: at the last tick.
        keep_m: what it keeps away from everything, m from its reference point.
    """

    def __init__(self, settings: Settings, body: Body, latency_s: float = 0.0) -> None:
        self.level, self.keep_m = 0, settings.kept_m(body)
        self._settings, self._latency_s, self._flies = settings, latency_s, body.flies
        self._lane_m = min(self.keep_m, 0.5 * body.width_m + BESIDE_M)  # half of it
        self._clear_ns: int | None = None  # since when it is far enough from everything to leave level 2

    def update(self, now_ns: int, nearest_m: float, speed: float) -> int:
        """The level, where the nearest thing is ``nearest_m`` away, m, of one that moves or is to move at ``speed``, m/s."""
        if self._is_second(now_ns, nearest_m, speed):
            self.level = 2
        else:
            self.level = int(nearest_m < self._settings.reach_m)
        return self.level

    def limited(self, view: View, velocity: Point) -> Point:
        """The velocity that is left of one, m/s, body frame: all of it below level 2."""
        if self.level < 2:
            return velocity
        if self._flies:
            return limited_flight(velocity, view, self.keep_m, self._settings.approach)
        return limited_drive(velocity[0], view, self.keep_m, self._lane_m, self._settings.approach), 0.0

    def _is_second(self, now_ns: int, nearest_m: float, speed: float) -> bool:
        if self._settings.level < 2:
            return False
        begins_m = second_m(speed, self.keep_m, self._settings.braking, self._latency_s)
        if nearest_m < begins_m:
            self._clear_ns = None
            return True
        if self.level < 2:
            return False
        if nearest_m <= begins_m + RELEASE_M:
            self._clear_ns = None
        elif self._clear_ns is None:
            self._clear_ns = now_ns
        return self._clear_ns is None or now_ns - self._clear_ns < seconds_to_ns(RELEASE_S)


def second_m(speed: float, keep_m: float, braking: float, latency_s: float = 0.0) -> float:
    """Distance at which level 2 begins, m: the distance to keep plus 0.3 m, or the stopping distance if that is longer."""
    return keep_m + max(AROUND_M, speed * latency_s + speed * speed / (2.0 * braking))


def limited_flight(velocity: Point, view: View, keep_m: float, approach: float) -> Point:
    """The velocity nearest to the given one that comes towards no return too fast; both in m/s, body frame.

    Beam i with a return D_i allows ``v . u_i <= approach max(0, D_i - keep_m - 0.03)``. What all beams allow is convex and
    holds 0; so the nearest point of it is never longer than the given velocity and never against it, and motion along a wall
    goes on. Found by adding the beam that is violated most to the one or two that hold, until none is violated; each time the
    nearest point gets further from the given velocity, so that it ends (the dual method of Goldfarb and Idnani, A numerically
    stable dual method for solving strictly convex quadratic programs, Mathematical Programming 27, 1983, in two dimensions).
    """
    finite = np.isfinite(view.ranges)
    if not finite.any() or not math.isfinite(velocity[0] + velocity[1]):
        return velocity
    units, most = view.units[finite], approach * np.maximum(view.ranges[finite] - keep_m - SPARE_M, 0.0)
    allowed = velocity
    holding: list[int] = []
    for _ in range(ROUNDS):
        excess = units @ allowed - most
        worst = int(excess.argmax())
        if excess[worst] <= EXACT:
            return allowed
        if worst in holding:
            break
        allowed, holding = _nearest(velocity, units, most, [*holding, worst])
    towards = units @ allowed  # rounding is left over
    share = float(np.min(most / np.maximum(towards, EXACT), initial=1.0, where=towards > most))
    return allowed[0] * share, allowed[1] * share


def _nearest(velocity: Point, units: Array, most: Array, beams: list[int]) -> tuple[Point, list[int]]:
    """The velocity nearest to the given one that all beams allow, and the at most three beams that limit it."""
    limits = [(*units[i].tolist(), float(most[i])) for i in beams]
    x, y = velocity
    tried: list[tuple[Point, list[int]]] = [((0.0, 0.0), beams[-1:])]
    for (a, b, m), beam in zip(limits, beams, strict=True):
        over = a * x + b * y - m
        if over > 0.0:
            tried.append(((x - over * a, y - over * b), [beam]))
        for (c, d, n), other in zip(limits, beams, strict=True):
            cross = a * d - b * c
            if beam < other and abs(cross) > EXACT:
                tried.append((((m * d - n * b) / cross, (n * a - m * c) / cross), [beam, other]))
    fit = [each for each in tried if all(a * each[0][0] + b * each[0][1] <= m + EXACT for a, b, m in limits)]
    return min(fit, key=lambda each: math.dist(each[0], velocity))


def limited_drive(v: float, view: View, keep_m: float, lane_m: float, approach: float) -> float:
    """The speed that is left of ``v``, m/s, for a vehicle on wheels; it never changes its sign.

    It cannot move sideways: what counts lies less than ``lane_m`` beside the line straight ahead (behind, where v is negative),
    and the way that is left is that until a disc of radius ``keep_m``, no smaller, touches it. So walls beside it do not count.
    """
    if v == 0.0:
        return v
    sign = math.copysign(1.0, v)
    left_m = _left_m(view, keep_m, lane_m, sign)
    fastest = min(abs(v), approach * max(0.0, left_m - SPARE_M))
    return sign * (min(fastest, REVERSE) if v < 0.0 else fastest)


def _left_m(view: View, keep_m: float, lane_m: float, sign: float) -> float:
    """Distance that a disc can move along x, m, ahead (sign 1) or back (-1), to a return; negative: it touches one already."""
    ranges, ahead = view.ranges, sign * view.units[:, 0]
    finite = np.isfinite(ranges) & (ahead > EXACT)
    along, aside = ranges[finite] * ahead[finite], ranges[finite] * view.units[finite, 1]
    inside = np.abs(aside) < lane_m
    left = along[inside] - np.sqrt(keep_m**2 - aside[inside] ** 2)
    return float(left.min(initial=math.inf))
