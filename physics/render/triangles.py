"""Triangles of solids and bodies with their planes and colours, in pieces for quick culling."""

import math
from functools import cache
from typing import NamedTuple

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.physics.raycast.moving_hulls import hulls_of
from vcmvsp.physics.world.polygons import outward
from vcmvsp.physics.world.scene import Scene
from vcmvsp.physics.world.solids import Shapes, color_of, prism_triangles
from vcmvsp.physics.world.world import Light, World

_CHUNK = 64  # triangles of a mesh that are looked up together
_SIDES = 32  # of cylinders that move


class Triangles(NamedTuple):
    """Flat faces, seen from one side each."""

    corner: Array  # (t, 3, 3) m, counter-clockwise seen from where they are visible
    plane: Array  # (t, 4): unit normal n, and n . p of its points, m
    color: Array  # (t,) float32, see `packed`
    face: Array  # (t,) int64, which convex face of its solid or body it belongs to: one number for each of all faces

    def take(self, numbers: Array) -> "Triangles":
        """Some of them."""
        return Triangles(*(each[numbers] for each in self))


class ScenePieces(NamedTuple):
    """The triangles of a world, ordered by piece."""

    low: Array  # (m, 3) m, of a box around each piece
    high: Array  # (m, 3) m
    center: Array  # (m, 3) m, of a sphere around it
    radius: Array  # (m,) m
    block: Array  # (m,) bool, whether it is a prism with four walls that stands on the floor
    walls: Array  # (m, 4, 3): their normals x, y to the outside, and n . p of their points, m
    first: Array  # (m + 1,) int64, number of its first triangle
    triangles: Triangles


def packed(levels: Array) -> Array:
    """Red, green and blue, (..., 3), 0 to 255, as one number that fits a float32: red in the lowest eight bits."""
    whole = np.rint(levels).astype(np.int64) @ np.array([1, 1 << 8, 1 << 16])
    return np.asarray(whole, np.float32)


def brightness(light: Light, normal: Array) -> Array:
    """Brightness of faces with these unit normals, (..., 3): Lambert's law, at least the ambient light."""
    direction = np.array(light.direction) / np.linalg.norm(light.direction)
    shone: Array = light.ambient + (1.0 - light.ambient) * np.maximum(normal @ direction, 0.0)
    return shone


def pieces_of(world: World) -> ScenePieces:
    """All solids of a world above the floor."""
    corner, solid, piece, face = _soup(world.shapes)
    corner, source = clipped(corner, corner[:, :, 2])
    plane, usable = planes(corner)
    order = np.flatnonzero(usable)[np.argsort(piece[source[usable]], kind="stable")]
    corner, plane, source = corner[order], plane[order], source[order]
    colors = np.array([color_of(each) for each in world.solids], float).reshape(-1, 3)[solid[source]]
    color = packed(colors * brightness(world.light, plane[:, :3])[:, None])
    triangles = Triangles(corner, plane, color, face[source])
    number, first = np.unique(piece[source], return_index=True)
    low, high = np.empty((0, 3)), np.empty((0, 3))
    if len(first):
        low, high = np.minimum.reduceat(corner.min(axis=1), first), np.maximum.reduceat(corner.max(axis=1), first)
    radius = 0.5 * np.linalg.norm(high - low, axis=1)
    block, walls = (each[number] for each in _walls(world.shapes, int(number.max(initial=-1)) + 1))
    return ScenePieces(low, high, 0.5 * (low + high), radius, block, walls, np.append(first, len(corner)), triangles)


def _walls(shapes: Shapes, count: int) -> tuple[Array, Array]:
    """For each of ``count`` pieces: whether it is a prism with four walls on the floor, and these walls."""
    block, walls, first = np.zeros(count, bool), np.zeros((count, 4, 3)), 0
    for group in shapes.groups:
        m, k, _ = group.corners.shape
        if k == 4:
            normal = outward(group.corners)
            some = max(0, min(m, count - first))  # there are fewer pieces where the last lie under the floor
            walls[first : first + some] = np.dstack([normal, (normal * group.corners).sum(axis=2)])[:some]
            block[first : first + some] = group.bottom[:some] <= 0.0
        first += m
    return block, walls


def _soup(shapes: Shapes) -> tuple[Array, Array, Array, Array]:
    """All triangles, (t, 3, 3) m; solid, piece and face of each, (t,)."""
    parts, pieces, faces = [], 0, 0
    for group in shapes.groups:
        m, k, _ = group.corners.shape
        numbers, face = prism_triangles(k)
        number = np.repeat(np.arange(m), len(numbers))
        corner = group.points()[:, numbers].reshape(-1, 3, 3)
        parts.append((corner, group.solid[number], pieces + number, faces + number * (k + 2) + np.tile(face, m)))
        pieces, faces = pieces + m, faces + m * (k + 2)
    for corner in (shapes.triangles, shapes.triangles[:, ::-1]):  # a mesh need not be closed: it is seen from both sides
        number = np.arange(len(corner))
        parts.append((corner, shapes.triangle_solid, pieces + number // _CHUNK, faces + number))
        faces += len(corner)
    corner, solid, piece, face = (np.concatenate(each) for each in zip(*parts, strict=True))
    return corner, solid, piece, face


def planes(corner: Array) -> tuple[Array, Array]:
    """The planes of triangles, (t, 4), and which triangles have an area."""
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    size = np.sqrt((normal * normal).sum(axis=1))
    normal /= np.where(size > 0.0, size, 1.0)[:, None]
    return np.column_stack([normal, (normal * corner[:, 0]).sum(axis=1)]), size > 0.0


def clipped(corner: Array, distance: Array) -> tuple[Array, Array]:
    """Parts of triangles on the positive side of a plane, (u, 3, 3), and the number of the original of each, (u,).

    Args:
        corner: (t, 3, 3).
        distance: of each corner from the plane, (t, 3), in any unit.
    """
    inside = distance > 0.0
    count = inside.sum(axis=1)
    whole, cut = np.flatnonzero(count == 3), np.flatnonzero((count == 1) | (count == 2))
    if not len(cut):
        return corner[whole], whole
    alone = count[cut] == 1  # one corner is inside; else one is outside: it becomes the first, a
    odd = np.where(alone, inside[cut].argmax(axis=1), inside[cut].argmin(axis=1))
    turn = (odd[:, None] + np.arange(3)) % 3
    (a, b, c), (da, db, dc) = np.moveaxis(corner[cut[:, None], turn], 1, 0), distance[cut[:, None], turn].T
    ab = a + (b - a) * (da / (da - db))[:, None]
    ac = a + (c - a) * (da / (da - dc))[:, None]
    tip = np.stack([a, ab, ac], axis=1)[alone]
    rest = ~alone
    low, high = np.stack([ab, b, c], axis=1)[rest], np.stack([ab, c, ac], axis=1)[rest]
    parts = np.concatenate([corner[whole], tip, low, high])
    return parts, np.concatenate([whole, cut[alone], cut[rest], cut[rest]])


@cache
def _unit(kind: str) -> tuple[Array, Array, Array]:
    """Corners (t, 3, 3), normals (t, 3) and faces (t,) of a hull of size 1, 1, 1 around the origin."""
    angle = math.tau * np.arange(_SIDES) / _SIDES
    around = 0.5 * np.column_stack([np.cos(angle), np.sin(angle)])
    if kind == "box":
        around = np.array([(0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5), (0.5, -0.5)])
    points = np.column_stack([np.tile(around, (2, 1)), np.repeat([-0.5, 0.5], len(around))])
    numbers, face = prism_triangles(len(around))
    corner = points[numbers]
    return corner, planes(corner)[0][:, :3], face


def bodies(scene: Scene, rows: Array) -> Triangles:
    """Hulls of bodies in the world, clipped at the floor. Their faces have numbers below zero."""
    hulls = hulls_of(scene)
    kinds = (("box", rows[~hulls.round[rows]]), ("cylinder", rows[hulls.round[rows]]))
    parts = [_bodies(scene, some, kind) for kind, some in kinds if len(some)]
    corner, plane, color, face = (np.concatenate(each) for each in zip(*parts, strict=True))
    if corner[:, :, 2].min() < 0.0:
        corner, source = clipped(corner, corner[:, :, 2])
        plane, color, face = plane[source], color[source], face[source]
    return Triangles(corner, plane, color, face)


def _bodies(scene: Scene, rows: Array, kind: str) -> Triangles:
    hulls, (unit, normals, face) = hulls_of(scene), _unit(kind)
    size, turn = 2.0 * hulls.half[:, rows].T, np.moveaxis(hulls.rotation[:, :, rows], 2, 0)
    count = len(rows) * len(unit)
    local = (unit * size[:, None, None]).reshape(len(rows), 3 * len(unit), 3)
    corner = (local @ turn.swapaxes(1, 2) + hulls.centre[rows, None]).reshape(count, 3, 3)
    normal = normals / size[:, None]  # as normals of a scaled shape are
    normal = (normal @ turn.swapaxes(1, 2)).reshape(count, 3)
    normal /= np.sqrt((normal * normal).sum(axis=1))[:, None]
    colors = np.array([scene.hulls[row].color for row in rows.tolist()], float).repeat(len(unit), axis=0)
    color = packed(colors * brightness(scene.world.light, normal)[:, None])
    plane = np.column_stack([normal, (normal * corner[:, 0]).sum(axis=1)])
    return Triangles(corner, plane, color, -1 - (rows[:, None] * (_SIDES + 2) + face).reshape(count))
