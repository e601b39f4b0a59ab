"""Geofence: a polygon, convex or not, that a robot must not leave."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vcmvsp.hardware.safety.obstacle_distance import Floats, Obstacles, Stadiums, toward

RETURN_MPS = 0.1  # m/s outside, where obstacles are unknown

_NONE = np.zeros(1)
_STRAIGHT = 0.5  # cosine: outside, the robot may drive within 60 degrees of the shortest way back

_ON_M = 1e-9  # distance to a side below which its direction is undefined


class Polygon:
    """Polygon with these corners ((x, y) m, world; at least three, in any order of rotation, without crossings)."""

    def __init__(self, corners: Sequence[tuple[float, float]]) -> None:
        points = np.array(corners, float)
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 3 or not np.isfinite(points).all():
            raise ValueError(f"a fence needs at least three corners (x, y), all finite, not {list(corners)}")
        x, y = points.T
        area = 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
        if area < 0.0:
            points = points[::-1].copy()  # so that outside is on the right of each side
        self.a, self.b = points, np.roll(points, -1, axis=0)
        if area == 0.0 or bool((self.a == self.b).all(axis=1).any()) or _crosses(self.a, self.b):
            raise ValueError(f"the sides of a fence must not cross, touch or be empty: {list(corners)}")

    def contains(self, x: float, y: float) -> bool:
        """Whether a point is inside: a ray to the east crosses an odd number of sides."""
        (ax, ay), (bx, by) = self.a.T, self.b.T
        spans = (ay > y) != (by > y)
        rise = np.where(spans, by - ay, 1.0)
        return bool(np.count_nonzero(spans & (x < ax + (y - ay) * (bx - ax) / rise)) % 2)

    def around(self, x: float, y: float, margin: float) -> Obstacles:
        """The fence as obstacles of a robot at (x, y); its centre must stay ``margin`` m away."""
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


class _Outside:
    """Obstacles of a robot outside a polygon: it may only move towards the nearest point, and slowly."""

    clearance, closing, speed = 0.0, _NONE, RETURN_MPS

    def __init__(self, fence: Polygon, x: float, y: float) -> None:
        self._back = fence.way_back(x, y)

    def free(self, lo: float, hi: float) -> Floats:
        """See `Obstacles`; inf if every heading leads back."""
        half = 0.5 * (hi - lo)
        # the least cosine between "back" and the cone is minus the greatest one between "away" and the cone
        least = -toward(self._back + math.pi - 0.5 * (lo + hi), half) if half < math.pi else -1.0
        return np.array([math.inf if least >= _STRAIGHT else 0.0])


def _crosses(a: Floats, b: Floats) -> bool:
    """Whether two sides that are not neighbours have a point in common."""
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
