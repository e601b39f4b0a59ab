"""Small worlds with obstacles: gates, a pillar, a corridor."""

import math
from dataclasses import dataclass
from itertools import combinations
from typing import Annotated

import msgspec
import numpy as np

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Array, Positive
from vcmvsp.cosim.util.polygons import overlap_m
from vcmvsp.physics.world.solids import AnySolid, Box, Color, Cylinder, Point2, Prism
from vcmvsp.physics.world.world import World
from vcmvsp.physics.worlds.surroundings import Surroundings

_COLORS: tuple[Color, Color] = ((208, 72, 56), (56, 104, 184))  # of the walls on the left and on the right


@dataclass(frozen=True, kw_only=True)
class Gates(Surroundings):
    """Gates one after the other along the x axis (kind ``gates``); the first one is ``spacing`` from the origin."""

    number: Annotated[int, msgspec.Meta(ge=1, le=10_000)] = 5  # of gates
    width: Positive = 1.5  # of the gap, m
    spacing: Positive = 4.0  # from gate to gate, m
    offset: float = 0.0  # of the gaps from the x axis, m: first to the left, next to the right, and so on
    offsets: tuple[float, ...] = ()  # of each gap from the x axis, m, left is positive; in place of ``offset``, for all gates
    wall: Positive = 2.0  # length of each of the two walls, m
    thickness: Positive = 0.2  # of the walls, m
    height: Positive = 1.0  # of the walls, m

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.thickness >= self.spacing:
            raise ValueError(f"spacing = {self.spacing:g} leaves no room between gates, which are {self.thickness:g} m thick")
        if self.offsets and len(self.offsets) != self.number:
            problem = f"must have one value per gate (number = {self.number}), not {len(self.offsets)}"
            raise ScenarioError(problem, key="offsets")
        if self.offsets and self.offset != type(self).offset:
            raise ScenarioError("places all gaps already: leave out offset, or leave out offsets", key="offsets")

    def middles(self) -> tuple[float, ...]:
        """Middles of the gaps, y m."""
        return self.offsets or tuple(self.offset * (-1.0) ** gate for gate in range(self.number))

    def build(self) -> World:
        """Build the world."""
        solids = []
        for gate, middle in enumerate(self.middles()):
            x = self.spacing * (gate + 1)
            for side, color in zip((1.0, -1.0), _COLORS, strict=True):
                y = middle + side * 0.5 * (self.width + self.wall)
                size = (self.thickness, self.wall, self.height)
                solids.append(Box(center=(x, y, 0.5 * self.height), size=size, material="wood", color=color))
        return self.complete("gates-offset" if any(self.middles()) else "gates", solids=solids)


@dataclass(frozen=True, kw_only=True)
class GatesOffset(Gates):
    """Gates that stand alternately to the left and to the right (kind ``gates-offset``)."""

    offset: float = 0.75  # of the gaps from the x axis, m: first to the left, next to the right, and so on


@dataclass(frozen=True, kw_only=True)
class Pillar(Surroundings):
    """A pillar, round or square (kind ``pillar``)."""

    position: Point2 = (5.0, 0.0)  # of its axis, x, y, m
    radius: Positive = 0.5  # of the pillar, m; half its edge where it is square
    square: bool = False  # whether its sides are flat, along the axes
    height: Positive = 3.0  # of the pillar, m

    def build(self) -> World:
        """Build the world."""
        center, edge = (*self.position, 0.5 * self.height), 2.0 * self.radius
        pillar: AnySolid = Cylinder(center=center, radius=self.radius, height=self.height)
        if self.square:
            pillar = Box(center=center, size=(edge, edge, self.height))
        return self.complete("pillar", solids=[pillar])


@dataclass(frozen=True, kw_only=True)
class Corridor(Surroundings):
    """Two walls (kind ``corridor``); its middle line begins on the x axis and leads east until the first bend."""

    length: Positive = 20.0  # of its middle line, m; bends divide it into equal parts
    start: float = 0.0  # where its middle line begins, x m: robots can stand before it
    width: Positive = 2.0  # between the walls, m
    height: Positive = 2.5  # of the walls, m
    thickness: Positive = 0.2  # of the walls, m
    bends: tuple[float, ...] = ()  # rad, left is positive
    closed: bool = False  # whether the far end is walled up
    material: str = "brick"  # of the walls

    def __post_init__(self) -> None:
        super().__post_init__()
        reach = (0.5 * self.width + self.thickness) * math.tan(0.5 * max(map(abs, self.bends), default=0.0))
        if max(map(abs, self.bends), default=0.0) >= 0.99 * math.pi or 2.0 * reach >= self.part:
            problem = f"parts of {self.part:g} m are too short for these bends: raise length, or lower width or bends"
            raise ScenarioError(problem, key="bends")

    @property
    def part(self) -> float:
        """Length of the middle line between two bends, m."""
        return self.length / (len(self.bends) + 1)

    def middle(self) -> Array:
        """The middle line: start, bends and end, (bends + 2, 2) m."""
        headings = np.concatenate([[0.0], np.cumsum(self.bends)])
        steps = self.part * np.column_stack([np.cos(headings), np.sin(headings)])
        return np.cumsum(np.concatenate([[[self.start, 0.0]], steps]), axis=0)

    def build(self) -> World:
        """Build the world.

        Raises:
            ScenarioError: the corridor would run into itself.
        """
        inner, outer = 0.5 * self.width, 0.5 * self.width + self.thickness
        walls = [*self._wall(inner, outer), *self._wall(-outer, -inner)]
        if self.closed:
            *_, before, end = self.middle()
            along = (end - before) / self.part * self.thickness
            across = np.array([-along[1], along[0]]) / self.thickness * outer
            walls.append(np.array([end - across, end - across + along, end + across + along, end + across]))
        if any(overlap_m(a, b) > 1e-9 for a, b in combinations(walls, 2)):
            raise ScenarioError("the corridor crosses itself: raise length, or lower bends", key="bends")
        corners = (map(tuple, wall.tolist()) for wall in walls)
        solids = [Prism(outline=tuple(each), height=self.height, material=self.material) for each in corners]
        return self.complete("corridor", solids=solids)

    def _wall(self, right: float, left: float) -> list[Array]:
        """Quadrangles, one for each part, between two lines at these distances to the left of the middle line, m."""
        a, d = self._along(right), self._along(left)
        return [*np.stack([a[:-1], a[1:], d[1:], d[:-1]], axis=1)]

    def _along(self, left: float) -> Array:
        """A line at a distance to the left of the middle line, m, mitred at the bends."""
        headings = np.concatenate([[0.0], np.cumsum(self.bends)])
        before, after = np.append(headings, headings[-1]), np.concatenate([headings[:1], headings])
        half = 0.5 * (after - before)  # at each corner, half of the turn
        across = 0.5 * (before + after) + 0.5 * math.pi
        return np.asarray(self.middle() + (left / np.cos(half))[:, None] * np.column_stack([np.cos(across), np.sin(across)]))
