"""Conversion between north-east-down and east-north-up, and between forward-right-down and forward-left-up.

A world vector changes x and y and the sign of z (T); a body vector the signs of y and z (D). Both are their own inverse. With
Euler angles ZYX, as in MAVLink, ``T Rz(yaw) Ry(pitch) Rx(roll) D = Rz(pi/2 - yaw) Ry(-pitch) Rx(roll)``, since D changes the
signs of rotations about y and z, and T D is a quarter turn about z.
"""

import math

from vcmvsp.cosim.frames import Quaternion, wrap
from vcmvsp.cosim.types import Vec3


def world_flipped(v: Vec3) -> Vec3:
    """A vector of the world from NED to ENU, or back."""
    return v[1], v[0], -v[2]


def body_flipped(v: Vec3) -> Vec3:
    """A vector of the body from FRD to FLU, or back."""
    return v[0], -v[1], -v[2]


def yaw_flipped(yaw: float) -> float:
    """A direction from clockwise of north to counter-clockwise of east, or back, in [-pi, pi)."""
    return wrap(0.5 * math.pi - yaw)


def attitude_from_euler(roll: float, pitch: float, yaw: float) -> Quaternion:
    """``world_from_body`` in ENU and FLU of Euler angles of NED and FRD, rad."""
    return _quaternion(roll, -pitch, 0.5 * math.pi - yaw)


def euler_from_attitude(attitude: Quaternion) -> Vec3:
    """Roll, pitch and yaw of NED and FRD, rad, of ``world_from_body`` in ENU and FLU."""
    w, x, y, z = attitude
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return roll, -pitch, yaw_flipped(yaw)


def _quaternion(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Of Rz(yaw) Ry(pitch) Rx(roll)."""
    cr, sr = math.cos(0.5 * roll), math.sin(0.5 * roll)
    cp, sp = math.cos(0.5 * pitch), math.sin(0.5 * pitch)
    cy, sy = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )
