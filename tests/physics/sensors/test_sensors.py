"""What all kinds of sensors have in common, and the small ones."""

import dataclasses

import numpy as np
import pytest

from tests.support.physics.sensor_scenes import readings, scene_of, still
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.reference.describe import meanings
from vcmvsp.physics.sensors.detectors import Bumper, NeighbourRange
from vcmvsp.physics.sensors.motion import Altimeter, Compass, InertialUnit, WheelOdometry
from vcmvsp.physics.sensors.positioning import Gps, PositioningSensor, Uwb
from vcmvsp.physics.sensors.sensor import Noise, Sensor

KINDS = (Altimeter, Bumper, Compass, Gps, InertialUnit, NeighbourRange, PositioningSensor, Uwb, WheelOdometry)


@pytest.mark.parametrize("kind", KINDS)
def test_every_parameter_has_a_meaning_and_a_default_that_its_annotation_allows(kind: type[Sensor]) -> None:
    known = binding.parameters(kind)
    assert set(known) == {field.name for field in dataclasses.fields(kind)}
    assert set(known) <= set(meanings(kind))
    assert not any(each.required for each in known.values())
    complete = binding.complete(kind, {})
    assert dataclasses.asdict(binding.call(kind, complete)) == dataclasses.asdict(kind())


@pytest.mark.parametrize("kind", KINDS)
def test_default_rates_fall_on_steps_of_120_and_240_hz(kind: type[Sensor]) -> None:
    assert 120.0 % kind().rate_hz == 0.0


@pytest.mark.parametrize("kind", KINDS)
def test_no_sensor_changes_the_truth(kind: type[Sensor]) -> None:
    scene = scene_of((1.0, 2.0, 3.0), (2.0, 2.0, 3.0), wheels=(1.0, 2.0))
    arrays = (scene.position, scene.attitude, scene.velocity, scene.angular_velocity, scene.acceleration, scene.wheels)
    for array in arrays:
        array.flags.writeable = False
    before = [array.copy() for array in arrays]
    sensor = WheelOdometry(wheel_radius_m=0.1, track_m=0.3) if kind is WheelOdometry else kind()
    (reading,) = readings(sensor, [scene])
    assert reading.__struct_fields__
    assert all(np.array_equal(a, b) for a, b in zip(arrays, before, strict=True))


def test_an_altimeter_tells_the_height_and_drifts_with_the_weather() -> None:
    (exact,) = readings(Altimeter(noise=Noise()), [scene_of((1.0, 2.0, 3.5))])
    assert exact.values == {"height_m": 3.5}
    said = np.array([reading.values["height_m"] for reading in readings(Altimeter(), still(2000, (0.0, 0.0, 50.0), hz=20.0))])
    assert np.diff(said).std() == pytest.approx(0.1 * 2**0.5, rel=0.06)  # white noise; the drift hardly moves in 50 ms


def test_a_compass_tells_the_yaw_wrapped() -> None:
    (exact,) = readings(Compass(noise=Noise()), [scene_of(yaw=-2.0)])
    assert exact.values == {"yaw_rad": pytest.approx(-2.0)}
    said = [reading.values["yaw_rad"] for reading in readings(Compass(noise=Noise(sigma=0.3)), still(300, yaw=3.1))]
    assert -np.pi <= min(said) < -3.0
    assert 3.0 < max(said) < np.pi
