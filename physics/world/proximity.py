"""Distances of places and paths to the nearest solid, and overlaps of bodies with solids."""

import math
from typing import NamedTuple

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util.polygons import overlap_m
from vcmvsp.physics.world.solids import Group, Shapes

_STRETCH = 32  # places of a way that share a bounding box
_AT_ONCE = 256  # stretches that are measured place by place at once
_GAPS_AT_ONCE = 1 << 20  # of boxes, which bounds the memory that they take


class NearestPoint(NamedTuple):
    """The nearest point of all solids."""

    distance_m: float
    point: Array  # (3,) m, world


class Clearance:
    """Distances (m) of points to the nearest solid, without the floor. A mesh has no inside: 0 only on its faces."""

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
        below_m = self._measured(pieces[gaps.argmin(axis=1)], stretches[:, 0], below_m)  # excludes nearly all others
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
    return np.asarray(np.where(inside[:, None], places - height[:, None] * normals, feet[np.arange(len(feet)), best]))


_SKIN = 1e-9  # m: touching is not overlapping


class Blocking:
    """Finds the solid that a body overlaps most.

    Two convex bodies share volume unless some direction separates their shadows; the normals of their faces and the cross
    products of their edges are enough (S. Gottschalk, M. Lin, D. Manocha, OBBTree, SIGGRAPH 1996). The smallest overlap of the
    shadows is the shortest way out.
    """

    def __init__(self, shapes: Shapes) -> None:
        self._shapes = shapes
        self._boxes = [(group.corners.min(axis=1), group.corners.max(axis=1)) for group in shapes.groups]
        self._low, self._high = shapes.triangles.min(axis=1), shapes.triangles.max(axis=1)

    def deepest(self, corners: Array, bottom: float, top: float) -> tuple[int, float] | None:
        """The solid that an upright convex prism reaches into most, and the depth, m; None: the prism is free.

        For meshes the depth is approximate: each triangle counts alone; inside a closed mesh it is the way out of its bounding
        box.
        """
        overlaps = [*self._in_pieces(corners, bottom, top), *self._in_meshes(corners, bottom, top)]
        depth, solid = max(overlaps, key=lambda each: (each[0], -each[1]), default=(0.0, 0))
        return (solid, depth) if depth > _SKIN else None

    def _in_pieces(self, corners: Array, bottom: float, top: float) -> list[tuple[float, int]]:
        low, high, overlaps = corners.min(axis=0), corners.max(axis=0), []
        for group, (lows, highs) in zip(self._shapes.groups, self._boxes, strict=True):
            near = (lows < high).all(axis=1) & (highs > low).all(axis=1) & (group.bottom < top) & (group.top > bottom)
            for k in np.flatnonzero(near).tolist():
                vertical = min(top - group.bottom[k], group.top[k] - bottom)
                overlaps.append((min(float(vertical), overlap_m(corners, group.corners[k])), int(group.solid[k])))
        return overlaps

    def _in_meshes(self, corners: Array, bottom: float, top: float) -> list[tuple[float, int]]:
        triangles, of = self._shapes.triangles, self._shapes.triangle_solid
        if not len(triangles):
            return []
        low, high = np.append(corners.min(axis=0), bottom), np.append(corners.max(axis=0), top)
        near = (self._low < high).all(axis=1) & (self._high > low).all(axis=1)
        depths = _triangle_depths(corners, bottom, top, triangles[near])
        overlaps = list(zip(depths.tolist(), of[near].tolist(), strict=True))
        centre = np.append(corners.mean(axis=0), 0.5 * (bottom + top))
        for solid in np.unique(of).tolist():
            of_solid = of == solid
            if _encloses(triangles[of_solid], centre):  # nothing is near that a body inside would touch
                out = np.minimum(high - self._low[of_solid].min(axis=0), self._high[of_solid].max(axis=0) - low)
                overlaps.append((float(out.min()), solid))
        return overlaps


def _triangle_depths(corners: Array, bottom: float, top: float, triangles: Array) -> Array:
    """Depths (t,) m of triangles (t, 3, 3) m in an upright convex prism; 0 or less: outside."""
    count, k = len(triangles), len(corners)
    prism = np.concatenate([np.column_stack([corners, np.full(k, z)]) for z in (bottom, top)])
    sides = np.column_stack([np.roll(corners, -1, axis=0) - corners, np.zeros(k)])
    up = np.array([[0.0, 0.0, 1.0]])
    edges = np.roll(triangles, -1, axis=1) - triangles  # (t, 3, 3)
    across = np.cross(edges[:, :, None], np.concatenate([sides, up])).reshape(count, 3 * (k + 1), 3)
    normals = np.cross(edges[:, 0], edges[:, 1])[:, None]
    own = np.broadcast_to(np.concatenate([np.cross(sides, up), up]), (count, k + 1, 3))
    axes = np.concatenate([own, normals, across], axis=1)
    lengths = np.sqrt((axes * axes).sum(axis=2))
    flat = lengths < 1e-12 * (1.0 + np.abs(triangles).max(initial=0.0))  # edges that run the same way: no axis
    axes = axes / np.where(flat, 1.0, lengths)[:, :, None]
    prism_shadows, triangle_shadows = axes @ prism.T, axes @ triangles.transpose(0, 2, 1)  # shadows, (t, axes, corners)
    ahead = prism_shadows.max(axis=2) - triangle_shadows.min(axis=2)
    behind = triangle_shadows.max(axis=2) - prism_shadows.min(axis=2)
    return np.asarray(np.where(flat, np.inf, np.minimum(ahead, behind)).min(axis=1, initial=np.inf))


def _encloses(triangles: Array, point: Array) -> bool:
    """Whether a closed mesh holds a point: upwards and downwards, rays leave it once more often than they enter."""
    a, b, c = (triangles[:, i, :2] - point[:2] for i in range(3))

    ab, bc, ca = (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0] for p, q in ((a, b), (b, c), (c, a)))
    over = ((ab > 0.0) & (bc > 0.0) & (ca > 0.0)) | ((ab < 0.0) & (bc < 0.0) & (ca < 0.0))
    total = (ab + bc + ca)[over]
    weights = np.stack([bc, ca, ab], axis=1)[over] / total[:, None]
    heights = (weights * triangles[over, :, 2]).sum(axis=1)
    sign, above = np.sign(total), heights > point[2]
    return bool(sign[above].sum() > 0.0 and sign[~above].sum() < 0.0)
