"""Sensors: truth, timing, noise. What a sensor of one's own has to be.

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
    """One sensor of one vehicle: at its ticks it is asked for a reading, which is delivered ``latency_s`` later.

    An object belongs to one vehicle, and may keep what it needs from one reading to the next. Where that is much work
    (`on_demand`) a reading is worked out only if somebody looks at it, from the scene of its tick and from a generator that
    belongs to that tick: such a sensor must not remember anything.
    """

    on_demand: ClassVar[bool] = False

    rate_hz: Rate = 10.0  # readings a second
    phase_s: Seconds = 0.0  # when the first one is taken, s after the start
    latency_s: Seconds = 0.0  # from measuring to delivery, s
    drop_out: Probability = 0.0  # probability that a reading is not delivered

    def misfit(self, model: object) -> str:
        """What keeps it from being fitted to a vehicle like this one (`physics.vehicles.models`); empty: nothing does."""
        return ""

    @abstractmethod
    def measure(self, scene: Scene, row: int, rng: np.random.Generator) -> Reading:
        """The reading of the vehicle in this row of the scene."""

    @classmethod
    def measure_all(
        cls, sensors: Sequence[Self], scene: Scene, rows: Sequence[int], rngs: Sequence[np.random.Generator]
    ) -> list[Reading]:
        """The readings of several sensors of this class at once; a class may have a quicker way than one by one."""
        return [sensor.measure(scene, row, rng) for sensor, row, rng in zip(sensors, rows, rngs, strict=True)]
