"""Motion of the emulated robot: set points of its firmware, and wheels that follow within limits."""

import math

from vcmvsp.cosim.frames import arc, rotate2, wrap
from vcmvsp.hardware.drivers.arcos.command_numbers import Command
from vcmvsp.hardware.drivers.arcos.robot_parameters import Robot

Pose = tuple[float, float, float]  # x m, y m, yaw rad

_ARRIVED_M = 1e-3  # MOVE ends this near to its goal; the firmware's own margin is not published


def relative(pose: Pose, origin: Pose) -> Pose:
    """A pose relative to another."""
    x, y = rotate2(pose[0] - origin[0], pose[1] - origin[1], -origin[2])
    return x, y, wrap(pose[2] - origin[2])


class SetPoints:
    """Set points of forward speed and yaw rate, from motion commands.

    A forward command (VEL, MOVE) and a turning one (RVEL, ROTATE, HEAD, DHEAD) hold side by side; VEL2, STOP and
    ESTOP replace both.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.accel, self.decel, self.yaw_accel, self.yaw_decel = robot.accel, robot.decel, robot.yaw_accel, robot.yaw_accel
        self.max_speed, self.max_yaw_rate = robot.speed, robot.yaw_rate
        self.emergency = False  # ESTOP: stop without deceleration
        self.stop()

    def stop(self) -> None:
        """Forget all commands for motion."""
        self._v = self._w = 0.0
        self._left_m: float | None = None  # remaining distance of MOVE
        self.heading: float | None = None  # rad, goal of HEAD or DHEAD

    def take(self, number: int, value: int, heading: float) -> None:
        """Take a command; commands without motion are ignored.

        Args:
            number: of the command.
            value: its argument, in the unit of the protocol.
            heading: the robot's own, rad.
        """
        if number in _MOTIONS:
            self.emergency = number == Command.ESTOP
        match number:
            case Command.VEL:
                self._v, self._left_m = value * 1e-3, None
            case Command.MOVE:
                self._v, self._left_m = 0.0, value * 1e-3
            case Command.RVEL | Command.ROTATE:
                self._w, self.heading = math.radians(value), None
            case Command.HEAD:
                self.heading = wrap(math.radians(value))
            case Command.DHEAD:
                self.heading = wrap(heading + math.radians(value))
            case Command.VEL2:
                self._wheels(value)
            case Command.STOP | Command.ESTOP:
                self.stop()
            case _:
                self._limit(number, value)

    def _wheels(self, value: int) -> None:
        """VEL2: the right wheel in the low byte, the left one in the high byte."""
        low, high = (value & 0xFFFF).to_bytes(2, "little")
        right_wheel, left_wheel = ((byte ^ 0x80) - 0x80 for byte in (low, high))
        mm = self.robot.vel2_divisor
        self.stop()
        self._v = 0.5e-3 * mm * (right_wheel + left_wheel)
        self._w = 0.5 * mm * (right_wheel - left_wheel) * self.robot.diff_factor

    def _limit(self, number: int, value: int) -> None:
        """Commands that set limits."""
        match number:
            case Command.SETV:
                self.max_speed = min(abs(value) * 1e-3, self.robot.max_speed)
            case Command.SETRV:
                self.max_yaw_rate = min(math.radians(abs(value)), self.robot.max_yaw_rate)
            case Command.SETA if value > 0:
                self.accel = value * 1e-3
            case Command.SETA if value < 0:
                self.decel = -value * 1e-3
            case Command.SETRA if value > 0:
                self.yaw_accel = math.radians(value)
            case Command.SETRA if value < 0:
                self.yaw_decel = math.radians(-value)

    def travelled(self, forward_m: float) -> None:
        """The robot moved this far: for MOVE."""
        if self._left_m is not None:
            self._left_m -= forward_m
            if abs(self._left_m) <= _ARRIVED_M:
                self._left_m = None

    def wanted(self, heading: float) -> tuple[float, float]:
        """Forward speed (m/s) and yaw rate (rad/s) within the limits; towards a goal, as fast as it can still brake."""
        v, w = self._v, self._w
        if self._left_m is not None:
            v = math.copysign(math.sqrt(2.0 * self.decel * abs(self._left_m)), self._left_m)
        if self.heading is not None:
            error = wrap(self.heading - heading)
            w = math.copysign(math.sqrt(2.0 * self.yaw_decel * abs(error)), error)
        return max(-self.max_speed, min(self.max_speed, v)), max(-self.max_yaw_rate, min(self.max_yaw_rate, w))


_MOTIONS = frozenset(
    (
        Command.VEL,
        Command.MOVE,
        Command.RVEL,
        Command.ROTATE,
        Command.HEAD,
        Command.DHEAD,
        Command.VEL2,
        Command.STOP,
        Command.ESTOP,
    )
)


class Wheels:
    """A robot without mass: its speeds follow the set points within accelerations, its path is made of arcs."""

    def __init__(self, pose: Pose) -> None:
        self.pose, self.v, self.w = pose, 0.0, 0.0

    def step(self, wanted: tuple[float, float], motion: SetPoints, dt: float) -> None:
        """Go on for ``dt`` seconds."""
        if motion.emergency:
            self.v = self.w = 0.0
        else:
            self.v = _towards(self.v, wanted[0], motion.accel * dt, motion.decel * dt)
            self.w = _towards(self.w, wanted[1], motion.yaw_accel * dt, motion.yaw_decel * dt)
        self.pose = arc(self.pose, self.v, self.w, dt)


def _towards(now: float, goal: float, up: float, down: float) -> float:
    """A speed nearer to its goal: by at most ``down`` while it falls, else by at most ``up``; it pauses at zero."""
    if now * goal < 0.0:
        goal = 0.0
    most = up if abs(goal) > abs(now) else down
    return now + max(-most, min(most, goal - now))
