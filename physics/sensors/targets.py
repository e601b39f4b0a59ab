"""A simulated detector of targets, for studies of searches in which no picture needs to be taken."""

from dataclasses import dataclass

import numpy as np

from cosim.types import Array, Looks, Positive, Probability, Rate, frozen
from physics.scene import Scene
from physics.sensor import Sensor
from physics.world import World


@dataclass(kw_only=True)
class TargetSensor(Sensor):
    """Says of every cell of the ground around the vehicle whether a target is in it, and errs now and then.

    The cells are squares, of which one has a corner in the world's origin; those within reach are looked at, within the bounds
    of the world where it has any. Answers are independent of each other: Bernoulli draws with p in a cell in which the middle
    of a target of the world lies now, with q in any other. Nothing hides a target, however high the vehicle is.
    """

    rate_hz: Rate = 1.0  # looks a second
    reach_m: Positive = 8.0  # cells whose middle is not further away than this, horizontally, are looked at
    cell_m: Positive = 2.0  # edge of a cell, m
    p: Probability = 0.9  # that it says target of a cell with one
    q: Probability = 0.1  # that it says target of a cell without

    def measure(self, scene: Scene, row: int, rng: np.random.Generator) -> Looks:
        """What it says of the cells, from south to north, in a row from west to east."""
        cells = self._cells(scene.world, *scene.position[row, :2].tolist())
        chance = np.full(len(cells), self.q)
        for target in scene.world.targets:
            lies_in = np.floor(np.array(target.place(scene.now_ns / 1e9)) / self.cell_m)
            chance[(cells == lies_in).all(axis=1)] = self.p
        hits = rng.random(len(cells)) < chance
        return Looks(time_ns=scene.now_ns, cell_m=self.cell_m, cells=frozen(cells, np.int32), hits=frozen(hits))

    def _cells(self, world: World, x: float, y: float) -> Array:
        """Those within reach, (n, 2): column and row."""
        column, row = (
            np.arange(np.floor((at - self.reach_m) / self.cell_m), np.floor((at + self.reach_m) / self.cell_m) + 1.0)
            for at in (x, y)
        )
        across, up = (column + 0.5) * self.cell_m, (row[:, None] + 0.5) * self.cell_m
        near = (across - x) ** 2 + (up - y) ** 2 <= self.reach_m**2
        if world.bounds is not None:
            west, south, east, north = world.bounds
            near &= (across > west) & (across < east) & (up > south) & (up < north)
        rows, columns = np.nonzero(near)
        return np.column_stack([column[columns], row[rows]])
