"""Inertial unit and wheel odometry: exact without errors, and errors of the stated size."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.physics.sensor_scenes import readings, scene_of, still
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.frames import arc
from vcmvsp.cosim.types import Array
from vcmvsp.physics.sensors.motion import InertialUnit, WheelOdometry
from vcmvsp.physics.sensors.sensor import Noise
from vcmvsp.physics.world.world import Scene, rotations

pytestmark = pytest.mark.slow

EXACT = InertialUnit(accelerometer_density=0.0, accelerometer=Noise(), gyroscope_density=0.0, gyroscope=Noise())
G = 9.81
angles = st.floats(-3.0, 3.0)


def test_free_fall_reads_zero_at_any_attitude() -> None:
    (reading,) = readings(EXACT, [scene_of(attitude=(0.5, 0.5, -0.5, 0.5), acceleration=(0.0, 0.0, -G), rate=(1.0, 2.0, 3.0))])
    assert reading.acceleration == pytest.approx((0.0, 0.0, 0.0))
    assert reading.angular_velocity == (1.0, 2.0, 3.0)


@given(yaw=angles)
def test_a_circle_reads_v_squared_by_r_towards_the_centre(yaw: float) -> None:
    v, r = 2.0, 5.0
    inward = v * v / r * np.array([-np.sin(yaw), np.cos(yaw), 0.0])  # to the left of the direction of travel
    (reading,) = readings(EXACT, [scene_of(yaw=yaw, acceleration=inward.tolist(), rate=(0.0, 0.0, v / r))])
    assert reading.acceleration == pytest.approx((0.0, v * v / r, G))
    assert reading.angular_velocity == (0.0, 0.0, v / r)


@given(st.tuples(angles, angles, angles, angles).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_at_rest_it_shows_which_way_is_up(q: tuple[float, ...]) -> None:
    attitude = np.array(q) / np.linalg.norm(q)
    (reading,) = readings(EXACT, [scene_of(attitude=attitude)])
    assert rotations(attitude[None])[0] @ reading.acceleration == pytest.approx((0.0, 0.0, G), abs=1e-9)


@pytest.mark.parametrize("hz", [20.0, 80.0])
def test_integrated_noise_grows_with_the_root_of_time(hz: float) -> None:
    sensor = InertialUnit(
        rate_hz=hz, gyroscope_density=0.01, gyroscope=Noise(), accelerometer_density=0.02, accelerometer=Noise()
    )
    each = int(2.0 * hz)  # 2 s
    runs = 100
    values = readings(sensor, still(runs * each, hz=hz))
    rel = 4 / (2 * 3 * runs) ** 0.5  # standard errors, of three axes
    turns = np.array([reading.angular_velocity for reading in values]).reshape(runs, each, 3).sum(axis=1) / hz
    speeds = np.array([reading.acceleration for reading in values]) - (0.0, 0.0, G)
    assert turns.std() == pytest.approx(0.01 * 2.0**0.5, rel=rel)
    assert (speeds.reshape(runs, each, 3).sum(axis=1) / hz).std() == pytest.approx(
        0.02 * 2.0**0.5, rel=4 / (2 * turns.size) ** 0.5
    )


def test_readings_end_at_the_limits_and_are_quantised() -> None:
    fast: Any = {"rate": (30.0, -30.0, 0.1), "acceleration": (200.0, -200.0, 0.0)}
    (reading,) = readings(EXACT, [scene_of(**fast)])
    assert reading.acceleration == (78.5, -78.5, G)
    assert reading.angular_velocity == (17.45, -17.45, 0.1)
    steps = InertialUnit(accelerometer_density=0.0, gyroscope_density=0.0, accelerometer=Noise(quantum=0.5), gyroscope=Noise())
    (reading,) = readings(steps, [scene_of(acceleration=(0.7, -0.2, 0.0))])
    assert reading.acceleration == (0.5, 0.0, 10.0)


def test_default_errors_of_a_calibrated_low_cost_unit() -> None:
    """Turn-on bias per unit, and white noise of a density at 60 Hz."""
    units = [readings(InertialUnit(), still(40, hz=60.0), f"car{number}/imu") for number in range(75)]
    force: Array = np.array([[reading.acceleration for reading in unit] for unit in units]) - (0.0, 0.0, G)
    turn: Array = np.array([[reading.angular_velocity for reading in unit] for unit in units])
    assert force.mean(axis=1).std() == pytest.approx(np.hypot(0.05, 0.01), rel=0.15)
    assert turn.mean(axis=1).std() == pytest.approx(np.hypot(0.005, 0.001), rel=0.15)
    assert (force - force.mean(axis=1, keepdims=True)).std() == pytest.approx(0.0039 * 60**0.5, rel=0.03)


R, B = 0.05, 0.25
Pose = tuple[float, float, float]


def driven(speeds: list[tuple[float, float]], dt: float = 0.1, start: Pose = (1.0, 2.0, 0.5)) -> tuple[list[Scene], list[Pose]]:
    """Scenes of a robot with each (v m/s, w rad/s) for dt, without slip, and its true poses."""
    poses, left, right, scenes = [start], 3.0, -2.0, []
    for number in range(len(speeds) + 1):
        x, y, yaw = poses[-1]
        scenes.append(scene_of((x, y, 0.0), t=number * dt, yaw=yaw, wheels=(left, right)))
        if number < len(speeds):
            v, w = speeds[number]
            left, right = left + (v - 0.5 * B * w) * dt / R, right + (v + 0.5 * B * w) * dt / R
            poses.append(arc(poses[-1], v, w, dt))
    return scenes, poses


def odometer(**errors: float) -> WheelOdometry:
    return WheelOdometry(wheel_radius_m=R, track_m=B, **errors)  # type: ignore[arg-type]


@settings(max_examples=50)
@given(st.lists(st.tuples(st.floats(-1.0, 1.0), st.floats(-2.0, 2.0)), min_size=1, max_size=30))
def test_without_slip_and_errors_it_is_the_truth(speeds: list[tuple[float, float]]) -> None:
    scenes, poses = driven(speeds)
    samples = readings(odometer(), scenes)
    for reading, pose, (v, w) in zip(samples, poses, [(0.0, 0.0), *speeds], strict=True):
        assert reading.pose == pytest.approx(pose, abs=1e-9)
        assert (reading.v, reading.w) == pytest.approx((v, w), abs=1e-9)


def test_a_radius_error_of_one_per_cent_scales_the_distance() -> None:
    scenes, _ = driven([(0.5, 0.0)] * 100, start=(0.0, 0.0, 0.0))
    last = readings(odometer(left_radius_error=0.01, right_radius_error=0.01), scenes)[-1]
    assert last.pose == pytest.approx((5.05, 0.0, 0.0))
    assert last.v == pytest.approx(0.505)


def test_a_radius_error_of_one_wheel_bends_a_line() -> None:
    """The left distance is 1 % too long: a right turn of radius b (2.01 / 2) / 0.01."""
    scenes, _ = driven([(0.5, 0.0)] * 100, start=(0.0, 0.0, 0.0))
    x, y, yaw = readings(odometer(left_radius_error=0.01), scenes)[-1].pose
    turned, radius = 0.01 * 5.0 / B, B * 1.005 / 0.01
    assert (x, y, yaw) == pytest.approx((radius * math.sin(turned), -radius * (1 - math.cos(turned)), -turned))


def test_a_wide_track_makes_turns_small() -> None:
    scenes, poses = driven([(0.0, 1.0)] * 100, start=(0.0, 0.0, 0.0))
    assert readings(odometer(track_error=0.01), scenes)[-1].pose[2] == pytest.approx(poses[-1][2] / 1.01)


def test_a_walk_grows_with_root_distance() -> None:
    """After s m: each wheel by walk sqrt(s), so the middle by walk sqrt(s / 2) and the yaw by walk sqrt(2 s) / track."""
    scenes, _ = driven([(0.5, 0.0)] * 40, start=(0.0, 0.0, 0.0))
    ends = np.array([readings(odometer(walk_m=0.002), scenes, f"car{n}/odo")[-1].pose for n in range(600)])
    assert ends[:, 0].std() == pytest.approx(0.002 * 1.0, rel=0.12)
    assert ends[:, 2].std() == pytest.approx(0.002 * 2.0 / B, rel=0.12)


def test_encoder_ticks_are_never_lost() -> None:
    scenes, poses = driven([(0.0333, 0.0)] * 300, start=(0.0, 0.0, 0.0))
    distances = np.array([reading.pose[0] for reading in readings(odometer(ticks_per_turn=64), scenes)])
    assert np.abs(distances - [pose[0] for pose in poses]).max() <= math.tau * R / 64
    assert np.unique(distances.round(9)).size < 250


def test_slip_is_not_seen() -> None:
    scenes = [scene_of((0.0, 0.0, 0.0), t=t, wheels=(10.0 * t, 10.0 * t)) for t in (0.0, 1.0, 2.0)]
    assert readings(odometer(), scenes)[-1].pose == pytest.approx((1.0, 0.0, 0.0))


@pytest.mark.parametrize("sensor", [odometer(), WheelOdometry()])
def test_a_vehicle_without_wheels_is_refused_by_name(sensor: WheelOdometry) -> None:
    with pytest.raises(ScenarioError, match="car0 has no two driven wheels") as refused:
        readings(sensor, [scene_of()])
    assert refused.value.key == "vehicle.car0.sensors"
