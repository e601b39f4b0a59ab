"""A random town: blocks between streets, buildings with coloured roofs, targets in the streets."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Annotated

import msgspec
import numpy as np

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import NonNegative, Positive, Probability, Seed
from vcmvsp.physics.world.floor import MOST_PIXELS, GroundPicture, GroundTarget, Mark, PlacedTarget, placed
from vcmvsp.physics.world.solids import Box, Color, Point2
from vcmvsp.physics.world.world import World
from vcmvsp.physics.worlds.surroundings import Surroundings, bounds_of, rectangle_points, upright

_ASPHALT, _PAVED, _PARK, _LINE = (92, 94, 98), (172, 168, 160), (108, 150, 84), (226, 226, 220)
_WALLS: tuple[tuple[str, Color], ...] = (
    *(("concrete", (186, 182, 172)), ("concrete", (160, 158, 154))),
    *(("brick", (172, 104, 82)), ("brick", (196, 150, 112))),
)
_ROOFS: tuple[Color, ...] = (
    *((198, 62, 50), (216, 138, 44), (232, 204, 72), (70, 140, 78)),
    *((48, 112, 176), (116, 82, 154), (72, 74, 82), (150, 150, 152)),
)
_ROOF_M = 0.5  # thickness of a roof
_STEPPED = 0.35  # of the higher buildings have a narrower upper part
MOST_LOTS = 20_000  # building them takes some seconds
MOST_M = 100_000.0  # along an edge: the lines of its streets are marks of 3 m each
_TRIES = 1000  # to find a free place for a target


@dataclass(frozen=True, kw_only=True)
class Urban(Surroundings):
    """Random buildings in square blocks between streets (kind ``urban``); the origin is the middle of the town."""

    size: tuple[Positive, Positive] = (200.0, 200.0)  # of the town, east-west and north-south, m
    block: Positive = 36.0  # edge of a block, m
    street: Positive = 10.0  # width of a street, m
    lots: Annotated[int, msgspec.Meta(ge=1, le=20)] = 2  # along each edge of a block, one building on each
    gap: NonNegative = 4.0  # between lots of a block, at least, m
    density: Probability = 0.85  # probability that a lot has a building; otherwise it is a small park
    height_min: Positive = 4.0  # of a building, m
    height_max: Positive = 24.0  # of a building, m
    storey: NonNegative = 0.0  # heights are rounded to multiples of it, m; 0: not rounded
    seed: Seed | None = None  # of everything random here; None: that of the run

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.height_max < self.height_min:
            raise ScenarioError(f"must be at least height_min = {self.height_min:g}, not {self.height_max:g}", key="height_max")
        if max(self.size) > MOST_M:
            raise ScenarioError(f"a town of {max(self.size):g} m is too large: at most {MOST_M:g} m", key="size")
        if min(self.size) < self.block + 2.0 * self.street:
            raise ScenarioError(f"too small for one block of {self.block:g} m and its streets of {self.street:g} m", key="size")
        across = [math.floor(each / (self.block + self.street)) for each in self.size]
        if (lots := across[0] * across[1] * self.lots**2) > MOST_LOTS:
            raise ScenarioError(f"a town of {lots} lots is too large (at most {MOST_LOTS}): use larger blocks", key="size")
        if self.lot <= 1.0:
            problem = f"{self.lots} lots in a block of {self.block:g} m leave less than 1 m for a building"
            raise ScenarioError(problem, key="gap")

    @property
    def lot(self) -> float:
        """Edge of a lot, m."""
        return (self.block - (self.lots - 1) * self.gap) / self.lots

    def middles(self, axis: int) -> list[float]:
        """Middles of the blocks, east-west (0) or north-south (1), m."""
        pitch = self.block + self.street
        number = math.floor((self.size[axis] - self.street) / pitch + 1e-9)
        return [pitch * (k - 0.5 * (number - 1)) for k in range(number)]

    def build(self) -> World:
        """Build the world."""
        rng = stream(self.seed or 0, "urban")
        solids: list[Box] = []
        blocks, parks = [], []
        lots = [(self.lot + self.gap) * (k - 0.5 * (self.lots - 1)) for k in range(self.lots)]  # from the middle of a block
        for x, y in product(self.middles(0), self.middles(1)):
            blocks.append(Mark(outline=rectangle_points((x, y), (self.block, self.block)), color=_PAVED))
            for u, v in product(lots, lots):
                draws = rng.uniform(size=8).tolist()
                if draws[0] < self.density:
                    solids += self._building((x + u, y + v), draws[1:])
                else:
                    parks.append(Mark(outline=rectangle_points((x + u, y + v), (self.lot, self.lot)), color=_PARK))
        resolution_m = max(0.1, math.sqrt(self.size[0] * self.size[1] / MOST_PIXELS))
        marks = (*self._lines(), *blocks, *parks)
        ground = GroundPicture(size=self.size, color=_ASPHALT, resolution_m=resolution_m, marks=marks)
        return self.complete("urban", solids=solids, ground=ground, bounds=bounds_of(*self.size))

    def _building(self, place: Point2, draws: list[float]) -> Iterator[Box]:
        long, wide, right, up, tall, look, step = draws
        size = (self.lot * (0.7 + 0.3 * long), self.lot * (0.7 + 0.3 * wide))
        center = (place[0] + (right - 0.5) * (self.lot - size[0]), place[1] + (up - 0.5) * (self.lot - size[1]))
        height = self._storeys(self.height_min + tall * (self.height_max - self.height_min))
        material, color = _WALLS[int(look * len(_WALLS))]
        roof = _ROOFS[int(look * len(_WALLS) * len(_ROOFS)) % len(_ROOFS)]
        eaves = height - min(_ROOF_M, 0.2 * height)
        bottom = 0.0
        if step < _STEPPED and tall > 0.4:
            bottom = min(self._storeys(eaves * (0.4 + step)), max(eaves - 0.1, 0.5 * eaves))
            yield upright(center, size, 0.0, bottom, material, color)
            size = (0.65 * size[0], 0.65 * size[1])
        yield upright(center, size, bottom, eaves, material, color)
        yield upright(center, size, eaves, height, material, roof)

    def _storeys(self, height: float) -> float:
        return height if self.storey == 0.0 else max(1, round(height / self.storey)) * self.storey

    def _lines(self) -> Iterator[Mark]:
        for axis in (0, 1):
            pitch, middles, end = self.block + self.street, self.middles(axis), 0.5 * self.size[1 - axis]
            for middle in [middles[0] - 0.5 * pitch, *(each + 0.5 * pitch for each in middles)]:
                for start in np.arange(-end, end, 6.0).tolist():
                    line = _crosswise(axis, middle, start), _crosswise(axis, middle, min(start + 3.0, end))
                    yield Mark(line=line, width=0.2, color=_LINE)

    def sited(self) -> tuple[GroundTarget, ...]:
        """The targets; those without a place or a way lie on streets, clear of each other."""
        rng = stream(self.seed or 0, "urban/targets")
        targets: list[GroundTarget] = []
        for number, target in enumerate(self.targets):
            free = target.place is None and not target.way
            place = self._free(rng, target, number, placed(targets)) if free else target.place
            targets.append(msgspec.structs.replace(target, place=place))
        return tuple(targets)

    def _free(self, rng: np.random.Generator, target: GroundTarget, number: int, others: Sequence[PlacedTarget]) -> Point2:
        pitch, room = self.block + self.street, 0.5 * (self.street - target.size)
        for _ in range(_TRIES if room >= 0.0 else 0):
            axis = int(rng.integers(2))
            middles = self.middles(axis)
            across = middles[0] + (int(rng.integers(len(middles) + 1)) - 0.5) * pitch + float(rng.uniform(-room, room))
            end = 0.5 * (self.size[1 - axis] - target.size)
            along = float(rng.uniform(-end, end))
            place = _crosswise(axis, across, along)
            if all(math.dist(place, other.place(0.0)) > 0.75 * (target.size + other.size_m) for other in others):
                return place
        problem = f"target number {number} finds no free place on streets {self.street:g} m wide: "
        raise ScenarioError(f"{problem}set its place, or make it smaller", key="targets")


def _crosswise(axis: int, across: float, along: float) -> Point2:
    """A place at a distance across streets that run north-south (0) or east-west (1), and one along them, m."""
    return (across, along) if axis == 0 else (along, across)
