"""Pictures of a world: floor and sky, then triangles of solids and bodies with a depth buffer, sampled at pixel middles."""

from typing import NamedTuple

import cv2
import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Array
from vcmvsp.physics.raycast.moving_hulls import hulls_of
from vcmvsp.physics.render.floor_and_sky import ground, inverse_depth, levels_of
from vcmvsp.physics.render.large_faces import LARGE_PX, Buffers, draw_large
from vcmvsp.physics.render.occlusion import shown
from vcmvsp.physics.render.triangles import ScenePieces, Triangles, bodies, clipped, pieces_of
from vcmvsp.physics.render.view import View
from vcmvsp.physics.world.scene import Scene
from vcmvsp.physics.world.world import World, made_once

NEAREST_M = 0.005  # along the optical axis: what is nearer is cut off

_GUARD = 16.0  # triangles are cut off where they reach so many half pictures beyond the middle: float32 needs small numbers


class Picture(NamedTuple):
    """A camera's picture."""

    pixels: Array  # (height, width, 3) uint8, red, green, blue
    depth_m: Array | None  # (height, width) float32, along the optical axis; inf: nothing, or out of reach


def render(
    world: World, view: View, *, scene: Scene | None = None, without: int = -1, depth: bool = False, time_s: float = 0.0
) -> Picture:
    """Render a world and the bodies in it.

    Args:
        world: all that stands still.
        view: of the camera.
        scene: all that moves; None: nothing.
        without: row of the camera's own body, which is omitted; -1: none.
        depth: whether to compute the depth.
        time_s: time of the targets' places without a scene.
    """
    time_s = time_s if scene is None else scene.now_ns / SECOND_NS
    floor = ground(world, made_once(world, levels_of), view, time_s)
    triangles = _visible(made_once(world, pieces_of), view)
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
    return Picture(_unpacked(floor), None if number is None else _depth(view, triangles, number))


def _visible(pieces: ScenePieces, view: View) -> Triangles:
    near = shown(pieces, np.flatnonzero(_in_frustum(pieces.center, pieces.radius, view)), view)
    first = pieces.first[near]
    count = pieces.first[near + 1] - first
    ends = np.cumsum(count)
    numbers = np.arange(ends[-1] if len(ends) else 0) + np.repeat(first - ends + count, count)
    return pieces.triangles.take(numbers[_facing(pieces.triangles.plane[numbers], view)])


def _bodies_near(scene: Scene, without: int, view: View) -> Array:
    hulls = hulls_of(scene)
    visible = _in_frustum(hulls.centre, hulls.radius, view)
    if without >= 0:
        visible[without] = False
    return np.flatnonzero(visible)


def _in_frustum(center: Array, radius: Array, view: View) -> Array:
    """Spheres that may be in the picture, (m,) bool."""
    f, half_width, half_height = view.focal_px, 0.5 * view.width, 0.5 * view.height
    side, upper = np.hypot(f, half_width), np.hypot(f, half_height)
    inward = np.array(
        [
            [f / side, 0.0, half_width / side],
            [-f / side, 0.0, half_width / side],
            [0.0, f / upper, half_height / upper],
            [0.0, -f / upper, half_height / upper],
            [0.0, 0.0, 1.0],
            [0.0, 0.0, -1.0],
        ]
    )
    inward = view.rotation @ inward.T  # (3, 6), world
    offset = view.eye @ inward
    offset[5] -= view.reach_m
    inside: Array = (center @ inward + radius[:, None] >= offset).all(axis=1)
    return inside


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
    cut = _any(behind | (np.abs(x) > _GUARD * right) | (np.abs(y) > _GUARD * lower)) & ~outside
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
    both: Array = first & second & third
    return both


def _any(of_corners: Array) -> Array:
    first, second, third = of_corners.T
    either: Array = first | second | third
    return either


def _draw(buffers: Buffers, corner: Array, color: Array, source: Array, view: View) -> tuple[Array, Array | None]:
    if not len(corner):
        return buffers.color, buffers.number
    values = np.zeros((len(corner), 3, 3), np.float32)  # the three channels of each corner; that of the first corner counts
    values[:, 0, 0], values[:, 0, 1] = color, source + 1
    canvas = np.empty((view.height, view.width, 3), np.float32)
    canvas[:, :, 0] = buffers.color
    if buffers.number is not None:
        canvas[:, :, 1] = buffers.number
    _rasterize(buffers, canvas, corner, values, view)
    return cv2.extractChannel(canvas, 0), None if buffers.number is None else canvas[:, :, 1]


def _rasterize(buffers: Buffers, canvas: Array, corner: Array, values: Array, view: View) -> None:
    """OpenCV's own renderer, which samples pixel middles, too."""
    cv2.triangleRasterize(
        (corner * (1.0, -1.0, -1.0)).astype(np.float32).reshape(1, -1, 3),  # as OpenGL has it: y up, looking along -z
        np.arange(3 * len(corner), dtype=np.int32).reshape(1, -1, 3),
        values.reshape(1, -1, 3),
        canvas,
        buffers.depth,
        np.eye(4),
        2.0 * float(np.arctan(0.5 * view.height / view.focal_px)),
        buffers.near,
        buffers.far,
        _SETTINGS,
    )


def _settings() -> cv2.TriangleRasterizeSettings:
    settings = cv2.TriangleRasterizeSettings()
    settings.setShadingType(cv2.RASTERIZE_SHADING_FLAT)
    settings.setCullingMode(cv2.RASTERIZE_CULLING_NONE)
    settings.setGlCompatibleMode(cv2.RASTERIZE_COMPAT_INVDEPTH)
    return settings


_SETTINGS = _settings()

# The C library gives freed memory back to the system, to get it again page by page, as long as nothing large has been freed: a
# picture of 640 x 480 would take twice as long. So something large is freed, of which no page was ever touched.
np.empty(24 << 20, np.uint8)


def _unpacked(color: Array) -> Array:
    """Packed colours, (h, w), as red, green, blue, (h, w, 3) uint8."""
    rgba = color.astype("<i4").view(np.uint8).reshape(*color.shape, 4)
    pixels: Array = cv2.cvtColor(rgba, cv2.COLOR_RGBA2RGB)
    return pixels


def _depth(view: View, triangles: Triangles, number: Array) -> Array:
    """Depths from the planes of what was drawn: one over the depth is linear in the picture."""
    inverse = inverse_depth(view)
    rows, columns = np.nonzero(number)
    normal = triangles.plane[:, :3]
    slopes = (normal @ view.rotation) / (triangles.plane[:, 3] - normal @ view.eye)[:, None]
    right, down, ahead = slopes[number[rows, columns].astype(np.int64) - 1].T
    inverse[rows, columns] = right * view.columns()[columns] + down * view.rows()[rows] + ahead
    with np.errstate(divide="ignore"):
        metres = np.where(inverse > 1.0 / view.reach_m, 1.0 / inverse, np.inf)
    return metres.astype(np.float32)
