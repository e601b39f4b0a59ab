"""When which speeds are sent: at most once a cycle of the robot, at least five times a second, and zero when nobody commands.

No clock and no line of its own: time comes in, bytes come out.
"""

import math
from typing import Literal

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.hardware.drivers.arcos.command_numbers import Command
from vcmvsp.hardware.drivers.arcos.packet import command
from vcmvsp.hardware.drivers.arcos.robot_parameters import Robot
from vcmvsp.hardware.drivers.command_repeater import Pace

Mode = Literal["vel", "vel2"]
RESEND_NS = 200_000_000  # nothing is acknowledged, and the robot stops itself after 2 s without a command


def speeds(robot: Robot, v: float, w: float, mode: Mode) -> bytes:
    """Commands for ``v`` m/s and ``w`` rad/s, no faster than the robot ever goes.

    ``vel`` sends VEL and RVEL, in whole mm/s and deg/s; ``vel2`` sends both wheels in one command, in steps of 20 mm/s.
    Wheels: v -+ w/2 times the effective track.
    """
    v = min(max(v, -robot.max_speed), robot.max_speed)
    w = min(max(w, -robot.max_yaw_rate), robot.max_yaw_rate)
    if mode == "vel":
        return command(Command.VEL, round(1000.0 * v)) + command(Command.RVEL, round(math.degrees(w)))
    unit = robot.vel2_divisor / 1000.0
    apart = 0.5 * w * robot.track_m
    most = max(1.0, (abs(v) + abs(apart)) / (127 * unit))  # beyond a byte: slower, on the same arc
    left, right = round((v - apart) / most / unit), round((v + apart) / most / unit)
    return command(Command.VEL2, (left & 0xFF) << 8 | right & 0xFF)


class Steering(Pace[tuple[float, float]]):
    """The newest command (m/s, rad/s), and what has to be sent of it when.

    Args:
        robot: parameters.
        mode: see `speeds`.
        timeout_s: zero speed after so long without a command.
    """

    def __init__(self, robot: Robot, mode: Mode, timeout_s: float) -> None:
        super().__init__((0.0, 0.0), timeout_s, again_ns=RESEND_NS, least_ns=seconds_to_ns(robot.period_s))
        self._robot, self._mode = robot, mode

    def packets(self, now_ns: int) -> bytes:
        """What to send at this time."""
        said = self.advance(now_ns)
        return b"" if said is None else speeds(self._robot, *said, self._mode)
