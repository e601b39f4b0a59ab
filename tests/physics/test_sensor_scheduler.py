"""Sensor scheduling: times, order, random streams, and the cost of unused readings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest

from tests.support.physics.sensor_scenes import SECOND_NS, scene_of
from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import FederateError, ScenarioError
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.types import Later, Measured, Rate, Reading
from vcmvsp.physics.sensor_scheduler import SensorScheduler
from vcmvsp.physics.sensors.detectors import NeighbourRange
from vcmvsp.physics.sensors.motion import Altimeter, InertialUnit
from vcmvsp.physics.sensors.positioning import Gps, Uwb
from vcmvsp.physics.sensors.sensor import Noise, Sensor
from vcmvsp.physics.world.world import Scene

pytestmark = pytest.mark.slow

Fitted = Mapping[str, Mapping[str, Sensor]]


@dataclass(kw_only=True)
class Draw(Sensor):
    """Returns one draw and the row."""

    def measure(self, scene: Scene, row: int, rng: np.random.Generator) -> Measured:
        return Measured(time_ns=scene.now_ns, values={"draw": float(rng.standard_normal()), "row": row})


@dataclass(kw_only=True)
class Heavy(Draw):
    """A draw on demand; records the size of each batch."""

    on_demand: ClassVar[bool] = True
    batches: ClassVar[list[int]] = []

    @classmethod
    def measure_all(cls, sensors: Any, scene: Any, rows: Any, rngs: Any) -> list[Reading]:
        cls.batches.append(len(sensors))
        return super().measure_all(sensors, scene, rows, rngs)


@pytest.fixture(autouse=True)
def _clear_batches() -> None:
    Heavy.batches.clear()


def run(
    fitted: Fitted, seconds: float, *, seed: int = 1, vehicles: int = 3, requested: frozenset[str] = frozenset()
) -> list[Event]:
    """All events of a run; on-demand readings stay lazy."""
    instruments = SensorScheduler(fitted, seed, requested=requested)
    places, events = [(3.0 * n, 0.0, 1.0) for n in range(vehicles)], []
    for now in times(instruments, seconds):
        assert instruments.due(now)
        events += instruments.read(scene_of(*places, t=now / SECOND_NS))
    return events


def times(instruments: SensorScheduler, seconds: float) -> list[int]:
    """Reading times before ``seconds``, ns."""
    found = set()
    for ticks, offset_ns in ((each.ticks, each.offset_ns) for each in instruments.instants):
        found |= {now for k in range(10_000) if (now := ticks.at(k) + offset_ns) < seconds * SECOND_NS}
    return sorted(found)


def values_of(events: Sequence[Event], key: str) -> list[Any]:
    return [value_of(event) for event in events if event.key == key]


def value_of(event: Event) -> Any:
    value: Any = event.value
    return value.get() if isinstance(value, Later) else value


def test_each_sensor_is_read_at_its_rate_from_its_phase_on_and_delivered_late() -> None:
    events = run({"car0": {"a": Draw(rate_hz=10.0, phase_s=0.05, latency_s=0.12), "b": Draw(rate_hz=4.0)}}, 1.0)
    taken = [value_of(event).time_ns for event in events if event.key == "car0/a"]
    assert taken == [(50 + 100 * k) * 10**6 for k in range(10)]
    assert [event.time_ns for event in events if event.key == "car0/a"] == [now + 120 * 10**6 for now in taken]
    assert [event.time_ns for event in events if event.key == "car0/b"] == [0, 250 * 10**6, 500 * 10**6, 750 * 10**6]


@pytest.mark.parametrize("sensors", [{}, {"a": Draw(rate_hz=10.0, phase_s=0.05), "b": Draw(rate_hz=4.0)}], ids=["none", "two"])
def test_sensors_are_due_at_their_own_instants_alone(sensors: dict[str, Sensor]) -> None:
    instruments = SensorScheduler({"car0": sensors}, 1)
    assert len(instruments.instants) == len(sensors)
    due = [now for now in range(-(10**8), 10**9, 25 * 10**6) if instruments.due(now)]
    assert due == times(instruments, 1.0)


def test_ticks_of_fractional_nanoseconds_are_all_met() -> None:
    assert len(run({"car0": {"a": Draw(rate_hz=120.0), "b": Draw(rate_hz=60.0)}}, 1.0)) == 180


def test_events_of_an_instant_are_ordered_as_fitted() -> None:
    fitted: Fitted = {
        "car1": {"z": Heavy(), "a": Draw()},
        "car0": {"m": Draw(rate_hz=20.0), "b": Gps(rate_hz=10.0), "c": Draw()},
    }
    keys = [event.key for event in run(fitted, 0.1)]
    assert keys == ["car1/z", "car1/a", "car0/m", "car0/b", "car0/c", "car0/m"]


def test_each_sensor_gets_the_row_of_its_vehicle() -> None:
    events = run({"car2": {"a": Draw(), "h": Heavy()}, "car1": {"a": Draw()}}, 0.1)
    assert {event.key: value_of(event).values["row"] for event in events} == {"car2/a": 2, "car2/h": 2, "car1/a": 1}


def test_draws_depend_on_the_sensor_only() -> None:
    """Vehicles, other sensors and drop-outs have no effect; each run begins with fresh sensors."""
    sensors: dict[str, Sensor] = {
        "gps": Gps(),
        "imu": InertialUnit(),
        "uwb": Uwb(),
        "range": NeighbourRange(reach_m=4.0),
        "h": Heavy(),
    }
    alone = {name: values_of(run({"car0": {name: each}}, 1.0), f"car0/{name}") for name, each in sensors.items()}
    others: Fitted = {
        "car1": {"gps": Gps(), "h": Heavy()},
        "car0": {**sensors, "draw": Draw(rate_hz=50.0)},
        "car2": {"d": Draw()},
    }
    together = run(others, 1.0, vehicles=5, requested=frozenset({"car0/h", "car1/h"}))
    for name, readings in alone.items():
        assert values_of(together, f"car0/{name}") == readings
    draws = [reading.values["draw"] for reading in alone["h"]]
    assert len(set(draws)) == len(draws) == 10
    assert values_of(together, "car1/gps") != alone["gps"]
    assert values_of(run({"car0": {"gps": sensors["gps"]}}, 1.0, seed=2), "car0/gps") != alone["gps"]


@pytest.mark.parametrize("sensor", [Draw(), Altimeter(noise=Noise(drift_sd=1.0, walk=1.0), rate_hz=10.0), Heavy()])
def test_drop_outs_have_the_stated_rate_and_no_other_effect(sensor: Sensor) -> None:
    n = 1500
    every = run({"car0": {"a": sensor}}, n / 10)
    lossy = type(sensor)(**{**vars_of(sensor), "drop_out": 0.3})
    some = run({"car0": {"a": lossy}}, n / 10)
    assert 1.0 - len(some) / n == pytest.approx(0.3, abs=4 * (0.3 * 0.7 / n) ** 0.5)
    readings = {value_of(event).time_ns: value_of(event) for event in every}
    assert all(value_of(event) == readings[value_of(event).time_ns] for event in some)
    gaps = np.diff([value_of(event).time_ns for event in some]) // 10**8
    assert np.mean(gaps == 1) == pytest.approx(0.7, abs=0.06)  # independent between readings


def vars_of(sensor: Sensor) -> dict[str, Any]:
    return {name: getattr(sensor, name) for name in binding.parameters(type(sensor))}


def test_on_demand_only_used_readings_are_computed() -> None:
    events = run({f"car{n}": {"h": Heavy()} for n in range(3)}, 1.0)
    assert Heavy.batches == []
    first = [value_of(events[number]) for number in (7, 20, 7)]
    assert Heavy.batches == [1, 1]
    assert first[0] is first[2]


def test_requested_readings_are_batched_with_equal_values() -> None:
    fitted = {f"car{n}": {"h": Heavy(), "g": Heavy(rate_hz=5.0)} for n in range(3)}
    each = [value_of(event) for event in run(fitted, 1.0)]
    assert set(Heavy.batches) == {1}
    Heavy.batches.clear()
    some = run(fitted, 1.0, requested=frozenset({"car0/h", "car2/h", "car2/g"}))
    value_of(some[0])  # car0/h at 0
    assert Heavy.batches == [3]
    backwards = [value_of(event) for event in reversed(some)]
    assert backwards[::-1] == each
    assert sorted(Heavy.batches) == sorted([3] * 5 + [2] * 5 + [1] * (3 * 15 - 25))


def test_light_sensors_are_read_at_once_in_batches() -> None:
    batches = []

    @dataclass(kw_only=True)
    class Light(Draw):
        @classmethod
        def measure_all(cls, sensors: Any, scene: Any, rows: Any, rngs: Any) -> list[Reading]:
            batches.append(rows)
            return super().measure_all(sensors, scene, rows, rngs)

    run({"car1": {"a": Light()}, "car0": {"a": Light(), "b": Light(rate_hz=5.0)}}, 0.2)
    assert batches == [[1, 0, 0], [1, 0]]


@pytest.mark.parametrize(
    ("sensor", "key", "words"),
    [
        (Draw(rate_hz=240.0), "rate_hz", "240 Hz is above physics.rate_hz = 120"),
        (Draw(rate_hz=50.0), "rate_hz", "50 Hz does not divide physics.rate_hz = 120; use 120, 60, 40"),
        (Draw(rate_hz=7.0), "rate_hz", "7 Hz does not divide"),
        (Draw(phase_s=0.004), "phase_s", r"0.004 s is not a whole number of physics steps \(1/120 s\)"),
    ],
)
def test_a_rate_or_phase_between_steps_of_physics_is_refused(sensor: Sensor, key: str, words: str) -> None:
    with pytest.raises(ScenarioError, match=words) as refused:
        SensorScheduler({"car0": {"ok": Draw()}, "car1": {"bad": sensor}}, 1).check(Ticks.rate(120.0))
    assert refused.value.key == f"vehicle.car1.sensors.bad.{key}"


def test_rates_and_phases_on_steps_of_physics_are_not_refused() -> None:
    sensors = {str(hz): Draw(rate_hz=hz, phase_s=0.025) for hz in (120.0, 60.0, 40.0, 0.5, 7.5)}
    SensorScheduler({"car0": sensors}, 1).check(Ticks.rate(120.0))


def test_a_failing_sensor_is_named() -> None:
    @dataclass(kw_only=True)
    class Broken(Sensor):
        def measure(self, scene: Scene, row: int, rng: np.random.Generator) -> Reading:
            raise ZeroDivisionError("oh")

    @dataclass(kw_only=True)
    class Silent(Sensor):
        def measure(self, scene: Scene, row: int, rng: np.random.Generator) -> Any:
            return 3.0

    with pytest.raises(FederateError, match=r"sensor car0/b \(Broken\): ZeroDivisionError: oh \(test_sensor_scheduler.py line"):
        run({"car0": {"b": Broken()}}, 0.1)
    with pytest.raises(FederateError, match=r"sensors car0/b, car1/b \(Silent\): measure must return a reading, not 3.0"):
        run({"car0": {"b": Silent()}, "car1": {"b": Silent()}}, 0.1)


@pytest.mark.parametrize(
    ("params", "words"),
    [
        ({"drop_out": 1.5}, ">= 0 and <= 1"),
        ({"drop_out": -0.1}, ">= 0 and <= 1"),
        ({"latency_s": -0.1}, ">= 0"),
        ({"phase_s": -1.0}, ">= 0"),
        ({"rate_hz": 0.0}, ">= 1e-06"),
    ],
)
def test_impossible_values_are_refused_by_name(params: dict[str, float], words: str) -> None:
    @dataclass(kw_only=True)
    class Own(Draw):
        rate_hz: Rate = 20.0

    for kind in (Draw, Own, Gps, Uwb):
        with pytest.raises(ScenarioError, match=f"must be a number {words}") as refused:
            binding.call(kind, params, key="vehicle.car.sensors.a")
        assert refused.value.key == f"vehicle.car.sensors.a.{next(iter(params))}"
