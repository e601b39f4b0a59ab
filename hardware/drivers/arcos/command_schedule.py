"""ARCOS commands of a velocity."""

import math
from typing import Literal

from vcmvsp.hardware.drivers.arcos.command_numbers import Command
from vcmvsp.hardware.drivers.arcos.packet import command
from vcmvsp.hardware.drivers.arcos.robot_parameters import Robot

Mode = Literal["vel", "vel2"]


def speeds(robot: Robot, v: float, w: float, mode: Mode) -> bytes:
    """Commands for ``v`` m/s and ``w`` rad/s, limited to the greatest speeds of the robot.

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
