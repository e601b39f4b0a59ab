"""The hand point of a ground robot: a point of its body that, unlike its axle, can be sent in any direction.

With the axle at ``(x, y)``, heading ``yaw``, and the hand a signed ``distance`` d ahead (d < 0: behind, a castor), its velocity
``(ux, uy)`` in the world frame and the robot's speeds are related by::

    [ux]   [cos yaw  -d sin yaw] [v]        [v]   [ cos yaw       sin yaw    ] [ux]
    [uy] = [sin yaw   d cos yaw] [w]        [w] = [-sin yaw / d   cos yaw / d] [uy]

Toh 2012, (3-1) to (3-4). The determinant is d, so the hand must not lie on the axle.
"""

import math


def hand_point(x: float, y: float, yaw: float, distance: float) -> tuple[float, float]:
    """Where the hand is, m (3-1, 3-2)."""
    return x + distance * math.cos(yaw), y + distance * math.sin(yaw)


def hand_velocity(v: float, w: float, yaw: float, distance: float) -> tuple[float, float]:
    """Velocity of the hand, m/s world, of a robot that moves at ``v`` m/s and ``w`` rad/s (3-3)."""
    c, s = math.cos(yaw), math.sin(yaw)
    return c * v - distance * s * w, s * v + distance * c * w


def axle_velocity(ux: float, uy: float, yaw: float, distance: float) -> tuple[float, float]:
    """The speeds (v m/s, w rad/s) that give the hand the velocity ``(ux, uy)`` m/s, world (3-4).

    Raises:
        ValueError: the hand lies on the axle (``distance`` 0), where no speeds move it sideways.
    """
    if distance == 0.0:
        raise ValueError(
            "the hand point must not lie on the axle: distance 0 m is not allowed, any other is (behind: negative)"
        )
    c, s = math.cos(yaw), math.sin(yaw)
    return c * ux + s * uy, (c * uy - s * ux) / distance
