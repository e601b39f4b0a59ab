"""Floor and sky in a camera's picture."""

import math
from typing import NamedTuple

import cv2
import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.physics.render.target_textures import lay_seen, textures_of
from vcmvsp.physics.render.triangles import packed
from vcmvsp.physics.render.view import View
from vcmvsp.physics.world.world import World, made_once

SKY = (172, 204, 235)  # above the horizon

_LARGEST = 32766  # pixels along an edge of a picture that OpenCV can warp


class Level(NamedTuple):
    """The ground picture at one resolution."""

    pixels: Array  # (h, w, 4) uint8, red, green, blue, nothing
    from_world: Array  # (3, 3): pixel coordinates (column, row, 1) of world (x, y, 1)
    metre_px: float  # pixels a metre, along the finer axis


def levels_of(world: World) -> list[Level]:
    """The ground picture, and smaller copies, each half as large; empty: there is none."""
    picture = world.ground.image()
    if picture is None:
        return []
    rgba: Array = cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_RGB2RGBA)
    levels = [_level(world, _fitting(rgba))]
    while min(levels[-1].pixels.shape[:2]) > 1:
        height, width = levels[-1].pixels.shape[:2]
        half = ((width + 1) // 2, (height + 1) // 2)
        levels.append(_level(world, cv2.resize(levels[-1].pixels, half, interpolation=cv2.INTER_AREA)))
    return levels


def _fitting(rgba: Array) -> Array:
    height, width = rgba.shape[:2]
    if max(height, width) <= _LARGEST:
        return rgba
    smaller: Array = cv2.resize(rgba, (min(width, _LARGEST), min(height, _LARGEST)), interpolation=cv2.INTER_AREA)
    return smaller


def _level(world: World, pixels: Array) -> Level:
    (x, y), (east_west, north_south) = world.ground.center, world.ground.size
    height, width = pixels.shape[:2]
    right, up = width / east_west, height / north_south
    from_world = np.array(  # the middle of the first pixel is (0, 0)
        [
            [right, 0.0, -right * (x - 0.5 * east_west) - 0.5],
            [0.0, -up, up * (y + 0.5 * north_south) - 0.5],
            [0.0, 0.0, 1.0],
        ]
    )
    return Level(pixels, from_world, max(right, up))


def inverse_depth(view: View) -> Array:
    """One over the depth of the floor, along the optical axis, (height, width) 1/m; not positive: the sky."""
    right, down, ahead = view.rotation[2]
    rows = (view.rows() * down + ahead) / -view.eye[2]
    result: Array = rows[:, None] + view.columns() * (right / -view.eye[2])
    return result


def ground(world: World, levels: list[Level], view: View, time_s: float) -> Array:
    """Floor and sky, (height, width) int32: red in the lowest eight bits, then green and blue.

    Floor and targets, at their places at that time, have their own colours, without light.
    """
    plain, sky = (np.int32(packed(np.array(color))) for color in (world.ground.color, SKY))
    right, down, ahead = view.rotation[2]
    middle, half = down * view.rows() + ahead, 0.5 * abs(right) * view.width / view.focal_px  # how far rays rise, row by row
    above, below = middle >= half, middle <= -half  # rows of the sky alone, and of the floor alone
    if above.all():
        return np.full((view.height, view.width), sky)
    if levels:
        picture = _warped(world, levels, view, float(half - middle.min()) / view.eye[2])
    else:
        picture = np.full((view.height, view.width), plain)
    if world.targets:
        pixels = picture.view(np.uint8).reshape(view.height, view.width, 4)
        lay_seen(pixels, world, made_once(world, textures_of), view, time_s)
    picture[above] = sky
    both = ~(above | below)
    if both.any():
        rising = middle[both, None] + view.columns() * right >= 0.0
        picture[both] = np.where(rising, sky, picture[both])
    return picture


def _warped(world: World, levels: list[Level], view: View, nearest: float) -> Array:
    """The ground picture in the camera, in the plain colour; ``nearest``: the largest inverse depth."""
    finest = levels[0].metre_px / (view.focal_px * nearest)  # pixels of the picture that a pixel of the camera covers
    level = levels[min(len(levels) - 1, max(0, math.floor(math.log2(finest))))]
    picture = cv2.warpPerspective(
        level.pixels,
        level.from_world @ view.floor_from_pixel(),
        (view.width, view.height),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=world.ground.color,
    )
    packed_picture: Array = picture.view(np.int32)[:, :, 0] & 0xFFFFFF
    return packed_picture
