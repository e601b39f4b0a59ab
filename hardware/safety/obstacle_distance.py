"""How far it is to walls and discs, over all directions in which a robot may come to move.

A robot that drives s m forwards, while its heading stays between ``lo`` and ``hi`` (less than half a turn apart), moves by a
sum of short vectors with these headings: it stays in the circular sector of radius s between them, however v and w are
played against each other on the way. What is kept clear is this sector; it needs no model of how the robot brakes.

Walls are stadiums: all points within ``radius`` of a segment a-b; discs are those with a = b. A stadium K and the cone of
the headings are convex, so the nearest point of both together is the nearest point of K, if that lies in the cone, and else
lies on one of the cone's two rays.

Who is inside a stadium already may move so that it does not come nearer to the segment: the distance to a convex set is
convex, so it is never less than now along a direction in which it does not fall at first.
"""

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.frames import wrap

Floats = NDArray[np.float64]

_ROUNDING = 1e-9  # m, or a cosine: driving along a wall is not driving at it


class Obstacles(Protocol):
    """What is around a robot at one place: n things that it must not touch."""

    clearance: float  # m to the nearest of them in any direction; may be less than is true
    closing: Floats  # (n,) m/s at which each of them comes nearer, >= 0
    speed: float  # m/s that is allowed at most here

    def free(self, lo: float, hi: float) -> Floats:
        """How far (m, (n,)) the robot may move with headings between ``lo`` and ``hi`` rad (hi >= lo) for each of them."""


def toward(delta: float, half: float) -> float:
    """The greatest cosine between a direction and a cone: their angle ``delta``, the cone's half width ``half``; rad."""
    return math.cos(max(0.0, abs(wrap(delta)) - half))


class Stadiums:
    """Walls and discs seen from a place; a, b (n, 2) and radius (n,) in m, closing (n,) in m/s."""

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
        if on.any():  # on a wall: its right hand side counts as beyond it
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
        """Where a ray meets each stadium, m (n,); inf: nowhere. For those that the place is clearly outside of."""
        u = np.array((math.cos(heading), math.sin(heading)))
        hit = np.minimum(_disc(u, self._a, self._radius), _disc(u, self._b, self._radius))
        # The long sides: as high above the segment's line as the radius, met between the segment's ends.
        normal = np.column_stack((-self._along[:, 1], self._along[:, 0])) / np.sqrt(self._safe2)[:, None]
        above = -np.einsum("ij,ij->i", self._a, normal)  # of the place, signed
        sinking = -np.sign(above) * (normal @ u)
        meets = (self._length2 > 0.0) & (np.abs(above) > self._radius) & (sinking > _ROUNDING)
        s = np.divide(np.abs(above) - self._radius, sinking, out=np.full_like(above, math.inf), where=meets)
        at = np.where(meets, (np.where(meets, s, 0.0) * (self._along @ u) - np.einsum("ij,ij->i", self._a, self._along)), -1.0)
        nearest: Floats = np.where((at >= 0.0) & (at <= self._length2), np.minimum(hit, s), hit)
        return nearest


def _disc(u: Floats, centre: Floats, radius: Floats) -> Floats:
    """Where the ray from the origin along u meets each disc, m (n,); inf: nowhere."""
    ahead = centre @ u
    aside = centre[:, 0] * u[1] - centre[:, 1] * u[0]
    square = radius * radius - aside * aside
    return np.where((square >= 0.0) & (ahead > 0.0), ahead - np.sqrt(np.maximum(square, 0.0)), math.inf)
