"""Samples of ROS 2 odometry: pose from the start pose or in the world, time of measurement by this clock."""

from typing import Literal

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.estimation.clock_offset import ForeignClock
from vcmvsp.cosim.frames import Quaternion, product, quaternion_from_yaw, rotate2, wrap, yaw_of
from vcmvsp.cosim.types import Odometry, Vec3, VehicleState
from vcmvsp.hardware.drivers.base import Sample
from vcmvsp.hardware.drivers.ros2.cdr_messages import STAMPS_END_NS, OdometryMessage

Pose = Literal["odometry", "world"]
DRIFT_PPM = 500.0  # maximum drift: the largest slew of NTP
JUMP_S = 0.2  # smaller jumps of the clock make odometry seem older for a while
LEAP_S = 1.0  # longest step of the pose: greatest speed times (time since the last message + this)


class Ros2Sampler:
    """Converts odometry messages to samples, over reconnections.

    Args:
        start: start pose, for ``pose`` "odometry".
        pose: "odometry": any frame, only differences count; "world": the world, moved by ``origin``.
        origin: x m, y m, yaw rad of the frame of odometry in the world, for ``pose`` "world".
        max_speed: m/s; larger steps of odometry are ignored.

    Attributes:
        leaps: number of ignored steps.
    """

    def __init__(self, start: Vec3, pose: Pose, origin: Vec3, max_speed: float) -> None:
        self.leaps = 0
        self._clock = _clock()
        self._kind, self._origin, self._max_speed = pose, origin, max_speed
        self._number = self._link = 0
        self._pose = start
        self._base: Vec3 | None = None  # x m, y m, yaw rad of the last message
        self._arrived_ns = 0

    def connect(self, *, anew: bool) -> None:
        """A connection begins; ``anew``: perhaps another node, with another start and another clock."""
        self._link += 1
        if anew:
            self._base = None
            self._clock = _clock()

    def add(self, message: OdometryMessage, arrived_ns: int, stopped: str) -> Sample:
        """Sample of a message."""
        measured_ns = self._clock.heard(message.stamp_ns, arrived_ns) if message.stamp_ns else arrived_ns
        state = self._state(message) if self._kind == "world" else None
        if state is None:
            self._move(message, arrived_ns)
            pose = self._pose
        else:
            pose = (state.position[0], state.position[1], state.yaw)
        self._arrived_ns = arrived_ns
        self._number += 1
        return Sample(
            number=self._number,
            link=self._link,
            arrived_ns=arrived_ns,
            measured_ns=measured_ns,
            odometry=Odometry(pose=pose, v=message.linear[0], w=message.angular[2]),
            state=state,
            stopped=stopped,
        )

    def stamp_ns(self, now_ns: int) -> int:
        """Present time of the robot's clock; 0: unknown."""
        offset_ns = self._clock.offset_ns(now_ns)
        return 0 if offset_ns is None or not 0 <= now_ns - offset_ns < STAMPS_END_NS else now_ns - offset_ns

    def _move(self, message: OdometryMessage, arrived_ns: int) -> None:
        """Add the difference of two messages to the pose, rotated to its heading."""
        new = (message.position[0], message.position[1], yaw_of(message.attitude))
        last, self._base = self._base, new
        if last is None:
            return
        dx, dy = new[0] - last[0], new[1] - last[1]
        farthest = self._max_speed * ((arrived_ns - self._arrived_ns) / SECOND_NS + LEAP_S)
        if dx * dx + dy * dy > farthest * farthest:
            self.leaps += 1
            return
        x, y, yaw = self._pose
        dx, dy = rotate2(dx, dy, yaw - last[2])
        self._pose = (x + dx, y + dy, yaw + wrap(new[2] - last[2]))

    def _state(self, message: OdometryMessage) -> VehicleState:
        """State in the world; the velocity of odometry is in the body's frame."""
        x, y, yaw = self._origin
        dx, dy = rotate2(message.position[0], message.position[1], yaw)
        attitude = product(quaternion_from_yaw(yaw), message.attitude)
        return VehicleState(
            position=(x + dx, y + dy, message.position[2]),
            velocity=_rotated(attitude, message.linear),
            attitude=attitude,
            angular_velocity=message.angular,
        )


def _clock() -> ForeignClock:
    return ForeignClock(drift_ppm=DRIFT_PPM, jump_s=JUMP_S)


def _rotated(attitude: Quaternion, vector: Vec3) -> Vec3:
    """The vector turned by the attitude: q v q*."""
    w, x, y, z = attitude
    _, rx, ry, rz = product(product(attitude, (0.0, *vector)), (w, -x, -y, -z))
    return rx, ry, rz
