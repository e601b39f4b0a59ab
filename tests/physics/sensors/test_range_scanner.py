"""Range scanners: beam directions, ranges and errors."""

import math
from typing import Any

import numpy as np
import pytest

from tests.support.physics.random_worlds import Floats, scene
from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Scan
from vcmvsp.physics.sensors.range_scanner import Lms, RangeScanner, Ring
from vcmvsp.physics.world.solids import Box, Hull
from vcmvsp.physics.world.world import Scene, World

FULL = 6.2832
# A room of 8 x 6 m around the origin, walls 3 m high.
ROOM = World(
    solids=(
        Box(center=(4.5, 0.0, 1.5), size=(1.0, 8.0, 3.0)),
        Box(center=(-4.5, 0.0, 1.5), size=(1.0, 8.0, 3.0)),
        Box(center=(0.0, 3.5, 1.5), size=(8.0, 1.0, 3.0)),
        Box(center=(0.0, -3.5, 1.5), size=(8.0, 1.0, 3.0)),
    )
)


def scan(sensor: RangeScanner, among: Scene, row: int = 0) -> Scan:
    return sensor.measure(among, row, stream(1, "car/scan"))


def angles(found: Scan) -> Floats:
    return np.float64(found.angle_min) + found.angle_step * np.arange(len(found.ranges), dtype=np.float64)


def room(angle: Floats, x: float = 0.0, y: float = 0.0) -> Floats:
    """Distance to the walls, in closed form."""
    c, s = np.cos(angle), np.sin(angle)
    with np.errstate(divide="ignore"):
        found: Floats = np.minimum((np.copysign(4.0, c) - x) / c, (np.copysign(3.0, s) - y) / s)
    return found


@pytest.mark.parametrize("field_of_view", [0.5, math.pi, 5.0, FULL])
@pytest.mark.parametrize("beams", [2, 33, 512])
def test_a_room_for_any_scanner_heading(field_of_view: float, beams: int) -> None:
    for yaw, heading, x, y in ((0.0, 0.0, 0.0, 0.0), (1.3, -2.2, 1.5, -2.0), (-3.0, 3.1, -3.0, 1.0)):
        sensor = RangeScanner(beams=beams, field_of_view=field_of_view, range_max=20.0, yaw=yaw)
        found = scan(sensor, scene(ROOM, [(x, y, 0.5)], np.array([quaternion_from_yaw(heading)])))
        assert found.ranges == pytest.approx(room(angles(found) + heading, x, y), rel=1e-6)
        assert found.ranges.dtype == np.float32
        assert (found.range_max, found.time_ns) == (20.0, 5)
        assert not found.ranges.flags.writeable


def test_beams_are_spread_as_in_ros() -> None:
    half_turn = scan(RangeScanner(beams=181, field_of_view=math.pi, range_max=9.0), scene(ROOM, [(0, 0, 1)]))
    assert angles(half_turn)[[0, 90, 180]] == pytest.approx([-0.5 * math.pi, 0.0, 0.5 * math.pi])  # right, ahead, left
    full = scan(RangeScanner(beams=4, field_of_view=FULL, range_max=9.0), scene(ROOM, [(1, 0, 1)]))
    assert angles(full) == pytest.approx([0.0, 0.5 * math.pi, math.pi, 1.5 * math.pi])  # the last beam differs from the first
    assert full.ranges.tolist() == pytest.approx([3.0, 3.0, 5.0, 3.0])
    alone = scan(RangeScanner(beams=1, field_of_view=1.0, range_max=9.0, yaw=0.5 * math.pi), scene(ROOM, [(1, 1, 1)]))
    assert (alone.angle_min, alone.ranges.tolist()) == (0.5 * math.pi, [2.0])


def test_reach_and_too_near() -> None:
    found = scan(RangeScanner(beams=4, field_of_view=FULL, range_max=3.5, range_min=2.5), scene(ROOM, [(2.0, 0.0, 1.0)]))
    assert found.ranges.tolist() == [-math.inf, 3.0, math.inf, 3.0]
    assert (found.ranges < 2.6).tolist() == [True, False, False, False]
    exact = RangeScanner(beams=1, field_of_view=1.0, range_max=4.0, range_min=3.9)
    assert scan(exact, scene(ROOM, [(0, 0, 1)])).ranges.tolist() == [4.0]


def test_inside_a_solid_all_ranges_are_zero() -> None:
    sensor = RangeScanner(beams=9, field_of_view=FULL, range_max=9.0)
    assert scan(sensor, scene(ROOM, [(4.5, 0.0, 1.0)])).ranges.tolist() == [0.0] * 9
    assert scan(sensor, scene(ROOM, [(4.5, 0.0, 3.1)])).ranges.tolist() == [math.inf] * 9
    two = scene(World(), [(0.0, 0.0, 0.0), (0.1, 0.0, 0.0)])
    assert scan(sensor, two).ranges.tolist() == [0.0] * 9


def test_a_scanner_pitched_downwards() -> None:
    sensor = RangeScanner(beams=1, field_of_view=0.1, range_max=20.0, pitch=0.3, yaw=1.0, position=(0.5, 0.0, 0.2))
    low = scan(sensor, scene(World(), [(0.0, 0.0, 1.0)]))
    assert low.ranges.tolist() == pytest.approx([1.2 / math.sin(0.3)])
    straight_down = RangeScanner(beams=5, field_of_view=math.pi, range_max=20.0, pitch=0.5 * math.pi)
    assert scan(straight_down, scene(World(), [(0, 0, 2.0)])).ranges == pytest.approx(
        [math.inf, 2.0 * math.sqrt(2.0), 2.0, 2.0 * math.sqrt(2.0), math.inf]
    )


def test_others_are_seen_and_the_own_vehicle_is_not() -> None:
    car = Hull(size=(0.5, 0.4, 0.2), offset=(0.0, 0.0, 0.1))
    drone = Hull(size=(0.5, 0.5, 0.1), kind="cylinder")
    among = scene(World(), [(0, 0, 0), (3, 0, 0), (0, 2, 0.1), (0, -2, 0.4)], hulls=[car, car, drone, car])
    found = scan(RangeScanner(beams=3, field_of_view=math.pi, range_max=9.0, position=(0.0, 0.0, 0.1)), among)
    assert found.ranges.tolist() == pytest.approx([math.inf, 2.75, 1.75])  # the vehicle on the right flies above the beam
    back = scan(RangeScanner(beams=1, field_of_view=1.0, range_max=9.0, position=(0.0, 0.0, 0.1), yaw=math.pi), among, row=1)
    assert back.ranges.tolist() == pytest.approx([2.75])


def test_presets() -> None:
    lms, ring = Lms(), Ring()
    assert (lms.beams, lms.field_of_view, lms.range_max, lms.rate_hz) == (512, math.pi, 20.0, 10.0)
    assert (ring.beams, ring.angle_step, ring.range_max, ring.rate_hz) == (32, math.tau / 32, 6.0, 10.0)
    assert lms.on_demand
    robot = Hull(size=(0.33, 0.28, 0.12), offset=(0.0, 0.0, 0.09))  # an AmigoBot on the floor
    found = scan(Lms(), scene(World(), [(0, 0, 0), (5, 0, 0)], hulls=[robot] * 2))
    assert np.isfinite(found.ranges).sum() >= 8


def test_an_impossible_range_is_refused() -> None:
    with pytest.raises(ValueError, match=r"range_min = 2.0 must be less than range_max = 1.0"):
        RangeScanner(beams=3, field_of_view=1.0, range_min=2.0, range_max=1.0)


# All beams of a scanner at the origin meet the wall at 4 m, almost perpendicularly.
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


def test_quantised_ranges() -> None:
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
    hits = np.isfinite(among_nothing.measure(WALL, 0, stream(1, "car/scan")).ranges)
    assert np.array_equal(hits, found != 4.0)  # outliers also occur without an obstacle


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


def test_parameters_change_no_draws() -> None:
    plain = ranges(sigma_m=0.05)
    assert ranges(sigma_m=0.1) - 4.0 == pytest.approx(2.0 * (plain - 4.0), abs=1e-6)
    cases: tuple[dict[str, Any], ...] = ({"no_return": 0.2}, {"outlier_probability": 0.2})
    for noise in cases:
        some = ranges(sigma_m=0.05, **noise)
        assert (some == plain).mean() == pytest.approx(0.8, abs=0.02)
        assert np.array_equal(some != plain, ranges(**noise) != 4.0)
    assert not np.array_equal(ranges("other/scan", sigma_m=0.05), plain)


def test_a_batch_gives_equal_scans() -> None:
    among = scene(WALL.world, [(0.0, 0.0, 0.5), (0.0, 2.0, 0.5), (3.0, 1.0, 0.4)])
    sensors = [Ring(no_return=0.1), Ring(beams=7, range_min=0.2), Ring(field_of_view=2.0, outlier_probability=0.3)]
    together = Ring.measure_all(sensors, among, [0, 1, 2], [stream(1, str(k)) for k in range(3)])
    for row, (each, found) in enumerate(zip(sensors, together, strict=True)):
        assert np.array_equal(found.ranges, each.measure(among, row, stream(1, str(row))).ranges)  # type: ignore[union-attr]
