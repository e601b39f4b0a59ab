"""Floor, sky and targets in a camera's picture; targets also on maps."""

import math
from typing import NamedTuple

import cv2
import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.physics.render.triangles import View, clipped, packed
from vcmvsp.physics.world.floor import PlacedTarget, read_picture
from vcmvsp.physics.world.solids import rectangle
from vcmvsp.physics.world.world import World, cached_on_world

SKY = (172, 204, 235)  # above the horizon

_LARGEST = 32766  # pixels along an edge of a picture that OpenCV can warp


class Level(NamedTuple):
    """The ground picture at one resolution."""

    pixels: Array  # (h, w, 4) uint8, red, green, blue, nothing
    from_world: Array  # (3, 3): pixel coordinates (column, row, 1) of world (x, y, 1)
    metre_px: float  # pixels a metre, along the finer axis


@cached_on_world
def levels_of(world: World) -> list[Level]:
    """The ground picture, and smaller copies, each half as large; empty: there is none."""
    picture = world.ground.image
    if picture is None:
        return []
    rgba: Array = cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_RGB2RGBA)
    height, width = rgba.shape[:2]
    if max(height, width) > _LARGEST:
        rgba = cv2.resize(rgba, (min(width, _LARGEST), min(height, _LARGEST)), interpolation=cv2.INTER_AREA)
    return [_level(world, each) for each in _halved(rgba)]


def _halved(pixels: Array) -> list[Array]:
    """A picture, and smaller copies, each half as large."""
    pictures = [pixels]
    while min(pictures[-1].shape[:2]) > 1:
        height, width = pictures[-1].shape[:2]
        pictures.append(cv2.resize(pictures[-1], ((width + 1) // 2, (height + 1) // 2), interpolation=cv2.INTER_AREA))
    return pictures


def _level(world: World, pixels: Array) -> Level:
    (x, y), (east_west, north_south) = world.ground.center, world.ground.size
    height, width = pixels.shape[:2]
    right, up = width / east_west, height / north_south
    # The middle of the first pixel is (0, 0).
    first, second = [right, 0.0, -right * (x - 0.5 * east_west) - 0.5], [0.0, -up, up * (y + 0.5 * north_south) - 0.5]
    return Level(pixels, np.array([first, second, [0.0, 0.0, 1.0]]), max(right, up))


def inverse_depth(view: View) -> Array:
    """One over the depth of the floor, along the optical axis, (height, width) 1/m; not positive: the sky."""
    right, down, ahead = view.rotation[2]
    rows = (view.rows() * down + ahead) / -view.eye[2]
    return np.asarray(rows[:, None] + view.columns() * (right / -view.eye[2]))


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
        lay_seen(pixels, world, textures_of(world), view, time_s)
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
    return np.asarray(picture.view(np.int32)[:, :, 0] & 0xFFFFFF)


_NEAREST_M = 0.005  # along the optical axis
_DISC_PX = 128


Texture = list[Array]
"""Look of a target: red, green, blue, each times the opacity, and that, (n, n, 4) uint8; then each half as large."""


@cached_on_world
def textures_of(world: World) -> list[Texture]:
    """Textures of the targets of a world."""
    looks = [target.picture or target.color for target in world.targets]
    by_look = {look: _texture(target) for look, target in dict(zip(looks, world.targets, strict=True)).items()}
    return [by_look[look] for look in looks]


def _texture(target: PlacedTarget) -> Texture:
    if target.picture:
        pixels = read_picture(target.picture)
        edge = max(pixels.shape[:2])
        rgba = cv2.cvtColor(cv2.resize(pixels, (edge, edge), interpolation=cv2.INTER_LINEAR), cv2.COLOR_RGB2RGBA)
    else:
        rgba = np.zeros((_DISC_PX, _DISC_PX, 4), np.uint8)
        middle = round((0.5 * _DISC_PX - 0.5) * 16)
        cv2.circle(rgba, (middle, middle), 8 * _DISC_PX, (*target.color, 255), cv2.FILLED, cv2.LINE_AA, 4)
    return _halved(rgba)


def lay_seen(picture: Array, world: World, textures: list[Texture], view: View, time_s: float) -> None:
    """Lay the targets into the floor of a picture, (h, w, 4) uint8, before the sky is drawn."""
    corners = np.array([corners_of(target, time_s) for target in world.targets])
    places = np.concatenate([corners, np.zeros((len(corners), 4, 1))], axis=2) - view.eye
    places = places @ view.rotation
    scale, middle = view.focal_px, 0.5 * np.array([view.width, view.height])
    for number in np.flatnonzero(places[:, :, 2].max(axis=1) > _NEAREST_M).tolist():
        ahead = places[number]
        if ahead[:, 2].min() <= _NEAREST_M:  # partly behind the camera
            halves = ahead[[(0, 1, 2), (0, 2, 3)]]
            ahead = clipped(halves, halves[:, :, 2] - _NEAREST_M)[0].reshape(-1, 3)
        pixels = ahead[:, :2] * (scale / ahead[:, 2:]) + middle - 0.5
        if (pixels.max(axis=0) > -1.0).all() and (pixels.min(axis=0) < (view.width, view.height)).all():
            lay(picture, textures[number], corners[number], pixels, view.floor_from_pixel())


def corners_of(target: PlacedTarget, time_s: float) -> Array:
    """Corners of a target's picture, (4, 2) m: its upper right, then counter-clockwise."""
    half = 0.5 * target.size_m
    return rectangle(*target.place(time_s), half, half, target.yaw_rad)


def lay(picture: Array, texture: Texture, corners: Array, pixels: Array, floor_from_pixel: Array) -> None:
    """Lay a target over a picture, (h, w, 3 or 4) uint8, which is changed.

    Args:
        picture, texture: of the floor, of the target.
        corners: of the target on the floor, (4, 2) m: its upper right, then counter-clockwise.
        pixels: corners of its visible part, (k, 2) column and row.
        floor_from_pixel: (3, 3), see `View`.
    """
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    size = math.sqrt(max(cv2.contourArea(cv2.convexHull(pixels.astype(np.float32))), 1.0))  # of the target in the picture, px
    level = round(math.log2(max(texture[0].shape[0] / size, 1.0)))
    pixel_of = texture[min(level, len(texture) - 1)]
    edge = pixel_of.shape[0]
    room = 1.0 + (high - low).max() / edge  # it fades out half of its own pixel beyond its edges
    left, top = np.maximum(np.floor(low - room), 0).astype(int).tolist()
    right, bottom = np.minimum(np.ceil(high + room) + 1, picture.shape[1::-1]).astype(int).tolist()
    if left >= right or top >= bottom:
        return
    along, down = corners[0] - corners[1], corners[2] - corners[1]
    basis = np.linalg.inv(np.array([[along[0], down[0], corners[1, 0]], [along[1], down[1], corners[1, 1]], [0.0, 0.0, 1.0]]))
    texture_from_floor = np.array([[edge, 0.0, -0.5], [0.0, edge, -0.5], [0.0, 0.0, 1.0]]) @ basis
    shift = np.array([[1.0, 0.0, left], [0.0, 1.0, top], [0.0, 0.0, 1.0]])
    over = cv2.warpPerspective(
        pixel_of,
        texture_from_floor @ floor_from_pixel @ shift,
        (right - left, bottom - top),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
    )
    part = picture[top:bottom, left:right, :3]
    behind = part * (255 - over[:, :, 3:].astype(np.uint16))
    part[:] = over[:, :, :3] + ((behind + 127) // 255).astype(np.uint8)
