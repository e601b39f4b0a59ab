"""A sensor of one's own: the example of `physics.sensors.sensor`, in a file beside a scenario."""

from pathlib import Path
from typing import Any

import pytest

from tests.support.physics.sensor_scenes import scene_of
from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Measured
from vcmvsp.cosim.util.codec import Decoder, encode
from vcmvsp.physics.sensor_scheduler import SensorScheduler
from vcmvsp.physics.sensors import sensor as module

IMPORTS = """\
from dataclasses import dataclass

from numpy.random import Generator

from vcmvsp.cosim.types import Measured, NonNegative
from vcmvsp.physics.world.world import Scene
from vcmvsp.physics.sensors.sensor import Sensor


"""


@pytest.fixture
def altimeter(tmp_path: Path) -> Any:
    example = (module.__doc__ or "").partition("::\n\n")[2]
    text = IMPORTS + "\n".join(line.removeprefix("    ") for line in example.rstrip().splitlines()) + "\n"
    assert len(text.splitlines()) <= 20
    (tmp_path / "my_sensors.py").write_text(text)
    return registry.find("sensor", "my_sensors.py:Altimeter", folder=tmp_path)


def test_it_is_read_as_any_other(altimeter: Any) -> None:
    built = binding.call(altimeter, {"sigma_m": 0, "rate_hz": 20, "latency_s": 0.05}, key="vehicle.car0.sensors.alt")
    instruments = SensorScheduler({"car0": {"alt": built}}, 1)
    (event,) = instruments.read(scene_of((1.0, 2.0, 3.0)))
    assert (event.key, event.time_ns) == ("car0/alt", 50_000_000)
    assert event.value == Measured(time_ns=0, values={"height_m": 3.0})
    assert [instruments.due(now) for now in (0, 25_000_000, 50_000_000)] == [True, False, True]


def test_it_errs_by_itself(altimeter: Any) -> None:
    instruments = SensorScheduler({"car0": {"alt": altimeter()}, "car1": {"alt": altimeter()}}, 1)
    a, b = (event.value for event in instruments.read(scene_of((0.0, 0.0, 3.0), (0.0, 0.0, 3.0))))
    assert isinstance(a, Measured)
    assert isinstance(b, Measured)
    assert 0.0 < abs(a.values["height_m"] - 3.0) < 0.5
    assert a != b
    assert Decoder[Measured](Measured).decode(encode(a)) == a  # NumPy's numbers travel as plain ones


def test_its_parameters_are_checked_by_their_annotations(altimeter: Any) -> None:
    for bad in ({"sigma_m": -1.0}, {"rate_hz": -1.0}, {"sigma": 1.0}):
        with pytest.raises(ScenarioError) as refused:
            binding.call(altimeter, bad, key="vehicle.car0.sensors.alt")
        assert refused.value.key == f"vehicle.car0.sensors.alt.{next(iter(bad))}"
