"""Pictures of a world: floor and sky, then triangles of solids and bodies with a depth buffer, sampled at pixel middles."""

from typing import NamedTuple

import cv2
import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Array
from vcmvsp.physics.render.floor_and_sky import ground, inverse_depth, levels_of
from vcmvsp.physics.render.triangles import ScenePieces, Triangles, View, bodies, clipped, pieces_of, visible_pieces
from vcmvsp.physics.world.world import Scene, World

LARGE_PX = 6000  # a triangle in a rectangle of so many pixels is drawn here: about where both ways take equally long


class Buffers(NamedTuple):
    """Buffers of a picture, (height, width) each."""

    color: Array  # int32, see `packed`
    number: Array | None  # int32: one plus the number of the triangle; 0: floor or sky
    depth: Array  # float32, from 0 (at ``near``) to 1 (at ``far``): a linear function of one over the depth, as in OpenGL
    near: float  # m
    far: float


NEAREST_M = 0.005  # along the optical axis: nearer parts are cut off

_GUARD = 16.0  # triangles are clipped at so many half pictures from the middle: float32 needs small numbers


class Picture(NamedTuple):
    """A camera's picture."""

    pixels: Array  # (height, width, 3) uint8, red, green, blue
    depth_m: Array | None  # (height, width) float32, along the optical axis; inf: nothing, or out of reach


def render(
    world: World, view: View, *, scene: Scene | None = None, without: int = -1, depth: bool = False, time_s: float = 0.0
) -> Picture:
    """Render a world and the bodies in it.

    Args:
        world: all static objects.
        view: of the camera.
        scene: all moving objects; None: none.
        without: row of the camera's own body, which is omitted; -1: none.
        depth: whether to compute the depth.
        time_s: time of the targets' places without a scene.
    """
    time_s = time_s if scene is None else scene.now_ns / SECOND_NS
    floor = ground(world, levels_of(world), view, time_s)
    triangles = _visible(pieces_of(world), view)
    if scene is not None and len(rows := _bodies_near(scene, without, view)):
        moving = bodies(scene, rows)
        moving = moving.take(_facing(moving.plane, view))
        triangles = Triangles(*(np.concatenate(each) for each in zip(triangles, moving, strict=True)))
    corner, source = _in_picture(((triangles.corner.reshape(-1, 3) - view.eye) @ view.rotation).reshape(-1, 3, 3), view)
    number = np.zeros(floor.shape, np.int32) if depth else None
    if len(corner):
        nearest = 0.999 * float(corner[:, :, 2].min())
        buffers = Buffers(floor, number, np.ones(floor.shape, np.float32), nearest, max(view.reach_m, 2.0 * nearest))
        if floor.size > 8 * LARGE_PX:
            small = draw_large(buffers, corner, triangles, source, view)
            corner, source = corner[small], source[small]
        floor, number = _draw(buffers, corner, triangles.color[source], source, view)
    pixels = cv2.cvtColor(floor.astype("<i4").view(np.uint8).reshape(*floor.shape, 4), cv2.COLOR_RGBA2RGB)
    return Picture(pixels, None if number is None else _depth(view, triangles, number))


def _visible(pieces: ScenePieces, view: View) -> Triangles:
    near = visible_pieces(pieces, np.flatnonzero(_in_frustum(pieces.center, pieces.radius, view)), view)
    first = pieces.first[near]
    count = pieces.first[near + 1] - first
    ends = np.cumsum(count)
    numbers = np.arange(ends[-1] if len(ends) else 0) + np.repeat(first - ends + count, count)
    return pieces.triangles.take(numbers[_facing(pieces.triangles.plane[numbers], view)])


def _bodies_near(scene: Scene, without: int, view: View) -> Array:
    visible = _in_frustum(scene.placed_hulls.centre, scene.placed_hulls.radius, view)
    return np.flatnonzero(visible & (np.arange(len(visible)) != without))


def _in_frustum(center: Array, radius: Array, view: View) -> Array:
    """Spheres that may be in the picture, (m,) bool."""
    f, half_width, half_height = view.focal_px, 0.5 * view.width, 0.5 * view.height
    side, upper = np.hypot(f, half_width), np.hypot(f, half_height)
    sides = [[f / side, 0.0, half_width / side], [-f / side, 0.0, half_width / side]]
    ends = [[0.0, f / upper, half_height / upper], [0.0, -f / upper, half_height / upper]]
    inward = view.rotation @ np.array([*sides, *ends, [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]).T  # (3, 6), world
    offset = view.eye @ inward
    offset[5] -= view.reach_m
    return np.asarray((center @ inward + radius[:, None] >= offset).all(axis=1))


def _facing(plane: Array, view: View) -> Array:
    return np.flatnonzero(plane[:, :3] @ view.eye > plane[:, 3])


def _in_picture(corner: Array, view: View) -> tuple[Array, Array]:
    """Triangles in the camera's frame that may be in the picture, clipped behind it and far beside it.

    Returns:
        Triangles, (u, 3, 3) m, and the number of the original of each, (u,).
    """
    x, y, z = np.moveaxis(corner, 2, 0)
    right, lower = z * (0.5 * view.width / view.focal_px), z * (0.5 * view.height / view.focal_px)
    behind = z < NEAREST_M
    outside = _all(behind) | _all(x > right) | _all(x < -right) | _all(y > lower) | _all(y < -lower)
    near = ~(behind | (np.abs(x) > _GUARD * right) | (np.abs(y) > _GUARD * lower))
    cut = ~(_all(near) | outside)
    whole = np.flatnonzero(~(outside | cut))
    if not cut.any():
        return corner[whole], whole
    parts, source = corner[cut], np.flatnonzero(cut)
    wide, high = _GUARD * 0.5 * view.width / view.focal_px, _GUARD * 0.5 * view.height / view.focal_px
    for inward in ((0, 0, 1), (1, 0, wide), (-1, 0, wide), (0, 1, high), (0, -1, high)):
        distance = parts @ inward - (NEAREST_M if inward == (0, 0, 1) else 0.0)
        if (distance <= 0.0).any():
            parts, inside = clipped(parts, distance)
            source = source[inside]
    return np.concatenate([corner[whole], parts]), np.concatenate([whole, source])


def _all(of_corners: Array) -> Array:
    first, second, third = of_corners.T
    return np.asarray(first & second & third)


def _draw(buffers: Buffers, corner: Array, color: Array, source: Array, view: View) -> tuple[Array, Array | None]:
    if not len(corner):
        return buffers.color, buffers.number
    values = np.zeros((len(corner), 3, 3), np.float32)  # the three channels of each corner; that of the first corner counts
    values[:, 0, 0], values[:, 0, 1] = color, source + 1
    canvas = np.empty((view.height, view.width, 3), np.float32)
    canvas[:, :, 0] = buffers.color
    if buffers.number is not None:
        canvas[:, :, 1] = buffers.number
    places = (corner * (1.0, -1.0, -1.0)).astype(np.float32).reshape(1, -1, 3)  # as OpenGL has it: y up, looking along -z
    numbers, colors = np.arange(3 * len(corner), dtype=np.int32).reshape(1, -1, 3), values.reshape(1, -1, 3)
    opening, ends = 2.0 * float(np.arctan(0.5 * view.height / view.focal_px)), (buffers.near, buffers.far)
    # OpenCV's own renderer samples pixel middles, too.
    cv2.triangleRasterize(places, numbers, colors, canvas, buffers.depth, np.eye(4), opening, *ends, _SETTINGS)
    return cv2.extractChannel(canvas, 0), None if buffers.number is None else canvas[:, :, 1]


def _settings() -> cv2.TriangleRasterizeSettings:
    settings = cv2.TriangleRasterizeSettings()
    settings.setShadingType(cv2.RASTERIZE_SHADING_FLAT)
    settings.setCullingMode(cv2.RASTERIZE_CULLING_NONE)
    settings.setGlCompatibleMode(cv2.RASTERIZE_COMPAT_INVDEPTH)
    return settings


_SETTINGS = _settings()

# Until a large block has been freed, the C library returns freed memory to the system and gets it again page by page: a
# picture of 640 x 480 would take twice as long. So a large block is freed here, of which no page was ever touched.
np.empty(24 << 20, np.uint8)


def _depth(view: View, triangles: Triangles, number: Array) -> Array:
    """Depths from the planes of drawn triangles: one over the depth is linear in the picture."""
    inverse = inverse_depth(view)
    rows, columns = np.nonzero(number)
    normal = triangles.plane[:, :3]
    slopes = (normal @ view.rotation) / (triangles.plane[:, 3] - normal @ view.eye)[:, None]
    right, down, ahead = slopes[number[rows, columns].astype(np.int64) - 1].T
    inverse[rows, columns] = right * view.columns()[columns] + down * view.rows()[rows] + ahead
    with np.errstate(divide="ignore"):
        metres = np.where(inverse > 1.0 / view.reach_m, 1.0 / inverse, np.inf)
    return metres.astype(np.float32)


def draw_large(buffers: Buffers, corner: Array, triangles: Triangles, source: Array, view: View) -> Array:
    """Draw all faces with a large triangle into the buffers; returns the other triangles, (n,) int.

    ``corner`` (t, 3, 3) m are triangles in the camera's frame, all in front of it, ``source`` (t,) their numbers in
    ``triangles``, before clipping.
    """
    height, width = buffers.depth.shape
    scale = view.focal_px / corner[:, :, 2]
    u, v = corner[:, :, 0] * scale + 0.5 * width, corner[:, :, 1] * scale + 0.5 * height
    large = _length(u, width) * _length(v, height) > LARGE_PX
    if not large.any():
        return np.arange(len(corner))
    face = triangles.face[source]
    whole = np.isin(face, face[large])
    some = np.flatnonzero(whole)
    some = some[np.argsort(face[some], kind="stable")]
    first = np.flatnonzero(np.diff(face[some], prepend=face[some[0]] - 1))
    left, right = _ends(u[some], v[some], first, width, height)
    numbers = source[some[first]]
    _fill(buffers, left, right, _planes(buffers, triangles.plane[numbers], view), triangles.color[numbers], numbers)
    return np.flatnonzero(~whole)


def _length(ends: Array, edge: int) -> Array:
    """Extent of the corners of each triangle along a picture's edge, (t,) px."""
    a, b, c = np.clip(ends, 0.0, edge).T
    return np.asarray(np.maximum(np.maximum(a, b), c) - np.minimum(np.minimum(a, b), c))


def _ends(u: Array, v: Array, first: Array, width: int, height: int) -> tuple[Array, Array]:
    """First columns with their middle in a face, and the columns behind the last, row by row, (f, height) int16."""
    middle = np.arange(height) + 0.5
    u0, v0, u1, v1 = (each[:, :, None] for each in (u, v, np.roll(u, -1, axis=1), np.roll(v, -1, axis=1)))
    crossing = (v0 <= middle) != (v1 <= middle)
    with np.errstate(divide="ignore", invalid="ignore"):
        column = u0 + (middle - v0) * ((u1 - u0) / (v1 - v0))
    left = np.minimum.reduceat(np.where(crossing, column, np.inf).min(axis=1), first)
    right = np.maximum.reduceat(np.where(crossing, column, -np.inf).max(axis=1), first)
    ends = np.ceil(np.clip([left, right], 0.0, width) - 0.5).astype(np.int16)
    return ends[0], ends[1]


def _planes(buffers: Buffers, plane: Array, view: View) -> tuple[Array, Array]:
    """Depth buffer of each face as a sum of a value for each row, (f, height), and for each column, (f, width)."""
    normal, (near, far) = plane[:, :3], buffers[3:]
    inverse = (normal @ view.rotation) / (plane[:, 3] - normal @ view.eye)[:, None]  # of a ray's right, down, ahead: 1/m
    inverse *= -far * near / (far - near)
    rows = inverse[:, 1:2] * view.rows() + (inverse[:, 2:] + far / (far - near))
    columns = inverse[:, :1] * view.columns()
    return rows.astype(np.float32), columns.astype(np.float32)


def _fill(buffers: Buffers, left: Array, right: Array, planes: tuple[Array, Array], color: Array, number: Array) -> None:
    every = np.arange(buffers.depth.shape[1], dtype=np.int16)
    for i, value in enumerate(color.astype(np.int32)):
        rows = np.flatnonzero(left[i] < right[i])
        if not len(rows):
            continue
        top, bottom = int(rows[0]), int(rows[-1]) + 1
        begin, end = left[i, top:bottom, None], right[i, top:bottom, None]
        west, east = int(begin.min()), int(end.max())
        part, columns = np.s_[top:bottom, west:east], every[west:east]
        depth = planes[0][i, top:bottom, None] + planes[1][i, west:east]
        nearer = depth < buffers.depth[part]
        nearer &= columns >= begin
        nearer &= columns < end
        mask = nearer.view(np.uint8)
        cv2.copyTo(depth, mask, buffers.depth[part])
        cv2.copyTo(np.full(depth.shape, value), mask, buffers.color[part])
        if buffers.number is not None:
            cv2.copyTo(np.full(depth.shape, number[i] + 1, np.int32), mask, buffers.number[part])
