"""How fast a robot may be told to move and to turn, and how fast that may change."""

import math

import msgspec

from vcmvsp.cosim.types import Positive


class Limits(msgspec.Struct, frozen=True, kw_only=True):
    """Limits of a robot with two driven wheels; the same forwards and backwards, to the left and to the right.

    The stop decelerations are what the robot is sure to reach on its floor, not what it can reach at best: braking distances
    are reckoned with them. They also limit how fast a command may slow down. There is no gentler limit for that: nobody
    should be kept from slowing down.
    """

    speed_mps: Positive
    yaw_rate_radps: Positive
    accel_mps2: Positive
    stop_mps2: Positive
    yaw_accel_radps2: Positive
    yaw_stop_radps2: Positive


def clamp(v: float, w: float, last: tuple[float, float], dt: float, limits: Limits) -> tuple[float, float]:
    """The nearest command to (v m/s, w rad/s) that keeps the limits, ``dt`` s after the command ``last`` was given.

    What is not finite is a stop. A robot stands before it drives the other way.
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
    """The command ``dt`` s after ``last`` of a robot that stops as fast as it can."""
    return clamp(0.0, 0.0, last, dt, limits)


def _ramp(target: float, last: float, up: float, down: float) -> float:
    """The nearest value to the target that can be reached: ``up`` away from zero, ``down`` towards it."""
    if last < 0.0:
        return -_ramp(-target, -last, up, down)
    # Where slowing down takes only a part of the time, the other way is gained speed in what is left of it.
    least = last - down if last >= down else -up * (1.0 - last / down)
    return max(least, min(last + up, target)) if down > 0.0 else last
