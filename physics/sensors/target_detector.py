"""A simulated detector of targets, for studies of searches without pictures."""

import math
from dataclasses import dataclass

import numpy as np

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Array, Looks, Positive, Probability, Rate, frozen
from vcmvsp.physics.sensors.sensor import Sensor
from vcmvsp.physics.world.scene import Scene
from vcmvsp.physics.world.world import World

MOST_ACROSS = 2_000  # cells of one look: it takes half a second


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
        """Columns, or rows, within reach and bounds."""
        first, last = np.floor(np.array([max(at - self.reach_m, low), min(at + self.reach_m, high)]) / self.cell_m)
        if last - first > MOST_ACROSS:
            problem = f"{last - first:.3g} cells of {self.cell_m:g} m across are more than {MOST_ACROSS}: make them larger"
            raise ScenarioError(problem, key="target_sensor.cell_m")
        return np.arange(first, last + 1.0)
