"""Base of all sensors: timing and readings.

An own sensor:

::

    @dataclass(kw_only=True)
    class Altimeter(Sensor):
        sigma_m: NonNegative = 0.1  # standard deviation of the height, m

        def measure(self, scene: Scene, row: int, rng: Generator) -> Measured:
            height = scene.position[row, 2] + self.sigma_m * rng.standard_normal()
            return Measured(time_ns=scene.now_ns, values={"height_m": height})
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from vcmvsp.cosim.types import Probability, Rate, Reading, Seconds
from vcmvsp.physics.world.scene import Scene


@dataclass(kw_only=True)
class Sensor(ABC):
    """One sensor of one vehicle: measures at its ticks, and delivers ``latency_s`` later.

    An object belongs to one vehicle, and may keep state between readings. With `on_demand`, a reading is computed only at its
    first use, from the scene of its tick and a generator for that tick: such a sensor must not keep state.
    """

    on_demand: ClassVar[bool] = False

    rate_hz: Rate = 10.0  # readings a second
    phase_s: Seconds = 0.0  # when the first one is taken, s after the start
    latency_s: Seconds = 0.0  # from measuring to delivery, s
    drop_out: Probability = 0.0  # probability that a reading is not delivered

    def misfit(self, model: object) -> str:
        """Reason why a model (`physics.vehicles.models`) cannot carry it; empty: it can."""
        return ""

    @abstractmethod
    def measure(self, scene: Scene, row: int, rng: np.random.Generator) -> Reading:
        """The reading of the vehicle in this row of the scene."""

    @classmethod
    def measure_all(
        cls, sensors: Sequence[Self], scene: Scene, rows: Sequence[int], rngs: Sequence[np.random.Generator]
    ) -> list[Reading]:
        """Readings of several sensors of this class at once; a class may override it with a quicker way."""
        return [sensor.measure(scene, row, rng) for sensor, row, rng in zip(sensors, rows, rngs, strict=True)]
