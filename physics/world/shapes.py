"""A world's solids in pieces, as arrays: what collisions, scanners, cameras, the radio and pictures look at."""

from collections.abc import Sequence
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


class Shapes(NamedTuple):
    """All solids in pieces: prisms by their number of corners, and the triangles of meshes."""

    groups: tuple[Group, ...]
    triangles: Array  # (t, 3, 3) m
    triangle_solid: Array  # (t,) int64


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
    meshes = [(solid.triangles, number) for number, solid in enumerate(solids) if isinstance(solid, Mesh)]
    triangles = np.concatenate([np.empty((0, 3, 3)), *(each for each, _ in meshes)])
    of = np.repeat(np.array([number for _, number in meshes], np.int64), [len(each) for each, _ in meshes])
    return Shapes(tuple(groups), triangles, of)


def mesh_of(shapes: Shapes) -> tuple[Array, Array]:
    """Vertices (v, 3) m and triangles (t, 3) int, counter-clockwise seen from outside."""
    vertices, triangles, first = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0
    for group in shapes.groups:
        m, k, _ = group.corners.shape
        low, high = (np.broadcast_to(z[:, None, None], (m, k, 1)) for z in (group.bottom, group.top))
        points = np.concatenate([np.concatenate([group.corners, z], axis=2) for z in (low, high)], axis=1)
        vertices.append(points.reshape(-1, 3))
        i = np.arange(k)
        j = (i + 1) % k
        fan = np.arange(1, k - 1)
        one = np.concatenate(
            [
                np.column_stack([i, j, k + j]),
                np.column_stack([i, k + j, k + i]),
                np.column_stack([np.full(k - 2, k), k + fan, k + fan + 1]),
                np.column_stack([np.zeros(k - 2, np.int64), fan + 1, fan]),
            ]
        )
        triangles.append((first + 2 * k * np.arange(m)[:, None, None] + one).reshape(-1, 3))
        first += 2 * k * m
    vertices.append(shapes.triangles.reshape(-1, 3))
    triangles.append(first + np.arange(3 * len(shapes.triangles)).reshape(-1, 3))
    return np.concatenate(vertices), np.concatenate(triangles)
