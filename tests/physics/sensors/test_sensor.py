"""Common sensor functions: errors of readings, independent draws, runs, custom sensors."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.physics.engines import KINDS as KINDS_OF_PHYSICS
from tests.support.physics.runs import play
from tests.support.physics.sensor_scenes import readings, scene_of, still
from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.federate import Instants
from vcmvsp.cosim.reference.describe import meanings
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Array, Measured
from vcmvsp.cosim.util.codec import Decoder, encode
from vcmvsp.physics.federate import BulletPhysics, KinematicPhysics, Physics
from vcmvsp.physics.sensor_scheduler import SensorScheduler
from vcmvsp.physics.sensors import sensor as module
from vcmvsp.physics.sensors.detectors import Bumper, NeighbourRange
from vcmvsp.physics.sensors.motion import Altimeter, Compass, InertialUnit, Magnetometer, WheelOdometry
from vcmvsp.physics.sensors.positioning import Gps, PositioningSensor, Uwb
from vcmvsp.physics.sensors.sensor import Errors, Noise, Sensor, jump
from vcmvsp.physics.vehicles.models import P2DX
from vcmvsp.physics.vehicles.specification import VehicleSpec
from vcmvsp.physics.world.solids import Box
from vcmvsp.physics.world.world import World

pytestmark = pytest.mark.slow

N = 20_000


def sequence(noise: Noise, channels: int, times_s: Array) -> Array:
    """Errors of equal channels at these times, (t, channels)."""
    errors, rng = Errors([noise] * channels), stream(1, "noise")
    return np.array([errors.read(np.zeros(channels), round(1e9 * t), rng) for t in times_s])


def test_nothing_by_default() -> None:
    errors = Errors([Noise()] * 3)
    assert errors.read(np.array([1.0, -2.0, 3.0]), 0, stream(1, "a")).tolist() == [1.0, -2.0, 3.0]


@pytest.mark.parametrize("times_s", [np.arange(31.0), np.array([5.0, 5.5, 15.0, 35.0, 65.0])], ids=["even", "uneven"])
@pytest.mark.parametrize(
    "noise",
    [
        Noise(sigma=0.3, bias=2.0),
        Noise(bias_sd=0.5, bias=1.0),
        Noise(drift_sd=2.0, drift_time_s=20.0),
        Noise(walk=0.1),
        Noise(sigma=0.3, bias_sd=0.5, drift_sd=0.4, drift_time_s=5.0, walk=0.1, outlier_probability=0.1, outlier=1.0),
    ],
    ids=["white", "turn-on bias", "drift", "walk", "all"],
)
def test_errors_have_the_stated_mean_and_covariance_at_any_rate(noise: Noise, times_s: Array) -> None:
    e = sequence(noise, N, times_s) - noise.bias
    apart, since = np.abs(np.subtract.outer(times_s, times_s)), np.minimum.outer(times_s, times_s) - times_s[0]
    white = noise.sigma**2 + noise.outlier_probability * noise.outlier**2
    expected = noise.bias_sd**2 + noise.drift_sd**2 * np.exp(-apart / noise.drift_time_s) + noise.walk**2 * since
    expected += white * np.eye(len(times_s))
    size = np.sqrt(expected.diagonal())
    assert (np.abs(e.mean(axis=1)) <= 5.0 * size / N**0.5).all()
    assert (np.abs(e @ e.T / N - expected) <= 5.0 * (2.0 / N) ** 0.5 * np.outer(size, size) + 1e-12).all()


def test_outliers_have_the_stated_rate_and_size_on_both_sides() -> None:
    e = sequence(Noise(outlier_probability=0.1, outlier=7.0), N, np.zeros(1))[0]
    assert set(e.tolist()) == {-7.0, 0.0, 7.0}
    for side in (-7.0, 7.0):
        assert np.mean(e == side) == pytest.approx(0.05, abs=4 * (0.05 * 0.95 / N) ** 0.5)


def test_quantised_readings_are_the_nearest_multiples() -> None:
    truth = np.linspace(-1.0, 1.0, 333)
    read = Errors([Noise(quantum=0.03)] * 333).read(truth, 0, stream(1, "a"))
    assert np.abs(read / 0.03 - np.round(read / 0.03)).max() < 1e-9
    assert np.abs(read - truth).max() <= 0.015 + 1e-12
    assert np.unique(read).size > 60


def test_channels_may_differ() -> None:
    rng, errors = stream(1, "a"), Errors([Noise(sigma=1.0), Noise(quantum=0.5), Noise(bias=3.0)])
    first, second, third = np.array([errors.read(np.full(3, 0.3), t, rng) for t in range(500)]).T
    assert first.std() == pytest.approx(1.0, rel=4 / 1000**0.5)
    assert set(second.tolist()) == {0.5}
    assert third == pytest.approx(3.3)


def test_parameters_change_no_draws() -> None:
    """Every reading takes the same number of draws, and the contributions of parameters are independent."""
    times, zero = (0, 10**8, 10**9), np.zeros(2)
    every = Noise(bias=1.0, bias_sd=1.0, drift_sd=1.0, walk=1.0, sigma=1.0, outlier_probability=0.5, outlier=9.0, quantum=0.1)
    a, b = stream(1, "a"), stream(1, "a")
    plain, full = Errors([Noise()] * 2), Errors([every] * 2)
    for now in times:
        plain.read(zero, now, a)
        full.read(zero, now, b)
    assert a.random() == b.random()
    parts = (Noise(bias_sd=1.0), Noise(drift_sd=1.0), Noise(walk=1.0), Noise(sigma=1.0))
    sums = sum(sequence(part, 2, np.array([0.0, 1.0, 4.0])) for part in parts)
    whole = sequence(Noise(bias_sd=1.0, drift_sd=1.0, walk=1.0, sigma=1.0), 2, np.array([0.0, 1.0, 4.0]))
    assert whole == pytest.approx(sums)


def test_jumps_have_the_stated_rate_and_size_in_all_directions() -> None:
    rng = stream(1, "jump")
    jumps = np.array([jump(0.2, 3.0, rng) for _ in range(N)])
    far = np.hypot(*jumps.T)
    assert far[far > 0.0] == pytest.approx(3.0)
    assert np.mean(far > 0.0) == pytest.approx(0.2, abs=4 * (0.2 * 0.8 / N) ** 0.5)
    assert np.abs(jumps[far > 0.0].mean(axis=0)).max() < 4 * 3.0 / (0.5**0.5 * (0.2 * N) ** 0.5)


def test_as_a_table_of_a_scenario() -> None:
    def sensor(noise: Noise) -> Noise:
        return noise

    assert binding.call(sensor, {"noise": {"sigma": 1, "quantum": 0.5}}) == Noise(sigma=1.0, quantum=0.5)
    for bad in ({"sigma": -1.0}, {"outlier_probability": 1.5}, {"drift_time_s": 0.0}, {"sigmas": 1.0}):
        with pytest.raises(ScenarioError, match=next(iter(bad))) as refused:
            binding.call(sensor, {"noise": bad}, key="vehicle.car.sensors.alt")
        assert refused.value.key.startswith("vehicle.car.sensors.alt.noise")


KINDS = (Altimeter, Bumper, Compass, Gps, InertialUnit, Magnetometer, NeighbourRange, PositioningSensor, Uwb, WheelOdometry)


@pytest.mark.parametrize("kind", KINDS)
def test_every_parameter_has_a_meaning_and_a_default_that_its_annotation_allows(kind: type[Sensor]) -> None:
    known = binding.parameters(kind)
    assert set(known) == {field.name for field in dataclasses.fields(kind)}
    assert set(known) <= set(meanings(kind))
    assert not any(each.required for each in known.values())
    complete = binding.complete(kind, {})
    assert dataclasses.asdict(binding.call(kind, complete)) == dataclasses.asdict(kind())
    assert 120.0 % kind().rate_hz == 0.0  # readings fall on steps of 120 and 240 Hz


def test_an_altimeter_reads_height_plus_weather_drift() -> None:
    (exact,) = readings(Altimeter(noise=Noise()), [scene_of((1.0, 2.0, 3.5))])
    assert exact.values == {"height_m": 3.5}
    heights = np.array(
        [reading.values["height_m"] for reading in readings(Altimeter(), still(2000, (0.0, 0.0, 50.0), hz=20.0))]
    )
    assert np.diff(heights).std() == pytest.approx(0.1 * 2**0.5, rel=0.06)  # white noise; drift within 50 ms is negligible


def test_a_compass_reads_the_wrapped_yaw() -> None:
    (exact,) = readings(Compass(noise=Noise()), [scene_of(yaw=-2.0)])
    assert exact.values == {"yaw_rad": pytest.approx(-2.0)}
    yaws = [reading.values["yaw_rad"] for reading in readings(Compass(noise=Noise(sigma=0.3)), still(300, yaw=3.1))]
    assert -np.pi <= min(yaws) < -3.0
    assert 3.0 < max(yaws) < np.pi


def test_a_magnetometer_reads_the_field_in_its_axes() -> None:
    sensor = Magnetometer(noise=Noise(), field_ut=(1.0, 20.0, -40.0))  # east, north, up
    (east,) = readings(sensor, [scene_of(yaw=0.0)])
    (north,) = readings(sensor, [scene_of(yaw=0.5 * np.pi)])
    assert east.values == {"x_ut": pytest.approx(1.0), "y_ut": pytest.approx(20.0), "z_ut": pytest.approx(-40.0)}
    assert north.values == {"x_ut": pytest.approx(20.0), "y_ut": pytest.approx(-1.0), "z_ut": pytest.approx(-40.0)}
    fields = np.array([[*reading.values.values()] for reading in readings(Magnetometer(), still(2000))])
    assert fields.std(axis=0) == pytest.approx([0.3] * 3, rel=0.06)


MODEL = P2DX()
TURNS = [(0.0, "car", 0.5, 0.0), (3.0, "car", 0.3, 0.6), (6.0, "car", 0.0, 0.0), (8.0, "car", 0.5, -0.4)]


def odometer(**errors: float) -> WheelOdometry:
    return WheelOdometry(wheel_radius_m=MODEL.wheel_radius_m, track_m=MODEL.track_m, **errors)  # type: ignore[arg-type]


def values_of(kind: type[Physics], sensors: dict[str, Sensor], **rest: Any) -> dict[str, dict[int, Any]]:
    """Values by key and time of delivery, of a car that starts at the origin."""
    spec = VehicleSpec(name="car", model=MODEL, position=(0.0, 0.0, 0.0), heading=0.3, sensors=sensors)
    physics = kind(world=rest.get("world", World()), vehicles=[spec])
    steps = play(physics, rest.get("commands", TURNS), rest.get("seconds", 10.0), [Instants(Ticks.rate(10.0))])
    values: dict[str, dict[int, Any]] = {}
    for event in (event for events in steps for event in events):
        values.setdefault(event.key, {})[event.time_ns] = event.value
    return values


def poses(values: dict[str, dict[int, Any]]) -> tuple[Any, Any]:
    """Odometry and true poses, (n, 3) x m, y m, yaw rad."""
    odometry = np.array([reading.pose for reading in values["car/odo"].values()])
    true = np.array([(*state.position[:2], state.yaw) for state in values["car/estimate"].values()])
    return odometry, true


def test_odometry_of_wheels_that_do_not_slip_is_the_truth() -> None:
    odometry, true = poses(values_of(KinematicPhysics, {"odo": odometer()}))
    assert len(odometry) == 101
    assert np.abs(odometry - true).max() < 1e-9


def test_odometry_of_a_body_on_a_good_floor_is_nearly_the_truth() -> None:
    odometry, true = poses(values_of(BulletPhysics, {"odo": odometer()}))
    assert np.hypot(*(odometry - true)[:, :2].T).max() < 0.01
    assert np.abs(odometry - true)[:, 2].max() < 0.005
    wrong, _ = poses(values_of(BulletPhysics, {"odo": odometer(track_error=0.02)}))
    assert np.abs(wrong - true)[:, 2].max() > 0.02


def test_a_bumper_reports_contact_with_the_wall() -> None:
    wall = World(solids=(Box(center=(2.0, 0.6, 0.5), size=(0.2, 6.0, 1.0), yaw_rad=0.3),))
    values = values_of(BulletPhysics, {"bump": Bumper()}, world=wall, commands=[(0.0, "car", 0.5, 0.0)])
    (hit_ns,) = values["world/contact"]
    pressed = [time_ns for time_ns, reading in values["car/bump"].items() if reading.values["front"]]
    assert pressed[0] == hit_ns
    assert not any(reading.values["back"] + reading.values["left"] for reading in values["car/bump"].values())


@KINDS_OF_PHYSICS
def test_an_inertial_unit_reads_floor_force_and_turn(kind: type[Physics]) -> None:
    exact = InertialUnit(
        rate_hz=120.0, accelerometer_density=0.0, accelerometer=Noise(), gyroscope_density=0.0, gyroscope=Noise()
    )
    readings = values_of(kind, {"imu": exact})["car/imu"]
    times = np.array(list(readings)) * 1e-9
    force = np.array([reading.acceleration for reading in readings.values()])
    turn = np.array([reading.angular_velocity for reading in readings.values()])
    circling, standing = (times > 4.5) & (times < 6.0), (times > 7.5) & (times < 8.0)
    assert force[circling].mean(axis=0) == pytest.approx((0.0, 0.3 * 0.6, 9.81), abs=0.02)  # v w, to the left
    assert turn[circling].mean(axis=0) == pytest.approx((0.0, 0.0, 0.6), abs=0.005)
    assert force[standing].mean(axis=0) == pytest.approx((0.0, 0.0, 9.81), abs=0.02)


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


def test_it_is_read_like_others(altimeter: Any) -> None:
    built = binding.call(altimeter, {"sigma_m": 0, "rate_hz": 20, "latency_s": 0.05}, key="vehicle.car0.sensors.alt")
    instruments = SensorScheduler({"car0": {"alt": built}}, 1)
    (event,) = instruments.read(scene_of((1.0, 2.0, 3.0)))
    assert (event.key, event.time_ns) == ("car0/alt", 50_000_000)
    assert event.value == Measured(time_ns=0, values={"height_m": 3.0})
    assert [instruments.due(now) for now in (0, 25_000_000, 50_000_000)] == [True, False, True]


def test_it_has_own_noise(altimeter: Any) -> None:
    instruments = SensorScheduler({"car0": {"alt": altimeter()}, "car1": {"alt": altimeter()}}, 1)
    a, b = (event.value for event in instruments.read(scene_of((0.0, 0.0, 3.0), (0.0, 0.0, 3.0))))
    assert isinstance(a, Measured)
    assert isinstance(b, Measured)
    assert 0.0 < abs(a.values["height_m"] - 3.0) < 0.5
    assert a != b
    assert Decoder[Measured](Measured).decode(encode(a)) == a  # NumPy numbers are encoded as plain ones


def test_its_parameters_are_checked_by_their_annotations(altimeter: Any) -> None:
    for bad in ({"sigma_m": -1.0}, {"rate_hz": -1.0}, {"sigma": 1.0}):
        with pytest.raises(ScenarioError) as refused:
            binding.call(altimeter, bad, key="vehicle.car0.sensors.alt")
        assert refused.value.key == f"vehicle.car0.sensors.alt.{next(iter(bad))}"
