"""A recreation centre: a large field with a running track, a pitch, a few halls and trees along its border."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Seed
from vcmvsp.physics.world.floor import GroundPicture, Mark
from vcmvsp.physics.world.solids import AnySolid, Box, Color, Cylinder, Point2
from vcmvsp.physics.world.world import World
from vcmvsp.physics.worlds.surroundings import Surroundings, bounds_of, rectangle_points

LENGTH, WIDTH = 300.0, 250.0  # east-west, north-south, m

_STRAIGHT, _BEND, _LANES, _LANE = 84.39, 36.5, 8, 1.22  # of a 400 m track, m (World Athletics, Facilities Manual)
_PITCH = (105.0, 68.0)  # m (FIFA)
_CROWN = 2.5  # greatest radius of a crown, m
_TREES_FROM_BORDER = 8.0  # m

_LAWN: Color = (104, 148, 78)
_PITCH_GREEN: Color = (84, 136, 66)
_TARTAN: Color = (176, 82, 62)
_PAVED: Color = (164, 160, 152)
_WHITE: Color = (240, 240, 236)
_HARD_COURT: Color = (62, 104, 150)

_HALLS = (  # centre, size, m; material, colour
    ((-95.0, 88.0, 6.0), (56.0, 34.0, 12.0), "brick", (186, 112, 84)),  # sports hall
    ((98.0, 86.0, 4.5), (44.0, 28.0, 9.0), "glass", (142, 178, 196)),  # swimming hall
    ((0.0, -96.0, 3.0), (36.0, 12.0, 6.0), "concrete", (208, 196, 168)),  # club house
    ((112.0, -92.0, 2.0), (18.0, 10.0, 4.0), "wood", (140, 96, 60)),  # boat shed
)
_YARDS: tuple[tuple[Point2, Point2], ...] = (  # middle, size, m
    *(((0.0, -110.0), (LENGTH, 6.0)), ((0.0, -100.0), (60.0, 26.0)), ((-95.0, 64.0), (70.0, 14.0))),
    *(((98.0, 64.0), (58.0, 16.0)), ((-134.0, -23.0), (6.0, 174.0)), ((134.0, -23.0), (6.0, 174.0))),
)
_COURTS = ((-112.0, -72.0), (-92.0, -72.0), (-72.0, -72.0))  # middles of tennis courts, m
_COURT = (10.97, 23.77)  # m (ITF)


@dataclass(frozen=True, kw_only=True)
class RecreationCentre(Surroundings):
    """A field of 300 x 250 m (kind ``recreation-centre``); the origin is the middle of the pitch."""

    trees: Annotated[int, msgspec.Meta(ge=0, le=120)] = 72  # along the border
    seed: Seed = 0  # of the trees' sizes and places

    def build(self) -> World:
        """Build the world."""
        halls = [Box(center=center, size=size, material=material, color=color) for center, size, material, color in _HALLS]
        solids: list[AnySolid] = [*halls, *_trees(self.trees, self.seed)]
        return self.complete("recreation-centre", solids=solids, ground=_ground(), bounds=bounds_of(LENGTH, WIDTH))


def _trees(number: int, seed: int) -> Iterator[Cylinder]:
    length, width = LENGTH - 2.0 * _TREES_FROM_BORDER, WIDTH - 2.0 * _TREES_FROM_BORDER
    rng, spacing = stream(seed, "recreation-centre/trees"), 2.0 * (length + width) / max(1, number)
    play = max(0.0, 0.5 * (spacing - math.sqrt(2.0) * 2.0 * _CROWN))  # round a corner, neighbours are closer by the root of 2
    draws = rng.uniform(size=(number, 4))
    along = spacing * np.arange(number) + play * (2.0 * draws[:, 0] - 1.0)
    corners = np.cumsum([0.0, length, width, length, width])
    x = np.interp(along % corners[-1], corners, 0.5 * length * np.array([-1, 1, 1, -1, -1]))
    y = np.interp(along % corners[-1], corners, 0.5 * width * np.array([-1, -1, 1, 1, -1]))
    for east, north, (trunk, crown, green) in zip(x.tolist(), y.tolist(), draws[:, 1:].tolist(), strict=True):
        top, radius, height = 2.2 + 1.2 * trunk, 1.4 + (_CROWN - 1.4) * crown, 3.0 + 3.0 * crown
        yield Cylinder(center=(east, north, 0.5 * top), radius=0.15 + 0.15 * crown, height=top, material="wood")
        color = (60 + round(24 * green), 104 + round(30 * green), 52)
        yield Cylinder(center=(east, north, top + 0.5 * height), radius=radius, height=height, material="wood", color=color)


def _ground() -> GroundPicture:
    paths = [((0.5 * (x + math.copysign(134.0, x)), 61.0), (abs(abs(x) - 134.0) + 6.0, 6.0)) for x in (-95.0, 98.0)]
    marks = [_area(center, size, _PAVED) for center, size in (*_YARDS, *paths)]
    marks += [mark for middle in _COURTS for mark in _court(middle)]
    marks += [Mark(outline=_stadium(_BEND + _LANES * _LANE), color=_TARTAN), Mark(outline=_stadium(_BEND), color=_PITCH_GREEN)]
    for lane in range(_LANES + 1):
        ring = _stadium(_BEND + lane * _LANE)
        marks.append(Mark(line=(*ring, ring[0]), width=0.05, color=_WHITE))
    marks += _pitch()
    return GroundPicture(size=(LENGTH, WIDTH), color=_LAWN, resolution_m=0.1, marks=tuple(marks))


def _area(center: Point2, size: Point2, color: Color) -> Mark:
    return Mark(outline=rectangle_points(center, size), color=color)


def _frame(center: Point2, size: Point2) -> Mark:
    ring = rectangle_points(center, size)
    return Mark(line=(*ring, ring[0]), width=0.12, color=_WHITE)


def _ring(center: Point2, radius: float) -> Mark:
    angles = np.linspace(0.0, math.tau, 65).tolist()
    points = tuple((center[0] + radius * math.cos(a), center[1] + radius * math.sin(a)) for a in angles)
    return Mark(line=points, width=0.12, color=_WHITE)


def _stadium(radius: float) -> tuple[Point2, ...]:
    half = [math.pi * k / 48 for k in range(49)]
    east = [(0.5 * _STRAIGHT + radius * math.sin(a), -radius * math.cos(a)) for a in half]
    return (*east, *((-x, -y) for x, y in east))


def _pitch() -> list[Mark]:
    """The lines of a football pitch (IFAB, Laws of the Game, law 1)."""
    length, width = _PITCH
    marks = [_frame((0.0, 0.0), _PITCH), _ring((0.0, 0.0), 9.15)]
    marks.append(Mark(line=((0.0, -0.5 * width), (0.0, 0.5 * width)), width=0.12, color=_WHITE))
    for side in (-1.0, 1.0):
        for depth, across in ((16.5, 40.32), (5.5, 18.32)):
            marks.append(_frame((side * 0.5 * (length - depth), 0.0), (depth, across)))
        marks.append(Mark(center=(side * (0.5 * length - 11.0), 0.0), radius=0.2, color=_WHITE))
    return marks


def _court(middle: Point2) -> list[Mark]:
    x, y = middle
    net = Mark(line=((x - 0.5 * _COURT[0], y), (x + 0.5 * _COURT[0], y)), width=0.12, color=_WHITE)
    return [_area(middle, (_COURT[0] + 6.0, _COURT[1] + 8.0), _HARD_COURT), _frame(middle, _COURT), net]
