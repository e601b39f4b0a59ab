"""Distance to walls and discs, over a range of headings.

A robot that drives s m forwards, while its heading stays between ``lo`` and ``hi`` (less than half a turn apart), moves by a
sum of short vectors with these headings: it stays in the circular sector of radius s between them, for any course of v and
w. This sector is kept clear; no model of braking is needed.

Walls are stadiums: all points within ``radius`` of a segment a-b; discs have a = b. A stadium K and the cone of the headings
are convex, so the nearest point of both together is the nearest point of K, if that lies in the cone, and else lies on one
of the cone's two rays.

A robot inside a stadium may move if it does not come nearer to the segment: the distance to a convex set is convex, so it is
never less than now along a direction in which it does not decrease at first.
"""

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.frames import wrap

Floats = NDArray[np.float64]

_ROUNDING = 1e-9  # m, or a cosine: driving along a wall is not driving at it


class Obstacles(Protocol):
    """Obstacles around a robot at one place: n things that it must not touch."""

    clearance: float  # m to the nearest one in any direction, or less
    closing: Floats  # (n,) m/s, speeds of approach, >= 0
    speed: float  # m/s, maximum speed here

    def free(self, lo: float, hi: float) -> Floats:
        """Free distances (m, (n,)) for headings between ``lo`` and ``hi`` rad (hi >= lo)."""


def toward(delta: float, half: float) -> float:
    """Greatest cosine between a direction and a cone: their angle ``delta``, the cone's half width ``half``; rad."""
    return math.cos(max(0.0, abs(wrap(delta)) - half))


class Stadiums:
    """Walls and discs around a place; a, b (n, 2) and radius (n,) in m, closing (n,) in m/s."""

    def __init__(self, x: float, y: float, a: Floats, b: Floats, radius: Floats, closing: Floats) -> None:
        self.closing, self.speed = closing, math.inf
        self._a, self._b, self._radius = a - (x, y), b - (x, y), radius
        self._along = b - a
        self._length2 = np.einsum("ij,ij->i", self._along, self._along)
        self._safe2 = np.where(self._length2 > 0.0, self._length2, 1.0)
        at = np.clip(-np.einsum("ij,ij->i", self._a, self._along) / self._safe2, 0.0, 1.0)
        self._nearest = self._a + at[:, None] * self._along
        self._distance = np.hypot(self._nearest[:, 0], self._nearest[:, 1])
        on = self._distance < _ROUNDING
        if on.any():  # on a wall: its right side is outside
            self._nearest[on] = np.column_stack((self._along[on, 1], -self._along[on, 0]))
        self._bearing = np.arctan2(self._nearest[:, 1], self._nearest[:, 0])
        self._gap: Floats = np.maximum(self._distance - radius, 0.0)
        self.clearance = float(self._gap.min(initial=math.inf))

    def free(self, lo: float, hi: float) -> Floats:
        """See `Obstacles`."""
        half = 0.5 * (hi - lo)
        if half >= 0.5 * math.pi:  # any direction
            return self._gap
        delta = np.abs((self._bearing - 0.5 * (lo + hi) + math.pi) % math.tau - math.pi)
        on_rays: Floats = np.minimum(self._ray(lo), self._ray(hi))
        apart = np.where(delta <= half, self._gap, on_rays)
        leaves = np.cos(np.maximum(delta - half, 0.0)) <= _ROUNDING
        touching: Floats = np.where(leaves, math.inf, 0.0)
        free: Floats = np.where(self._gap > _ROUNDING, apart, touching)
        return free

    def _ray(self, heading: float) -> Floats:
        """Distance along a ray to each stadium, m (n,); inf: no hit. Valid for stadiums that do not contain the place."""
        u = np.array((math.cos(heading), math.sin(heading)))
        hit = np.minimum(_disc(u, self._a, self._radius), _disc(u, self._b, self._radius))
        # Long sides: at the radius from the segment's line, between the segment's ends.
        normal = np.column_stack((-self._along[:, 1], self._along[:, 0])) / np.sqrt(self._safe2)[:, None]
        above = -np.einsum("ij,ij->i", self._a, normal)  # of the place, signed
        sinking = -np.sign(above) * (normal @ u)
        meets = (self._length2 > 0.0) & (np.abs(above) > self._radius) & (sinking > _ROUNDING)
        s = np.divide(np.abs(above) - self._radius, sinking, out=np.full_like(above, math.inf), where=meets)
        at = np.where(meets, (np.where(meets, s, 0.0) * (self._along @ u) - np.einsum("ij,ij->i", self._a, self._along)), -1.0)
        nearest: Floats = np.where((at >= 0.0) & (at <= self._length2), np.minimum(hit, s), hit)
        return nearest


def _disc(u: Floats, centre: Floats, radius: Floats) -> Floats:
    """Distance along the ray u from the origin to each disc, m (n,); inf: no hit."""
    ahead = centre @ u
    aside = centre[:, 0] * u[1] - centre[:, 1] * u[0]
    square = radius * radius - aside * aside
    return np.where((square >= 0.0) & (ahead > 0.0), ahead - np.sqrt(np.maximum(square, 0.0)), math.inf)
