"""Scheduler of the sensors: reads all that are due at an instant, and turns their readings into events.

Light sensors are read at once. Sensors with expensive readings (`Sensor.on_demand`) return a `Later`, computed at its first
use; requested readings are computed together, which is quicker.

Nothing else changes the draws of a sensor: each has the stream ``<vehicle>/<sensor>``, its drop-outs have another, and each
reading on demand has a stream of its own.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.config.binding import show
from vcmvsp.cosim.errors import FederateError, ScenarioError, VcmvspError, place_of, words_of
from vcmvsp.cosim.federate import Event, Instants
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Later, Reading
from vcmvsp.physics.sensors.sensor import FittedSensor, Sensor, Train
from vcmvsp.physics.world.world import Scene


class SensorScheduler:
    """All sensors of all vehicles: ``fitted`` has the sensors of each vehicle by name.

    They are copied, so that every run begins with fresh ones. ``requested`` are keys ``<vehicle>/<sensor>`` of readings on
    demand that are certainly used: they are computed together.
    """

    def __init__(self, fitted: Mapping[str, Mapping[str, Sensor]], seed: int, *, requested: Collection[str] = ()) -> None:
        self._seed, self._requested = seed, frozenset(requested)
        sensors = {f"{vehicle}/{name}": each for vehicle, own in fitted.items() for name, each in own.items()}
        self._sensors = [FittedSensor(key, each, seed) for key, each in sensors.items()]
        self._trains: dict[Train, list[int]] = {}
        for number, each in enumerate(self._sensors):
            self._trains.setdefault(each.train, []).append(number)

    def check(self, step: Ticks) -> None:
        """Refuse sensors with readings between two steps of physics."""
        hz = float(1_000_000_000 / step.period)
        for each in self._sensors:
            key, (ticks, phase_ns) = f"vehicle.{each.key.replace('/', '.sensors.', 1)}", each.train
            rate_hz = each.sensor.rate_hz
            if ticks.period < step.period:
                problem = f"{rate_hz:g} Hz is above physics.rate_hz = {hz:g}; "
                raise ScenarioError(f"{problem}lower the sensor rate, or raise physics.rate_hz", key=f"{key}.rate_hz")
            if not ticks.is_multiple_of(step):
                rates = [f"{hz / by:g}" for by in (1, 2, 3, 4, 5, 6, 8, 10, 12, 24) if float(f"{hz / by:g}") == hz / by]
                problem = f"{rate_hz:g} Hz does not divide physics.rate_hz = {hz:g}; use {', '.join(rates)} Hz, "
                raise ScenarioError(f"{problem}or set physics.rate_hz", key=f"{key}.rate_hz")
            if not step.hits(phase_ns):
                problem = f"{each.sensor.phase_s:g} s is not a whole number of physics steps (1/{hz:g} s)"
                raise ScenarioError(f"{problem}; use a multiple, or set physics.rate_hz", key=f"{key}.phase_s")

    @property
    def instants(self) -> tuple[Instants, ...]:
        """Instants of readings."""
        return tuple(Instants(*train) for train in self._trains)

    def due(self, now_ns: int) -> bool:
        """Whether a reading is due now."""
        return any(ticks.hits(now_ns - phase_ns) for ticks, phase_ns in self._trains)

    def read(self, scene: Scene) -> list[Event]:
        """All readings that are due at the instant of the scene, as events at the times of their delivery."""
        now_ns = scene.now_ns
        due = [number for (ticks, phase), own in self._trains.items() if ticks.hits(now_ns - phase) for number in own]
        sensors = [self._sensors[number] for number in sorted(due)]
        # Sensors that drop out are read, too: their errors continue.
        readings: dict[str, Any] = {}
        for own in _families(each for each in sensors if not each.sensor.on_demand):
            values = _measure(scene, own, [each.rng for each in own])
            readings |= zip((each.key for each in own), values, strict=True)
        delivered = [each for each in sensors if not each.drops_out()]
        readings |= self._later(scene, [each for each in delivered if each.sensor.on_demand])
        return [Event(each.key, now_ns + each.latency_ns, readings[each.key]) for each in delivered]

    def _later(self, scene: Scene, sensors: Sequence[FittedSensor]) -> dict[str, Later]:
        """Readings on demand by key: each computed alone, requested ones of a class together."""
        groups = _families(each for each in sensors if each.key in self._requested)
        groups += [[each] for each in sensors if each.key not in self._requested]
        readings: dict[str, Later] = {}
        for own in groups:
            batch = ReadingBatch(self._seed, scene, own)
            readings |= {each.key: Later(partial(batch.reading, number)) for number, each in enumerate(own)}
        return readings


class ReadingBatch:
    """Readings on demand of sensors of one class at one instant, all computed at the first use of one."""

    def __init__(self, seed: int, scene: Scene, sensors: Sequence[FittedSensor]) -> None:
        self._pending: tuple[int, Scene, Sequence[FittedSensor]] | None = (seed, scene, sensors)
        self._readings: list[Reading] = []

    def reading(self, number: int) -> Reading:
        """The reading of one sensor."""
        if self._pending is not None:
            seed, scene, sensors = self._pending
            rngs = [stream(seed, f"{each.key}/{scene.now_ns}") for each in sensors]
            self._readings = _measure(scene, sensors, rngs)  # after an error, the next use fails again
            self._pending = None
        return self._readings[number]


def _families(sensors: Iterable[FittedSensor]) -> list[list[FittedSensor]]:
    """Groups of sensors that can be read together: of one class, or of the class that defines a faster way."""
    families: dict[type[Sensor], list[FittedSensor]] = {}
    for each in sensors:
        kind = type(each.sensor)
        home = next(base for base in kind.__mro__ if "measure_all" in vars(base))
        families.setdefault(kind if home is Sensor else home, []).append(each)
    return [*families.values()]


def _measure(scene: Scene, fitted: Sequence[FittedSensor], rngs: Sequence[np.random.Generator]) -> list[Reading]:
    sensors, kind = [each.sensor for each in fitted], type(fitted[0].sensor)
    try:
        readings = kind.measure_all(sensors, scene, [scene.row_of[each.vehicle] for each in fitted], rngs)
    except (VcmvspError, KeyboardInterrupt):
        raise
    except BaseException as error:  # of a user-defined sensor
        raise FederateError("physics", f"{_sensor_words(fitted)}: {words_of(error)}{place_of(error)}") from error
    if wrong := [each for each in readings if not isinstance(each, Reading)]:
        raise FederateError("physics", f"{_sensor_words(fitted)}: measure must return a reading, not {show(wrong[0])}")
    return readings


def _sensor_words(fitted: Sequence[FittedSensor]) -> str:
    keys = [each.key for each in fitted[:3]]
    if len(fitted) > 3:
        keys.append("...")
    return f"sensor{'s' if len(fitted) > 1 else ''} {', '.join(keys)} ({type(fitted[0].sensor).__name__})"
