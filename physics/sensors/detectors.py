"""Detectors of contacts, other vehicles and targets."""

import math
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Array, Looks, Measured, NonNegative, Positive, Probability, Rate, Vec3, frozen
from vcmvsp.physics.raycast.line_of_sight import sightline_of
from vcmvsp.physics.sensors.sensor import Sensor
from vcmvsp.physics.world.world import Scene, World

_FLOOR_M = 0.01  # contacts with the world below this height are contacts with the floor


@dataclass(kw_only=True)
class Bumper(Sensor):
    """1 for each segment of the hull that touches a solid or another body, else 0. The floor does not count.

    Four segments are called ``front``, ``left``, ``back`` and ``right``, and are the sides of a box; any other number ``s0``,
    ``s1``, ... counter-clockwise, with the middle of ``s0`` ahead. They share the outline evenly by bearing from its centre
    after it has been stretched to a square.
    """

    segments: Annotated[int, msgspec.Meta(ge=1, le=360)] = 4  # how many

    def measure(self, scene: Scene, row: int, rng: np.random.Generator) -> Measured:
        """Segments with a contact now. No draws."""
        n, names = self.segments, ["front", "left", "back", "right"]
        if n != len(names):
            names = [f"s{number}" for number in range(n)]
        values = dict.fromkeys(names, 0.0)
        for a, b, place in scene.touching:
            if row in (a, b) and (b is not None or place[2] > _FLOOR_M):
                values[names[round(self._bearing(scene, row, place) * n / math.tau) % n]] = 1.0
        return Measured(time_ns=scene.now_ns, values=values)

    def _bearing(self, scene: Scene, row: int, place: Vec3) -> float:
        """Bearing of a place from the middle of the hull, stretched to a square, rad counter-clockwise from ahead."""
        hull = scene.hulls[row]
        x, y, _ = ((np.array(place) - scene.position[row]) @ scene.rotation(row) - hull.offset).tolist()
        return math.atan2(y / hull.size[1], x / hull.size[0])


_AHEAD = 64  # draws for as many readings are made at once


@dataclass(kw_only=True)
class NeighbourRange(Sensor):
    """Distance to every other vehicle within reach, m, from reference point to reference point, under the vehicle's name.

    The default error is that of two-way ranging between ultra-wideband radios.
    """

    reach_m: Positive = 20.0  # vehicles further away are not in the reading
    sigma_m: NonNegative = 0.1  # standard deviation of the white noise of each range, m
    bias_m: float = 0.0  # of every range, m
    line_of_sight: bool = False  # vehicles behind a solid of the world are not in the reading either

    def __post_init__(self) -> None:
        self._streams: list[np.random.Generator] = []
        self._draws: Array = np.empty((0, 0))
        self._next = _AHEAD

    def measure(self, scene: Scene, row: int, rng: np.random.Generator) -> Measured:
        """The ranges. Each pair of vehicles has its own draws: another vehicle changes none of them."""
        count = len(scene.vehicles)
        noise = self._noise(scene.vehicles, rng)
        run = scene.position[:count] - scene.position[row]
        distances = np.sqrt((run * run).sum(axis=1))
        within = distances <= self.reach_m
        within[row] = False
        (rows,) = np.nonzero(within)
        if self.line_of_sight and rows.size:
            passes, _ = sightline_of(scene.world).crossings(scene.position[row], scene.position[rows])
            rows = rows[~passes.any(axis=1)]
        ranges = np.maximum(distances + self.bias_m + self.sigma_m * noise, 0.0)
        values = {scene.vehicles[other]: each for other, each in zip(rows.tolist(), ranges[rows].tolist(), strict=True)}
        return Measured(time_ns=scene.now_ns, values=values)

    def _noise(self, names: tuple[str, ...], rng: np.random.Generator) -> Array:
        if not self._streams:
            seed = int(rng.integers(2**63))
            self._streams = [stream(seed, name) for name in names]
        if self._next == _AHEAD:
            self._draws, self._next = np.array([each.standard_normal(_AHEAD) for each in self._streams]), 0
        self._next += 1
        return np.asarray(self._draws[:, self._next - 1])


MOST_ACROSS = 2_000  # cells of one look, which takes half a second


@dataclass(kw_only=True)
class TargetSensor(Sensor):
    """Reports for every ground cell around the vehicle whether a target is in it, with errors.

    The cells are squares, one with a corner in the world's origin; cells within reach and within the bounds of the world are
    reported. Reports are independent Bernoulli draws with p in a cell with the middle of a target, with q in any other. Nothing
    hides a target, at any height of the vehicle.
    """

    rate_hz: Rate = 1.0  # reports a second
    reach_m: Positive = 8.0  # greatest horizontal distance to the middle of a reported cell, m
    cell_m: Positive = 2.0  # edge of a cell, m
    p: Probability = 0.9  # of a detection in a cell with a target
    q: Probability = 0.1  # of a detection in a cell without one

    def measure(self, scene: Scene, row: int, rng: np.random.Generator) -> Looks:
        """Reports of the cells, from south to north, in a row from west to east."""
        cells = self._cells(scene.world, *scene.position[row, :2].tolist())
        chance = np.full(len(cells), self.q)
        for target in scene.world.targets:
            lies_in = np.floor(np.array(target.place(scene.now_ns / 1e9)) / self.cell_m)
            chance[(cells == lies_in).all(axis=1)] = self.p
        hits = rng.random(len(cells)) < chance
        return Looks(time_ns=scene.now_ns, cell_m=self.cell_m, cells=frozen(cells, np.int32), hits=frozen(hits))

    def _cells(self, world: World, x: float, y: float) -> Array:
        """Cells within reach, (n, 2): column and row."""
        west, south, east, north = world.bounds or (-math.inf, -math.inf, math.inf, math.inf)
        column, row = self._between(x, west, east), self._between(y, south, north)
        across, up = (column + 0.5) * self.cell_m, (row[:, None] + 0.5) * self.cell_m
        near = (across - x) ** 2 + (up - y) ** 2 <= self.reach_m**2
        near &= (across > west) & (across < east) & (up > south) & (up < north)
        rows, columns = np.nonzero(near)
        return np.column_stack([column[columns], row[rows]])

    def _between(self, at: float, low: float, high: float) -> Array:
        first, last = np.floor(np.array([max(at - self.reach_m, low), min(at + self.reach_m, high)]) / self.cell_m)
        if last - first > MOST_ACROSS:
            problem = f"{last - first:.3g} x {self.cell_m:g} m across are too many: use larger cells (at most {MOST_ACROSS})"
            raise ScenarioError(problem, key="target_sensor.cell_m")
        return np.arange(first, last + 1.0)
