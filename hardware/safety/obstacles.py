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
from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.frames import wrap
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util.polygons import area_m2, problem_of

Floats = NDArray[np.float64]

_ROUNDING = 1e-9  # m, or a cosine: driving along a wall is not driving at it


def toward(delta: float, half: float) -> float:
    """Greatest cosine between a direction and a cone: their angle ``delta``, the cone's half width ``half``; rad."""
    return math.cos(max(0.0, abs(wrap(delta)) - half))


class Stadiums:
    """Walls and discs around a place that a robot must not touch; a, b (n, 2) and radius (n,) in m.

    ``closing``: (n,) m/s, speeds of approach, >= 0; ``clearance``: m to the nearest one in any direction, or less; ``speed``:
    m/s, the maximum here.
    """

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
        """Free distances (m, (n,)) for headings between ``lo`` and ``hi`` rad (hi >= lo)."""
        half = 0.5 * (hi - lo)
        if half >= 0.5 * math.pi:  # any direction
            return self._gap
        delta = np.abs((self._bearing - 0.5 * (lo + hi) + math.pi) % math.tau - math.pi)
        on_rays: Floats = np.minimum(self._ray(lo), self._ray(hi))
        apart = np.where(delta <= half, self._gap, on_rays)
        leaves = np.cos(np.maximum(delta - half, 0.0)) <= _ROUNDING
        touching: Floats = np.where(leaves, math.inf, 0.0)
        return np.where(self._gap > _ROUNDING, apart, touching)

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
        return np.where((at >= 0.0) & (at <= self._length2), np.minimum(hit, s), hit)


def _disc(u: Floats, centre: Floats, radius: Floats) -> Floats:
    """Distance along the ray u from the origin to each disc, m (n,); inf: no hit."""
    ahead = centre @ u
    aside = centre[:, 0] * u[1] - centre[:, 1] * u[0]
    square = radius * radius - aside * aside
    return np.where((square >= 0.0) & (ahead > 0.0), ahead - np.sqrt(np.maximum(square, 0.0)), math.inf)


RETURN_MPS = 0.1  # m/s outside, where obstacles are unknown

_NONE = np.zeros(1)
_STRAIGHT = 0.5  # cosine: outside, the robot may drive within 60 degrees of the shortest way back

_ON_M = 1e-9  # distance to a side below which its direction is undefined


class Polygon:
    """Polygon with these corners ((x, y) m, world; at least three, in any order of rotation, without crossings)."""

    def __init__(self, corners: Sequence[tuple[float, float]]) -> None:
        if problem := problem_of(corners):
            raise ValueError(f"a fence {problem}: {list(corners)}")
        points = np.array(corners, float)
        if area_m2(points) < 0.0:
            points = points[::-1].copy()  # so that outside is on the right of each side
        self.a, self.b = points, np.roll(points, -1, axis=0)

    def contains(self, x: float, y: float) -> bool:
        """Whether a point is inside: a ray to the east crosses an odd number of sides."""
        (ax, ay), (bx, by) = self.a.T, self.b.T
        spans = (ay > y) != (by > y)
        rise = np.where(spans, by - ay, 1.0)
        return bool(np.count_nonzero(spans & (x < ax + (y - ay) * (bx - ax) / rise)) % 2)

    def around(self, x: float, y: float, margin: float) -> "Obstacles":
        """The fence as obstacles of a robot at (x, y); its centre must stay ``margin`` m away."""
        if not self.contains(x, y):
            return Outside(self, x, y)
        n = len(self.a)
        return Stadiums(x, y, self.a, self.b, np.full(n, margin), np.zeros(n))

    def way_back(self, x: float, y: float) -> float:
        """The direction (rad) from a point outside to the nearest point of the sides."""
        along, to = self.b - self.a, (x, y) - self.a
        at = np.clip(np.einsum("ij,ij->i", to, along) / np.einsum("ij,ij->i", along, along), 0.0, 1.0)
        offset = to - at[:, None] * along
        distance = np.hypot(offset[:, 0], offset[:, 1])
        best = int(np.argmin(distance))
        if distance[best] < _ON_M:
            return math.atan2(along[best, 0], -along[best, 1])  # inside is on the left
        return math.atan2(-offset[best, 1], -offset[best, 0])


class Outside:
    """Obstacles of a robot outside a polygon: it may only move towards the nearest point, and slowly."""

    clearance, closing, speed = 0.0, _NONE, RETURN_MPS

    def __init__(self, fence: Polygon, x: float, y: float) -> None:
        self._back = fence.way_back(x, y)

    def free(self, lo: float, hi: float) -> Floats:
        """Free distances as of `Stadiums.free`; inf if every heading leads back."""
        half = 0.5 * (hi - lo)
        # the least cosine between "back" and the cone is minus the greatest one between "away" and the cone
        least = -toward(self._back + math.pi - 0.5 * (lo + hi), half) if half < math.pi else -1.0
        return np.array([math.inf if least >= _STRAIGHT else 0.0])


Obstacles = Stadiums | Outside


class Others(msgspec.Struct, frozen=True):
    """Other vehicles at one instant, a row each."""

    position: Array  # (n, 2) or (n, 3) m, world
    velocity: Array  # of the same shape, m/s, world
    radius: Array  # (n,) m, of a circle around the body

    def finite(self) -> bool:
        """Whether all numbers are finite."""
        return all(bool(np.isfinite(each).all()) for each in (self.position, self.velocity, self.radius))

    def around(self, x: float, y: float, margin: float) -> Obstacles:
        """The others as obstacles of a robot at (x, y); its centre stays ``margin`` m away from their bodies.

        Each counts with its speed of approach; receding adds no room.
        """
        position, velocity = _plane(self.position), _plane(self.velocity)
        to = position - (x, y)
        distance = np.hypot(to[:, 0], to[:, 1])
        approach = -np.einsum("ij,ij->i", to, velocity)
        closing = np.maximum(approach, 0.0) / np.where(distance > 0.0, distance, 1.0)
        return Stadiums(x, y, position, position, np.asarray(self.radius, float) + margin, closing)


def _plane(vectors: Array) -> Array:
    rows: Array = np.asarray(vectors, float)
    return rows[:, :2] if rows.size else np.empty((0, 2))
