"""Drawings of a world for people: a map and an oblique view."""

import dataclasses
import math
from typing import NamedTuple

import cv2
import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.physics.render.renderer import render
from vcmvsp.physics.render.view import View
from vcmvsp.physics.render.world_map import draw_map, round_step, text
from vcmvsp.physics.world.floor import GroundPicture, Mark
from vcmvsp.physics.world.solids import AnySolid, Box, Color, Mesh
from vcmvsp.physics.world.world import Moving, World

_FOV = 0.7  # rad
_FROM = (0.5, -0.87)  # direction of the viewer: south-east, as sides to the east and south differ in brightness
_ELEVATION = 0.72  # rad
_AROUND_M = 3.0  # so much around the origin is drawn where a world has neither bounds nor a ground picture
_FINER = 2  # a picture is taken so many times larger and then averaged: smooth edges


class Drawing(NamedTuple):
    """A world on paper, (height, width, 3) uint8, red, green, blue."""

    above: Array  # a map
    oblique: Array  # from high up, looking north


def draw_world(world: World, *, width: int = 1200, height: int = 800, time_s: float = 0.0) -> Drawing:
    """Draw a world and its bodies.

    Args:
        world: the world.
        width: of each picture, px.
        height: px.
        time_s: time of moving obstacles and targets.
    """
    solids = (*world.solids, *(each.solid for each in world.movables), *(_placed(each, time_s) for each in world.moving))
    filled = dataclasses.replace(world, solids=solids)
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
    done, data = cv2.imencode(".png", picture[:, :, ::-1])
    if not done:
        raise ValueError(f"a picture of shape {picture.shape} cannot be written as PNG")
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
    return [
        np.column_stack([np.tile(piece.corners, (2, 1)), np.repeat([piece.bottom, piece.top], len(piece.corners))])
        for piece in solid.uprights()
    ]


def _placed(moving: Moving, time_s: float) -> AnySolid:
    """A moving obstacle at a time, as a solid."""
    x, y, z, yaw = moving.pose(time_s)
    if isinstance(moving.solid, Box):
        return Box(
            center=(x, y, z), size=moving.solid.size, yaw_rad=yaw, material=moving.solid.material, color=moving.solid.color
        )
    solid = moving.solid
    return type(solid)(center=(x, y, z), radius=solid.radius, height=solid.height, material=solid.material, color=solid.color)


def _grid(low: Array, high: Array, step: float, color: Color) -> GroundPicture:
    """A floor with grid lines as a scale, as far as the view reaches."""
    room = 2.0 * float((high - low).max())
    west, south, east, north = (
        step * round(edge / step) for edge in (low[0] - room, low[1] - room, high[0] + room, high[1] + room)
    )
    red, green, blue = color
    faint = (red * 9 // 10, green * 9 // 10, blue * 9 // 10)
    lines = [((x, south), (x, north)) for x in np.arange(west, east + 0.5 * step, step).tolist()]
    lines += [((west, y), (east, y)) for y in np.arange(south, north + 0.5 * step, step).tolist()]
    return GroundPicture(
        center=(0.5 * (west + east), 0.5 * (south + north)),
        size=(east - west, north - south),
        color=color,
        resolution_m=max(east - west, north - south) / 4000,
        marks=tuple(Mark(line=line, color=faint, width=0.03 * step) for line in lines),
    )


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
    for _ in range(4):  # near enough that all corners are inside; then to the middle of what is projected
        places = (corners - aim) @ rotation
        distance = float(((np.abs(places[:, :2]) / slopes).max(axis=1) - places[:, 2]).max())
        projected = places[:, :2] / (places[:, 2:] + distance)
        aim = aim + distance * rotation[:, :2] @ (0.5 * (projected.min(axis=0) + projected.max(axis=0)))
    places = (corners - aim) @ rotation
    distance = float(((np.abs(places[:, :2]) / slopes).max(axis=1) - places[:, 2]).max())
    view = View(
        eye=aim + distance * back,
        rotation=rotation,
        width=_FINER * width,
        height=_FINER * height,
        focal_px=0.5 * _FINER * width / math.tan(0.5 * _FOV),
        reach_m=distance + 2.0 * float(np.linalg.norm(high - low)),
    )
    picture: Array = cv2.resize(render(world, view, time_s=time_s).pixels, (width, height), interpolation=cv2.INTER_AREA)
    return picture
