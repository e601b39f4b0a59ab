"""Motion of the emulated vehicle: its velocity follows the command with a first-order lag, within limits."""

import math

from vcmvsp.cosim.frames import quaternion_from_yaw, rotate2
from vcmvsp.cosim.types import Vec3, VehicleState, Velocity
from vcmvsp.hardware.drivers.mavlink.coordinate_frames import attitude_from_euler

LAG_S = 0.3  # of a velocity controller
YAW_LAG_S = 0.15
SPEED_MPS, CLIMB_MPS, YAW_RATE = 5.0, 2.0, 1.5  # limits
ACCEL_MPS2 = 4.0
GRAVITY = 9.80665  # m/s2


class VehicleMotion:
    """Motion without forces: a quadrotor tilts as its acceleration needs, a rover moves along its heading."""

    def __init__(self, start: VehicleState, *, on_ground: bool) -> None:
        self._position, self._yaw = start.position, start.yaw
        self._velocity: Vec3 = (0.0, 0.0, 0.0)
        self._yaw_rate = 0.0
        self._on_ground = on_ground

    def step(self, command: Velocity, dt: float, ground: float) -> VehicleState:
        """Advance by ``dt`` seconds; the height is at least ``ground``, m."""
        goal = self._in_world(command.linear)
        change = [(to - v) * min(1.0, dt / LAG_S) for to, v in zip(goal, self._velocity, strict=True)]
        size = math.hypot(*change)
        scale = min(1.0, ACCEL_MPS2 * dt / size) if size else 0.0
        ax, ay, az = (each * scale / dt for each in change)
        vx, vy, vz = (v + each * scale for v, each in zip(self._velocity, change, strict=True))
        rate = max(-YAW_RATE, min(YAW_RATE, command.yaw_rate))
        self._yaw_rate += (rate - self._yaw_rate) * min(1.0, dt / YAW_LAG_S)
        self._yaw += self._yaw_rate * dt
        x, y, z = self._position
        z += vz * dt
        if z <= ground:
            z, vz = ground, max(0.0, vz)
            if not self._on_ground:  # it stands
                vx = vy = ax = ay = 0.0
        self._position, self._velocity = (x + vx * dt, y + vy * dt, z), (vx, vy, vz)
        attitude = quaternion_from_yaw(self._yaw)
        if not self._on_ground:
            forward, leftward = rotate2(ax, ay, -self._yaw)
            lean = math.atan2(forward, GRAVITY + az)  # its z axis is along the thrust: acceleration minus gravity
            roll = -math.atan2(leftward * math.cos(lean), GRAVITY + az)
            attitude = attitude_from_euler(roll, -lean, 0.5 * math.pi - self._yaw)
        return VehicleState(
            position=self._position,
            velocity=self._velocity,
            attitude=attitude,
            angular_velocity=(0.0, 0.0, self._yaw_rate),
        )

    def _in_world(self, linear: Vec3) -> Vec3:
        """Velocity goal within the limits, in the world."""
        if self._on_ground:
            linear = (*rotate2(linear[0], 0.0, self._yaw), 0.0)
        x, y, z = linear
        speed = math.hypot(x, y)
        scale = min(1.0, SPEED_MPS / speed) if speed else 0.0
        return x * scale, y * scale, max(-CLIMB_MPS, min(CLIMB_MPS, z))
