"""Base of all sensors: timing and readings.

Example of a user-defined sensor:

::

    @dataclass(kw_only=True)
    class Altimeter(Sensor):
        sigma_m: NonNegative = 0.1  # standard deviation of the height, m

        def measure(self, scene: Scene, row: int, rng: Generator) -> Measured:
            height = scene.position[row, 2] + self.sigma_m * rng.standard_normal()
            return Measured(time_ns=scene.now_ns, values={"height_m": height})
"""

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

import msgspec
import numpy as np

from vcmvsp.cosim.clock import Ticks, seconds_to_ns
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Array, NonNegative, Positive, Probability, Rate, Reading, Seconds
from vcmvsp.physics.world.world import Scene

Train = tuple[Ticks, int]  # ticks, shifted by ns


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


class Noise(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Errors of a reading, in its unit. A table replaces all of the default: omitted keys are 0.

    A reading is ``quantised(truth + bias + walk + drift + white + outlier)``. The drift is a first-order Gauss-Markov process:
    its autocorrelation is ``drift_sd^2 exp(-|t| / drift_time_s)``, and between readings dt apart it follows exactly
    ``d' = a d + drift_sd sqrt(1 - a^2) n`` with ``a = exp(-dt / drift_time_s)`` (A. Gelb (ed.), Applied Optimal Estimation,
    1974, chapter 3). The walk is a Wiener process that begins at 0: its variance after t seconds is ``walk^2 t``.
    """

    bias: float = 0.0  # constant error of all readings
    bias_sd: NonNegative = 0.0  # standard deviation of a further bias, drawn once a run: from turn-on to turn-on
    drift_sd: NonNegative = 0.0  # standard deviation of a bias that wanders about 0
    drift_time_s: Positive = 100.0  # ... and its correlation time, s
    walk: NonNegative = 0.0  # of a bias that wanders away: its standard deviation after 1 s, growing as the root of time
    sigma: NonNegative = 0.0  # standard deviation of white noise
    outlier_probability: Probability = 0.0  # of a reading to be far off
    outlier: NonNegative = 0.0  # ... by this, upwards or downwards
    quantum: NonNegative = 0.0  # readings are multiples of it; 0: not quantised


class Errors:
    """Errors of several channels of one sensor, independent of each other.

    All parameters are factors of draws in a constant number, so that none of them changes the others' draws: two normal ones
    for each channel at the first reading, three normal and two uniform ones at every reading.
    """

    def __init__(self, channels: Sequence[Noise]) -> None:
        table = np.array([msgspec.structs.astuple(each) for each in channels], float).T  # the fields of `Noise`
        self._bias, self._bias_sd, self._drift_sd, self._drift_time_s, self._walk = table[:5]
        self._sigma, self._probability, self._outlier, self._quantum = table[5:]
        self._step = np.where(self._quantum > 0.0, self._quantum, 1.0)
        self._wanders, self._strays, self._steps = self._drift_sd.any(), self._probability.any(), self._quantum.any()
        self._drift = np.zeros(len(channels))
        self._last_ns: int | None = None
        self._dt_ns = -1  # for which the next two are valid
        self._decay = self._kick = np.zeros(len(channels))

    def read(self, truth: Array, now_ns: int, rng: np.random.Generator) -> Array:
        """Readings of true values (channels,), at a time not before that of the last call."""
        if self._last_ns is None:
            bias, drift = rng.standard_normal((2, len(self._bias)))
            self._bias, self._drift, self._last_ns = self._bias + self._bias_sd * bias, self._drift_sd * drift, now_ns
        dt_ns, self._last_ns = now_ns - self._last_ns, now_ns
        white, kick, stride = rng.standard_normal((3, len(self._bias)))
        chance, side = rng.random((2, len(self._bias)))
        if dt_ns != self._dt_ns:
            self._dt_ns, self._decay = dt_ns, np.exp(-1e-9 * dt_ns / self._drift_time_s)
            self._kick = self._drift_sd * np.sqrt(1.0 - self._decay**2)
        if self._wanders:
            self._drift = self._decay * self._drift + self._kick * kick
        self._bias = self._bias + (math.sqrt(1e-9 * dt_ns) * self._walk) * stride
        reading: Array = truth + self._bias + self._drift + self._sigma * white
        if self._strays:
            reading += np.where(chance < self._probability, np.where(side < 0.5, -self._outlier, self._outlier), 0.0)
        if self._steps:
            reading = np.where(self._quantum > 0.0, self._step * np.round(reading / self._step), reading)
        return reading


def jump(probability: float, far_m: float, rng: np.random.Generator) -> tuple[float, float]:
    """Displacement of an outlier, x and y m: sometimes ``far_m`` in a random direction. Always two uniform draws."""
    chance, direction = rng.random(2).tolist()
    if chance >= probability:
        return 0.0, 0.0
    return far_m * math.cos(math.tau * direction), far_m * math.sin(math.tau * direction)


class FittedSensor:
    """A copy of a sensor on a vehicle; ``key`` of its readings: ``<vehicle>/<sensor>``."""

    def __init__(self, key: str, sensor: Sensor, seed: int) -> None:
        self.key, self.vehicle, self.sensor = key, key.partition("/")[0], copy.deepcopy(sensor)
        self.rng = stream(seed, key)  # for readings that are not on demand
        self.drop_outs = stream(seed, f"{key}/drop_out")
        self.train: Train = Ticks.rate(sensor.rate_hz), seconds_to_ns(sensor.phase_s)
        self.latency_ns = seconds_to_ns(sensor.latency_s)

    def drops_out(self) -> bool:
        """Whether the next reading is not delivered."""
        return self.sensor.drop_out > 0.0 and self.drop_outs.random() < self.sensor.drop_out
