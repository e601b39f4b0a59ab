"""Levels of nearness, and limits of the speed: by their rules, over random scans, and as closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.agents.avoidance import PotentialField, View, view_of
from vcmvsp.agents.avoidance.steering import ObstacleLevels, limited_drive, limited_flight, second_m
from vcmvsp.cosim.agent import Body
from vcmvsp.cosim.types import Scan

KEEP, APPROACH = 0.5, 0.4
AMIGO = Body(width_m=0.279, radius_m=0.216)
DRONE = Body(width_m=0.5, radius_m=0.25, flies=True)
MS = 1_000_000

ranges = st.lists(st.floats(0.0, 8.0) | st.just(math.inf), min_size=2, max_size=40)
speeds = st.floats(-3.0, 3.0)


def seen(distances: list[float], first: float = 0.0, step: float | None = None) -> View:
    step = math.tau / len(distances) if step is None else step
    view = view_of(Scan(ranges=np.array(distances), angle_min=first, angle_step=step, range_max=10.0))
    assert view is not None
    return view


def walls(half_width: float, end: float = math.inf, count: int = 361) -> View:
    """The half turn ahead in a corridor along x, closed by a wall at ``end``."""
    bearing = np.linspace(-math.pi / 2, math.pi / 2, count)
    with np.errstate(divide="ignore"):
        aside = half_width / np.abs(np.sin(bearing))
        ahead = np.where(np.cos(bearing) > 1e-9, end / np.maximum(np.cos(bearing), 1e-9), np.inf)
    return seen(np.minimum(aside, ahead).tolist(), -math.pi / 2, math.pi / (count - 1))


def allowed(view: View) -> np.ndarray:
    return APPROACH * np.maximum(view.ranges - KEEP - 0.03, 0.0)


# --- in the air ---


@given(ranges, speeds, speeds)
def test_a_limited_velocity_satisfies_every_beam_and_is_neither_longer_nor_reversed(
    distances: list[float], x: float, y: float
) -> None:
    view = seen(distances)
    limited = np.array(limited_flight((x, y), view, KEEP, APPROACH))
    assert (view.units @ limited <= allowed(view) + 1e-8).all()
    assert np.hypot(*limited) <= math.hypot(x, y) + 1e-9
    assert limited @ (x, y) >= -1e-9
    if (view.units @ (x, y) <= allowed(view)).all():
        assert limited.tolist() == [x, y]


@given(st.lists(st.floats(0.0, 3.0), min_size=3, max_size=24), speeds, speeds)
def test_no_velocity_that_all_beams_allow_is_nearer_to_the_wanted_one(distances: list[float], x: float, y: float) -> None:
    """By brute force: the nearest of all feet on one limit and crossings of two."""
    view, wanted = seen(distances), np.array((x, y))
    most = allowed(view)
    feet = wanted + (most - view.units @ wanted)[:, None] * view.units
    i, j = np.triu_indices(len(most), 1)
    pairs = np.stack([view.units[i], view.units[j]], axis=1)
    real = np.abs(np.linalg.det(pairs)) > 1e-6
    crossings = np.linalg.solve(pairs[real], np.stack([most[i], most[j]], axis=1)[real][..., None])[..., 0]
    tried = np.vstack([wanted, feet, crossings, (0.0, 0.0)])
    fit = tried[(tried @ view.units.T <= most + 1e-7).all(axis=1)]
    best = np.hypot(*(fit - wanted).T).min()
    assert math.dist(limited_flight((x, y), view, KEEP, APPROACH), (x, y)) == pytest.approx(best, abs=1e-5)


@given(ranges, speeds, speeds)
def test_mirrored_scans_give_mirrored_velocities(distances: list[float], x: float, y: float) -> None:
    mirrored = [distances[0], *distances[:0:-1]]
    one = limited_flight((x, y), seen(distances), KEEP, APPROACH)
    other = limited_flight((x, -y), seen(mirrored), KEEP, APPROACH)
    assert other == pytest.approx((one[0], -one[1]), abs=1e-6)


def test_motion_along_a_wall_goes_on_where_motion_into_it_does_not() -> None:
    """A wall on the left at 0.8 m, seen by 64 beams: of a velocity that leads at it askew, more than half is left along it."""
    bearing = math.tau * np.arange(64) / 64
    with np.errstate(divide="ignore"):
        wall = seen(np.where(np.sin(bearing) > 0.1, 0.8 / np.sin(bearing), np.inf).tolist())
    x, y = limited_flight((0.5, 0.5), wall, KEEP, APPROACH)
    assert x > 0.25
    assert y <= APPROACH * (0.8 - KEEP - 0.03) + 1e-9


def test_512_beams_that_all_hold_it_are_no_problem() -> None:
    assert limited_flight((3.0, 1.0), seen([0.2] * 512), KEEP, APPROACH) == pytest.approx((0.0, 0.0), abs=1e-8)


# --- on wheels ---


@given(ranges, st.floats(-2.0, 2.0))
def test_on_wheels_a_speed_is_never_raised_nor_reversed(distances: list[float], v: float) -> None:
    limited = limited_drive(v, seen(distances), KEEP, 0.2, APPROACH)
    assert abs(limited) <= abs(v)
    assert limited * v >= 0.0


@given(ranges, st.floats(0.0, 2.0), st.floats(0.05, KEEP))
def test_on_wheels_no_return_of_the_lane_is_driven_at_too_fast(distances: list[float], v: float, lane: float) -> None:
    view = seen(distances)
    limited = limited_drive(v, view, KEEP, lane, APPROACH)
    for distance, (x, y) in zip(view.ranges.tolist(), view.units.tolist(), strict=True):
        if distance < math.inf and x > 1e-9 and abs(distance * y) < lane:
            left = distance * x - math.sqrt(KEEP**2 - (distance * y) ** 2)
            assert limited <= APPROACH * max(0.0, left - 0.03) + 1e-9


def test_a_corridor_of_90_cm_does_not_slow_an_amigobot_down_and_its_end_does() -> None:
    assert ObstacleLevels(PotentialField(keep_m=0.266), AMIGO).keep_m < 0.45
    assert limited_drive(0.6, walls(0.45), 0.266, 0.1895, APPROACH) == 0.6
    near_end = limited_drive(0.6, walls(0.45, 1.0), 0.266, 0.1895, APPROACH)
    assert near_end == pytest.approx(APPROACH * (1.0 - 0.266 - 0.03))


def test_levels_hold_an_amigobot_back_for_what_is_ahead_and_not_for_walls_beside_it_whatever_is_kept() -> None:
    for keep in (0.266, 0.6):
        levels = ObstacleLevels(PotentialField(keep_m=keep), AMIGO)
        view = walls(0.45)
        assert levels.update(0, view.nearest_m, 0.6) == 2
        assert levels.limited(view, (0.6, 0.0)) == (0.6, 0.0)
        assert levels.limited(walls(0.45, 0.29), (0.6, 0.0)) == (0.0, 0.0)


@pytest.mark.parametrize(("behind", "v", "left"), [(math.inf, -0.3, -0.1), (0.2, -0.3, 0.0), (0.7, -0.3, -0.068)])
def test_reverse_is_slow_and_limited_by_what_is_seen_behind(behind: float, v: float, left: float) -> None:
    view = seen([math.inf, math.inf, behind, math.inf])  # ahead, left, behind, right
    assert limited_drive(v, view, KEEP, 0.2, APPROACH) == pytest.approx(left)


def test_who_sees_nothing_behind_is_let_back() -> None:
    assert limited_drive(-0.1, walls(0.45, 0.3), KEEP, 0.2, APPROACH) == -0.1


# --- levels ---


@pytest.mark.parametrize(
    ("speed", "latency", "begins"), [(0.0, 0.0, 0.9), (0.3, 0.0, 0.9), (0.6, 0.0, 1.2), (0.6, 0.5, 1.5), (3.0, 0.0, 15.6)]
)
def test_level_2_begins_where_braking_must(speed: float, latency: float, begins: float) -> None:
    """The larger of keep + 0.3 m and keep + v latency + v^2 / (2 a), a = 0.3 m/s2."""
    assert second_m(speed, 0.6, 0.3, latency) == pytest.approx(begins)
    levels = ObstacleLevels(PotentialField(keep_m=0.6), DRONE, latency)
    assert levels.update(0, begins + 1e-6, speed) < 2
    assert levels.update(0, begins - 1e-6, speed) == 2


def test_levels_0_and_1_are_told_apart_by_the_reach_of_the_method() -> None:
    levels = ObstacleLevels(PotentialField(), DRONE)
    assert [levels.update(0, nearest, 0.1) for nearest in (math.inf, 1.2, 1.19, 0.91)] == [0, 0, 1, 1]


def test_level_2_ends_when_things_have_been_further_away_for_half_a_second() -> None:
    levels = ObstacleLevels(PotentialField(), DRONE)
    places = [0.8, 1.04, 1.04, 1.06, 1.06, 1.04, 1.06, *[1.06] * 4, 1.06]  # 0.9 begins, 1.05 ends, and starts to count anew
    assert [levels.update(100 * MS * tick, nearest, 0.0) for tick, nearest in enumerate(places)] == [2] * 11 + [1]


def test_without_the_second_level_nothing_is_limited() -> None:
    levels = ObstacleLevels(PotentialField(level=1), DRONE)
    assert levels.update(0, 0.1, 1.0) == 1
    assert levels.limited(seen([0.1] * 32), (1.0, 0.0)) == (1.0, 0.0)


@pytest.mark.parametrize("start", [0.8, 1.5, 3.0])
def test_the_way_left_along_a_beam_decays_exponentially(start: float) -> None:
    """v = approach (D - keep - 0.03) has D - keep - 0.03 decay with exp(-approach t); in periods of 0.1 s by 1 - 0.04 each."""
    distance = start
    for _ in range(100):
        distance -= 0.1 * limited_flight((9.0, 0.0), seen([distance, math.inf, math.inf, math.inf]), KEEP, APPROACH)[0]
    assert distance - KEEP - 0.03 == pytest.approx((start - KEEP - 0.03) * 0.96**100)
