"""View of a camera; triangles of solids and bodies with their planes and colours, in pieces for quick culling."""

import math
from functools import cache
from typing import NamedTuple

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util.polygons import outward
from vcmvsp.physics.world.solids import Shapes, color_of, prism_triangles
from vcmvsp.physics.world.world import Light, Scene, World, cached_on_world

_CHUNK = 64  # triangles of a mesh that form one piece
_SIDES = 32  # of cylinders that move


class View(NamedTuple):
    """View of a pinhole camera with its principal point in the middle of the picture.

    A pixel samples its middle: column c and row r look along
    ``((c + 0.5 - width / 2) / focal_px, (r + 0.5 - height / 2) / focal_px, 1)`` in the camera's frame.
    """

    eye: Array  # (3,) m, world, above the floor
    rotation: Array  # (3, 3) world_from_camera; camera: x to the right of the picture, y down, z along the optical axis
    width: int  # px
    height: int
    focal_px: float
    reach_m: float = 1000.0  # solids and bodies further away, along the optical axis, are left out

    def columns(self) -> Array:
        """Slope of each column's rays to the right, (width,)."""
        return np.asarray((np.arange(self.width) + (0.5 - 0.5 * self.width)) / self.focal_px)

    def rows(self) -> Array:
        """Slope of each row's rays downwards, (height,)."""
        return np.asarray((np.arange(self.height) + (0.5 - 0.5 * self.height)) / self.focal_px)

    def floor_from_pixel(self) -> Array:
        """Homography (3, 3) from columns and rows to x, y on the floor; behind the camera above the horizon."""
        (x, y, z), rotation = self.eye, self.rotation
        meets = np.stack([x * rotation[2] - z * rotation[0], y * rotation[2] - z * rotation[1], rotation[2]])
        focal, center = self.focal_px, 0.5 / self.focal_px
        right, down = [1 / focal, 0.0, center * (1 - self.width)], [0.0, 1 / focal, center * (1 - self.height)]
        return np.asarray(meets @ np.array([right, down, [0.0, 0.0, 1.0]]))


class Triangles(NamedTuple):
    """Flat faces, seen from one side each."""

    corner: Array  # (t, 3, 3) m, counter-clockwise seen from the visible side
    plane: Array  # (t, 4): unit normal n, and n . p of its points, m
    color: Array  # (t,) float32, see `packed`
    face: Array  # (t,) int64, number of its convex face, unique among all solids and bodies

    def take(self, numbers: Array) -> "Triangles":
        """Subset of the triangles."""
        return Triangles(*(each[numbers] for each in self))


class ScenePieces(NamedTuple):
    """The triangles of a world, ordered by piece."""

    low: Array  # (m, 3) m, of a box around each piece
    high: Array  # (m, 3) m
    center: Array  # (m, 3) m, of a sphere around it
    radius: Array  # (m,) m
    block: Array  # (m,) bool, whether it is a prism with four walls that stands on the floor
    walls: Array  # (m, 4, 3): their outward normals x, y, and n . p of their points, m
    first: Array  # (m + 1,) int64, number of its first triangle
    triangles: Triangles


def packed(levels: Array) -> Array:
    """Red, green and blue, (..., 3), 0 to 255, as one number that fits a float32: red in the lowest eight bits."""
    whole = np.rint(levels).astype(np.int64) @ np.array([1, 1 << 8, 1 << 16])
    return np.asarray(whole, np.float32)


def brightness(light: Light, normal: Array) -> Array:
    """Brightness of faces with these unit normals, (..., 3): Lambert's law, at least the ambient light."""
    direction = np.array(light.direction) / np.linalg.norm(light.direction)
    return np.asarray(light.ambient + (1.0 - light.ambient) * np.maximum(normal @ direction, 0.0))


@cached_on_world
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

    The triangles have corners (t, 3, 3), at a distance (t, 3) from the plane in any unit.
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
    hulls = scene.placed_hulls
    kinds = (("box", rows[~hulls.round[rows]]), ("cylinder", rows[hulls.round[rows]]))
    parts = [_bodies(scene, some, kind) for kind, some in kinds if len(some)]
    corner, plane, color, face = (np.concatenate(each) for each in zip(*parts, strict=True))
    if corner[:, :, 2].min() < 0.0:
        corner, source = clipped(corner, corner[:, :, 2])
        plane, color, face = plane[source], color[source], face[source]
    return Triangles(corner, plane, color, face)


def _bodies(scene: Scene, rows: Array, kind: str) -> Triangles:
    hulls, (unit, normals, face) = scene.placed_hulls, _unit(kind)
    size, turn = 2.0 * hulls.half[:, rows].T, np.moveaxis(hulls.rotation[:, :, rows], 2, 0)
    count = len(rows) * len(unit)
    local = (unit * size[:, None, None]).reshape(len(rows), 3 * len(unit), 3)
    corner = (local @ turn.swapaxes(1, 2) + hulls.centre[rows, None]).reshape(count, 3, 3)
    normal = normals / size[:, None]  # normals of a scaled shape
    normal = (normal @ turn.swapaxes(1, 2)).reshape(count, 3)
    normal /= np.sqrt((normal * normal).sum(axis=1))[:, None]
    colors = np.array([scene.hulls[row].color for row in rows.tolist()], float).repeat(len(unit), axis=0)
    color = packed(colors * brightness(scene.world.light, normal)[:, None])
    plane = np.column_stack([normal, (normal * corner[:, 0]).sum(axis=1)])
    return Triangles(corner, plane, color, -1 - (rows[:, None] * (_SIDES + 2) + face).reshape(count))


_FEWEST = 48  # pieces: with fewer it is faster to draw all
_BLOCKS = 8  # buildings tested as occluders
_GAP_M = 0.05  # a nearer building is no occluder: part of it may be clipped
_MARGIN_M = 0.001


def visible_pieces(pieces: ScenePieces, near: Array, view: View) -> Array:
    """The pieces (numbers) among ``near`` that no single building hides.

    The shadow of a convex body is convex, so a piece is hidden if the corners of its bounding box are. Behind a building on the
    floor the lower corners are hidden where the upper ones are, as the eye is above the floor. A corner is hidden if its line
    to the eye passes through the building: between two places, below the roof at one.
    """
    if len(near) < _FEWEST:
        return near
    number, where = _blocks(pieces, near, view)
    if not len(number):
        return near
    (low, high), eye = (pieces.low[near], pieces.high[near]), view.eye
    corners = np.concatenate([[low[:, 0], high[:, 0], high[:, 0], low[:, 0]], [low[:, 1], low[:, 1], high[:, 1], high[:, 1]]])
    plan = corners.reshape(2, -1).T - eye[:2]  # (4 n, 2): the first corners of all, then the second corners, and so on
    speed = np.einsum("pc,kec->ekp", plan, pieces.walls[number, :, :2])  # to the outside of each wall, along each line
    speed[speed == 0.0] = -1e-300  # a line along a wall is entirely outside or inside
    when = where.T[:, :, None] / speed
    enter = np.where(speed < 0.0, when, 0.0).max(axis=0)
    leave = np.where(speed > 0.0, when, 1.0).min(axis=0)
    rise = np.tile(high[:, 2], 4) - eye[2]
    lowest = eye[2] + np.minimum(enter * rise, leave * rise)
    through = (leave > enter + 1e-6) & (lowest < pieces.high[number, 2][:, None] - _MARGIN_M)
    hidden = through.reshape(len(number), 4, len(near)).all(axis=1).any(axis=0)
    return np.asarray(near[~hidden])


def _blocks(pieces: ScenePieces, near: Array, view: View) -> tuple[Array, Array]:
    """The widest buildings in the picture among those higher than the eye.

    Also returns how far inside each of their four walls the eye is, (k, 4) m.
    """
    blocks = near[pieces.block[near] & (pieces.high[near, 2] > view.eye[2])]
    away = pieces.center[blocks, :2] - view.eye[:2]
    wide = pieces.radius[blocks] ** 2 / ((away * away).sum(axis=1) + 1e-9)
    blocks = blocks[np.argsort(-wide, kind="stable")[:_BLOCKS]]
    walls = pieces.walls[blocks]
    where = walls[:, :, 2] - walls[:, :, :2] @ view.eye[:2]
    outside = where.min(axis=1) < -_GAP_M
    return blocks[outside], where[outside]
