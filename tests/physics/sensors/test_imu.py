"""The inertial unit: specific force in the body frame, and errors of the stated size."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.physics.sensor_scenes import readings, scene_of, still
from vcmvsp.cosim.types import Array
from vcmvsp.physics.sensors.motion import InertialUnit
from vcmvsp.physics.sensors.sensor import Noise
from vcmvsp.physics.world.world import rotations

EXACT = InertialUnit(accelerometer_density=0.0, accelerometer=Noise(), gyroscope_density=0.0, gyroscope=Noise())
G = 9.81
angles = st.floats(-3.0, 3.0)


def test_in_free_fall_it_feels_nothing_whatever_its_attitude() -> None:
    (reading,) = readings(EXACT, [scene_of(attitude=(0.5, 0.5, -0.5, 0.5), acceleration=(0.0, 0.0, -G), rate=(1.0, 2.0, 3.0))])
    assert reading.acceleration == pytest.approx((0.0, 0.0, 0.0))
    assert reading.angular_velocity == (1.0, 2.0, 3.0)


@given(yaw=angles)
def test_on_a_circle_it_feels_v_squared_by_r_towards_the_centre(yaw: float) -> None:
    v, r = 2.0, 5.0
    inward = v * v / r * np.array([-np.sin(yaw), np.cos(yaw), 0.0])  # to the left of its way
    (reading,) = readings(EXACT, [scene_of(yaw=yaw, acceleration=inward.tolist(), rate=(0.0, 0.0, v / r))])
    assert reading.acceleration == pytest.approx((0.0, v * v / r, G))
    assert reading.angular_velocity == (0.0, 0.0, v / r)


@given(st.tuples(angles, angles, angles, angles).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_at_rest_it_shows_which_way_is_up(q: tuple[float, ...]) -> None:
    attitude = np.array(q) / np.linalg.norm(q)
    (reading,) = readings(EXACT, [scene_of(attitude=attitude)])
    assert rotations(attitude[None])[0] @ reading.acceleration == pytest.approx((0.0, 0.0, G), abs=1e-9)


@pytest.mark.parametrize("hz", [20.0, 80.0])
def test_a_noise_density_makes_what_is_integrated_walk_away_by_the_root_of_time(hz: float) -> None:
    sensor = InertialUnit(
        rate_hz=hz, gyroscope_density=0.01, gyroscope=Noise(), accelerometer_density=0.02, accelerometer=Noise()
    )
    each = int(2.0 * hz)  # 2 s
    runs = 200
    values = readings(sensor, still(runs * each, hz=hz))
    turns = np.array([reading.angular_velocity for reading in values]).reshape(runs, each, 3).sum(axis=1) / hz
    speeds = np.array([reading.acceleration for reading in values]) - (0.0, 0.0, G)
    assert turns.std() == pytest.approx(0.01 * 2.0**0.5, rel=4 / (2 * turns.size) ** 0.5)
    assert (speeds.reshape(runs, each, 3).sum(axis=1) / hz).std() == pytest.approx(0.02 * 2.0**0.5, rel=0.1)


def test_readings_end_at_the_limits_and_are_quantised() -> None:
    fast: Any = {"rate": (30.0, -30.0, 0.1), "acceleration": (200.0, -200.0, 0.0)}
    (reading,) = readings(EXACT, [scene_of(**fast)])
    assert reading.acceleration == (78.5, -78.5, G)
    assert reading.angular_velocity == (17.45, -17.45, 0.1)
    steps = InertialUnit(accelerometer_density=0.0, gyroscope_density=0.0, accelerometer=Noise(quantum=0.5), gyroscope=Noise())
    (reading,) = readings(steps, [scene_of(acceleration=(0.7, -0.2, 0.0))])
    assert reading.acceleration == (0.5, 0.0, 10.0)


def test_by_default_it_errs_as_a_calibrated_low_cost_unit() -> None:
    """Turn-on biases from unit to unit, and the white noise of a density at 60 Hz."""
    units = [readings(InertialUnit(), still(40, hz=60.0), f"car{number}/imu") for number in range(150)]
    force: Array = np.array([[reading.acceleration for reading in unit] for unit in units]) - (0.0, 0.0, G)
    turn: Array = np.array([[reading.angular_velocity for reading in unit] for unit in units])
    assert force.mean(axis=1).std() == pytest.approx(np.hypot(0.05, 0.01), rel=0.15)
    assert turn.mean(axis=1).std() == pytest.approx(np.hypot(0.005, 0.001), rel=0.15)
    assert (force - force.mean(axis=1, keepdims=True)).std() == pytest.approx(0.0039 * 60**0.5, rel=0.03)
