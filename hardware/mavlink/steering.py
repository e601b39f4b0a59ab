"""Which velocity set-points go out and when: 20 times a second, zero when nobody commands, a stop at once.

No clock and no line of its own.
"""

import math

from cosim.clock import seconds_to_ns
from cosim.types import Vec3, Velocity
from hardware.mavlink.codec import Message, Sender, mavlink
from hardware.mavlink.frames import world_flipped

PERIOD_NS = 50_000_000  # PX4 wants more than 2 Hz, ArduPilot one in 3 s; a radio at 57600 baud is filled to a fifth
NOT_YET = "no command yet"
STILL: Vec3 = (0.0, 0.0, 0.0)

# POSITION_TARGET_TYPEMASK: what is to be ignored. Velocities and the yaw rate (bits 3 to 5, and 11) are not.
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


class Steering:
    """The newest command, and when it goes out.

    Attributes:
        stopped: why the vehicle is held at zero speed; empty: it follows the commands.
    """

    def __init__(self, timeout_s: float) -> None:
        self.stopped = NOT_YET
        self._timeout_s, self._timeout_ns = timeout_s, seconds_to_ns(timeout_s)
        self._linear, self._yaw_rate = STILL, 0.0
        self._given_ns = self._next_ns = 0

    def command(self, linear: Vec3, yaw_rate: float, now_ns: int) -> None:
        """Move like this until the next command."""
        self.stopped = ""
        self._linear, self._yaw_rate, self._given_ns = linear, yaw_rate, now_ns

    def stop(self, cause: str) -> None:
        """Zero speed at once, ahead of the next set-point."""
        self.stopped = cause
        self._linear, self._yaw_rate = STILL, 0.0
        self._next_ns = 0

    def advance(self, now_ns: int) -> tuple[Vec3, float] | None:
        """The set-point to send at this time, if one is due."""
        if not self.stopped and now_ns >= self._given_ns + self._timeout_ns:
            self.stop(f"no command for {self._timeout_s:g} s")
        if now_ns < self._next_ns:
            return None
        late = now_ns - self._next_ns
        self._next_ns = now_ns + PERIOD_NS - (late if late < PERIOD_NS else 0)
        return self._linear, self._yaw_rate

    @property
    def due_ns(self) -> int:
        """When `advance` has something to do."""
        return self._next_ns if self.stopped else min(self._next_ns, self._given_ns + self._timeout_ns)
