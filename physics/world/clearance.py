"""Distance to the nearest solid: from one place, and from all places of a vehicle's path."""

import math
from typing import NamedTuple

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.physics.world.solids import Group, Shapes

_STRETCH = 32  # places of a way that share a bounding box
_AT_ONCE = 256  # stretches that are looked at place by place in one go
_GAPS_AT_ONCE = 1 << 20  # of boxes, which bounds the memory that they take


class NearestPoint(NamedTuple):
    """The nearest point of all solids."""

    distance_m: float
    point: Array  # (3,) m, world


class Clearance:
    """Distances to solids, without the floor. A mesh has no inside: its distance is 0 only on its faces."""

    def __init__(self, solids: Shapes) -> None:
        groups, self._triangles = solids.groups, solids.triangles
        low = [np.column_stack([group.corners.min(axis=1), group.bottom]) for group in groups]
        high = [np.column_stack([group.corners.max(axis=1), group.top]) for group in groups]
        self._low = np.ascontiguousarray(np.concatenate([*low, self._triangles.min(axis=1)]).T)  # of all pieces, (3, p) m
        self._high = np.ascontiguousarray(np.concatenate([*high, self._triangles.max(axis=1)]).T)
        ends = np.cumsum([0, *(len(group.bottom) for group in groups)]).tolist()
        self._groups = list(zip(groups, ends[:-1], ends[1:], strict=True))
        self._first_triangle = ends[-1]

    def nearest(self, place: Array, reach_m: float) -> NearestPoint | None:
        """The nearest point of any solid closer than ``reach_m``; inside a solid the place itself."""
        at = place[:, None]
        (near,) = np.nonzero(((self._low - reach_m < at) & (at < self._high + reach_m)).all(axis=0))  # by bounding boxes
        if not near.size:
            return None
        candidates = self._points(near, np.broadcast_to(place, (len(near), 3)))
        distances = np.linalg.norm(candidates - place, axis=1)
        best = int(distances.argmin())
        return NearestPoint(float(distances[best]), candidates[best]) if distances[best] < reach_m else None

    def least_m(self, way: Array, below_m: float = math.inf) -> float:
        """Smallest distance of a path (k, 3) m to any solid, m, or ``below_m`` if none is smaller.

        Bounding boxes of the path, of its stretches and of the solids leave few places to measure, nearest first.
        """
        if not len(way) or not self._low.shape[1]:
            return below_m
        gaps = _gaps(way.min(axis=0)[:, None], way.max(axis=0)[:, None], self._low, self._high)
        below_m = self._measured(gaps.argmin(axis=0, keepdims=True), way[:1], below_m)
        (pieces,) = np.nonzero(gaps < below_m * below_m)
        filled = np.concatenate([way, np.repeat(way[-1:], -len(way) % _STRETCH, axis=0)])
        stretches = filled.reshape(-1, _STRETCH, 3)
        rows = max(1, _GAPS_AT_ONCE // max(1, len(pieces)))
        for first in range(0, len(stretches) if len(pieces) else 0, rows):
            below_m = self._along(stretches[first : first + rows], pieces, below_m)
        return below_m

    def _along(self, stretches: Array, pieces: Array, below_m: float) -> float:
        """`least_m` of stretches (b, k, 3) m and some pieces."""
        low, high = stretches.min(axis=1)[:, :, None], stretches.max(axis=1)[:, :, None]
        gaps = _gaps(low, high, self._low[:, pieces], self._high[:, pieces])
        below_m = self._measured(pieces[gaps.argmin(axis=1)], stretches[:, 0], below_m)  # nearly all others drop out
        stretch, piece = np.nonzero(gaps < below_m * below_m)
        gap = gaps[stretch, piece]
        order = np.argsort(gap)
        for chosen in np.split(order, range(_AT_ONCE, len(order), _AT_ONCE)):
            if not chosen.size or gap[chosen[0]] >= below_m * below_m:
                break
            places, near = stretches[stretch[chosen]], pieces[piece[chosen]]
            at = places.transpose(0, 2, 1)
            pair, place = np.nonzero(_gaps(at, at, self._low.T[near, :, None], self._high.T[near, :, None]) < below_m * below_m)
            below_m = self._measured(near[pair], places[pair, place], below_m)
        return below_m

    def _measured(self, pieces: Array, places: Array, below_m: float) -> float:
        """Smallest distance of pairs of a piece and a place (3,) m, or ``below_m``."""
        distances = np.linalg.norm(self._points(pieces, places) - places, axis=1)
        return min(below_m, float(distances.min(initial=math.inf)))

    def _points(self, pieces: Array, places: Array) -> Array:
        """Nearest points (q, 3) m of q pieces to one place each, (q, 3) m."""
        points = np.empty((len(pieces), 3))
        for group, first, end in self._groups:
            own = (pieces >= first) & (pieces < end)
            if own.any():
                points[own] = _of_prisms(group, pieces[own] - first, places[own])
        own = pieces >= self._first_triangle
        if own.any():
            points[own] = _of_triangles(self._triangles[pieces[own] - self._first_triangle], places[own])
        return points


def _gaps(low: Array, high: Array, other_low: Array, other_high: Array) -> Array:
    """Squared distances (..., p) m2 of boxes; corners broadcast to (..., 3, p) m."""
    total: Array = np.zeros(())
    for axis in range(3):
        gap = np.maximum(other_low[..., axis, :] - high[..., axis, :], low[..., axis, :] - other_high[..., axis, :])
        np.maximum(gap, 0.0, out=gap)
        total = total + np.multiply(gap, gap, out=gap)
    return total


def _of_prisms(group: Group, numbers: Array, places: Array) -> Array:
    """Nearest points (q, 3) m of upright convex prisms to one place each, (q, 3) m."""
    corners, flat = group.corners[numbers], places[:, :2]
    edges = np.roll(corners, -1, axis=1) - corners
    to = flat[:, None] - corners
    inside = (edges[..., 0] * to[..., 1] - edges[..., 1] * to[..., 0] >= 0.0).all(axis=1)
    along = np.clip((to * edges).sum(axis=2) / (edges * edges).sum(axis=2), 0.0, 1.0)
    feet = corners + along[..., None] * edges
    best = ((feet - flat[:, None]) ** 2).sum(axis=2).argmin(axis=1)
    points = np.where(inside[:, None], flat, feet[np.arange(len(feet)), best])
    return np.column_stack([points, np.clip(places[:, 2], group.bottom[numbers], group.top[numbers])])


def _of_triangles(triangles: Array, places: Array) -> Array:
    """Nearest points (t, 3) m of triangles to one place each: the foot of the perpendicular, or a point on an edge."""
    edges = np.roll(triangles, -1, axis=1) - triangles
    normals = np.cross(edges[:, 0], edges[:, 1])
    square = (normals * normals).sum(axis=1)
    to = places[:, None] - triangles
    inside = ((np.cross(edges, to) * normals[:, None]).sum(axis=2) >= 0.0).all(axis=1) & (square > 0.0)
    height = (to[:, 0] * normals).sum(axis=1) / np.where(square > 0.0, square, 1.0)
    along = np.clip((to * edges).sum(axis=2) / np.maximum((edges * edges).sum(axis=2), 1e-300), 0.0, 1.0)
    feet = triangles + along[..., None] * edges
    best = ((feet - places[:, None]) ** 2).sum(axis=2).argmin(axis=1)
    points: Array = np.where(inside[:, None], places - height[:, None] * normals, feet[np.arange(len(feet)), best])
    return points
