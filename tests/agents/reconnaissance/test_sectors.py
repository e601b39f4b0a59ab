"""Division of the area: strips cover it and agree between members; lanes leave no cell unseen."""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.agents.agent_loop import present
from vcmvsp.agents.reconnaissance.probability_map import Grid, Rectangle
from vcmvsp.agents.reconnaissance.sectors import Comb, LaneFollower, Point, lanes, strips

AREA = Rectangle(-20.0, 10.0, 80.0, 110.0)
NAMES = st.lists(st.text("abc123", min_size=1, max_size=3), min_size=1, max_size=6)


@given(living=NAMES)
def test_strips_divide_the_area_equally_for_all_members(living: list[str]) -> None:
    found = strips(AREA, living)
    assert found == strips(AREA, reversed(living)) == strips(AREA, frozenset(living))
    assert set(found) == set(living)
    edges = [strip.left for strip in found.values()] + [AREA.right]
    assert [strip.right for strip in found.values()] == pytest.approx(edges[1:])
    assert np.diff(edges) == pytest.approx(100.0 / len(found))
    assert {(strip.bottom, strip.top) for strip in found.values()} == {(10.0, 110.0)}


@pytest.mark.parametrize("names", [[f"uav{n}" for n in range(1, 12)], []])
def test_strips_are_in_natural_order_of_the_names(names: list[str]) -> None:
    assert list(strips(AREA, reversed(names))) == names


def test_lanes_agree_with_the_definition() -> None:
    """50 m wide, radius 8 m, overlap 0.2: ceil(50 / 12.8) = 4 lanes, 12.5 m apart, from 4 m to 96 m."""
    way = lanes(Rectangle(0.0, 0.0, 50.0, 100.0), 8.0)
    assert way == (
        (6.25, 4.0), (6.25, 96.0), (18.75, 96.0), (18.75, 4.0), (31.25, 4.0), (31.25, 96.0), (43.75, 96.0), (43.75, 4.0),
    )  # fmt: skip


@given(width=st.floats(1, 120), height=st.floats(1, 120), radius=st.floats(1, 20), overlap=st.floats(0, 0.6))
def test_lanes_overlap_as_set_and_are_the_fewest_possible(width: float, height: float, radius: float, overlap: float) -> None:
    xs = np.array([x for x, _ in lanes(Rectangle(0.0, 0.0, width, height), radius, overlap)])[::2]
    swath = 2 * radius * (1 - overlap)
    assert np.diff(xs) == pytest.approx(width / len(xs))
    assert width / len(xs) <= swath * (1 + 1e-6)
    assert len(xs) == 1 or width / (len(xs) - 1) > swath * (1 - 1e-6)
    assert xs[0] == pytest.approx(width - xs[-1])


@settings(max_examples=20)
@given(overlap=st.floats(0.2, 0.5), radius=st.floats(6, 20))
def test_lanes_cover_the_area(overlap: float, radius: float) -> None:
    """The farthest point from a lane of half width w that ends r/2 before the border is at hypot(w, r/2) < r."""
    area = Rectangle(0.0, 0.0, 60.0, 90.0)
    grid, cells = Grid(area, 3.0), set()
    way = lanes(area, radius, overlap)
    for a, b in pairwise(way):
        for part in np.linspace(0.0, 1.0, 31):
            cells |= set(grid.within(a[0] + part * (b[0] - a[0]), a[1] + part * (b[1] - a[1]), radius).tolist())
    assert math.hypot(radius * (1 - overlap), radius / 2) < radius
    assert len(cells) == grid.rows * grid.columns


@given(x=st.floats(-30, 90), y=st.floats(0, 120))
def test_lanes_begin_at_the_nearest_end(x: float, y: float) -> None:
    ways = [lanes(AREA, 8.0, 0.2, start) for start in ((-20.0, 10.0), (-20.0, 110.0), (80.0, 10.0), (80.0, 110.0))]
    nearest = min(math.dist(way[0], (x, y)) for way in ways)
    way = lanes(AREA, 8.0, 0.2, (x, y))
    assert math.dist(way[0], (x, y)) == pytest.approx(nearest)
    assert way in ways


@pytest.mark.parametrize(("radius", "overlap"), [(0.0, 0.2), (-1.0, 0.2), (8.0, 1.0), (8.0, -0.1), (math.nan, 0.2)])
def test_lanes_that_never_end_are_refused(radius: float, overlap: float) -> None:
    with pytest.raises(ValueError, match="radius"):
        lanes(AREA, radius, overlap)


def goals_of(comb: Comb, living: Sequence[str], count: int, position: Point = (-20.0, 10.0)) -> list[Point]:
    """Way-points of a vehicle that jumps from one to the next."""
    goals: list[Point] = []
    for _ in range(count):
        position = comb.goal(position, living)
        goals.append(position)
    return goals


def test_a_strip_is_searched_forth_and_back() -> None:
    comb, way = Comb("b", AREA, 8.0), lanes(strips(AREA, "ab")["b"], 8.0)
    n = len(way)
    goals = goals_of(comb, ["a", "b"], 2 * n + 3)
    assert goals[: 2 * n + 1] == [*way, *way[-2::-1], *way[1:3]]


def test_after_a_failure_the_others_begin_new_lanes_at_the_nearest_end() -> None:
    combs = {name: Comb(name, AREA, 8.0) for name in "abc"}
    for comb in combs.values():
        goals_of(comb, ["c", "b", "a"], 3)
    del combs["b"]
    for name, comb in combs.items():
        here = (75.0, 100.0)
        way = lanes(strips(AREA, "ac")[name], 8.0, 0.2, here)
        assert comb.goal(here, ["c", "a"]) == way[0]
        assert comb.goal(here, ["c", "a", name]) == way[0]
        assert comb.goal(way[0], ["a", "c"]) == way[1]


def test_with_the_former_members_it_resumes_its_former_lane() -> None:
    comb = Comb("a", AREA, 8.0)
    before = goals_of(comb, ["a", "b"], 4)[-1]
    here = (-15.0, 60.0)
    assert comb.came == lanes(strips(AREA, "ab")["a"], 8.0)[2]
    alone = lanes(strips(AREA, "a")["a"], 8.0, 0.2, here)
    assert comb.goal(here, ["a"]) == alone[0]
    assert comb.came is None
    assert comb.goal(alone[0], ["a"]) == alone[1]
    assert comb.came == alone[0]
    assert comb.goal(here, ["b", "a"]) == before
    assert comb.came is None
    assert comb.goal(here, ["a"]) == alone[1]


def test_a_skipped_way_point_is_left_out() -> None:
    comb, way = Comb("a", AREA, 8.0), lanes(strips(AREA, "a")["a"], 8.0)
    here = (-20.0, 10.0)
    for goal in (*way, *way[-2::-1], way[1]):
        assert comb.goal(here, ["a"]) == goal
        comb.skip()
    assert comb.came is None


def test_a_vehicle_always_counts_itself_as_living() -> None:
    assert Comb("a", AREA, 8.0).goal((0.0, 0.0), []) == lanes(AREA, 8.0)[0]


@given(st.sets(st.integers(0, 4), min_size=1))
def test_closed_lanes_are_left_out_while_others_are_open(open_lanes: set[int]) -> None:
    area = Rectangle(0.0, 0.0, 50.0, 100.0)
    comb = Comb("a", area, 5.0, overlap=0.0, is_open=lambda start, _: int(start[0] // 10) in open_lanes)
    way = goals_of(comb, "a", 4 * len(open_lanes), (0.0, 0.0))
    assert {int(x // 10) for x, _ in way} == open_lanes
    first = way[: 2 * len(open_lanes)]  # each from end to end, before any is repeated
    assert [int(x // 10) for x, _ in first] == sorted(2 * list(open_lanes))
    assert all(abs(a[1] - b[1]) == 95.0 for a, b in zip(first[::2], first[1::2], strict=True))


def test_after_all_lanes_follow_lanes_across_and_then_the_first_again() -> None:
    comb = Comb("a", Rectangle(0.0, 0.0, 30.0, 60.0), 5.0, overlap=0.0, across=10.0)
    way = goals_of(comb, "a", 40, (0.0, 0.0))
    up = [(5.0, 2.5), (5.0, 57.5), (15.0, 57.5), (15.0, 2.5), (25.0, 2.5), (25.0, 57.5)]
    assert way[:6] == up
    assert way[6:12] == [(25.0, 50.0), (5.0, 50.0), (5.0, 30.0), (25.0, 30.0), (25.0, 10.0), (5.0, 10.0)]
    assert set(way[12:18]) == set(up)
    assert {x for x, _ in way[12:14]} == {5.0}


@given(st.sets(st.integers(0, 4)), st.sets(st.integers(0, 4)))
def test_open_lanes_along_and_across_are_flown(columns: set[int], rows: set[int]) -> None:
    def is_open(start: Point, end: Point) -> bool:
        return int(start[0] // 10) in columns if start[0] == end[0] else int(start[1] // 10) in rows

    comb = Comb("a", Rectangle(0.0, 0.0, 50.0, 50.0), 5.0, overlap=0.0, across=5.0, is_open=is_open)
    way = goals_of(comb, "a", 60, (0.0, 0.0))
    if columns or rows:
        lines = {
            ("x", int(a[0] // 10)) if a[0] == b[0] else ("y", int(a[1] // 10))
            for a, b in pairwise(way)
            if math.dist(a, b) == 45.0
        }
        assert lines == {("x", each) for each in columns} | {("y", each) for each in rows}
    else:
        assert len({*way}) == 20


# --- motion along lanes: distance, speed, turns, and way-points that cannot be reached ---


STRIP = Rectangle(0.0, 0.0, 40.0, 100.0)  # lanes at x = 5, 15, 25, 35, from y = 4 to 96
LANES = np.array([5.0, 15.0, 25.0, 35.0])
T = 0.1
TICK_NS = 100_000_000


def way(reached: float = 2.0, stuck_s: float = 6.0, speed: float = 4.0) -> LaneFollower:
    return LaneFollower(Comb("a", STRIP, 8.0, reached=reached), speed=speed, acceleration=2.0, stuck_s=stuck_s)


def track_of(
    along: LaneFollower, seconds: float, *, lag_s: float = 0.0, most: float = math.inf, start: Point = (5.0, 0.0)
) -> np.ndarray:
    """(x, y, speed) at each tick, of a vehicle with a velocity lag and at most ``most`` m/s2."""
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
def test_the_speed_is_the_greatest_that_allows_a_stop_at_the_way_point(x: float, y: float) -> None:
    along = way(reached=0.5)
    velocity = along.velocity(0, (x, y), ["a"])
    goal_x, goal_y = present(along.goal)
    away = math.hypot(goal_x - x, goal_y - y)
    assert math.hypot(*velocity) == pytest.approx(min(4.0, math.sqrt(2.0 * 2.0 * away)))
    assert velocity[0] * (goal_y - y) == pytest.approx(velocity[1] * (goal_x - x), abs=1e-6)


@pytest.mark.parametrize(("lag_s", "most", "beyond_m"), [(0.0, math.inf, 0.01), (0.4, 4.0, 1.0)])
def test_all_lanes_are_flown_at_full_speed_and_hardly_overshot(lag_s: float, most: float, beyond_m: float) -> None:
    track = track_of(way(), 110.0, lag_s=lag_s, most=most)
    x, y, speed = track[20:].T
    middle = (y > 25.0) & (y < 75.0)
    off = np.abs(x[middle, None] - LANES)
    assert set(off.argmin(axis=1).tolist()) == {0, 1, 2, 3}
    assert off.min(axis=1).max() < 0.5
    assert speed[middle] == pytest.approx(4.0, rel=0.02)
    assert y.max() < 96.0 + beyond_m
    assert y.min() > 4.0 - beyond_m
    assert speed.mean() > 3.8


def test_a_displaced_vehicle_returns_to_the_lane() -> None:
    along = way()
    track_of(along, 5.0)
    x, y, _ = track_of(along, 12.0, start=(12.0, 20.0)).T
    assert np.abs(x[(y > 45.0) & (y < 90.0)] - 5.0).max() < 0.1


def test_a_way_point_is_skipped_after_stuck_s_without_progress() -> None:
    along = way(stuck_s=6.0)
    goals = []
    for tick in range(200):
        along.velocity(tick * TICK_NS, (5.0, min(90.0, 0.4 * tick)), ["a"])  # blocked at 90 m from tick 225 on
        goals.append(along.goal)
    assert set(goals[20:]) == {(5.0, 96.0)}
    for tick in range(200, 300):
        along.velocity(tick * TICK_NS, (5.0, 80.0), ["a"])
        goals.append(along.goal)
    assert goals[257] == (5.0, 96.0)
    assert goals[261] == (15.0, 96.0)


@given(speed=st.floats(0.05, 0.19) | st.floats(0.21, 8.0))
def test_slow_progress_does_not_count_as_stuck(speed: float) -> None:
    along = way(speed=speed)
    track_of(along, 10.0)
    assert along.goal == ((5.0, 4.0) if speed < 0.2 else (5.0, 96.0))  # 2 m before the first way-point it changes to the next


def test_a_pause_does_not_count_as_stuck() -> None:
    along = way(stuck_s=6.0)
    for tick in range(0, 1000, 50):
        along.velocity(tick * TICK_NS, (5.0, 50.0), ["a"])
        along.pause()
    assert along.velocity(1000 * TICK_NS, (5.0, 50.0), ["a"]) != (0.0, 0.0)
    assert along.goal == (5.0, 4.0)


def test_it_hovers_over_an_area_within_its_view() -> None:
    along = LaneFollower(Comb("a", Rectangle(0.0, 0.0, 6.0, 6.0), 8.0), speed=4.0, acceleration=2.0, stuck_s=6.0)
    assert np.abs(track_of(along, 30.0)[50:, :2] - 3.0).max() < 1.5
