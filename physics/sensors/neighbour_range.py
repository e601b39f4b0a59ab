"""Ranges to the other vehicles, by name."""

from dataclasses import dataclass

import numpy as np

from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Array, Measured, NonNegative, Positive
from vcmvsp.physics.line_of_sight.sightline import sightline_of
from vcmvsp.physics.sensors.sensor import Sensor
from vcmvsp.physics.world.scene import Scene

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
        """A normal draw for each vehicle, (n,)."""
        if not self._streams:
            seed = int(rng.integers(2**63))
            self._streams = [stream(seed, name) for name in names]
        if self._next == _AHEAD:
            self._draws = np.array([each.standard_normal(_AHEAD) for each in self._streams])
            self._next = 0
        self._next += 1
        draws: Array = self._draws[:, self._next - 1]
        return draws
