"""Planar poses, quaternions and rotations. World is ENU, body is x forward, y left, z up; angles rad, counter-clockwise.

Pure functions: no other package of the platform is imported.
"""

import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Quaternion = tuple[float, float, float, float]


def wrap(angle: float) -> float:
    """An angle in [-pi, pi)."""
    wrapped = (angle + math.pi) % math.tau - math.pi
    return wrapped if wrapped < math.pi else -math.pi  # the remainder of a tiny negative angle rounds up to 2 pi


def arc(pose: tuple[float, float, float], v: float, w: float, dt: float) -> tuple[float, float, float]:
    """Exact unicycle motion: the pose (x, y, yaw) after ``dt`` s at ``v`` m/s and ``w`` rad/s.

    The chord of a circular arc has length ``v dt sinc(w dt / 2)`` and direction ``yaw + w dt / 2``.
    """
    x, y, yaw = pose
    half = 0.5 * w * dt
    sinc = math.sin(half) / half if abs(half) > 1e-8 else 1.0 - half * half / 6.0
    chord = v * dt * sinc
    return x + chord * math.cos(yaw + half), y + chord * math.sin(yaw + half), yaw + w * dt


def travelled(before: tuple[float, float, float], after: tuple[float, float, float]) -> tuple[float, float]:
    """Distance along the arc (m) and turn (rad) of a vehicle between two poses.

    The inverse of `arc`; the chord of an arc of length d and angle a is ``d sin(a/2) / (a/2)``, in the direction
    ``yaw + a/2``. Turns of more than half a circle cannot be told from their remainders.
    """
    dx, dy, turn = after[0] - before[0], after[1] - before[1], wrap(after[2] - before[2])
    half = 0.5 * turn
    chord = dx * math.cos(before[2] + half) + dy * math.sin(before[2] + half)
    return chord * (half / math.sin(half) if half else 1.0), turn


def quaternion_from_yaw(yaw: float) -> Quaternion:
    """Quaternion (w, x, y, z) of a rotation by ``yaw`` about the z axis."""
    return math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)


def yaw_of(attitude: Quaternion) -> float:
    """Yaw of the body x axis seen from above, in [-pi, pi]; attitude is (w, x, y, z), world_from_body."""
    w, x, y, z = attitude
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def yaws_of(attitude: "NDArray[Any]") -> "NDArray[np.float64]":
    """`yaw_of` many attitudes: (..., 4) to (...,)."""
    import numpy as np  # here: the command line starts without it

    w, x, y, z = attitude[..., 0], attitude[..., 1], attitude[..., 2], attitude[..., 3]
    yaw: NDArray[np.float64] = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return yaw


def rotate2(x: float, y: float, angle: float) -> tuple[float, float]:
    """The vector (x, y) rotated by ``angle``."""
    c, s = math.cos(angle), math.sin(angle)
    return c * x - s * y, s * x + c * y


def product(a: Quaternion, b: Quaternion) -> Quaternion:
    """Quaternion of the rotation ``b`` followed by ``a`` (Hamilton)."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )
