"""A world's solids as arrays of pieces, for collisions, scanners, cameras, the radio and pictures."""

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.physics.world.solids import AnySolid, Mesh


class Group(NamedTuple):
    """Upright convex prisms with the same number of corners."""

    corners: Array  # (m, k, 2) m, counter-clockwise
    bottom: Array  # (m,) m
    top: Array  # (m,) m
    solid: Array  # (m,) int64, which solid of the world each belongs to

    def points(self) -> Array:
        """Corners (m, 2 k, 3) m of the prisms, the lower ones first."""
        m, k, _ = self.corners.shape
        ends = [np.broadcast_to(z[:, None, None], (m, k, 1)) for z in (self.bottom, self.top)]
        return np.concatenate([np.concatenate([self.corners, z], axis=2) for z in ends], axis=1)


class Shapes(NamedTuple):
    """All solids in pieces: prisms by their number of corners, and the triangles of meshes."""

    groups: tuple[Group, ...]
    triangles: Array  # (t, 3, 3) m
    triangle_solid: Array  # (t,) int64

    def mesh(self) -> tuple[Array, Array]:
        """Vertices (v, 3) m and triangles (t, 3) int, counter-clockwise seen from outside."""
        vertices, triangles, first = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0
        for group in self.groups:
            points = group.points()
            m, corners, _ = points.shape
            prism, _ = prism_triangles(corners // 2)
            vertices.append(points.reshape(-1, 3))
            triangles.append((first + corners * np.arange(m)[:, None, None] + prism).reshape(-1, 3))
            first += m * corners
        vertices.append(self.triangles.reshape(-1, 3))
        triangles.append(first + np.arange(3 * len(self.triangles)).reshape(-1, 3))
        return np.concatenate(vertices), np.concatenate(triangles)


@cache
def prism_triangles(k: int) -> tuple[Array, Array]:
    """Triangles (4 k - 4, 3) of a prism by its k lower and then its k upper corners, and the face of each, (4 k - 4,)."""
    i, fan = np.arange(k), np.arange(1, k - 1)
    j = (i + 1) % k
    numbers = [
        (i, j, k + j),
        (i, k + j, k + i),
        (np.full(k - 2, k), k + fan, k + fan + 1),
        (np.zeros(k - 2, int), fan + 1, fan),
    ]
    face = np.concatenate([i, i, np.full(k - 2, k), np.full(k - 2, k + 1)])
    return np.concatenate([np.column_stack(each) for each in numbers]), face


def shapes_of(solids: Sequence[AnySolid]) -> Shapes:
    """Solids in pieces."""
    by_corners: dict[int, list[tuple[Array, float, float, int]]] = {}
    for number, solid in enumerate(solids):
        for piece in solid.uprights():
            by_corners.setdefault(len(piece.corners), []).append((*piece, number))
    groups = []
    for _, pieces in sorted(by_corners.items()):
        corners, bottom, top, solid_numbers = zip(*pieces, strict=True)
        groups.append(Group(np.array(corners), np.array(bottom), np.array(top), np.array(solid_numbers)))
    meshes = {number: solid.triangles for number, solid in enumerate(solids) if isinstance(solid, Mesh)}
    triangles = np.concatenate([np.empty((0, 3, 3)), *meshes.values()])
    of = np.repeat(np.array(list(meshes), np.int64), [len(each) for each in meshes.values()])
    return Shapes(tuple(groups), triangles, of)
