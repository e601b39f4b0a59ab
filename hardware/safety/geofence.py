"""The ground that a robot must not leave: a polygon, convex or not, or a circle, seen from above."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cosim.types import Positive
from hardware.safety.sector import Around, Floats, Stadiums, toward

_NONE = np.zeros(1)
_STRAIGHT = 0.5  # cosine: who is outside may drive back within 60 degrees of the shortest way

_ON_M = 1e-9  # so near to a side, the direction to it says nothing


class Polygon:
    """Inside a polygon with these corners ((x, y) m, world; at least three, in any sense of rotation, without crossings)."""

    def __init__(self, corners: Sequence[tuple[float, float]], return_mps: Positive = 0.1) -> None:
        points = np.array(corners, float)
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 3 or not np.isfinite(points).all():
            raise ValueError(f"a fence needs at least three corners (x, y), all finite, not {list(corners)}")
        x, y = points.T
        area = 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
        if area < 0.0:
            points = points[::-1].copy()  # so that outside is on the right of each side
        self.a, self.b, self.return_mps = points, np.roll(points, -1, axis=0), return_mps
        if area == 0.0 or bool((self.a == self.b).all(axis=1).any()) or _crosses(self.a, self.b):
            raise ValueError(f"the sides of a fence must not cross, touch or be empty: {list(corners)}")

    def contains(self, x: float, y: float) -> bool:
        """Whether a point is inside: a ray to the east crosses an odd number of sides."""
        (ax, ay), (bx, by) = self.a.T, self.b.T
        spans = (ay > y) != (by > y)
        rise = np.where(spans, by - ay, 1.0)
        return bool(np.count_nonzero(spans & (x < ax + (y - ay) * (bx - ax) / rise)) % 2)

    def around(self, x: float, y: float, margin: float) -> Around:
        """The fence as it is seen from (x, y) by a robot whose centre must stay ``margin`` m away from it."""
        if not self.contains(x, y):
            return _Outside(self, x, y)
        n = len(self.a)
        return Stadiums(x, y, self.a, self.b, np.full(n, margin), np.zeros(n))

    def way_back(self, x: float, y: float) -> float:
        """The direction (rad) from a point outside to the nearest point of the sides."""
        along, to = self.b - self.a, (x, y) - self.a
        at = np.clip(np.einsum("ij,ij->i", to, along) / np.einsum("ij,ij->i", along, along), 0.0, 1.0)
        away = to - at[:, None] * along
        distance = np.hypot(away[:, 0], away[:, 1])
        best = int(np.argmin(distance))
        if distance[best] < _ON_M:
            return math.atan2(along[best, 0], -along[best, 1])  # inside is on the left
        return math.atan2(-away[best, 1], -away[best, 0])


class Circle:
    """Inside a circle around ``centre`` ((x, y) m, world) with this radius, m."""

    def __init__(self, centre: tuple[float, float], radius: Positive) -> None:
        if not all(map(math.isfinite, (*centre, radius))) or radius <= 0.0:
            raise ValueError(f"a fence needs a finite centre and a radius above 0, not {centre} and {radius}")
        self.centre, self.radius = centre, radius

    def contains(self, x: float, y: float) -> bool:
        """Whether a point is inside."""
        return math.dist((x, y), self.centre) <= self.radius

    def around(self, x: float, y: float, margin: float) -> Around:
        """The fence as it is seen from (x, y) by a robot whose centre must stay ``margin`` m away from it."""
        return _InCircle(x - self.centre[0], y - self.centre[1], self.radius - margin)


Fence = Polygon | Circle


class _Outside:
    """Outside a polygon: only towards the nearest point of it, and slowly, because nothing is known of what is here."""

    clearance, closing = 0.0, _NONE

    def __init__(self, fence: Polygon, x: float, y: float) -> None:
        self.speed = fence.return_mps
        self._back = fence.way_back(x, y)

    def free(self, lo: float, hi: float) -> Floats:
        """See `Around`: all, if every heading leads back."""
        half = 0.5 * (hi - lo)
        # the least cosine between "back" and the cone is minus the greatest one between "away" and the cone
        least = -toward(self._back + math.pi - 0.5 * (lo + hi), half) if half < math.pi else -1.0
        return np.array([math.inf if least >= _STRAIGHT else 0.0])


class _InCircle:
    """A circle of radius r seen from d = (dx, dy) off its centre. Along u it is ``-d.u + sqrt((d.u)^2 + r^2 - d^2)`` away.

    This falls as d.u grows, so the heading that is nearest to d's decides. Who is outside may not get farther from the
    centre: the same with r = d.
    """

    closing, speed = _NONE, math.inf

    def __init__(self, dx: float, dy: float, radius: float) -> None:
        self._off, self._bearing = math.hypot(dx, dy), math.atan2(dy, dx)
        self._room = max(0.0, radius * radius - self._off * self._off) if radius > 0.0 else 0.0  # r^2 - d^2
        self.clearance = max(0.0, radius - self._off)

    def free(self, lo: float, hi: float) -> Floats:
        """See `Around`."""
        outward = self._off * toward(self._bearing - 0.5 * (lo + hi), 0.5 * (hi - lo))
        root = math.sqrt(outward * outward + self._room)
        # the difference of nearly equal numbers is avoided where d.u > 0
        if outward > 0.0:
            return np.array([self._room / (outward + root)])
        return np.array([root - outward])


def _crosses(a: Floats, b: Floats) -> bool:
    """Whether any two sides that are not neighbours have a point in common."""
    n = len(a)
    along = b - a

    def side(points: Floats) -> Floats:  # of side i's line, point j's: -1, 0 or 1
        to = points[None, :, :] - a[:, None, :]
        turn: Floats = np.sign(along[:, None, 0] * to[:, :, 1] - along[:, None, 1] * to[:, :, 0])
        return turn

    def on(points: Floats) -> NDArray[np.bool_]:  # whether point j lies on side i
        low, high = np.minimum(a, b)[:, None, :], np.maximum(a, b)[:, None, :]
        within: NDArray[np.bool_] = ((low <= points) & (points <= high)).all(axis=2) & (side(points) == 0.0)
        return within

    apart = side(a) * side(b) < 0.0
    meet = (apart & apart.T) | on(a) | on(b) | on(a).T | on(b).T
    i, j = np.indices((n, n))
    return bool(meet[(j - i) % n * ((i - j) % n) > n - 1].any())  # neighbours share a corner
