"""Errors of range scanners: their sizes and rates, and draws that nothing else moves."""

import math
from typing import Any

import numpy as np
import pytest

from tests.support.physics.random_worlds import Floats, scene
from vcmvsp.cosim.rng import stream
from vcmvsp.physics.sensors.range_scanner import RangeScanner, Ring
from vcmvsp.physics.world.solids import Box
from vcmvsp.physics.world.world import World

# All beams of a scanner at the origin meet the wall at 4 m, nearly at right angles.
WALL = scene(World(solids=(Box(center=(4.5, 0.0, 0.5), size=(1.0, 9.0, 2.0)),)), [(0.0, 0.0, 0.5)])
BEAMS = 40_000


def sensor(**noise: Any) -> RangeScanner:
    return RangeScanner(**{"beams": BEAMS, "field_of_view": 1e-4, "range_max": 10.0, **noise})


def ranges(name: str = "car/scan", **noise: Any) -> Floats:
    return sensor(**noise).measure(WALL, 0, stream(1, name)).ranges.astype(np.float64)


def test_gaussian_errors_of_the_stated_size_independent_from_beam_to_beam() -> None:
    error = ranges(sigma_m=0.05) - 4.0
    assert error.mean() == pytest.approx(0.0, abs=4 * 0.05 / BEAMS**0.5)
    assert error.std() == pytest.approx(0.05, rel=4 / (2 * BEAMS) ** 0.5)
    assert (np.abs(error) < 0.05).mean() == pytest.approx(math.erf(0.5**0.5), abs=4 * (0.6827 * 0.3173 / BEAMS) ** 0.5)
    assert abs(np.corrcoef(error[1:], error[:-1])[0, 1]) < 4 / BEAMS**0.5


def test_whole_steps() -> None:
    assert set(ranges(quantum_m=0.3).tolist()) == {np.float32(3.9)}
    found = ranges(sigma_m=0.2, quantum_m=0.1)
    assert np.abs(found / 0.1 - np.rint(found / 0.1)).max() < 1e-5
    assert (found - 4.0).std() == pytest.approx(math.sqrt(0.2**2 + 0.1**2 / 12.0), rel=4 / (2 * BEAMS) ** 0.5)


def test_beams_without_a_return() -> None:
    found = ranges(no_return=0.03)
    assert np.isinf(found).mean() == pytest.approx(0.03, abs=4 * (0.03 * 0.97 / BEAMS) ** 0.5)
    assert set(found[np.isfinite(found)].tolist()) == {4.0}
    assert np.isinf(ranges(no_return=1.0)).all()


def test_outliers_are_anywhere_within_reach() -> None:
    found = ranges(outlier_probability=0.2)
    far = found[found != 4.0]
    assert len(far) / BEAMS == pytest.approx(0.2, abs=4 * (0.16 / BEAMS) ** 0.5)
    assert 0.0 <= far.min() < far.max() <= 10.0
    assert far.mean() == pytest.approx(5.0, abs=4 * 10.0 / math.sqrt(12.0 * len(far)))
    assert far.std() == pytest.approx(10.0 / math.sqrt(12.0), rel=0.03)
    among_nothing = RangeScanner(beams=BEAMS, field_of_view=1e-4, range_max=10.0, yaw=math.pi, outlier_probability=0.2)
    seen = np.isfinite(among_nothing.measure(WALL, 0, stream(1, "car/scan")).ranges)
    assert np.array_equal(seen, found != 4.0)  # a ghost needs nothing there


def test_outliers_and_missing_returns_are_different_beams() -> None:
    found = ranges(outlier_probability=0.2, no_return=0.2)
    assert np.isinf(found).mean() == pytest.approx(0.2, abs=4 * (0.16 / BEAMS) ** 0.5)
    assert (found == 4.0).mean() == pytest.approx(0.6, abs=4 * (0.24 / BEAMS) ** 0.5)


def test_never_a_nan_and_nothing_outside_the_limits() -> None:
    found = ranges(sigma_m=3.0, no_return=0.1, outlier_probability=0.1, quantum_m=0.07, range_min=0.5, range_max=5.0)
    assert not np.isnan(found).any()
    inside = found[np.isfinite(found)]
    assert 0.5 <= inside.min() < inside.max() <= 5.0
    assert (found == -math.inf).any()
    assert (found == math.inf).any()
    assert ranges(sigma_m=3.0).min() == 0.0


def test_parameters_never_move_the_draws() -> None:
    plain = ranges(sigma_m=0.05)
    assert ranges(sigma_m=0.1) - 4.0 == pytest.approx(2.0 * (plain - 4.0), abs=1e-6)
    cases: tuple[dict[str, Any], ...] = ({"no_return": 0.2}, {"outlier_probability": 0.2})
    for noise in cases:
        some = ranges(sigma_m=0.05, **noise)
        assert (some == plain).mean() == pytest.approx(0.8, abs=0.02)
        assert np.array_equal(some != plain, ranges(**noise) != 4.0)
    assert not np.array_equal(ranges("other/scan", sigma_m=0.05), plain)


def test_all_at_once_are_the_same_scans() -> None:
    among = scene(WALL.world, [(0.0, 0.0, 0.5), (0.0, 2.0, 0.5), (3.0, 1.0, 0.4)])
    sensors = [Ring(no_return=0.1), Ring(beams=7, range_min=0.2), Ring(field_of_view=2.0, outlier_probability=0.3)]
    together = Ring.measure_all(sensors, among, [0, 1, 2], [stream(1, str(k)) for k in range(3)])
    for row, (each, found) in enumerate(zip(sensors, together, strict=True)):
        assert np.array_equal(found.ranges, each.measure(among, row, stream(1, str(row))).ranges)  # type: ignore[union-attr]
