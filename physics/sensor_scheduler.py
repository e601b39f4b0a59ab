"""Who asks the sensors: at each instant all that are due, and what they say becomes events.

Light sensors are read at once. Sensors that are much work (`Sensor.on_demand`) give a `Later`, worked out when somebody first
looks at it; such readings that are wanted for certain are worked out together, which is quicker.

Nothing moves the draws of a sensor but itself: each has the stream ``<vehicle>/<sensor>``, its drop-outs have another, and a
reading on demand has one of its own instant.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from vcmvsp.cosim.clock import Ticks, seconds_to_ns
from vcmvsp.cosim.config.messages import show
from vcmvsp.cosim.errors import FederateError, ScenarioError, VcmvspError, place_of, words_of
from vcmvsp.cosim.federate import Event, Instants
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Later, Reading
from vcmvsp.physics.sensors.sensor import Sensor
from vcmvsp.physics.world.scene import Scene

Train = tuple[Ticks, int]  # ticks, shifted by ns


@dataclass(frozen=True, kw_only=True, eq=False)
class Fitted:
    """A sensor on a vehicle."""

    vehicle: str
    name: str
    sensor: Sensor
    rng: np.random.Generator  # for readings that are not on demand
    drop_outs: np.random.Generator
    train: Train
    latency_ns: int

    @property
    def key(self) -> str:
        """Under which its readings are published."""
        return f"{self.vehicle}/{self.name}"


class Instruments:
    """All sensors of all vehicles.

    Args:
        fitted: the sensors by their names, of each vehicle; they are copied, so that every run begins with fresh ones.
        seed: of the run.
        wanted: keys ``<vehicle>/<sensor>`` of readings on demand that somebody will look at: they are worked out together.
    """

    def __init__(self, fitted: Mapping[str, Mapping[str, Sensor]], seed: int, *, wanted: frozenset[str] = frozenset()) -> None:
        self._seed, self._wanted = seed, wanted
        self._all = [_fit(vehicle, name, sensor, seed) for vehicle, own in fitted.items() for name, sensor in own.items()]
        self._trains: dict[Train, list[int]] = {}
        for number, each in enumerate(self._all):
            self._trains.setdefault(each.train, []).append(number)

    def check(self, step: Ticks) -> None:
        """Refuse sensors that would be read between two steps of physics."""
        hz = float(1_000_000_000 / step.period)
        for each in self._all:
            key, (ticks, phase_ns) = f"vehicle.{each.vehicle}.sensors.{each.name}", each.train
            rate_hz = each.sensor.rate_hz
            if ticks.period < step.period:
                problem = (
                    f"{rate_hz:g} Hz is more than the {hz:g} steps a second of physics; lower it, or raise physics.rate_hz"
                )
                raise ScenarioError(problem, key=f"{key}.rate_hz")
            if not ticks.is_multiple_of(step):
                problem = f"{rate_hz:g} Hz does not divide the {hz:g} steps a second of physics; "
                raise ScenarioError(problem + f"use {_divisors(hz)}, or set physics.rate_hz", key=f"{key}.rate_hz")
            if not step.hits(phase_ns):
                problem = f"{each.sensor.phase_s:g} s is not a whole number of physics steps (1/{hz:g} s)"
                raise ScenarioError(f"{problem}; use a multiple, or set physics.rate_hz", key=f"{key}.phase_s")

    @property
    def instants(self) -> tuple[Instants, ...]:
        """When sensors are to be read."""
        return tuple(Instants(ticks, phase_ns) for ticks, phase_ns in self._trains)

    def due(self, now_ns: int) -> bool:
        """Whether a sensor is to be read now."""
        return any(ticks.hits(now_ns - phase_ns) for ticks, phase_ns in self._trains)

    def read(self, scene: Scene) -> list[Event]:
        """The readings of all sensors that are due at the instant of the scene, as events at the times of their delivery."""
        now_ns = scene.now_ns
        due = [number for (ticks, phase), own in self._trains.items() if ticks.hits(now_ns - phase) for number in own]
        members = [self._all[number] for number in sorted(due)]
        values = self._light(scene, [each for each in members if not each.sensor.on_demand])
        arrive = [each for each in members if not _dropped(each)]
        values |= self._later(scene, [each for each in arrive if each.sensor.on_demand])
        return [Event(each.key, now_ns + each.latency_ns, values[each.key]) for each in arrive]

    def _light(self, scene: Scene, members: Sequence[Fitted]) -> dict[str, Any]:
        """Readings by key, of light sensors: also of those that drop out, whose errors go on."""
        kinds: dict[type[Sensor], list[Fitted]] = {}
        for each in members:
            kinds.setdefault(family(each.sensor), []).append(each)
        values: dict[str, Any] = {}
        for own in kinds.values():
            values |= zip([each.key for each in own], _measure(scene, own, [each.rng for each in own]), strict=True)
        return values

    def _later(self, scene: Scene, members: Sequence[Fitted]) -> dict[str, Any]:
        """Readings on demand by key: each alone, the wanted ones of a class together."""
        kinds: dict[type[Sensor], list[Fitted]] = {}
        values: dict[str, Any] = {}
        for each in members:
            if each.key in self._wanted:
                kinds.setdefault(family(each.sensor), []).append(each)
            else:
                values[each.key] = Later(partial(Batch(self._seed, scene, [each]).reading, 0))
        for own in kinds.values():
            batch = Batch(self._seed, scene, own)
            values |= {each.key: Later(partial(batch.reading, number)) for number, each in enumerate(own)}
        return values


class Batch:
    """Readings on demand of sensors of one class at one instant: all are worked out when the first is looked at."""

    def __init__(self, seed: int, scene: Scene, members: Sequence[Fitted]) -> None:
        self._work: tuple[int, Scene, Sequence[Fitted]] | None = (seed, scene, members)
        self._readings: list[Reading] = []

    def reading(self, number: int) -> Reading:
        """That of one of its members."""
        if self._work is not None:
            seed, scene, members = self._work
            rngs = [stream(seed, f"{each.key}/{scene.now_ns}") for each in members]
            self._readings = _measure(scene, members, rngs)  # where that fails, it fails again at the next look
            self._work = None
        return self._readings[number]


def family(sensor: Sensor) -> type[Sensor]:
    """The sensors that can be read at once: those of its class, or of the class that knows a quicker way."""
    kind = type(sensor)
    home = next(each for each in kind.__mro__ if "measure_all" in vars(each))
    return kind if home is Sensor else home


def _fit(vehicle: str, name: str, sensor: Sensor, seed: int) -> Fitted:
    key = f"{vehicle}/{name}"
    return Fitted(
        vehicle=vehicle,
        name=name,
        sensor=copy.deepcopy(sensor),
        rng=stream(seed, key),
        drop_outs=stream(seed, f"{key}/drop_out"),
        train=(Ticks.rate(sensor.rate_hz), seconds_to_ns(sensor.phase_s)),
        latency_ns=seconds_to_ns(sensor.latency_s),
    )


def _dropped(each: Fitted) -> bool:
    return each.sensor.drop_out > 0.0 and each.drop_outs.random() < each.sensor.drop_out


def _measure(scene: Scene, members: Sequence[Fitted], rngs: Sequence[np.random.Generator]) -> list[Reading]:
    """Readings of sensors of one class; an error names them."""
    sensors, kind = [each.sensor for each in members], type(members[0].sensor)
    try:
        row_of = _rows(scene)
        rows = [row_of[each.vehicle] for each in members]
        readings = kind.measure_all(sensors, scene, rows, rngs)
    except (VcmvspError, KeyboardInterrupt):
        raise
    except BaseException as error:  # whatever somebody's own sensor raises
        raise FederateError("physics", f"{_named(members)}: {words_of(error)}{place_of(error)}") from error
    if wrong := [each for each in readings if not isinstance(each, Reading)]:
        raise FederateError("physics", f"{_named(members)}: measure must return a reading, not {show(wrong[0])}")
    return readings


def _rows(scene: Scene) -> Mapping[str, int]:
    """The rows of vehicles by their names."""
    if "rows" not in scene.cache:
        scene.cache["rows"] = {name: row for row, name in enumerate(scene.vehicles)}
    rows: Mapping[str, int] = scene.cache["rows"]
    return rows


def _named(members: Sequence[Fitted]) -> str:
    keys = ", ".join(each.key for each in members[:3]) + (", ..." if len(members) > 3 else "")
    return f"sensor{'s' if len(members) > 1 else ''} {keys} ({type(members[0].sensor).__name__})"


def _divisors(hz: float) -> str:
    """Some rates that would do, for messages."""
    return ", ".join(f"{hz / by:g}" for by in (1, 2, 3, 4, 5, 6, 8, 10, 12, 24) if float(f"{hz / by:g}") == hz / by) + " Hz"
