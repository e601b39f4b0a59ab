"""MAVLink set-points of a velocity."""

import math

from vcmvsp.cosim.types import Vec3, Velocity
from vcmvsp.hardware.drivers.mavlink.codec import Message, Sender, mavlink
from vcmvsp.hardware.drivers.mavlink.coordinate_frames import world_flipped

PERIOD_NS = 50_000_000  # PX4 wants more than 2 Hz, ArduPilot one in 3 s; a radio at 57600 baud is filled to a fifth
STILL: Vec3 = (0.0, 0.0, 0.0)

# POSITION_TARGET_TYPEMASK: ignore all but velocities and the yaw rate (bits 3 to 5, and 11).
VELOCITY_AND_YAW_RATE = 0b0101_1100_0111


def finite(velocity: Velocity) -> None:
    """Refuse NaN and infinity."""
    if not all(map(math.isfinite, (*velocity.linear, velocity.yaw_rate))):
        raise ValueError(f"a vehicle cannot follow {velocity.linear} m/s and {velocity.yaw_rate} rad/s: all must be finite")


def setpoint(to: Sender, time_ms: int, linear: Vec3, yaw_rate: float, *, on_ground: bool) -> Message:
    """SET_POSITION_TARGET_LOCAL_NED of a velocity, ENU (on the ground: forward, left, up), and a counter-clockwise yaw rate."""
    if on_ground:
        frame, (vx, vy, vz) = mavlink.MAV_FRAME_BODY_NED, (linear[0], 0.0, 0.0)
    else:
        frame, (vx, vy, vz) = mavlink.MAV_FRAME_LOCAL_NED, world_flipped(linear)
    return mavlink.MAVLink_set_position_target_local_ned_message(
        time_ms & 0xFFFFFFFF,
        to.system,
        to.component,
        frame,
        VELOCITY_AND_YAW_RATE,
        *(0.0, 0.0, 0.0),  # position
        *(vx, vy, vz),
        *(0.0, 0.0, 0.0),  # acceleration
        0.0,  # yaw
        -yaw_rate,
    )
