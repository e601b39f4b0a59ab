"""When which speeds are sent: at most once a cycle of the robot, at least five times a second, and zero when nobody commands.

No clock and no line of its own: time comes in, bytes come out.
"""

import math
from typing import Literal

from cosim.clock import seconds_to_ns
from hardware.arcos.commands import Command
from hardware.arcos.packet import command
from hardware.arcos.robots import Robot

Mode = Literal["vel", "vel2"]
RESEND_NS = 200_000_000  # nothing is acknowledged, and the robot stops itself after 2 s without a command
NOT_YET = "no command yet"


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


class Steering:
    """The newest command, and what has to be sent of it when.

    Args:
        robot: parameters.
        mode: see `speeds`.
        timeout_s: zero speed after so long without a command.

    Attributes:
        stopped: why the robot is held at zero speed; empty: it follows the commands.
    """

    def __init__(self, robot: Robot, mode: Mode, timeout_s: float) -> None:
        self.stopped = NOT_YET
        self._robot, self._mode, self._timeout_s = robot, mode, timeout_s
        self._timeout_ns = seconds_to_ns(timeout_s)
        self._cycle_ns = seconds_to_ns(robot.period_s)
        self._v = self._w = 0.0
        self._given_ns = 0
        self._sent_ns: int | None = None
        self._waiting = False  # a command that was not sent yet
        self._urgent = False

    def command(self, v: float, w: float, now_ns: int) -> None:
        """Move like this until the next command."""
        self.stopped = ""
        self._v, self._w, self._given_ns = v, w, now_ns
        self._waiting = True

    def stop(self, cause: str) -> None:
        """Zero speed at once, not only in the robot's next cycle."""
        self.stopped = cause
        self._v = self._w = 0.0
        self._urgent = True

    def advance(self, now_ns: int) -> bytes:
        """What to send at this time."""
        if not self.stopped and now_ns >= self._given_ns + self._timeout_ns:
            self.stop(f"no command for {self._timeout_s:g} s")
        if not self._urgent and now_ns < self._next_ns():
            return b""
        self._waiting, self._urgent = self._urgent, False  # a stop is sent again in the next cycle: it might have been lost
        self._sent_ns = now_ns
        return speeds(self._robot, self._v, self._w, self._mode)

    @property
    def due_ns(self) -> int:
        """When `advance` has something to do, if nothing is commanded until then."""
        if self._urgent:
            return 0
        return self._next_ns() if self.stopped else min(self._next_ns(), self._given_ns + self._timeout_ns)

    def _next_ns(self) -> int:
        if self._sent_ns is None:
            return 0
        return self._sent_ns + (self._cycle_ns if self._waiting else RESEND_NS)
