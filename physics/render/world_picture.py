"""Drawings of a world for people: a map and an oblique view."""

import dataclasses
import math
from typing import NamedTuple

import cv2
import msgspec
import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.physics.render.floor_and_sky import corners_of, lay, textures_of
from vcmvsp.physics.render.renderer import render
from vcmvsp.physics.render.triangles import View
from vcmvsp.physics.world.floor import GroundPicture, Mark
from vcmvsp.physics.world.solids import AnySolid, Box, Color, Mesh, color_of, rectangle
from vcmvsp.physics.world.world import Moving, World

_FOV = 0.7  # rad
_FROM = (0.5, -0.87)  # direction of the viewer: south-east, as sides to the east and south differ in brightness
_ELEVATION = 0.72  # rad
_AROUND_M = 3.0  # drawn area around the origin for a world without bounds and ground picture
_FINER = 2  # pictures are rendered larger by this factor and then averaged: smooth edges


class Drawing(NamedTuple):
    """A world on paper, (height, width, 3) uint8, red, green, blue."""

    above: Array  # a map
    oblique: Array  # from high up, looking north


def draw_world(world: World, *, width: int = 1200, height: int = 800, time_s: float = 0.0) -> Drawing:
    """Draw a world and its bodies; each picture ``width`` x ``height`` px, with moving obstacles and targets at a time."""
    bodies: list[AnySolid] = [each.solid for each in world.movables]
    bodies += [_placed(each, time_s) for each in world.moving]
    filled = dataclasses.replace(world, solids=(*world.solids, *bodies))
    low, high = extent(filled)
    above = draw_map(filled, low, high, width, height, time_s)
    caption = world.name
    if world.ground.plain:
        step = round_step(0.05 * float((high - low)[:2].max()))
        filled = dataclasses.replace(filled, ground=_grid(low, high, step, world.ground.color))
        caption += f", lines every {step:g} m"
    oblique = _oblique(filled, low, high, width, height, time_s)
    text(oblique, caption, 16, height - 16, 0.6)
    return Drawing(above, oblique)


def png(picture: Array) -> bytes:
    """A picture, (h, w, 3) uint8 red, green, blue, as a PNG file.

    Raises:
        ValueError: it cannot be written as one.
    """
    is_encoded, data = cv2.imencode(".png", picture[:, :, ::-1])
    if not is_encoded:
        raise ValueError(f"an array of shape {picture.shape} cannot be written as PNG: it must be (h, w, 3)")
    return bytes(data)


def extent(world: World) -> tuple[Array, Array]:
    """Lowest and highest x, y, z, m, of the parts to draw."""
    corners = [each for solid in world.solids for each in _outer(solid)]
    corners += [each for moving in world.moving for time_s in moving.times_s for each in _outer(_placed(moving, time_s))]
    for target in world.targets:
        way = np.array(target.way)
        corners += [np.column_stack([way + side * target.size_m, np.zeros(len(way))]) for side in (-1.0, 1.0)]
    if not world.ground.plain:
        (x, y), (length, width) = world.ground.center, world.ground.size
        corners.append(np.array([[x - 0.5 * length, y - 0.5 * width, 0.0], [x + 0.5 * length, y + 0.5 * width, 0.0]]))
    if world.bounds is not None:
        west, south, east, north = world.bounds
        corners.append(np.array([[west, south, 0.0], [east, north, 0.0]]))
    elif world.ground.plain:
        corners.append(np.array([[-_AROUND_M, -_AROUND_M, 0.0], [_AROUND_M, _AROUND_M, 0.0]]))
    points = np.concatenate(corners)
    low, high = points.min(axis=0), points.max(axis=0)
    return np.minimum(low, [math.inf, math.inf, 0.0]), high


def _outer(solid: AnySolid) -> list[Array]:
    if isinstance(solid, Mesh):
        return [solid.triangles.reshape(-1, 3)]
    ends = [(each.corners, np.repeat([each.bottom, each.top], len(each.corners))) for each in solid.uprights()]
    return [np.column_stack([np.tile(corners, (2, 1)), heights]) for corners, heights in ends]


def _placed(moving: Moving, time_s: float) -> AnySolid:
    x, y, z, yaw = moving.pose(time_s)
    turned = {"yaw_rad": yaw} if isinstance(moving.solid, Box) else {}
    return msgspec.structs.replace(moving.solid, center=(x, y, z), **turned)


def _grid(low: Array, high: Array, step: float, color: Color) -> GroundPicture:
    """A floor with grid lines as a scale, as far as the view reaches."""
    room = 2.0 * float((high - low).max())
    west, south, east, north = (step * round(edge / step) for edge in (*(low[:2] - room), *(high[:2] + room)))
    red, green, blue = color
    faint = (red * 9 // 10, green * 9 // 10, blue * 9 // 10)
    lines = [((x, south), (x, north)) for x in np.arange(west, east + 0.5 * step, step).tolist()]
    lines += [((west, y), (east, y)) for y in np.arange(south, north + 0.5 * step, step).tolist()]
    center, size = (0.5 * (west + east), 0.5 * (south + north)), (east - west, north - south)
    marks = tuple(Mark(line=line, color=faint, width=0.03 * step) for line in lines)
    return GroundPicture(center=center, size=size, color=color, resolution_m=max(size) / 4000, marks=marks)


def _oblique(world: World, low: Array, high: Array, width: int, height: int, time_s: float) -> Array:
    """The world from high up, from the smallest distance that shows all of it."""
    back = np.array([*_FROM, math.hypot(*_FROM) * math.tan(_ELEVATION)])
    back /= np.linalg.norm(back)
    right = np.cross(-back, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.column_stack([right, np.cross(-back, right), -back])
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    slopes = np.array([1.0, height / width]) * (0.94 * math.tan(0.5 * _FOV))  # of rays to the picture's edges
    aim, distance = 0.5 * (low + high), 0.0
    for _ in range(4):  # from a distance that shows all corners, then centred on their projection
        places = (corners - aim) @ rotation
        distance = float(((np.abs(places[:, :2]) / slopes).max(axis=1) - places[:, 2]).max())
        projected = places[:, :2] / (places[:, 2:] + distance)
        aim = aim + distance * rotation[:, :2] @ (0.5 * (projected.min(axis=0) + projected.max(axis=0)))
    places = (corners - aim) @ rotation
    distance = float(((np.abs(places[:, :2]) / slopes).max(axis=1) - places[:, 2]).max())
    reach_m = distance + 2.0 * float(np.linalg.norm(high - low))
    focal_px = 0.5 * _FINER * width / math.tan(0.5 * _FOV)
    view = View(aim + distance * back, rotation, _FINER * width, _FINER * height, focal_px, reach_m)
    return np.asarray(cv2.resize(render(world, view, time_s=time_s).pixels, (width, height), interpolation=cv2.INTER_AREA))


_PAPER, _INK, _FAINT, _WAY = (255, 255, 255), (40, 40, 40), (120, 120, 120), (30, 90, 200)
_LEFT, _RIGHT, _TOP, _BOTTOM = 64, 24, 48, 56  # px around the map
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_BITS = 4  # of a pixel's fraction in OpenCV's drawing


class _Sheet(NamedTuple):
    picture: Array
    west: float  # m, at the left edge of the map
    north: float  # m, at its upper edge
    scale: float  # px a metre
    width: int  # of the map, px
    height: int

    def pixel(self, points: Array) -> Array:
        """Places (k, 2) m in OpenCV's fixed-point form: the middle of the first pixel is 0, in 16ths of a pixel."""
        column = _LEFT + (points[:, 0] - self.west) * self.scale - 0.5
        row = _TOP + (self.north - points[:, 1]) * self.scale - 0.5
        return np.asarray(np.rint(np.column_stack([column, row]) * (1 << _BITS)).astype(np.int32))


def draw_map(world: World, low: Array, high: Array, width: int, height: int, time_s: float = 0.0) -> Array:
    """Map of the world between ``low`` and ``high``, m, on a sheet of a size in pixels, at a time."""
    sheet = _sheet(low, high, width, height)
    _floor(sheet, world)
    _targets(sheet, world, time_s)
    _solids(sheet, world)
    if world.bounds is not None:
        west, south, east, north = world.bounds
        corners = np.array([(west, south), (east, south), (east, north), (west, north)])
        cv2.polylines(sheet.picture, [sheet.pixel(corners)], True, (200, 40, 40), 2, cv2.LINE_AA, _BITS)
    ways = [(each.name, np.array(each.way)[:, :2], each.loop) for each in world.moving]
    ways += [(each.name, np.array(each.way), each.loop) for each in world.targets]
    for name, way, loop in ways:
        cv2.polylines(sheet.picture, [sheet.pixel(way)], loop, _WAY, 2, cv2.LINE_AA, _BITS)
        _name(sheet, name, way[0])
    for movable in world.movables:
        _name(sheet, movable.name, np.array(movable.solid.center[:2]))
    _frame(sheet, world.name)
    return sheet.picture


def _sheet(low: Array, high: Array, width: int, height: int) -> _Sheet:
    room_x, room_y = width - _LEFT - _RIGHT, height - _TOP - _BOTTOM
    size = np.maximum((high - low)[:2], 0.1)
    scale = 0.96 * min(room_x / size[0], room_y / size[1])
    middle = 0.5 * (low + high)[:2]
    picture = np.full((height, width, 3), _PAPER, np.uint8)
    return _Sheet(picture, middle[0] - 0.5 * room_x / scale, middle[1] + 0.5 * room_y / scale, scale, room_x, room_y)


def _floor(sheet: _Sheet, world: World) -> None:
    part = sheet.picture[_TOP : _TOP + sheet.height, _LEFT : _LEFT + sheet.width]
    part[:] = world.ground.color
    picture = world.ground.image
    if picture is not None:
        (x, y), (length, width) = world.ground.center, world.ground.size
        right, up = sheet.scale * length / picture.shape[1], sheet.scale * width / picture.shape[0]
        if min(right, up) < 1.0:
            less = (max(1, round(picture.shape[1] * min(right, 1.0))), max(1, round(picture.shape[0] * min(up, 1.0))))
            picture = cv2.resize(picture, less, interpolation=cv2.INTER_AREA)
            right, up = sheet.scale * length / picture.shape[1], sheet.scale * width / picture.shape[0]
        left, top = (x - 0.5 * length - sheet.west) * sheet.scale, (sheet.north - y - 0.5 * width) * sheet.scale
        turn = np.array([[right, 0.0, left + 0.5 * right - 0.5], [0.0, up, top + 0.5 * up - 0.5]])
        cv2.warpAffine(picture, turn, (sheet.width, sheet.height), dst=part, borderMode=cv2.BORDER_TRANSPARENT)
    for zone in world.zones:
        corners = rectangle(*zone.center, 0.5 * zone.size[0], 0.5 * zone.size[1], zone.yaw_rad)
        cv2.polylines(sheet.picture, [sheet.pixel(corners)], True, zone.color or _FAINT, 2, cv2.LINE_AA, _BITS)


def _targets(sheet: _Sheet, world: World, time_s: float) -> None:
    """Targets at their size, each with a ring: most are small."""
    right, down = _LEFT - sheet.west * sheet.scale - 0.5, _TOP + sheet.north * sheet.scale - 0.5
    floor_from_pixel = np.linalg.inv(np.array([[sheet.scale, 0.0, right], [0.0, -sheet.scale, down], [0.0, 0.0, 1.0]]))
    for target, texture in zip(world.targets, textures_of(world), strict=True):
        corners, place = corners_of(target, time_s), np.array([target.place(time_s)])
        lay(sheet.picture, texture, corners, sheet.pixel(corners) / (1 << _BITS), floor_from_pixel)
        radius = round((0.75 * target.size_m * sheet.scale + 3.0) * (1 << _BITS))
        cv2.circle(sheet.picture, sheet.pixel(place)[0].tolist(), radius, _WAY, 1, cv2.LINE_AA, _BITS)


def _solids(sheet: _Sheet, world: World) -> None:
    faces = []
    for solid in world.solids:
        color = color_of(solid)
        if isinstance(solid, Mesh):
            faces += [(float(each[:, 2].max()), each[:, :2], color, False) for each in solid.triangles]
        faces += [(piece.top, piece.corners, color, True) for piece in solid.uprights()]
    for _, corners, color, edged in sorted(faces, key=lambda each: each[0]):
        points = sheet.pixel(corners)
        cv2.fillPoly(sheet.picture, [points], color, cv2.LINE_AA, _BITS)
        if edged:
            dark = tuple(level * 0.55 for level in color)
            cv2.polylines(sheet.picture, [points], True, dark, 1, cv2.LINE_AA, _BITS)


def _name(sheet: _Sheet, name: str, place: Array) -> None:
    column, row = (int(value) >> _BITS for value in sheet.pixel(place[None])[0])
    text(sheet.picture, name, column + 6, row - 6, 0.45)


def _frame(sheet: _Sheet, name: str) -> None:
    picture, (left, top) = sheet.picture, (_LEFT, _TOP)
    right, bottom = left + sheet.width, top + sheet.height
    picture[:top], picture[bottom:], picture[:, :left], picture[:, right:] = 4 * (_PAPER,)
    step = round_step(100.0 / sheet.scale)
    for metres in _ticks(sheet.west, sheet.width / sheet.scale, step):
        column = left + round((metres - sheet.west) * sheet.scale)
        cv2.line(picture, (column, bottom), (column, bottom + 5), _INK, 1)
        text(picture, f"{metres:g}", column, bottom + 20, 0.45, middle=True)
    for metres in _ticks(sheet.north - sheet.height / sheet.scale, sheet.height / sheet.scale, step):
        row = top + round((sheet.north - metres) * sheet.scale)
        cv2.line(picture, (left - 5, row), (left, row), _INK, 1)
        text(picture, f"{metres:g}", left - 30, row + 5, 0.45, middle=True)
    cv2.rectangle(picture, (left, top), (right, bottom), _INK, 1)
    text(picture, "x east, m", (left + right) // 2, bottom + 42, 0.5, middle=True)
    text(picture, "y north, m", 6, top - 12, 0.5)
    text(picture, name, (left + right) // 2, top - 16, 0.8, middle=True)
    long = round(step * sheet.scale)
    cv2.rectangle(picture, (right - long, top - 22), (right, top - 16), _INK, cv2.FILLED)
    text(picture, f"{step:g} m", right - long - 10, top - 14, 0.5, end=True)


def _ticks(first: float, length: float, step: float) -> list[float]:
    return [step * n for n in range(math.ceil(first / step), math.floor((first + length) / step) + 1)]


def round_step(metres: float) -> float:
    """Round up to one of ..., 0.5, 1, 2, 5, 10, ..."""
    power: float = 10.0 ** math.floor(math.log10(metres))
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= 0.999 * metres)


def text(picture: Array, words: str, column: int, row: int, size: float, *, middle: bool = False, end: bool = False) -> None:
    """Write text into a picture: dark with a light edge, for any background."""
    (width, _), _ = cv2.getTextSize(words, _FONT, size, 1)
    if middle:
        column -= width // 2
    elif end:
        column -= width
    for right, down in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        cv2.putText(picture, words, (column + right, row + down), _FONT, size, _PAPER, 1, cv2.LINE_AA)
    cv2.putText(picture, words, (column, row), _FONT, size, _INK, 1, cv2.LINE_AA)
