"""Limits of speeds and accelerations of a robot."""

import math

import msgspec

from vcmvsp.cosim.types import Positive


class Limits(msgspec.Struct, frozen=True, kw_only=True):
    """Limits of a robot with two driven wheels; symmetric in both directions of motion and of rotation.

    The stop decelerations are guaranteed on the robot's floor, not its best ones: braking distances depend on them. They also
    limit how fast a command may slow down; there is no lower limit for braking.
    """

    speed_mps: Positive
    yaw_rate_radps: Positive
    accel_mps2: Positive
    stop_mps2: Positive
    yaw_accel_radps2: Positive
    yaw_stop_radps2: Positive


def clamp(v: float, w: float, last: tuple[float, float], dt: float, limits: Limits) -> tuple[float, float]:
    """Command within the limits nearest to (v m/s, w rad/s), ``dt`` s after the command ``last``.

    A command that is not finite is a stop. A robot stops before it reverses.
    """
    if not (math.isfinite(v) and math.isfinite(w)):
        v, w = 0.0, 0.0
    last_v, last_w = last
    v = max(-limits.speed_mps, min(limits.speed_mps, v))
    w = max(-limits.yaw_rate_radps, min(limits.yaw_rate_radps, w))
    if v * last_v < 0.0:
        v = 0.0
    return (
        _ramp(v, last_v, limits.accel_mps2 * dt, limits.stop_mps2 * dt),
        _ramp(w, last_w, limits.yaw_accel_radps2 * dt, limits.yaw_stop_radps2 * dt),
    )


def slowest(last: tuple[float, float], dt: float, limits: Limits) -> tuple[float, float]:
    """Command ``dt`` s after ``last`` of a robot that brakes at its limits."""
    return clamp(0.0, 0.0, last, dt, limits)


def _ramp(target: float, last: float, up: float, down: float) -> float:
    """Value nearest to the target that can be reached: ``up`` away from zero, ``down`` towards it."""
    if last < 0.0:
        return -_ramp(-target, -last, up, down)
    # If slowing down takes a part of the time, the rest accelerates in the other direction.
    least = last - down if last >= down else -up * (1.0 - last / down)
    return max(least, min(last + up, target)) if down > 0.0 else last
