"""Dead reckoning: extrapolation of a vehicle's state."""

import cmath
import math

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.frames import product, quaternion_from_yaw
from vcmvsp.cosim.types import ORIGIN, Vec3, VehicleState

LONGEST_NS = SECOND_NS // 2
"""Longest extrapolation; the vehicle stands after it."""


def ahead(state: VehicleState, time_ns: int, *, flies: bool) -> VehicleState:
    """State after ``time_ns`` (may be negative) at constant speed and yaw rate; at rest beyond `LONGEST_NS`.

    On the ground the velocity turns with the body, in the air it does not.
    """
    seconds = max(-LONGEST_NS, min(time_ns, LONGEST_NS)) / SECOND_NS
    (x, y, z), (vx, vy, vz), turn = state.position, state.velocity, state.angular_velocity[2] * seconds
    chord = 1.0 if flies else cmath.rect(1.0, 0.5 * turn)
    mean_velocity = complex(vx, vy) * chord
    velocity = mean_velocity * chord
    linear, angular = (velocity.real, velocity.imag, vz), state.angular_velocity
    if abs(time_ns) > LONGEST_NS:
        linear = angular = ORIGIN
    return VehicleState(
        position=(x + mean_velocity.real * seconds, y + mean_velocity.imag * seconds, z + vz * seconds),
        velocity=linear,
        attitude=product(quaternion_from_yaw(turn), state.attitude),
        angular_velocity=angular,
    )


def planar(pose: Vec3, v: float, w: float, height_m: float) -> VehicleState:
    """State of a robot on the ground from its planar pose and speeds."""
    x, y, yaw = pose
    return VehicleState(
        position=(x, y, height_m),
        velocity=(v * math.cos(yaw), v * math.sin(yaw), 0.0),
        attitude=quaternion_from_yaw(yaw),
        angular_velocity=(0.0, 0.0, w),
    )
