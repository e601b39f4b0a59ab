"""Positioning sensors: stated errors, outliers, biases near walls, geometry of anchors, independent draws."""

from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares

from tests.support.physics.sensor_scenes import readings, scene_of, still
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.frames import quaternion_from_yaw, wrap
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Array, Fix, VehicleState
from vcmvsp.physics.sensors.positioning import Gps, Positioning, PositioningSensor, Uwb
from vcmvsp.physics.world.solids import Box
from vcmvsp.physics.world.world import World

pytestmark = pytest.mark.slow

TRUTH = VehicleState(position=(3.0, -4.0, 0.0), attitude=quaternion_from_yaw(3.1))


def fixes(sensor: Positioning, n: int, name: str = "car/positioning") -> list[Fix]:
    rng = stream(1, name)
    return [sensor.measure(k, TRUTH, rng) for k in range(n)]


def errors(sensor: Positioning, n: int, name: str = "car/positioning") -> np.ndarray:
    """Errors (n, 3): x m, y m, yaw rad."""
    return np.array([(f.position[0] - 3.0, f.position[1] + 4.0, wrap((f.yaw or 0.0) - 3.1)) for f in fixes(sensor, n, name)])


def test_errors_are_independent_and_of_the_stated_size() -> None:
    n = 20_000
    e = errors(Positioning(sigma_m=0.15, sigma_rad=0.05), n)
    assert np.abs(e.mean(axis=0)) == pytest.approx(0.0, abs=4 * 0.15 / n**0.5)
    assert e.std(axis=0) == pytest.approx((0.15, 0.15, 0.05), rel=4 / (2 * n) ** 0.5)
    correlation = np.corrcoef(e.T) - np.eye(3)
    assert np.abs(correlation).max() < 4 / n**0.5
    assert abs(np.corrcoef(e[1:, 0], e[:-1, 0])[0, 1]) < 4 / n**0.5


def test_without_noise_it_is_exact() -> None:
    fix = fixes(Positioning(sigma_m=0.0, sigma_rad=0.0), 1)[0]
    assert fix.position == TRUTH.position
    assert fix.yaw == pytest.approx(3.1)
    assert (fix.sigma_m, fix.sigma_rad) == (0.0, 0.0)


def test_yaw_is_wrapped() -> None:
    yaws = [fix.yaw or 0.0 for fix in fixes(Positioning(sigma_rad=0.5), 500)]
    assert min(yaws) >= -np.pi
    assert max(yaws) < np.pi
    assert min(yaws) < 0.0 < max(yaws)  # 3.1 rad with noise crosses the wrap at pi


def test_parameters_change_no_draws() -> None:
    plain = errors(Positioning(sigma_m=0.1), 200)
    assert errors(Positioning(sigma_m=0.2), 200)[:, :2] == pytest.approx(2.0 * plain[:, :2])
    some = errors(Positioning(sigma_m=0.1, outlier_probability=0.3), 200)
    displaced = np.hypot(*(some - plain).T[:2]) > 1.0
    assert 0 < displaced.sum() < 200
    assert np.array_equal(some[~displaced], plain[~displaced])
    assert not np.array_equal(errors(Positioning(sigma_m=0.1), 200, "other/positioning"), plain)


def test_the_sensor_gives_equal_fixes_from_equal_draws() -> None:
    parameters: Any = {"sigma_m": 0.2, "sigma_rad": 0.1, "outlier_probability": 0.3, "outlier_m": 3.0}
    scenes = [scene_of(TRUTH.position, t=k * 1e-9, yaw=3.1) for k in range(100)]
    assert readings(PositioningSensor(**parameters), scenes, "car/positioning") == fixes(Positioning(**parameters), 100)


def gps_errors(sensor: Gps, count: int, name: str = "car0/gps", hz: float = 5.0) -> Array:
    return np.array([fix.position for fix in readings(sensor, still(count, (3.0, -4.0, 5.0), hz=hz), name)]) - (3.0, -4.0, 5.0)


def test_many_receivers_have_the_spread_of_sigma() -> None:
    many = np.array([gps_errors(Gps(), 1, f"car{number}/gps")[0] for number in range(3000)])
    fix = readings(Gps(), [scene_of()])[0]
    assert fix.yaw is None
    assert many.std(axis=0) == pytest.approx((fix.sigma_m, fix.sigma_m, fix.sigma_z_m), rel=4 / 6000**0.5)
    assert np.median(np.hypot(*many.T[:2])) == pytest.approx(2.5, rel=0.06)  # circular error probable of the data sheet


def test_one_receiver_drifts_slowly_plus_white_noise() -> None:
    """Correlation after t: the slow share of the variance times exp(-t / T)."""
    runs = np.array([gps_errors(Gps(drift_time_s=10.0), 60, f"car{n}/gps", hz=1.0) for n in range(350)])
    slow = 2.1**2 / (2.1**2 + 0.3**2)
    for lag in (1, 5, 10, 30):
        flat = runs[:, lag:, :2].ravel(), runs[:, :-lag, :2].ravel()
        assert np.corrcoef(*flat)[0, 1] == pytest.approx(slow * np.exp(-lag / 10.0), abs=0.045)


def test_outliers_and_mount_of_an_antenna() -> None:
    exact: Any = {"drift_m": 0.0, "sigma_m": 0.0, "drift_z_m": 0.0, "sigma_z_m": 0.0}
    assert gps_errors(Gps(**exact), 3) == pytest.approx(0.0)
    far = np.hypot(*gps_errors(Gps(**exact, outlier_probability=1.0, outlier_m=15.0), 20).T[:2])
    assert far == pytest.approx(15.0)
    (fix,) = readings(Gps(**exact, mount=(1.0, 0.0, 0.5)), [scene_of((2.0, 3.0, 0.0), yaw=np.pi / 2)])
    assert fix.position == pytest.approx((2.0, 4.0, 0.5))


WALL_AT_5 = World(solids=(Box(center=(0.0, 5.1, 1.0), size=(20.0, 0.2, 4.0)),))  # face at y = 5
SQUARE = ((-5.0, -5.0, 1.0), (5.0, -5.0, 1.0), (5.0, 5.0, 1.0), (-5.0, 5.0, 1.0))
EXACT: Any = {"sigma_m": 0.0, "sigma_z_m": 0.0}


def uwb_errors(sensor: Uwb, count: int, place: tuple[float, float, float], world: World | None = None) -> Array:
    return np.array([fix.position for fix in readings(sensor, still(count, place, world=world))]) - place


def test_open_field_errors_match_sigma_without_heading() -> None:
    n = 5000
    e = uwb_errors(Uwb(), n, (3.0, 4.0, 1.0))
    assert e.std(axis=0) == pytest.approx((0.15, 0.15, 0.3), rel=4 / (2 * n) ** 0.5)
    assert np.abs(e.mean(axis=0)).max() < 4 * 0.3 / n**0.5
    assert np.abs(np.corrcoef(e.T) - np.eye(3)).max() < 4 / n**0.5
    (fix,) = readings(Uwb(), [scene_of()])
    assert (fix.yaw, fix.sigma_m, fix.sigma_z_m) == (None, 0.15, 0.3)


@pytest.mark.parametrize(("bias_m", "reach_m"), [(0.3, 1.0), (0.8, 4.0)])
def test_the_bias_points_away_from_a_wall_and_fades_to_the_reach(bias_m: float, reach_m: float) -> None:
    for gap in (0.001, 0.25, 0.5, 0.9, 1.0, 2.0, 3.0, 3.99, 4.01):
        pushed = bias_m * max(1.0 - gap / reach_m, 0.0)
        e = uwb_errors(Uwb(**EXACT, wall_bias_m=bias_m, wall_reach_m=reach_m), 1, (2.0, 5.0 - gap, 1.0), WALL_AT_5)[0]
        assert e == pytest.approx((0.0, -pushed, 0.0), abs=1e-9)


def test_the_bias_is_a_mean_and_leaves_the_noise_alone() -> None:
    near, far = uwb_errors(Uwb(), 500, (2.0, 4.5, 1.0), WALL_AT_5), uwb_errors(Uwb(), 500, (2.0, 0.0, 1.0), WALL_AT_5)
    assert near == pytest.approx(far - (0.0, 0.15, 0.0))


def test_outliers_and_mount() -> None:
    assert np.hypot(*uwb_errors(Uwb(**EXACT, outlier_probability=1.0), 20, (0.0, 0.0, 0.0)).T[:2]) == pytest.approx(2.0)
    (fix,) = readings(Uwb(**EXACT, mount=(0.1, 0.2, 0.3)), [scene_of((1.0, 1.0, 0.0), yaw=np.pi / 2)])
    assert fix.position == pytest.approx((0.8, 1.1, 0.3))


@pytest.mark.parametrize("place", [(0.0, 0.0, 1.0), (4.0, 1.0, 0.0), (20.0, 3.0, 0.2), (-30.0, 30.0, 4.0)])
def test_errors_match_the_stated_dilution(place: tuple[float, float, float]) -> None:
    n, sensor = 2000, Uwb(anchors=SQUARE)
    e = uwb_errors(sensor, n, place)
    (fix,) = readings(sensor, [scene_of(place)])
    sigmas = (fix.sigma_m, fix.sigma_z_m)
    assert (np.mean(e[:, :2] ** 2) ** 0.5, e[:, 2].std()) == pytest.approx(sigmas, rel=4 / (2 * n) ** 0.5)
    outside = max(abs(place[0]), abs(place[1])) > 10.0
    assert (fix.sigma_m > 0.2) == outside


def test_errors_equal_those_of_the_ranges() -> None:
    """Against an iterated least-squares solution of the ranges."""
    place, sensor = np.array([3.0, -2.0, 0.4]), Uwb(anchors=SQUARE, sigma_m=0.001, sigma_z_m=0.002)
    anchors = np.array(SQUARE)
    fix_errors = uwb_errors(sensor, 20, (3.0, -2.0, 0.4))
    rng = stream(1, "car0/sensor")
    for each in fix_errors:
        draws, _ = rng.standard_normal(7), rng.random(2)
        ranges = np.linalg.norm(anchors - place, axis=1) + 0.001 * draws[3:]
        height = 0.4 + 0.002 * draws[2]

        def residuals(p: Array, ranges: Array = ranges, height: float = height) -> Array:
            return np.append((np.linalg.norm(anchors - p, axis=1) - ranges) / 0.001, (p[2] - height) / 0.002)

        solved = least_squares(residuals, place + 0.1, xtol=1e-15, ftol=1e-15, gtol=1e-15).x
        assert each == pytest.approx(solved - place, abs=2e-5)


def test_a_blocked_range_is_too_long_and_pushes_away_from_its_anchor() -> None:
    wall = World(solids=(Box(center=(2.5, 2.5, 1.0), size=(1.0, 1.0, 4.0), yaw_rad=np.pi / 4),))
    sensor = Uwb(anchors=SQUARE, **EXACT, wall_bias_m=0.0, blocked_bias_m=0.4)
    e = uwb_errors(sensor, 1, (0.0, 0.0, 1.0), wall)[0]
    assert e == pytest.approx((-0.2 / 2**0.5, -0.2 / 2**0.5, 0.0), abs=1e-6)  # (H^T H)^-1 H^T e, with H^T H = 2 I
    assert uwb_errors(sensor, 1, (0.0, 0.0, 1.0))[0] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("anchors", [[(0.0, 0.0, 1.0)], [(0.0, 0.0, 1.0), (1.0, 1.0, 2.0), (2.0, 2.0, 5.0)]])
def test_anchors_that_give_no_position_are_refused(anchors: list[tuple[float, float, float]]) -> None:
    with pytest.raises(ScenarioError, match="at least three are needed") as refused:
        binding.call(Uwb, {"anchors": anchors}, key="vehicle.car.sensors.uwb")
    assert refused.value.key == "vehicle.car.sensors.uwb.anchors"
