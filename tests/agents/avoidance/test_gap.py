"""Through gaps: which way is taken, how, and that it leads there."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from tests.support.agents.scans import SMALL, Wall, bearings, box, ranges_of, view, wall_with_doors
from vcmvsp.agents.avoidance import Decision, Gap, Task
from vcmvsp.agents.avoidance.view import Point, View
from vcmvsp.cosim.agent import Body
from vcmvsp.cosim.types import Array

SQUARE = Body(width_m=0.4, radius_m=0.3)
DRONE = Body(width_m=0.4, radius_m=0.2, flies=True)
CORRIDOR = [((-9.0, 0.45), (9.0, 0.45)), ((-9.0, -0.45), (9.0, -0.45))]
BLOCKED = [((0.5, -9.0), (0.5, 9.0)), ((-9.0, 0.45), (9.0, 0.45)), ((-9.0, -0.45), (9.0, -0.45))]
LEFT, RIGHT = (0.4, 1.2), (-1.2, -0.4)  # doors


def decide(view_: View, task: Task, body: Body = SMALL, **settings: Any) -> Decision:
    return Gap(**settings).method(body, 0.1).decide(view_, task)


def seen(walls: list[Wall], fov: float = math.pi, beams: int = 512) -> View:
    return view(ranges_of(walls, beams=beams, fov=fov), fov)


def at(angle_deg: float, distance: float) -> Point:
    return distance * math.cos(math.radians(angle_deg)), distance * math.sin(math.radians(angle_deg))


# --- the task ---


@pytest.mark.parametrize("walls", [[], CORRIDOR, [((1.3, -9.0), (1.3, 9.0))]])
@pytest.mark.parametrize("body", [SMALL, DRONE])
@pytest.mark.parametrize("place", [None, (3.0, 0.0), (0.1, 0.0), (0.0, 0.0), (-2.0, 0.0)])
@pytest.mark.parametrize("leader", [None, (3.0, 0.5)])
def test_with_a_free_lane_the_task_is_done(walls: list[Wall], body: Body, place: Point | None, leader: Point | None) -> None:
    task = Task((0.31, 0.0), 0.17, place, leader)
    assert decide(seen(walls), task, body) == Decision((0.31, 0.0), 0.17, "task")


def test_the_lane_ends_at_the_aim() -> None:
    wall = seen([((0.8, -9.0), (0.8, 9.0))])
    assert decide(wall, Task((0.3, 0.0), 0.0, (0.7, 0.0))).mode == "task"
    assert decide(wall, Task((0.3, 0.0), 0.0, (0.9, 0.0))).mode != "task"


def test_the_lane_is_as_wide_as_the_body_and_the_margins() -> None:
    task = Task((0.3, 0.0), 0.0, (3.0, 0.0))
    for room, mode in ((0.5 * SMALL.width_m + 0.06 - 0.005, "avoid"), (0.5 * SMALL.width_m + 0.06 + 0.005, "task")):
        assert decide(seen([((0.6, room), (0.6, 0.9))], beams=8192), task).mode == mode


def test_what_stands_still_stands() -> None:
    assert decide(seen(BLOCKED), Task((0.0, 0.0), 0.0, (3.0, 0.0))) == Decision((0.0, 0.0), 0.0, "task")


def test_on_the_spot_anything_may_turn_that_goes_nowhere_in_sight() -> None:
    for aim in (None, (-3.0, 0.0)):
        assert decide(seen(BLOCKED), Task((0.0, 0.0), 0.4, aim)) == Decision((0.0, 0.0), 0.4, "task")


def test_with_an_aim_out_of_sight_the_way_ahead_counts() -> None:
    task = Task((0.3, 0.0), 0.5, at(120.0, 2.0))
    assert decide(seen([((0.8, -0.5), (0.8, 0.5))]), task).mode == "avoid"
    assert decide(seen(box(*at(60.0, 0.8), 0.2)), task).mode == "task"


def test_on_its_way_around_something_it_wants_to_see_that_it_can_go_on() -> None:
    method, behind = Gap().method(SMALL, 0.1), Task((0.3, 0.0), 0.5, at(100.0, 0.5))
    beside = seen([((-9.0, 0.4), (9.0, 0.4))])
    assert method.decide(beside, behind).mode == "task"
    assert method.decide(beside, Task((0.3, 0.0), 0.5, at(80.0, 0.5))).mode == "avoid"
    assert method.decide(beside, behind).mode == "avoid"
    assert method.decide(beside, Task((0.3, 0.0), 0.0, at(0.0, 2.0))).mode == "task"
    assert method.decide(beside, behind).mode == "task"


# --- the choice ---


def test_the_leader_behind_the_left_door_is_followed_through_it() -> None:  # Toh 2012, Fig 41
    walls = wall_with_doors(0.8, [LEFT, RIGHT], half=1.6)
    for leader, side in (((2.0, 1.0), 1), ((2.0, -1.0), -1)):
        decision = decide(seen(walls), Task((0.3, 0.0), 0.0, (1.5, 0.0), leader), lookahead_m=2.0, top=4)
        middle = 0.5 * (math.atan2(0.4, 0.8) + math.atan2(1.2, 0.8))
        assert decision.mode == "avoid"
        assert decision.yaw_rate == pytest.approx(side * min(1.5 * middle, 1.2), abs=0.02)
        assert decision.velocity == pytest.approx((0.6 * math.cos(middle), 0.0), abs=0.01)


@pytest.mark.parametrize(("leader_deg", "side"), [(170.0, 1), (100.0, 1), (-100.0, -1), (-170.0, -1)])
def test_the_leader_out_of_sight_is_followed_through_the_gap_at_that_border(leader_deg: float, side: int) -> None:
    """Its index lies beyond the beams, and is not clipped (Toh 2012, Fig 41)."""
    walls = wall_with_doors(0.7, [(0.3, 0.9), (-0.9, -0.3)], half=5.0)
    decision = decide(seen(walls), Task((0.3, 0.0), 0.0, (1.0, 0.0), at(leader_deg, 2.0)), top=4)
    border = 0.5 * (math.acos(0.7 / 1.2) + 0.5 * math.pi)
    assert decision.mode == "avoid"
    assert decision.yaw_rate == side * 1.2
    assert math.cos(border) == pytest.approx(decision.velocity[0] / 0.6, abs=0.01)


def test_in_a_whole_turn_the_leader_behind_is_followed_through_the_gap_behind() -> None:
    walls = [((-0.8, -5.0), (-0.8, -0.5)), ((-0.8, 0.4), (-0.8, 5.0)), ((0.6, -5.0), (0.6, 5.0))]
    decision = decide(seen(walls, math.tau), Task((0.3, 0.0), 0.0, (1.0, 0.0), (-2.0, -0.3)))
    assert decision.mode == "avoid"
    assert decision.yaw_rate == -1.2
    assert decision.velocity[0] == 0.0  # there is a wall ahead


def test_the_only_useful_gap_may_be_the_fourth() -> None:
    walls = wall_with_doors(0.8, [(-1.5, -0.5), (0.2, 1.0)], half=1.9)
    task = Task((0.3, 0.0), 0.0, (3.0, 0.5), (3.0, 0.6))
    assert decide(seen(walls), task, lookahead_m=2.4, top=4).yaw_rate > 0.5
    assert decide(seen(walls), task, lookahead_m=2.4, top=1).yaw_rate < 0.0


@pytest.mark.parametrize("fov", [math.pi, math.tau])
def test_towards_a_goal_the_gap_is_taken_that_ends_nearest_to_it(fov: float) -> None:
    walls = wall_with_doors(0.7, [LEFT, RIGHT], half=1.5)
    for aim, side in (((2.0, 0.2), 1), ((2.0, -0.2), -1), ((0.9, -0.3), -1)):
        decision = decide(seen(walls, fov), Task((0.3, 0.0), 0.0, aim), lookahead_m=1.5, top=4)
        assert decision.mode == "avoid"
        assert math.copysign(1.0, decision.yaw_rate) == side


def test_one_that_roams_goes_on_as_straight_as_it_can() -> None:
    walls, task = wall_with_doors(0.8, [(0.1, 0.8), (-1.2, -0.4)]), Task((0.3, 0.0))
    near, far = 0.5 * (math.atan2(0.1, 0.8) + 0.25 * math.pi), -0.5 * (math.atan2(0.4, 0.8) + math.atan2(1.2, 0.8))
    assert decide(seen(walls), task, lookahead_m=1.6, top=4).yaw_rate == pytest.approx(1.5 * near, abs=0.02)
    assert decide(seen(walls), task, lookahead_m=1.6).yaw_rate == pytest.approx(1.5 * far, abs=0.02)  # one of the widest


def test_ties_go_to_the_wider() -> None:
    first, last = -0.5 * math.pi, 0.5 * math.pi
    angles = np.linspace(first, last, 181)
    ranges = np.full(181, 0.9)
    ranges[np.abs(np.abs(angles) - 1.0) < 0.3] = 5.0
    for near, side in ((0, 1), (-1, -1)):  # the sides of one gap are nearer, so that it is narrower
        nearer = ranges.copy()
        nearer[:90] = np.where(nearer[:90] < 5.0, 0.8, 5.0)
        scan = view(nearer if near == 0 else nearer[::-1])
        assert math.copysign(1.0, decide(scan, Task((0.3, 0.0))).yaw_rate) == side


@pytest.mark.parametrize(("body", "half"), [(SMALL, 0.225), (SQUARE, 0.3), (DRONE, 0.26)])
def test_a_gap_must_have_room_for_the_body_and_the_margins(body: Body, half: float) -> None:
    """And for a turn on the spot within it."""
    for width, mode in ((2.0 * half - 0.02, "turn"), (2.0 * half + 0.02, "avoid")):
        d = 0.5 * width
        walls = [
            ((-0.1, -0.8), (0.9, -0.8)),
            ((0.9, -0.8), (0.9, 0.5 - d)),
            ((0.9, 0.5 + d), (0.9, 1.1)),
            ((0.9, 1.1), (-0.1, 1.1)),
        ]
        assert decide(seen(walls, beams=4096), Task((0.3, 0.0), 0.0, (3.0, 0.0)), body, lookahead_m=1.5).mode == mode


def test_whoever_keeps_more_needs_more() -> None:
    assert Gap().kept_m(SMALL) == pytest.approx(0.225)
    walls = [*wall_with_doors(0.8, [(0.2, 0.9)], half=1.0), ((-0.2, -1.0), (0.8, -1.0)), ((-0.2, 1.0), (0.8, 1.0))]
    assert decide(seen(walls), Task((0.3, 0.0)), lookahead_m=1.25).mode == "avoid"
    assert decide(seen(walls), Task((0.3, 0.0)), lookahead_m=1.25, keep_m=0.4).mode == "turn"


# --- how it goes there ---


def test_one_that_flies_goes_sideways() -> None:
    walls = wall_with_doors(0.8, [LEFT], half=1.6)
    decision = decide(seen(walls, math.tau), Task((0.25, 0.0), 0.1, (3.0, 0.6)), DRONE, lookahead_m=1.9)
    middle = 0.5 * (math.atan2(0.4, 0.8) + math.atan2(1.2, 0.8))
    assert decision.velocity == pytest.approx((0.25 * math.cos(middle), 0.25 * math.sin(middle)), abs=0.01)
    assert decision.yaw_rate == 0.1


def test_around_something_nobody_hurries_but_to_catch_up() -> None:
    scan, aim, leader = seen([((0.8, -0.5), (0.8, 0.3))]), (3.0, 0.0), (3.5, 0.0)
    for speed, of, behind in ((0.2, 0.2, None), (0.9, 0.5, None), (0.2, 0.5, leader), (0.9, 0.5, leader)):
        decision = decide(scan, Task((speed, 0.0), 0.0, aim, behind, 0.5), DRONE)
        assert decision.mode == "avoid"
        assert math.hypot(*decision.velocity) == pytest.approx(of)


def test_one_that_had_turned_on_the_spot_goes_on_as_fast_as_before() -> None:
    scan = seen([((0.8, -0.5), (0.8, 0.3))])
    method = Gap().method(SMALL, 0.1)
    assert method.decide(seen([]), Task((0.2, 0.0), 0.0, (3.0, 0.0))).mode == "task"
    decision = method.decide(scan, Task((0.0, 0.0), 0.4, (3.0, 0.0)))
    assert 0.1 < decision.velocity[0] < 0.2


def test_while_it_turns_by_much_it_creeps_only_where_the_way_ahead_is_free() -> None:
    """A gap on the right, hardly behind: the aim is behind something further round."""
    angles = np.degrees(bearings(720, math.tau))
    ranges = np.where(abs(angles + 110.0) < 25.0, 3.0, 0.7)
    task = Task((0.3, 0.0), 0.0, at(-150.0, 0.9))
    assert decide(view(ranges, math.tau), task) == Decision((0.0, 0.0), -1.2, "avoid")
    ranges[abs(angles) < 25.0] = 3.0
    assert decide(view(ranges, math.tau), task) == Decision((0.2 * 0.3, 0.0), -1.2, "avoid")


# --- no way ---


@pytest.mark.parametrize("body", [SMALL, DRONE])
@pytest.mark.parametrize(("y", "side"), [(0.4, 1), (-0.4, -1)])
def test_without_a_gap_it_turns_to_the_leader_or_the_goal(y: float, side: int, body: Body) -> None:
    for task in (Task((0.3, 0.0), 0.0, (3.0, y)), Task((0.3, 0.0), 0.0, (3.0, -y), (4.0, y))):
        assert decide(seen(BLOCKED), task, body) == Decision((0.0, 0.0), side * 0.6, "turn")


def test_one_that_roams_turns_to_the_side_with_more_room() -> None:
    for off, side in ((0.1, -1), (-0.1, 1)):
        walls = [((0.5, -9.0), (0.5, 9.0)), ((-9.0, 0.45 - off), (9.0, 0.45 - off)), ((-9.0, -0.45 - off), (9.0, -0.45 - off))]
        assert decide(seen(walls), Task((0.3, 0.0))).yaw_rate == side * 0.6


def test_it_goes_on_turning_to_one_side_until_there_is_a_gap() -> None:
    method, rng = Gap().method(SMALL, 0.1), np.random.default_rng(1)
    rates = {
        method.decide(view(rng.uniform(0.1, 0.6, 181)), Task((0.3, 0.0), 0.0, (2.0, float(rng.normal())))).yaw_rate
        for _ in range(50)
    }
    assert len(rates) == 1
    turned = method.decide(seen([]), Task((0.3, 0.0)))
    assert turned.mode == "task"
    other = Task((0.3, 0.0), 0.0, (2.0, -rates.pop()))
    assert method.decide(seen(BLOCKED), other).yaw_rate == math.copysign(0.6, -turned.yaw_rate or other.aim[1])  # type: ignore[index]


# --- all in all ---


@pytest.mark.parametrize("fov", [math.pi, math.tau])
@pytest.mark.parametrize("body", [SMALL, DRONE])
def test_left_and_right_are_alike(fov: float, body: Body) -> None:
    rng, modes = np.random.default_rng(3), set()
    for _ in range(300):
        ranges = np.repeat(rng.uniform(0.3, 2.0, int(rng.integers(5, 40))), 4)
        other = ranges[::-1] if fov == math.pi else np.roll(ranges[::-1], 1)  # the whole turn begins straight behind
        aim, leader, turn = rng.uniform(-2, 2, 2), rng.uniform(-2, 2, 2), rng.normal()
        kind = rng.integers(3)
        one = Task((0.3, 0.0), turn, _point(aim, 1) if kind else None, _point(leader, 1) if kind == 2 else None)
        two = Task((0.3, 0.0), -turn, _point(aim, -1) if kind else None, _point(leader, -1) if kind == 2 else None)
        here, there = decide(view(ranges, fov), one, body), decide(view(other, fov), two, body)
        modes.add(here.mode)
        assert there.mode == here.mode
        assert there.yaw_rate == pytest.approx(-here.yaw_rate, abs=1e-9)
        assert there.velocity == pytest.approx((here.velocity[0], -here.velocity[1]), abs=1e-9)
    assert {"task", "avoid"} <= modes


def _point(place: Array, side: int) -> Point:
    return float(place[0]), side * float(place[1])


Places = st.none() | st.tuples(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0))


@given(
    arrays.arrays(float, st.integers(2, 60), elements=st.sampled_from([0.0, 0.3, 1.2, math.inf]) | st.floats(0.0, 4.0)),
    st.sampled_from([0.5, math.pi, 4.0, math.tau]),
    st.sampled_from([SMALL, DRONE]),
    st.tuples(st.floats(-0.1, 1.0), st.floats(-1.0, 1.0), st.floats(-2.0, 2.0)),
    Places,
    Places,
)
def test_whatever_the_scan_says_there_is_a_decision_within_limits(
    ranges: Array, fov: float, body: Body, speeds: tuple[float, float, float], aim: Point | None, leader: Point | None
) -> None:
    v, across, w = speeds
    task = Task((v, across if body.flies else 0.0), w, aim, leader)
    (ahead, left), turning, mode = decide(view(ranges, fov), task, body)
    if mode == "task":
        assert ((ahead, left), turning) == (task.velocity, w)
    elif mode == "turn":
        assert (ahead, left, abs(turning)) == (0.0, 0.0, 0.6)
    else:
        assert math.hypot(ahead, left) <= 0.6 + 1e-9
        assert body.flies or (ahead >= 0.0 and left == 0.0 and abs(turning) <= 1.2)
