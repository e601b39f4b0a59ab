"""Along lanes: near them, at full speed but before turns, and past what nobody gets to."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.agents.reconnaissance.probability_map import Rectangle
from vcmvsp.agents.reconnaissance.sectors import Comb, LaneFollower, Point

AREA = Rectangle(0.0, 0.0, 40.0, 100.0)  # lanes at x = 5, 15, 25, 35, from y = 4 to 96
LANES = np.array([5.0, 15.0, 25.0, 35.0])
T = 0.1
TICK_NS = 100_000_000


def way(reached: float = 2.0, stuck_s: float = 6.0, speed: float = 4.0) -> LaneFollower:
    return LaneFollower(Comb("a", AREA, 8.0, reached=reached), speed=speed, acceleration=2.0, stuck_s=stuck_s)


def flown(
    along: LaneFollower, seconds: float, *, lag_s: float = 0.0, most: float = math.inf, start: Point = (5.0, 0.0)
) -> np.ndarray:
    """(x, y, speed) at each tick, of a vehicle whose velocity follows with a lag, by no more than so many m/s2."""
    (x, y), (vx, vy), track = start, (0.0, 0.0), []
    for tick in range(round(seconds / T)):
        wx, wy = along.velocity(tick * TICK_NS, (x, y), ["a"])
        steps = 10
        for _ in range(steps):
            ax, ay = ((wx - vx) / lag_s, (wy - vy) / lag_s) if lag_s else ((wx - vx) * steps / T, (wy - vy) * steps / T)
            share = min(1.0, most / max(math.hypot(ax, ay), 1e-9)) * T / steps
            vx, vy = vx + share * ax, vy + share * ay
            x, y = x + vx * T / steps, y + vy * T / steps
        track.append((x, y, math.hypot(vx, vy)))
    return np.array(track)


@given(x=st.floats(0.0, 40.0), y=st.floats(0.0, 100.0))
def test_it_can_stop_at_the_way_point_and_is_no_slower_than_it_must(x: float, y: float) -> None:
    along = way(reached=0.5)
    velocity = along.velocity(0, (x, y), ["a"])
    assert along.goal is not None
    away = math.dist((x, y), along.goal)
    assert math.hypot(*velocity) == pytest.approx(min(4.0, math.sqrt(2.0 * 2.0 * away)))
    assert velocity[0] * (along.goal[1] - y) == pytest.approx(velocity[1] * (along.goal[0] - x), abs=1e-6)


@pytest.mark.parametrize(("lag_s", "most", "beyond_m"), [(0.0, math.inf, 0.01), (0.4, 4.0, 1.0)])
def test_all_lanes_are_flown_at_full_speed_and_hardly_overshot(lag_s: float, most: float, beyond_m: float) -> None:
    track = flown(way(), 110.0, lag_s=lag_s, most=most)
    x, y, speed = track[20:].T
    middle = (y > 25.0) & (y < 75.0)
    off = np.abs(x[middle, None] - LANES)
    assert set(off.argmin(axis=1).tolist()) == {0, 1, 2, 3}
    assert off.min(axis=1).max() < 0.5
    assert speed[middle] == pytest.approx(4.0, rel=0.02)
    assert y.max() < 96.0 + beyond_m
    assert y.min() > 4.0 - beyond_m
    assert speed.mean() > 3.8


def test_one_who_was_pushed_aside_gets_back_to_the_lane() -> None:
    along = way()
    flown(along, 5.0)
    x, y, _ = flown(along, 12.0, start=(12.0, 20.0)).T
    assert np.abs(x[(y > 45.0) & (y < 90.0)] - 5.0).max() < 0.1


def test_a_way_point_is_given_up_after_so_long_without_progress() -> None:
    along = way(stuck_s=6.0)
    goals = []
    for tick in range(200):
        along.velocity(tick * TICK_NS, (5.0, min(90.0, 0.4 * tick)), ["a"])  # 90 m: something is in the way from tick 225 on
        goals.append(along.goal)
    assert set(goals[20:]) == {(5.0, 96.0)}
    for tick in range(200, 300):
        along.velocity(tick * TICK_NS, (5.0, 80.0), ["a"])
        goals.append(along.goal)
    assert goals[257] == (5.0, 96.0)
    assert goals[261] == (15.0, 96.0)


@given(speed=st.floats(0.05, 0.19) | st.floats(0.21, 8.0))
def test_who_makes_way_is_not_stuck_however_slow_it_is(speed: float) -> None:
    along = way(speed=speed)
    flown(along, 10.0)
    assert along.goal == ((5.0, 4.0) if speed < 0.2 else (5.0, 96.0))  # 2 m before the first it makes for the next


def test_who_does_something_else_is_not_stuck() -> None:
    along = way(stuck_s=6.0)
    for tick in range(0, 1000, 50):
        along.velocity(tick * TICK_NS, (5.0, 50.0), ["a"])
        along.pause()
    assert along.velocity(1000 * TICK_NS, (5.0, 50.0), ["a"]) != (0.0, 0.0)
    assert along.goal == (5.0, 4.0)


def test_an_area_that_is_all_seen_at_once_is_hovered_over() -> None:
    track = flown(LaneFollower(Comb("a", Rectangle(0.0, 0.0, 6.0, 6.0), 8.0), speed=4.0, acceleration=2.0, stuck_s=6.0), 30.0)
    assert np.abs(track[50:, :2] - 3.0).max() < 1.5
