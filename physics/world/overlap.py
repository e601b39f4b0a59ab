"""Overlap of a body with solids, and its depth: separating axes of upright prisms, and of prisms and triangles.

Two convex bodies share volume unless some direction separates their shadows; the normals of their faces and the cross products
of their edges are enough (S. Gottschalk, M. Lin, D. Manocha, OBBTree, SIGGRAPH 1996). The smallest overlap of the shadows is
the shortest way out.
"""

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.physics.world.polygons import overlap_m
from vcmvsp.physics.world.solids import Shapes

_SKIN = 1e-9  # m: touching is not overlapping


class Blocking:
    """Finds the solid that a body overlaps most."""

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
            mine = of == solid
            if _encloses(triangles[mine], centre):  # nothing is near that a body inside would touch
                out = np.minimum(high - self._low[mine].min(axis=0), self._high[mine].max(axis=0) - low)
                overlaps.append((float(out.min()), solid))
        return overlaps


def _triangle_depths(corners: Array, bottom: float, top: float, triangles: Array) -> Array:
    """Depths (t,) m of triangles (t, 3, 3) m in an upright convex prism; 0 or less: outside."""
    count = len(triangles)
    k = len(corners)
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
    mine, theirs = axes @ prism.T, axes @ triangles.transpose(0, 2, 1)  # shadows, (t, axes, corners)
    ahead, behind = mine.max(axis=2) - theirs.min(axis=2), theirs.max(axis=2) - mine.min(axis=2)
    depths: Array = np.where(flat, np.inf, np.minimum(ahead, behind)).min(axis=1, initial=np.inf)
    return depths


def _encloses(triangles: Array, point: Array) -> bool:
    """Whether a closed mesh holds a point: upwards and downwards, rays leave it once more often than they enter."""
    a, b, c = (triangles[:, i, :2] - point[:2] for i in range(3))

    def twice(p: Array, q: Array) -> Array:
        area: Array = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
        return area

    ab, bc, ca = twice(a, b), twice(b, c), twice(c, a)
    over = ((ab > 0.0) & (bc > 0.0) & (ca > 0.0)) | ((ab < 0.0) & (bc < 0.0) & (ca < 0.0))
    total = (ab + bc + ca)[over]
    weights = np.stack([bc, ca, ab], axis=1)[over] / total[:, None]
    heights = (weights * triangles[over, :, 2]).sum(axis=1)
    sign, above = np.sign(total), heights > point[2]
    return bool(sign[above].sum() > 0.0 and sign[~above].sum() < 0.0)
