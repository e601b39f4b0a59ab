"""The hand point of a ground robot, and the control law of a follower.

A hand point is a point of the body that, unlike the axle, can move in any direction. With the axle at ``(x, y)``, heading
``yaw``, and the hand a signed ``distance`` d ahead (d < 0: behind, a castor), its velocity ``(ux, uy)`` in the world frame and
the robot's speeds are related by (Toh 2012, (3-1) to (3-4); the determinant is d, so the hand must not lie on the axle)::

    [ux]   [cos yaw  -d sin yaw] [v]        [v]   [ cos yaw       sin yaw    ] [ux]
    [uy] = [sin yaw   d cos yaw] [w]        [w] = [-sin yaw / d   cos yaw / d] [uy]

A follower (Toh 2012, 3.3) has a handle h, ``ell`` ahead of its centre; the leader carries a point r. With the follower's slot
in the leader's frame at ``(-L, -L')``::

    h = p_f + ell (cos th_f, sin th_f)               r = p_l + Rot(th_l) c,    c = (ell - L, -L')

Error in the follower's frame (3-31, 3-34) and law (3-33, 3-35), with ``thb = th_l - th_f``::

    z   = Rot(-th_f) (r - h)
    u   = Rot(thb) (v_l - w_l c_y, w_l c_x)          velocity of r, in the follower's frame
    v_f = u1 + k1 z1                                 w_f = (u2 + k2 z2) / ell

so that ``z1' = -k1 z1 + w_f z2``, ``z2' = -k2 z2 - w_f z1`` and, with ``V = |z|^2 / 2``, ``V' = -k1 z1^2 - k2 z2^2``: the
error decays exponentially for any motion of the leader. Differences to what is printed: ``docs/explanation/formations.md``.
"""

import math
from typing import NamedTuple

from vcmvsp.agents.formation.reports.report import LeaderState
from vcmvsp.cosim.frames import rotate2


def hand_point(x: float, y: float, yaw: float, distance: float) -> tuple[float, float]:
    """Position of the hand point, m (3-1, 3-2)."""
    return x + distance * math.cos(yaw), y + distance * math.sin(yaw)


def axle_velocity(ux: float, uy: float, yaw: float, distance: float) -> tuple[float, float]:
    """The speeds (v m/s, w rad/s) that give the hand the velocity ``(ux, uy)`` m/s, world (3-4); not with ``distance`` 0."""
    if distance == 0.0:
        raise ValueError("the hand point must not lie on the axle: its distance must not be 0 m (negative: behind the axle)")
    c, s = math.cos(yaw), math.sin(yaw)
    return c * ux + s * uy, (c * uy - s * ux) / distance


class FollowerPlace(NamedTuple):
    """Place of a follower: its handle on a point of the leader's frame."""

    c_x: float  # m, leader's frame, forward
    c_y: float  # m, leader's frame, left
    handle: float  # m, ahead of the follower's centre


class Demand(NamedTuple):
    """Speeds from the law, and the error that they correct."""

    v: float  # m/s
    w: float  # rad/s
    z1: float  # m, forward in the follower's frame
    z2: float  # m, left


def point_of(leader: LeaderState, place: FollowerPlace) -> tuple[float, float]:
    """Target point r of the follower's handle, m, world."""
    x, y = rotate2(place.c_x, place.c_y, leader.th)
    return leader.x + x, leader.y + y


def formation_law(pose: tuple[float, float, float], leader: LeaderState, place: FollowerPlace, k1: float, k2: float) -> Demand:
    """Speeds for a follower at ``pose`` (x m, y m, yaw rad) with gains ``k1``, ``k2`` in 1/s; nothing is limited here."""
    x, y, th = pose
    c_x, c_y, handle = place
    cos_f, sin_f, cos_l, sin_l = math.cos(th), math.sin(th), math.cos(leader.th), math.sin(leader.th)
    e_x = leader.x + cos_l * c_x - sin_l * c_y - x - handle * cos_f
    e_y = leader.y + sin_l * c_x + cos_l * c_y - y - handle * sin_f
    z1 = e_x * cos_f + e_y * sin_f
    z2 = e_y * cos_f - e_x * sin_f
    cos_b, sin_b = cos_l * cos_f + sin_l * sin_f, sin_l * cos_f - cos_l * sin_f  # of thb = th_l - th_f
    ahead, across = leader.v - leader.w * c_y, leader.w * c_x
    u1 = ahead * cos_b - across * sin_b
    u2 = ahead * sin_b + across * cos_b
    return Demand(u1 + k1 * z1, (u2 + k2 * z2) / handle, z1, z2)
