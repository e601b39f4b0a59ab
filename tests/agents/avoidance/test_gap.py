"""Gaps: choice of a gap, motion towards it, and gaps in a scan."""

import math
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from tests.support.agents.scans import SMALL, Wall, bearings, ranges_of, sides, view, wall_with_doors
from vcmvsp.agents.avoidance import Decision, Gap, Task
from vcmvsp.agents.avoidance.gap import Gaps, gaps, gaps_ahead
from vcmvsp.agents.avoidance.view import Point, View
from vcmvsp.cosim.agent import Body
from vcmvsp.cosim.types import Array

pytestmark = pytest.mark.slow

SQUARE = Body(width_m=0.4, radius_m=0.3)
DRONE = Body(width_m=0.4, radius_m=0.2, flies=True)
CORRIDOR = [((-9.0, 0.45), (9.0, 0.45)), ((-9.0, -0.45), (9.0, -0.45))]
BLOCKED = [((0.5, -9.0), (0.5, 9.0)), *CORRIDOR]
LEFT, RIGHT = (0.4, 1.2), (-1.2, -0.4)  # doors


def decide(view_: View, task: Task, body: Body = SMALL, **settings: Any) -> Decision:
    return Gap(**settings).method(body, 0.1).decide(view_, task)


def seen(walls: list[Wall], fov: float = math.pi, beams: int = 512) -> View:
    return view(ranges_of(walls, beams=beams, fov=fov), fov)


def at(angle_deg: float, distance: float) -> Point:
    return distance * math.cos(math.radians(angle_deg)), distance * math.sin(math.radians(angle_deg))


# --- the task ---

WALL = ((0.8, -9.0), (0.8, 9.0))
ASIDE = Task((0.3, 0.0), 0.5, at(120.0, 2.0))


@pytest.mark.parametrize("walls", [[], CORRIDOR, [((1.3, -9.0), (1.3, 9.0))]])
@pytest.mark.parametrize("body", [SMALL, DRONE])
@pytest.mark.parametrize("place", [None, (3.0, 0.0), (0.1, 0.0), (0.0, 0.0), (-2.0, 0.0)])
@pytest.mark.parametrize("leader", [None, (3.0, 0.5)])
def test_with_a_free_lane_the_task_is_done(walls: list[Wall], body: Body, place: Point | None, leader: Point | None) -> None:
    task = Task((0.31, 0.0), 0.17, place, leader)
    assert decide(seen(walls), task, body) == Decision((0.31, 0.0), 0.17, "task")


@pytest.mark.parametrize(
    ("walls", "task", "is_free"),
    [
        pytest.param([WALL], Task((0.3, 0.0), 0.0, (0.7, 0.0)), True, id="the lane ends at the aim"),
        pytest.param([WALL], Task((0.3, 0.0), 0.0, (0.9, 0.0)), False, id="an aim behind a wall"),
        pytest.param(BLOCKED, Task((0.0, 0.0), 0.0, (3.0, 0.0)), True, id="at rest"),
        pytest.param(BLOCKED, Task((0.0, 0.0), 0.4), True, id="on the spot without an aim"),
        pytest.param(BLOCKED, Task((0.0, 0.0), 0.4, (-3.0, 0.0)), True, id="on the spot with an aim out of view"),
        pytest.param([((0.8, -0.5), (0.8, 0.5))], ASIDE, False, id="with an aim out of view the way ahead counts"),
        pytest.param(sides(at(57.1, 0.68), at(62.3, 0.93)), ASIDE, True, id="and not the way to the aim"),
    ],
)
def test_the_task_is_kept_where_its_lane_is_free(walls: list[Wall], task: Task, is_free: bool) -> None:
    assert (decide(seen(walls), task) == Decision(task.velocity, task.yaw_rate, "task")) == is_free


def test_the_lane_is_as_wide_as_the_body_and_the_margins() -> None:
    task = Task((0.3, 0.0), 0.0, (3.0, 0.0))
    for room, mode in ((0.5 * SMALL.width_m + 0.06 - 0.005, "avoid"), (0.5 * SMALL.width_m + 0.06 + 0.005, "task")):
        assert decide(seen([((0.6, room), (0.6, 0.9))], beams=8192), task).mode == mode


def test_avoidance_ends_only_with_a_free_way_in_view() -> None:
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
    assert decision.velocity[0] == 0.0  # wall ahead


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


def test_without_a_goal_the_straightest_gap_is_taken() -> None:
    walls, task = wall_with_doors(0.8, [(0.1, 0.8), (-1.2, -0.4)]), Task((0.3, 0.0))
    near, far = 0.5 * (math.atan2(0.1, 0.8) + 0.25 * math.pi), -0.5 * (math.atan2(0.4, 0.8) + math.atan2(1.2, 0.8))
    assert decide(seen(walls), task, lookahead_m=1.6, top=4).yaw_rate == pytest.approx(1.5 * near, abs=0.02)
    assert decide(seen(walls), task, lookahead_m=1.6).yaw_rate == pytest.approx(1.5 * far, abs=0.02)  # widest only


def test_equal_gaps_the_wider_one_is_taken() -> None:
    first, last = -0.5 * math.pi, 0.5 * math.pi
    angles = np.linspace(first, last, 181)
    ranges = np.full(181, 0.9)
    ranges[np.abs(np.abs(angles) - 1.0) < 0.3] = 5.0
    for near, side in ((0, 1), (-1, -1)):  # one gap is narrower, because its sides are nearer
        nearer = ranges.copy()
        nearer[:90] = np.where(nearer[:90] < 5.0, 0.8, 5.0)
        scan = view(nearer if near == 0 else nearer[::-1])
        assert math.copysign(1.0, decide(scan, Task((0.3, 0.0))).yaw_rate) == side


@pytest.mark.parametrize(("body", "half"), [(SMALL, 0.225), (SQUARE, 0.3), (DRONE, 0.26)])
def test_a_gap_must_have_room_for_the_body_and_the_margins(body: Body, half: float) -> None:
    """And for a turn on the spot within the gap."""
    for width, mode in ((2.0 * half - 0.02, "turn"), (2.0 * half + 0.02, "avoid")):
        d = 0.5 * width
        walls = [
            ((-0.1, -0.8), (0.9, -0.8)),
            ((0.9, -0.8), (0.9, 0.5 - d)),
            ((0.9, 0.5 + d), (0.9, 1.1)),
            ((0.9, 1.1), (-0.1, 1.1)),
        ]
        assert decide(seen(walls, beams=4096), Task((0.3, 0.0), 0.0, (3.0, 0.0)), body, lookahead_m=1.5).mode == mode


def test_a_larger_distance_needs_a_wider_gap() -> None:
    assert Gap().clearance_m(SMALL) == pytest.approx(0.225)
    walls = [*wall_with_doors(0.8, [(0.2, 0.9)], half=1.0), ((-0.2, -1.0), (0.8, -1.0)), ((-0.2, 1.0), (0.8, 1.0))]
    assert decide(seen(walls), Task((0.3, 0.0)), lookahead_m=1.25).mode == "avoid"
    assert decide(seen(walls), Task((0.3, 0.0)), lookahead_m=1.25, keep_m=0.4).mode == "turn"


# --- motion towards a gap ---


def test_a_flying_vehicle_moves_sideways() -> None:
    walls = wall_with_doors(0.8, [LEFT], half=1.6)
    decision = decide(seen(walls, math.tau), Task((0.25, 0.0), 0.1, (3.0, 0.6)), DRONE, lookahead_m=1.9)
    middle = 0.5 * (math.atan2(0.4, 0.8) + math.atan2(1.2, 0.8))
    assert decision.velocity == pytest.approx((0.25 * math.cos(middle), 0.25 * math.sin(middle)), abs=0.01)
    assert decision.yaw_rate == 0.1


def test_only_a_follower_that_lags_speeds_up_around_obstacles() -> None:
    scan, aim, leader = seen([((0.8, -0.5), (0.8, 0.3))]), (3.0, 0.0), (3.5, 0.0)
    for speed, of, behind in ((0.2, 0.2, None), (0.9, 0.5, None), (0.2, 0.5, leader), (0.9, 0.5, leader)):
        decision = decide(scan, Task((speed, 0.0), 0.0, aim, behind, 0.5), DRONE)
        assert decision.mode == "avoid"
        assert math.hypot(*decision.velocity) == pytest.approx(of)


def test_after_a_turn_on_the_spot_it_resumes_its_speed() -> None:
    scan = seen([((0.8, -0.5), (0.8, 0.3))])
    method = Gap().method(SMALL, 0.1)
    assert method.decide(seen([]), Task((0.2, 0.0), 0.0, (3.0, 0.0))).mode == "task"
    decision = method.decide(scan, Task((0.0, 0.0), 0.4, (3.0, 0.0)))
    assert 0.1 < decision.velocity[0] < 0.2


def test_in_sharp_turns_it_creeps_only_with_a_free_way_ahead() -> None:
    """A gap on the right, slightly behind; the aim is behind an obstacle further round."""
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


# --- gaps in a scan: each is found once, with its width, for any first beam ---


L = 2.0
BEAMS = 512


def found(walls: list[Wall], lookahead: float = L, beams: int = BEAMS) -> Gaps:
    return gaps(ranges_of(walls, beams=beams), lookahead, -0.5 * math.pi, math.pi / (beams - 1))


class Door(NamedTuple):
    distance: float
    width: float
    tilt: float
    left: float

    @property
    def walls(self) -> list[Wall]:
        return wall_with_doors(self.distance, [(self.left - 0.5 * self.width, self.left + 0.5 * self.width)], self.tilt)

    @property
    def jambs(self) -> tuple[float, float]:
        """Distances of the right and the left jamb, m."""
        (_, right), (left, _) = self.walls
        return math.hypot(*right), math.hypot(*left)

    @property
    def bearing(self) -> float:
        return math.atan2(self.left * math.cos(self.tilt), self.distance - self.left * math.sin(self.tilt))


DOORS = st.builds(Door, st.floats(0.5, 1.5), st.floats(0.4, 1.2), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))


@given(DOORS, st.sampled_from([256, 512, 1024, 4096]))
def test_a_door_is_too_wide_by_the_spacing_of_the_beams_on_either_side(door: Door, beams: int) -> None:
    step = math.pi / (beams - 1)
    spacing = [step * jamb**2 / (door.distance * math.cos(door.tilt)) for jamb in door.jambs]  # along the wall
    these, beam = found(door.walls, 2.5, beams), (door.bearing + 0.5 * math.pi) / step
    (width,) = these.width[(these.begin <= beam) & (beam < these.end)]
    assert -1e-9 <= width - door.width <= 1.1 * sum(spacing)


def test_a_wall_with_one_door_has_two_crossings_besides_the_free_sides() -> None:
    these = found(wall_with_doors(1.0, [(-0.4, 0.4)]))
    assert len(these.begin) == 3  # the door, and the wall beyond the look-ahead distance on both sides
    inner = np.concatenate([these.begin, these.end])
    inner = inner[(inner > 0) & (inner < BEAMS)]
    aside = math.acos(1.0 / L) / math.pi * (BEAMS - 1)  # beams from the middle to the end of the wall in view
    assert sum(abs(inner - 255.5) < aside - 1) == 2


def test_a_return_at_the_lookahead_distance_is_no_gap_and_counts_once() -> None:
    ranges = np.array([1.0, 1.0, 2.0, 2.5, 2.0, 3.0, 1.0])
    these = gaps(ranges, 2.0, -1.5, 0.5)
    assert sorted(zip(these.begin.tolist(), these.end.tolist(), strict=True)) == [(3, 4), (5, 6)]


def test_all_beams_free_is_one_gap_and_none_free_is_no_gap() -> None:
    for cyclic in (False, True):
        free = gaps(np.full(8, math.inf), 1.2, -0.5 * math.pi, math.pi / 7, cyclic)
        assert (free.begin.tolist(), free.end.tolist()) == ([0], [8])
        assert free.bearing[0] == pytest.approx(0.0)
        assert free.width[0] == pytest.approx(2.4)
        assert not len(gaps(np.full(8, 1.2), 1.2, -0.5 * math.pi, math.pi / 7, cyclic).begin)


def test_a_gap_at_the_border_is_closed_there_at_the_lookahead_distance() -> None:
    ranges = np.array([9.0, 9.0, 1.0, 1.0, 1.0])
    these = gaps(ranges, 2.0, 0.0, 0.3)
    a, b, delta = 2.0, 1.0, 2 * 0.3
    assert these.width[0] == pytest.approx(math.sqrt(a * a + b * b - 2 * a * b * math.cos(delta)))
    assert these.bearing[0] == pytest.approx(0.15)


def test_a_gap_of_half_a_turn_or_more_is_as_wide_as_both_distances() -> None:
    ranges = np.full(360, 9.0)
    ranges[10], ranges[100] = 0.5, 0.7
    these = gaps(ranges, 2.0, 0.0, math.radians(1.0), cyclic=True)
    assert these.begin.tolist() == [101, 11]
    assert these.end.tolist() == [370, 100]
    assert these.width.tolist() == pytest.approx([1.2, math.sqrt(0.5**2 + 0.7**2)])
    assert these.bearing[0] == pytest.approx(math.radians(235.0 - 360.0))


Ranges = arrays.arrays(
    float, st.integers(3, 64), elements=st.sampled_from([0.0, 0.3, 1.2, 3.0, math.inf]) | st.floats(0.0, 4.0)
)


def same(one: float, other: float) -> bool:
    return abs((one - other + math.pi) % math.tau - math.pi) < 1e-9


@given(Ranges, st.integers(0, 63))
def test_a_whole_turn_may_begin_anywhere(ranges: Array, by: int) -> None:
    count = len(ranges)
    step, by = math.tau / count, by % count
    if (ranges > 1.2).all():
        return
    one, other = gaps(ranges, 1.2, -math.pi, step, True), gaps(np.roll(ranges, by), 1.2, -math.pi, step, True)
    turned = {(begin + by) % count: k for k, begin in enumerate(one.begin.tolist())}
    assert set(turned) == set(other.begin.tolist())
    for k, begin in enumerate(other.begin.tolist()):
        before = turned[begin]
        assert other.end[k] - begin == one.end[before] - one.begin[before]
        assert other.width[k] == one.width[before]
        assert same(other.bearing[k], one.bearing[before] + by * step)


@given(Ranges, st.booleans())
def test_a_mirrored_scan_has_mirrored_gaps(ranges: Array, cyclic: bool) -> None:
    count = len(ranges)
    step = math.tau / count if cyclic else math.pi / (count - 1)
    first = -0.5 * (count - 1) * step
    one, other = gaps(ranges, 1.2, first, step, cyclic), gaps(ranges[::-1], 1.2, first, step, cyclic)
    mirrored = {(count - end) % count: k for k, end in enumerate(one.end.tolist())}
    assert set(mirrored) == {begin % count for begin in other.begin.tolist()}
    for k, begin in enumerate(other.begin.tolist()):
        assert other.width[k] == pytest.approx(one.width[mirrored[begin % count]], abs=1e-12)
        assert same(other.bearing[k], -one.bearing[mirrored[begin % count]])


@given(Ranges, st.booleans())
def test_gaps_are_the_runs_of_free_beams_the_widest_first(ranges: Array, cyclic: bool) -> None:
    count = len(ranges)
    these = gaps(ranges, 1.2, 0.0, math.tau / count, cyclic)
    held = [beam % count for begin, end in zip(these.begin, these.end, strict=True) for beam in range(begin, end)]
    assert sorted(held) == np.flatnonzero(ranges > 1.2).tolist()
    assert (np.diff(these.width) <= 0.0).all()
    assert (these.width >= 0.0).all()
    assert ((these.begin >= 0) & (these.begin < count)).all()
    if not (ranges > 1.2).all():
        for begin, end in zip(these.begin, these.end, strict=True):
            assert cyclic or begin == 0 or ranges[begin - 1] <= 1.2
            assert cyclic or end == count or ranges[end] <= 1.2
            assert not cyclic or max(ranges[begin - 1], ranges[end % count]) <= 1.2


@pytest.mark.parametrize("turn_deg", [-40, -10, 0, 10, 40])
def test_the_place_of_a_gap_at_the_border_does_not_depend_on_the_heading(turn_deg: int) -> None:
    """A pillar straight ahead of a vehicle that has turned: the ways around it keep their places."""
    turn = math.radians(turn_deg)
    scan = view(ranges_of([((1.0, -0.2), (1.0, 0.2))], (0.0, 0.0, turn)))
    _, places = gaps_ahead(scan, -turn, 1.2)
    aside = 0.5 * (math.atan2(0.2, 1.0) + 0.5 * math.pi)
    assert sorted(places + turn) == pytest.approx([-aside, aside], abs=0.01)


def test_in_a_whole_turn_gaps_end_a_quarter_turn_aside() -> None:
    scan = view(ranges_of([((1.0, -0.2), (1.0, 0.2))], beams=720, fov=math.tau), math.tau)
    these, places = gaps_ahead(scan, 0.0, 1.2)
    aside = 0.5 * (math.atan2(0.2, 1.0) + 0.5 * math.pi)
    assert sorted(these.bearing) == pytest.approx([-aside, aside], abs=0.01)
    assert places.tolist() == these.bearing.tolist()


@pytest.mark.parametrize(("distance", "wanted_deg"), [(0.25, 60.0), (0.3, 60.0), (0.3, 70.0), (0.25, -60.0)])
def test_a_narrow_door_looks_no_wider_where_the_quarter_turn_ends_in_it(distance: float, wanted_deg: float) -> None:
    look = view(ranges_of(wall_with_doors(distance, [(-0.175, 0.175)]), beams=BEAMS))
    ahead, _ = gaps_ahead(look, math.radians(wanted_deg), 1.2)
    assert ahead.width.max() == pytest.approx(0.35, abs=0.02)
    assert (np.diff(ahead.width) <= 0.0).all()


def test_in_a_whole_turn_a_near_post_closes_no_gap() -> None:
    ranges = np.full(360, np.inf)
    ranges[:5] = ranges[-5:] = 0.2
    look = view(ranges, fov=math.tau)
    ahead, _ = gaps_ahead(look, 0.0, 1.2)
    assert ahead.width.min() > 0.6
