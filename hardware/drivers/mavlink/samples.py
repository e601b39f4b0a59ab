"""Samples of MAVLink telemetry: state in the ENU world, odometry from the start pose, time of measurement."""

import math

from vcmvsp.cosim.estimation.clock_offset import ForeignClock
from vcmvsp.cosim.estimation.tangent_plane import TangentPlane
from vcmvsp.cosim.frames import rotate2, wrap
from vcmvsp.cosim.types import Odometry, Vec3, VehicleState
from vcmvsp.hardware.drivers.base import Sample
from vcmvsp.hardware.drivers.mavlink.codec import Message
from vcmvsp.hardware.drivers.mavlink.coordinate_frames import attitude_from_euler, body_flipped, world_flipped

ATTITUDE_NS = 500_000_000  # older attitudes are useless
MS = 1_000_000  # ns


class MavlinkSampler:
    """Converts telemetry to samples, over reconnections.

    Args:
        start: start pose in the run (x m, y m, yaw rad), where odometry begins.
        origin: of the autopilot's local frame in the world, m; or of ``plane``.
        plane: for global positions; None: positions are local.
    """

    def __init__(self, start: Vec3, origin: Vec3, plane: TangentPlane | None) -> None:
        self.position_message = "LOCAL_POSITION_NED" if plane is None else "GLOBAL_POSITION_INT"
        self.battery_v: float | None = None
        self.state: VehicleState | None = None  # the newest
        self._start, self._origin, self._plane = start, origin, plane
        self._number = self._link = 0
        self._clock = ForeignClock()
        self._attitude: Message | None = None
        self._attitude_ns = 0
        self._base: Vec3 | None = None  # pose at the first sample

    def connect(self) -> None:
        """A connection begins."""
        self._link += 1
        self._attitude, self.state = None, None
        self._clock = ForeignClock()  # stamps count from power-up, which may be recent

    def attitude(self, message: Message, now_ns: int) -> None:
        """An ATTITUDE has arrived."""
        fields = (message.roll, message.pitch, message.yaw, message.rollspeed, message.pitchspeed, message.yawspeed)
        if all(map(math.isfinite, fields)):
            self._attitude, self._attitude_ns = message, now_ns

    def position(self, message: Message, now_ns: int) -> bool:
        """Take a position; whether it completes a state."""
        if self._attitude is None or now_ns - self._attitude_ns > ATTITUDE_NS:
            return False
        place = self._local(message) if self._plane is None else self._global(message, self._plane)
        if place is None:
            return False
        (x, y, z), velocity = place
        turn = self._attitude
        self.state = VehicleState(
            position=(self._origin[0] + x, self._origin[1] + y, self._origin[2] + z),
            velocity=velocity,
            attitude=attitude_from_euler(turn.roll, turn.pitch, turn.yaw),
            angular_velocity=body_flipped((turn.rollspeed, turn.pitchspeed, turn.yawspeed)),
        )
        self._measured_ns, self._arrived_ns = self._clock.heard(message.time_boot_ms * MS, now_ns), now_ns
        self._number += 1
        return True

    def sample(self, *, motors: bool, terminated: bool, stopped: str) -> Sample:
        """Newest sample; only after `position` returned True."""
        assert self.state is not None  # noqa: S101  see above
        return Sample(
            number=self._number,
            link=self._link,
            arrived_ns=self._arrived_ns,
            measured_ns=self._measured_ns,
            odometry=self._odometry(self.state),
            state=self.state,
            battery_v=self.battery_v,
            motors=motors,
            emergency_stop=terminated,
            stopped=stopped,
        )

    def status(self, message: Message) -> None:
        """A SYS_STATUS has arrived."""
        self.battery_v = None if message.voltage_battery in (0, 0xFFFF) else 1e-3 * message.voltage_battery

    def _odometry(self, state: VehicleState) -> Odometry:
        """Motion since the first sample, from the start pose."""
        pose = (state.position[0], state.position[1], state.yaw)
        base = self._base = self._base or pose
        dx, dy = rotate2(pose[0] - base[0], pose[1] - base[1], self._start[2] - base[2])
        there = (self._start[0] + dx, self._start[1] + dy, self._start[2] + wrap(pose[2] - base[2]))
        forward, _ = rotate2(state.velocity[0], state.velocity[1], -pose[2])
        return Odometry(pose=there, v=forward, w=state.angular_velocity[2])

    @staticmethod
    def _local(message: Message) -> tuple[Vec3, Vec3] | None:
        position, velocity = (message.x, message.y, message.z), (message.vx, message.vy, message.vz)
        if not all(map(math.isfinite, position + velocity)):
            return None
        return world_flipped(position), world_flipped(velocity)

    @staticmethod
    def _global(message: Message, plane: TangentPlane) -> tuple[Vec3, Vec3] | None:
        """Position in 1e-7 degrees and mm above sea level, velocity in cm/s. Latitude and longitude 0 mean no position."""
        latitude, longitude = 1e-7 * message.lat, 1e-7 * message.lon
        if (message.lat == 0 and message.lon == 0) or not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
            return None
        return plane.enu(latitude, longitude, 1e-3 * message.alt), world_flipped(
            (1e-2 * message.vx, 1e-2 * message.vy, 1e-2 * message.vz)
        )
