"""Hovering over a target: the loop, association of detections, and the search for a lost target."""

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.agents.reconnaissance.ground_point import Nadir
from vcmvsp.agents.reconnaissance.tracking import Confirmation, Tracker, largest_gain, spiral

T, T_NS = 0.1, 100_000_000

Point = tuple[float, float]
angles = st.floats(-math.pi, math.pi)


def follow(
    tracker: Tracker,
    target: Callable[[int], Point],
    ticks: int,
    shown: Callable[[int], bool] = lambda tick: True,
) -> list[Point]:
    """Offsets of the target, tick by tick, of a vehicle without lag that sees through its camera."""
    tracker.begin(-T_NS, target(-1))
    x, y, offsets = 0.0, 0.0, []
    for tick in range(ticks):
        to = target(tick)
        offsets.append((to[0] - x, to[1] - y))
        camera = Nadir((x, y, 30.0), (1.0, 0.0, 0.0, 0.0), 400.0, 640, 480)
        pixel = camera.pixel(to)
        place = camera.ground_point(pixel) if pixel else None
        tracker.see(tick * T_NS, [place] if place and shown(tick) else [])
        vx, vy = tracker.command(tick * T_NS, (x, y, 30.0))
        x, y = x + T * vx, y + T * vy
    return offsets


def moving(speed: float, heading: float) -> Callable[[int], Point]:
    return lambda tick: (speed * T * tick * math.cos(heading), speed * T * tick * math.sin(heading))


@given(st.floats(0.0, 2.0), angles, st.sets(st.integers(60, 150)))
def test_missed_frames_of_a_steady_target_cause_no_error(speed: float, heading: float, missed: set[int]) -> None:
    """With a known speed the prediction is exact; gaps of up to 2.9 s."""
    hidden = {tick for tick in missed if not all(other in missed for other in range(tick - 28, tick))}
    always = follow(Tracker(T), moving(speed, heading), 180)
    now_and_then = follow(Tracker(T), moving(speed, heading), 180, lambda tick: tick not in hidden)
    assert now_and_then[-1] == pytest.approx(always[-1], abs=1e-3)


def test_the_estimated_speed_converges_by_a_fifth_a_tick_with_missed_ticks_too() -> None:
    tracker, other = Tracker(T), Tracker(T)
    for each in (tracker, other):
        each.begin(0, (0.0, 0.0))
    for tick in range(1, 7):
        tracker.see(tick * T_NS, [(0.1 * tick, 0.0)])
        assert tracker.velocity == pytest.approx((1.0 - 0.8**tick, 0.0))
        if tick in (2, 6):
            other.see(tick * T_NS, [(0.1 * tick, 0.0)])
            assert other.velocity == pytest.approx(tracker.velocity)


@pytest.mark.parametrize("n", [0, 1, 5, 15, 20])
def test_the_bound_is_where_a_root_of_the_loop_leaves_the_unit_circle(n: int) -> None:
    def radius(gain: float) -> float:
        polynomial = np.zeros(n + 2)  # z^(n+1) - z^n + kT
        polynomial[0], polynomial[-1] = 1.0, gain * T
        polynomial[1] -= 1.0
        return float(np.abs(np.roots(polynomial)).max())

    bound = largest_gain(n, T)
    assert radius(0.999 * bound) < 1.0 < radius(1.001 * bound)


def test_commands_are_limited() -> None:
    tracker = Tracker(T, max_speed=2.0)
    tracker.begin(0, (30.0, 40.0))
    assert tracker.command(0, (0.0, 0.0, 10.0)) == pytest.approx((1.2, 1.6))


# --- association ---


def test_the_nearest_valid_detection_in_reach_is_the_target() -> None:
    tracker = Tracker(T)
    tracker.begin(0, (0.0, 0.0))
    assert not tracker.see(T_NS, [(2.2, 0.0), (math.nan, 0.0), (0.0, math.inf)])
    assert tracker.see(2 * T_NS, [(1.5, 0.0), (-1.0, 0.0)])
    assert tracker.predicted(2 * T_NS) == (-1.0, 0.0)


def test_repeated_and_older_pictures_are_ignored() -> None:
    tracker = Tracker(T)
    tracker.begin(T_NS, (0.0, 0.0))
    tracker.see(3 * T_NS, [(0.1, 0.0)])
    before = tracker.velocity
    for taken in (3 * T_NS, 2 * T_NS, 0):
        assert not tracker.see(taken, [(0.5, 0.0)])
    assert (tracker.velocity, tracker.predicted(3 * T_NS)) == (before, (0.1, 0.0))


def test_the_region_of_interest_grows_with_the_time_out_of_sight() -> None:
    tracker = Tracker(T, within_m=2.0)
    tracker.begin(0, (0.0, 0.0))
    assert tracker.reach_m(2 * 10**9) == 4.0
    assert tracker.see(2 * 10**9, [(3.9, 0.0)])
    assert tracker.reach_m(2 * 10**9) == 2.0


@pytest.mark.parametrize(
    ("frames", "confirmed"),
    [
        ([1, 1, 1], True),
        ([1, 0, 1, 0, 1], True),
        ([1, 0, 0, 1, 0, 1], False),  # three of six
        ([1, 1, 0, 0, 0], False),
        ([1, 1, 9], False),  # 9: another place
        ([9, 1, 9, 1, 1], True),
        ([9, 1, 9, 0, 1], False),
    ],
)
def test_three_detections_of_five_frames_within_two_metres_confirm(frames: list[int], confirmed: bool) -> None:
    confirmation = Confirmation()
    shown: dict[int, list[Point]] = {0: [], 1: [(0.0, 1.9)], 9: [(0.0, -0.2)]}
    found = [confirmation.frame(shown[each]) for each in frames]
    assert found[:-1] == [None] * (len(frames) - 1)
    assert found[-1] == (shown[frames[-1]][0] if confirmed else None)


def test_two_detections_in_one_frame_count_once() -> None:
    confirmation = Confirmation()
    assert [confirmation.frame([(0.0, 0.0), (0.5, 0.0)]) for _ in range(3)] == [None, None, (0.0, 0.0)]


# --- lost ---


def test_after_three_seconds_it_is_lost_and_searched_for_ten_seconds_at_its_last_place() -> None:
    tracker = Tracker(T)
    follow(tracker, moving(0.5, 0.0), 51)
    seen_ns, last = 50 * T_NS, (2.5, 0.0)
    assert tracker.phase(seen_ns) == "seen"
    assert tracker.phase(seen_ns + 29 * T_NS) == "predicted"
    assert tracker.predicted(seen_ns + 20 * T_NS) == pytest.approx((3.5, 0.0), abs=1e-3)
    assert tracker.phase(seen_ns + 30 * T_NS) == "spiral"
    assert tracker.predicted(seen_ns + 30 * T_NS) == pytest.approx(last)
    place, ticks, furthest = last, 0, 0.0
    while tracker.phase(seen_ns + (30 + ticks) * T_NS) == "spiral":
        vx, vy = tracker.command(seen_ns + (30 + ticks) * T_NS, (*place, 30.0))
        place = place[0] + T * vx, place[1] + T * vy
        furthest = max(furthest, math.dist(place, last))
        ticks += 1
    assert ticks == 100
    assert furthest > 3.0
    assert tracker.phase(seen_ns + 131 * T_NS) == "lost"
    assert tracker.command(seen_ns + 131 * T_NS, (*place, 30.0)) == (0.0, 0.0)


def test_the_search_begins_in_the_direction_of_the_targets_motion() -> None:
    tracker = Tracker(T)
    follow(tracker, moving(0.5, 2.0), 51)
    x, y = tracker.predicted(8 * 10**9)
    vx, vy = tracker.command(8 * 10**9, (x, y, 30.0))
    assert math.atan2(vy, vx) == pytest.approx(2.0, abs=0.3)


def test_a_search_counts_commanded_ticks_only_and_ends_with_a_detection() -> None:
    tracker = Tracker(T)
    tracker.begin(0, (0.0, 0.0))
    assert tracker.phase(60 * 10**9) == "spiral"
    for tick in range(50):
        tracker.command(60 * 10**9 + tick * T_NS, (0.0, 0.0, 30.0))
    assert tracker.see(66 * 10**9, [(1.0, 1.0)])
    assert tracker.phase(66 * 10**9) == "seen"
    for tick in range(99):
        assert tracker.phase(70 * 10**9 + tick * T_NS) == "spiral"
        tracker.command(70 * 10**9 + tick * T_NS, (0.0, 0.0, 30.0))
    assert tracker.phase(80 * 10**9) == "spiral"


def test_without_a_target_the_command_is_zero() -> None:
    tracker = Tracker(T)
    assert tracker.phase(0) == "none"
    assert tracker.command(0, (1.0, 2.0, 3.0)) == (0.0, 0.0)
    assert not tracker.see(0, [(0.0, 0.0)])
    with pytest.raises(ValueError, match="no target is tracked"):
        tracker.predicted(0)
    with pytest.raises(ValueError, match="the place of a target must be finite"):
        tracker.begin(0, (math.nan, 0.0))
    tracker.begin(0, (1.0, 0.0))
    tracker.end()
    assert tracker.phase(0) == "none"


@given(st.floats(0.1, 5.0), st.floats(0.5, 10.0), angles, st.floats(0.0, 30.0), st.floats(0.01, 1.0))
def test_the_speed_on_a_spiral_is_between_seven_tenths_and_all_of_its_own(
    speed: float, pitch: float, heading: float, when: float, step: float
) -> None:
    """The chord of an arc is no longer than the arc; many short steps add up to the way."""
    ways = [spiral(when + step * i / 200, speed, pitch, heading) for i in range(201)]
    way = sum(math.dist(a, b) for a, b in pairwise(ways))
    assert 0.7 * speed * step <= way <= speed * step * (1.0 + 1e-9) + 1e-12


def test_the_turns_of_a_spiral_are_its_pitch_apart() -> None:
    path = np.array([spiral(0.01 * i, 2.0, 4.0) for i in range(10000)])
    angle, radius = np.unwrap(np.arctan2(path[1:, 1], path[1:, 0])), np.hypot(*path[1:].T)
    turns = np.interp([math.tau, 2 * math.tau, 3 * math.tau], angle, radius)
    assert np.diff(turns) == pytest.approx([4.0, 4.0], abs=1e-3)
    assert spiral(0.0, 2.0, 4.0) == (0.0, 0.0)
