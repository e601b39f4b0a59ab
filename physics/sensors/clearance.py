"""How near the nearest solid is: what ultra-wideband fixes suffer from."""

from typing import NamedTuple

import numpy as np

from cosim.types import Array
from physics.shapes import Group
from physics.world import World


class Near(NamedTuple):
    """The point of all solids that is nearest to a place."""

    distance_m: float
    point: Array  # (3,) m, world


class Clearance:
    """Distances to the solids of a world; the floor is none of them."""

    def __init__(self, world: World) -> None:
        groups, self._triangles = world.shapes.groups, world.shapes.triangles
        low = [np.column_stack([group.corners.min(axis=1), group.bottom]) for group in groups]
        high = [np.column_stack([group.corners.max(axis=1), group.top]) for group in groups]
        self._low = np.ascontiguousarray(np.concatenate([*low, self._triangles.min(axis=1)]).T)  # of all pieces, (3, p) m
        self._high = np.ascontiguousarray(np.concatenate([*high, self._triangles.max(axis=1)]).T)
        ends = np.cumsum([0, *(len(group.bottom) for group in groups)]).tolist()
        self._groups = list(zip(groups, ends[:-1], ends[1:], strict=True))
        self._first_triangle = ends[-1]

    def nearest(self, place: Array, reach_m: float) -> Near | None:
        """The nearest point of any solid, if it is less than ``reach_m`` away; inside a solid that is the place itself."""
        at = place[:, None]
        (near,) = np.nonzero(((self._low - reach_m < at) & (at < self._high + reach_m)).all(axis=0))  # by bounding boxes
        if not near.size:
            return None
        points = []
        for group, first, end in self._groups:
            own = near[(near >= first) & (near < end)] - first
            if own.size:
                points.append(_of_prisms(group, own, place))
        if near[-1] >= self._first_triangle:
            points.append(_of_triangles(self._triangles[near[near >= self._first_triangle] - self._first_triangle], place))
        candidates = np.concatenate(points)
        distances = np.linalg.norm(candidates - place, axis=1)
        best = int(distances.argmin())
        return Near(float(distances[best]), candidates[best]) if distances[best] < reach_m else None


def _of_prisms(group: Group, numbers: Array, place: Array) -> Array:
    """The nearest point of each of these upright convex prisms, (len(numbers), 3) m."""
    corners = group.corners[numbers]
    edges = np.roll(corners, -1, axis=1) - corners
    to = place[:2] - corners
    inside = (edges[..., 0] * to[..., 1] - edges[..., 1] * to[..., 0] >= 0.0).all(axis=1)
    along = np.clip((to * edges).sum(axis=2) / (edges * edges).sum(axis=2), 0.0, 1.0)
    feet = corners + along[..., None] * edges
    best = ((feet - place[:2]) ** 2).sum(axis=2).argmin(axis=1)
    flat = np.where(inside[:, None], place[:2], feet[np.arange(len(feet)), best])
    return np.column_stack([flat, np.clip(place[2], group.bottom[numbers], group.top[numbers])])


def _of_triangles(triangles: Array, place: Array) -> Array:
    """The nearest point of each triangle, (t, 3) m: the foot of the perpendicular if it lies inside, else one on an edge."""
    edges = np.roll(triangles, -1, axis=1) - triangles
    normals = np.cross(edges[:, 0], edges[:, 1])
    square = (normals * normals).sum(axis=1)
    to = place - triangles
    inside = ((np.cross(edges, to) * normals[:, None]).sum(axis=2) >= 0.0).all(axis=1) & (square > 0.0)
    height = (to[:, 0] * normals).sum(axis=1) / np.where(square > 0.0, square, 1.0)
    along = np.clip((to * edges).sum(axis=2) / np.maximum((edges * edges).sum(axis=2), 1e-300), 0.0, 1.0)
    feet = triangles + along[..., None] * edges
    best = ((feet - place) ** 2).sum(axis=2).argmin(axis=1)
    points: Array = np.where(inside[:, None], place - height[:, None] * normals, feet[np.arange(len(feet)), best])
    return points
