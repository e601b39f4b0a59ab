"""Safety supervisor of a vehicle that flies and takes velocities in the three axes of the world.

The vehicle stays inside the fence, between floor and ceiling and away from others, if it brakes as specified. Assumptions: from
one command to the next its velocity goes straight to the new one, at no less than ``decel``, horizontally and vertically each,
and it brakes straight. While its horizontal velocity goes from u to v and then to zero, all headings lie between the headings
of u and v, and since the norm is convex it moves no farther than ::

    |v| hold + |v|**2 / (2 decel) + |v - u| max(0, |u| - |v|) / (2 decel)

So it stays in the sector of that radius between the two headings (`hardware.safety.obstacles`), which is kept clear;
on a line this is `hardware.safety.supervisor.swept`. A command that does not fit is reduced, never turned aside; a command that
brakes straight always fits if poses are true, for the same reason as on the ground.

**Others** are upright cylinders: the required distance is the same above and beside, ``radius + radius + separation``. To be
clear of another vehicle in one direction is enough. A vehicle that is vertically clear, and could stop before it is not,
ignores the other horizontally; its vertical speed is then limited to stay clear, unless it is horizontally clear as well.
The supervisor assumes that others may stop at any time, and it does not evade them.

A stop in the air is zero velocity: the autopilot holds its position. Motors are never switched off.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.types import VehicleState, Velocity
from vcmvsp.hardware.safety.obstacles import Floats, Obstacles, Others
from vcmvsp.hardware.safety.supervisor import (
    LATCHED,
    TOLERANCE_M,
    Cause,
    Limits,
    Pose,
    Safety,
    Supervisor,
    clamp,
    fastest,
    stops_within,
)

Plane = tuple[float, float]  # m/s, east and north

_HALVINGS = 12  # bisection steps of a horizontal velocity


class _Level(NamedTuple):
    row: int
    above: bool  # of this vehicle
    room: float  # m between the cylinders; 0 if not clear
    closing: float  # m/s, speed of approach
    clear: bool  # clear, also while braking


class AerialSupervisor(Supervisor):
    """Safety of a vehicle that flies, and is assumed to be no faster than ``last``, the newest safe command, in the world."""

    def __init__(self, safety: Safety, latched: tuple[Cause, ...] = LATCHED) -> None:
        super().__init__(safety, latched)
        heights = [each for each in (safety.floor_m, safety.ceiling_m) if each is not None]
        if not all(map(math.isfinite, heights)) or any(low >= high for low, high in pairwise(heights)):
            raise ValueError(f"floor_m must be below ceiling_m, both finite, not {safety.floor_m} and {safety.ceiling_m}")
        self._upright = msgspec.structs.replace(safety, max_speed=safety.max_climb)
        self._needs_pose = self._needs_pose or bool(heights)
        self.last = (0.0, 0.0, 0.0, 0.0)  # x, y, z m/s, yaw rad/s

    @staticmethod
    def pose(state: VehicleState) -> Pose:
        """Position x, y, z m and yaw rad."""
        return (*state.position, state.yaw)

    def _brake(self, dt: float) -> None:
        vz, w = clamp(0.0, 0.0, self.last[2:], dt, self._upright)
        self.last = (*_ramp((0.0, 0.0), self.last[:2], dt, self._safety), vz, w)

    def _velocity(self) -> Velocity:
        return Velocity(linear=self.last[:3], yaw_rate=self.last[3])

    def _make_safe(self, command: Velocity, pose: Pose | None, others: Others | None, dt: float) -> tuple[Cause, ...]:
        p, (x, y, z) = self._safety, command.linear
        target = _within(x, y, p.max_speed)
        vz, w = clamp(z, command.yaw_rate, self.last[2:], dt, self._upright)
        across = _ramp(target, self.last[:2], dt, p)
        causes = [] if (*across, vz, w) == (x, y, z, command.yaw_rate) else [Cause.LIMITS]
        if pose is not None:
            obstacles: list[tuple[Cause, Obstacles]] = []
            if self._fence is not None:
                obstacles.append((Cause.GEOFENCE, self._fence.around(pose[0], pose[1], p.radius_m + p.fence_margin_m)))
            levels: list[_Level] = []
            if others is not None and len(others.position):
                levels = self._levels(pose[2], others)
                clear = [each.row for each in levels if each.clear]
                beside = np.setdiff1d(np.arange(len(others.position)), clear)
                obstacles.append((Cause.SEPARATION, self._around(pose, others, beside)))
            across, slowed = self._slow_down(target, across, dt, obstacles)
            vz, stopped = self._bounded(vz, dt, pose, across, levels, others)
            causes += dict.fromkeys((*slowed, *stopped))
        self.last = (*across, vz, w)
        return tuple(causes)

    def _blocks(self, level: _Level, across: Plane, pose: Pose, others: Others) -> bool:
        """Whether a vehicle above or below limits the vertical speed at this horizontal velocity.

        One that is clear in no way, because of rounding or a wrong pose, must not come nearer in any way.
        """
        obstacle = self._around(pose, others, np.array([level.row]))
        return obstacle.clearance <= 0.0 or (level.clear and not self._fits(across, obstacle))

    def _slow_down(
        self, target: Plane, requested: Plane, dt: float, obstacles: Sequence[tuple[Cause, Obstacles]]
    ) -> tuple[Plane, list[Cause]]:
        """Largest share of the target velocity that lets the vehicle stop in time, by bisection."""
        causes = [cause for cause, around in obstacles if not self._fits(requested, around)]
        if not causes:
            return requested, []
        sure, beyond, best = 0.0, 1.0, _ramp((0.0, 0.0), self.last[:2], dt, self._safety)
        for _ in range(_HALVINGS):
            share = 0.5 * (sure + beyond)
            trial = _ramp((share * target[0], share * target[1]), self.last[:2], dt, self._safety)
            if all(self._fits(trial, around) for _, around in obstacles):
                sure, best = share, trial
            else:
                beyond = share
        return best, causes

    def _fits(self, velocity: Plane, around: Obstacles) -> bool:
        """Whether the vehicle can stop before an obstacle after this horizontal velocity."""
        hold, decel = self._safety.reaction_s, self._safety.decel
        before = self.last[:2]
        v, u = math.hypot(*velocity), math.hypot(*before)
        if v == 0.0 and u == 0.0:
            return True
        length = v * hold + (v * v + math.dist(velocity, before) * max(0.0, u - v)) / (2.0 * decel)
        needs: Floats = length + around.closing * (hold + v / decel) - TOLERANCE_M
        if v > around.speed or needs.max(initial=0.0) <= around.clearance:
            return v <= around.speed
        return bool((needs <= around.free(*_cone(before, velocity))).all())

    def _around(self, pose: Pose, others: Others, rows: NDArray[np.intp]) -> Obstacles:
        some = Others(others.position[rows], others.velocity[rows], others.radius[rows])
        return some.around(pose[0], pose[1], self._safety.radius_m + self._safety.separation_m)

    def _levels(self, z: float, others: Others) -> list[_Level]:
        levels, vz = [], self.last[2]
        columns = others.position[:, 2].tolist(), others.velocity[:, 2].tolist(), others.radius.tolist()
        for row, (height, climbs, radius) in enumerate(zip(*columns, strict=True)):
            above = height >= z
            room = abs(height - z) - (self._safety.radius_m + radius + self._safety.separation_m)
            toward, closing = (max(0.0, vz), max(0.0, -climbs)) if above else (max(0.0, -vz), max(0.0, climbs))
            clear = room >= 0.0 and stops_within(room, toward, closing, self._safety.decel)
            levels.append(_Level(row, above, room if clear else 0.0, closing, clear))
        return levels

    def _bounded(
        self, vz: float, dt: float, pose: Pose, across: Plane, levels: Sequence[_Level], others: Others | None
    ) -> tuple[float, list[Cause]]:
        last, p = self.last[2], self._safety
        up = vz > 0.0 or last > 0.0  # the limits stop it before it reverses
        speed, causes = abs(vz), []

        def most(room: float, closing: float) -> float:
            return fastest(max(0.0, room), abs(last), closing, p.reaction_s, p.decel)

        edge = p.ceiling_m if up else p.floor_m
        if edge is not None and (fits := most(edge - pose[2] if up else pose[2] - edge, 0.0)) < speed:
            speed, causes = fits, [Cause.GEOFENCE]
        for each in levels:
            if each.above == up and (fits := most(each.room, each.closing)) < speed:
                assert others is not None  # noqa: S101  levels come from them
                if not self._blocks(each, across, pose, others):
                    continue
                speed = fits
                causes.append(Cause.SEPARATION)
        speed = max(speed, abs(clamp(0.0, 0.0, (last, 0.0), dt, self._upright)[0]))
        return speed if up else 0.0 - speed, causes


def _within(x: float, y: float, speed: float) -> Plane:
    """A velocity in this direction, no faster than ``speed``."""
    if (big := max(abs(x), abs(y))) > speed:
        x, y = x / big * speed, y / big * speed  # squares cannot overflow
    length = math.hypot(x, y)
    return (x, y) if length <= speed else (x / length * speed, y / length * speed)


def _ramp(target: Plane, last: Plane, dt: float, limits: Limits) -> Plane:
    """Velocity nearest to the target that can be reached in ``dt`` on the straight way from ``last``.

    Until its minimum it changes at the braking deceleration; from there on at the acceleration, or the deceleration if that is
    less.
    """
    dx, dy = target[0] - last[0], target[1] - last[1]
    way = math.hypot(dx, dy)
    if way == 0.0:
        return target
    slowing = min(way, max(0.0, -(last[0] * dx + last[1] * dy) / way))
    took = slowing / limits.decel
    gain = min(limits.accel, limits.decel)
    reach = limits.decel * dt if took >= dt else slowing + gain * (dt - took)
    if reach >= way:
        return target
    return last[0] + dx * (reach / way), last[1] + dy * (reach / way)


def _cone(u: Plane, v: Plane) -> tuple[float, float]:
    """Headings between two velocities, rad; if one is zero, the heading of the other."""
    if u == (0.0, 0.0):
        u = v
    if v == (0.0, 0.0):
        v = u
    start = math.atan2(u[1], u[0])
    turn = math.atan2(u[0] * v[1] - u[1] * v[0], u[0] * v[0] + u[1] * v[1])
    return min(start, start + turn), max(start, start + turn)
