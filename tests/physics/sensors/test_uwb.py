"""Ultra-wideband fixes: errors as told, biases near walls, geometry of the anchors."""

from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares

from tests.support.physics.sensor_scenes import readings, scene_of, still
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Array
from vcmvsp.physics.sensors.positioning import Uwb
from vcmvsp.physics.world.solids import Box
from vcmvsp.physics.world.world import World

WALL = World(solids=(Box(center=(0.0, 5.1, 1.0), size=(20.0, 0.2, 4.0)),))  # its face at y = 5
SQUARE = ((-5.0, -5.0, 1.0), (5.0, -5.0, 1.0), (5.0, 5.0, 1.0), (-5.0, 5.0, 1.0))
EXACT: Any = {"sigma_m": 0.0, "sigma_z_m": 0.0}


def errors(sensor: Uwb, count: int, place: tuple[float, float, float], world: World | None = None) -> Array:
    return np.array([fix.position for fix in readings(sensor, still(count, place, world=world))]) - place


def test_in_the_open_it_errs_by_what_it_tells_and_has_no_heading() -> None:
    n = 5000
    e = errors(Uwb(), n, (3.0, 4.0, 1.0))
    assert e.std(axis=0) == pytest.approx((0.15, 0.15, 0.3), rel=4 / (2 * n) ** 0.5)
    assert np.abs(e.mean(axis=0)).max() < 4 * 0.3 / n**0.5
    assert np.abs(np.corrcoef(e.T) - np.eye(3)).max() < 4 / n**0.5
    (fix,) = readings(Uwb(), [scene_of()])
    assert (fix.yaw, fix.sigma_m, fix.sigma_z_m) == (None, 0.15, 0.3)


@pytest.mark.parametrize(("gap", "pushed"), [(0.001, 0.2997), (0.25, 0.225), (0.5, 0.15), (0.9, 0.03), (1.0, 0.0), (3.0, 0.0)])
def test_near_a_wall_it_is_pushed_away_from_it(gap: float, pushed: float) -> None:
    e = errors(Uwb(**EXACT), 1, (2.0, 5.0 - gap, 1.0), WALL)[0]
    assert e == pytest.approx((0.0, -pushed, 0.0), abs=1e-9)


def test_the_bias_ends_where_it_is_said_to() -> None:
    sensor = Uwb(**EXACT, wall_bias_m=0.8, wall_reach_m=4.0)
    pushed = [-errors(sensor, 1, (2.0, 5.0 - gap, 1.0), WALL)[0, 1] for gap in (1.0, 2.0, 3.99, 4.01)]
    assert pushed == pytest.approx([0.6, 0.4, 0.002, 0.0], abs=1e-9)


def test_the_bias_is_a_mean_and_leaves_the_noise_alone() -> None:
    near, far = errors(Uwb(), 500, (2.0, 4.5, 1.0), WALL), errors(Uwb(), 500, (2.0, 0.0, 1.0), WALL)
    assert near == pytest.approx(far - (0.0, 0.15, 0.0))


def test_outliers_and_mount() -> None:
    assert np.hypot(*errors(Uwb(**EXACT, outlier_probability=1.0), 20, (0.0, 0.0, 0.0)).T[:2]) == pytest.approx(2.0)
    (fix,) = readings(Uwb(**EXACT, mount=(0.1, 0.2, 0.3)), [scene_of((1.0, 1.0, 0.0), yaw=np.pi / 2)])
    assert fix.position == pytest.approx((0.8, 1.1, 0.3))


def test_four_anchors_in_a_square_halve_the_variance_of_a_range_at_its_centre() -> None:
    """Directions at 45 degrees: the normal matrix is 2 I."""
    (fix,) = readings(Uwb(anchors=SQUARE, sigma_m=0.2), [scene_of((0.0, 0.0, 1.0))])
    assert fix.sigma_m == pytest.approx(0.2 / 2**0.5)
    assert fix.sigma_z_m == pytest.approx(0.3)  # all at the same height: only what is known beforehand


@pytest.mark.parametrize("place", [(0.0, 0.0, 1.0), (4.0, 1.0, 0.0), (20.0, 3.0, 0.2), (-30.0, 30.0, 4.0)])
def test_errors_are_diluted_by_geometry_as_told(place: tuple[float, float, float]) -> None:
    n, sensor = 2000, Uwb(anchors=SQUARE)
    e = errors(sensor, n, place)
    (fix,) = readings(sensor, [scene_of(place)])
    told = (fix.sigma_m, fix.sigma_z_m)
    assert (np.mean(e[:, :2] ** 2) ** 0.5, e[:, 2].std()) == pytest.approx(told, rel=4 / (2 * n) ** 0.5)
    outside = max(abs(place[0]), abs(place[1])) > 10.0
    assert (fix.sigma_m > 0.2) == outside


def test_it_errs_as_the_solution_of_the_ranges_does() -> None:
    """Against a least-squares solution of the ranges themselves, iterated to its end."""
    place, sensor = np.array([3.0, -2.0, 0.4]), Uwb(anchors=SQUARE, sigma_m=0.001, sigma_z_m=0.002)
    anchors = np.array(SQUARE)
    said = errors(sensor, 20, (3.0, -2.0, 0.4))
    rng = stream(1, "car0/sensor")
    for each in said:
        draws, _ = rng.standard_normal(7), rng.random(2)
        ranges = np.linalg.norm(anchors - place, axis=1) + 0.001 * draws[3:]
        height = 0.4 + 0.002 * draws[2]

        def residuals(p: Array, ranges: Array = ranges, height: float = height) -> Array:
            return np.append((np.linalg.norm(anchors - p, axis=1) - ranges) / 0.001, (p[2] - height) / 0.002)

        solved = least_squares(residuals, place + 0.1, xtol=1e-15, ftol=1e-15, gtol=1e-15).x
        assert each == pytest.approx(solved - place, abs=2e-5)


def test_a_range_through_a_solid_is_too_long_and_pushes_away_from_that_anchor() -> None:
    wall = World(solids=(Box(center=(2.5, 2.5, 1.0), size=(1.0, 1.0, 4.0), yaw_rad=np.pi / 4),))
    sensor = Uwb(anchors=SQUARE, **EXACT, wall_bias_m=0.0, blocked_bias_m=0.4)
    e = errors(sensor, 1, (0.0, 0.0, 1.0), wall)[0]
    assert e == pytest.approx((-0.2 / 2**0.5, -0.2 / 2**0.5, 0.0), abs=1e-6)  # (H^T H)^-1 H^T e, with H^T H = 2 I
    assert errors(sensor, 1, (0.0, 0.0, 1.0))[0] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("anchors", [[(0.0, 0.0, 1.0)], [(0.0, 0.0, 1.0), (1.0, 1.0, 2.0), (2.0, 2.0, 5.0)]])
def test_anchors_that_give_no_position_are_refused(anchors: list[tuple[float, float, float]]) -> None:
    with pytest.raises(ScenarioError, match="at least three that do not stand in a line") as refused:
        binding.call(Uwb, {"anchors": anchors}, key="vehicle.car.sensors.uwb")
    assert refused.value.key == "vehicle.car.sensors.uwb.anchors"
