"""Satellite positioning: a slow and a fast error, of the size that the fix tells."""

from typing import Any

import numpy as np
import pytest

from tests.support.physics.sensor_scenes import readings, scene_of, still
from vcmvsp.cosim.types import Array
from vcmvsp.physics.sensors.positioning import Gps


def errors(sensor: Gps, count: int, name: str = "car0/gps", hz: float = 5.0) -> Array:
    return np.array([fix.position for fix in readings(sensor, still(count, (3.0, -4.0, 5.0), hz=hz), name)]) - (3.0, -4.0, 5.0)


def test_many_receivers_err_by_what_their_fixes_tell() -> None:
    many = np.array([errors(Gps(), 1, f"car{number}/gps")[0] for number in range(3000)])
    fix = readings(Gps(), [scene_of()])[0]
    assert fix.yaw is None
    assert many.std(axis=0) == pytest.approx((fix.sigma_m, fix.sigma_m, fix.sigma_z_m), rel=4 / 6000**0.5)
    assert np.median(np.hypot(*many.T[:2])) == pytest.approx(2.5, rel=0.06)  # circular error probable of the data sheet


def test_one_receiver_errs_slowly_with_white_noise_upon_it() -> None:
    """Correlation after t: the share of the slow variance times exp(-t / T)."""
    runs = np.array([errors(Gps(drift_time_s=10.0), 60, f"car{n}/gps", hz=1.0) for n in range(700)])
    slow = 2.1**2 / (2.1**2 + 0.3**2)
    for lag in (1, 5, 10, 30):
        flat = runs[:, lag:, :2].ravel(), runs[:, :-lag, :2].ravel()
        assert np.corrcoef(*flat)[0, 1] == pytest.approx(slow * np.exp(-lag / 10.0), abs=0.03)


def test_outliers_and_mount() -> None:
    exact: Any = {"drift_m": 0.0, "sigma_m": 0.0, "drift_z_m": 0.0, "sigma_z_m": 0.0}
    assert errors(Gps(**exact), 3) == pytest.approx(0.0)
    far = np.hypot(*errors(Gps(**exact, outlier_probability=1.0, outlier_m=15.0), 20).T[:2])
    assert far == pytest.approx(15.0)
    (fix,) = readings(Gps(**exact, mount=(1.0, 0.0, 0.5)), [scene_of((2.0, 3.0, 0.0), yaw=np.pi / 2)])
    assert fix.position == pytest.approx((2.0, 4.0, 0.5))


def test_outliers_move_no_other_draw() -> None:
    plain, some = errors(Gps(), 300), errors(Gps(outlier_probability=0.2), 300)
    moved = np.hypot(*(some - plain).T[:2]) > 1.0
    assert 30 < moved.sum() < 90
    assert np.array_equal(plain[~moved], some[~moved])
