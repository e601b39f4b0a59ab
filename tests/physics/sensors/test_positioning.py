"""The positioning sensor: its statistics, its outliers, and draws that nothing else moves."""

from typing import Any

import numpy as np
import pytest

from tests.support.physics.sensor_scenes import readings, scene_of
from vcmvsp.cosim.frames import quaternion_from_yaw, wrap
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Fix, VehicleState
from vcmvsp.physics.sensors.positioning import Positioning, PositioningSensor

TRUTH = VehicleState(position=(3.0, -4.0, 0.0), attitude=quaternion_from_yaw(3.1))


def fixes(sensor: Positioning, n: int, name: str = "car/positioning") -> list[Fix]:
    rng = stream(1, name)
    return [sensor.measure(k, TRUTH, rng) for k in range(n)]


def errors(sensor: Positioning, n: int, name: str = "car/positioning") -> np.ndarray:
    """(n, 3): x m, y m, yaw rad."""
    return np.array([(f.position[0] - 3.0, f.position[1] + 4.0, wrap((f.yaw or 0.0) - 3.1)) for f in fixes(sensor, n, name)])


def test_errors_are_independent_and_of_the_stated_size() -> None:
    n = 20_000
    e = errors(Positioning(sigma_m=0.15, sigma_rad=0.05), n)
    assert np.abs(e.mean(axis=0)) == pytest.approx(0.0, abs=4 * 0.15 / n**0.5)
    assert e.std(axis=0) == pytest.approx((0.15, 0.15, 0.05), rel=4 / (2 * n) ** 0.5)
    correlation = np.corrcoef(e.T) - np.eye(3)
    assert np.abs(correlation).max() < 4 / n**0.5
    assert abs(np.corrcoef(e[1:, 0], e[:-1, 0])[0, 1]) < 4 / n**0.5


def test_without_noise_it_tells_the_truth() -> None:
    fix = fixes(Positioning(sigma_m=0.0, sigma_rad=0.0), 1)[0]
    assert fix.position == TRUTH.position
    assert fix.yaw == pytest.approx(3.1)
    assert (fix.sigma_m, fix.sigma_rad) == (0.0, 0.0)


def test_yaw_is_wrapped() -> None:
    yaws = [fix.yaw or 0.0 for fix in fixes(Positioning(sigma_rad=0.5), 500)]
    assert min(yaws) >= -np.pi
    assert max(yaws) < np.pi
    assert min(yaws) < 0.0 < max(yaws)  # 3.1 rad with noise lies on both sides of the seam


def test_outliers_are_as_many_and_as_far_as_stated() -> None:
    n = 10_000
    far = np.hypot(*errors(Positioning(sigma_m=0.0, sigma_rad=0.0, outlier_probability=0.1, outlier_m=2.0), n).T[:2])
    hit = far > 0.0
    assert far[hit] == pytest.approx(2.0)
    assert hit.mean() == pytest.approx(0.1, abs=4 * (0.1 * 0.9 / n) ** 0.5)


def test_parameters_never_move_the_draws() -> None:
    plain = errors(Positioning(sigma_m=0.1), 200)
    assert errors(Positioning(sigma_m=0.2), 200)[:, :2] == pytest.approx(2.0 * plain[:, :2])
    some = errors(Positioning(sigma_m=0.1, outlier_probability=0.3), 200)
    displaced = np.hypot(*(some - plain).T[:2]) > 1.0
    assert 0 < displaced.sum() < 200
    assert np.array_equal(some[~displaced], plain[~displaced])
    assert not np.array_equal(errors(Positioning(sigma_m=0.1), 200, "other/positioning"), plain)


def test_as_a_sensor_among_others_it_gives_the_same_fixes_from_the_same_draws() -> None:
    parameters: Any = {"sigma_m": 0.2, "sigma_rad": 0.1, "outlier_probability": 0.3, "outlier_m": 3.0}
    scenes = [scene_of(TRUTH.position, t=k * 1e-9, yaw=3.1) for k in range(100)]
    assert readings(PositioningSensor(**parameters), scenes, "car/positioning") == fixes(Positioning(**parameters), 100)
