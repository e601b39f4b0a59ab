"""All methods through `AvoidanceSteering`: fields of boxes and every kind of scanner."""

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from tests.support.agents.agent_loop import info
from tests.support.agents.obstacle_fields import (
    DRONE,
    ORIGIN,
    ROBOT,
    WHEELS,
    WINGS,
    Box,
    DriveResult,
    drive,
    observation_from,
    scattered_boxes,
    seen,
    steer_to_goal,
    steering,
    sweep,
    to_goal,
)
from tests.support.agents.obstacle_fields import there as reached
from tests.support.agents.scans import Point, Pose, view
from vcmvsp.agents.avoidance import DynamicWindow, Gap, PotentialField, Task, Vfh, View
from vcmvsp.agents.avoidance.gap import gaps_ahead
from vcmvsp.agents.avoidance.method import Settings
from vcmvsp.agents.avoidance.steering import AvoidanceSteering
from vcmvsp.cosim.agent import Body
from vcmvsp.cosim.types import Array

pytestmark = pytest.mark.slow

FIELD = PotentialField(core=0.3, reach=0.8)
METHODS = [FIELD, Gap(), Vfh(), DynamicWindow()]
NAMES = [type(each).__name__ for each in METHODS]
IN_THE_AIR = [PotentialField(), Gap(), Vfh()]
AHEAD: list[Box] = [((0.7, -0.25), (1.2, 0.25))]
ALONG: dict[str, Any] = {
    "half a turn": {},
    "from 0": {"fov": math.tau, "first": 0.0},
    "turned": {"fov": math.tau, "first": 2.9},
}
RING: Any = {"beams": 32, "fov": math.tau, "first": 0.0}


@pytest.mark.parametrize("method", METHODS, ids=NAMES)
@pytest.mark.parametrize(("scanner", "every"), [("half a turn", 4), ("from 0", 1), ("turned", 4)])
def test_it_touches_nothing_and_mostly_gets_there(method: Settings, scanner: str, every: int) -> None:
    rng = np.random.default_rng(5)
    ways = [
        steer_to_goal(method, scattered_boxes(rng), (6.0, 0.0), every=every, seconds=45.0, beams=121, **ALONG[scanner])
        for _ in range(3)
    ]
    assert min(way.clearance for way, _ in ways) > WHEELS.radius_m
    assert sum(there for _, there in ways) >= (1 if method is FIELD else 2)


@pytest.mark.parametrize("level", [1, 2])
def test_gaps_lead_through_fields_of_boxes(level: int) -> None:
    """Heading for the middle of a gap is not enough: obstacles nearer than the gap reach into the way."""
    rng, stuck = np.random.default_rng(5), 0
    for k in range(18):
        boxes = scattered_boxes(rng)
        if k in {4, 5, 7, 10, 14, 15, 17}:  # fields in which heading for the middle got stuck
            way, there = steer_to_goal(Gap(level=level), boxes, (6.0, 0.0), seconds=45.0)
            stuck += not there
            assert level == 1 or way.clearance > WHEELS.radius_m  # level 1 does not limit the speed
            turns = [each.yaw_rate for each in way.decisions if each.mode == "turn"]
            assert sum(a != b for a, b in pairwise(turns)) <= 3  # no trembling
    assert stuck <= 1  # between two boxes it still turns to and fro


@pytest.mark.parametrize("start", [(-1.8, 1.3, 0.0), (-1.0, -1.2, 0.3), (-0.8, 0.9, -0.3)])
def test_gaps_lead_through_a_door_that_is_seen_from_the_side(start: tuple[float, float, float]) -> None:
    walls: list[Box] = [
        ((-0.01, 0.35), (0.01, 4.0)),
        ((-0.01, -4.0), (0.01, -0.35)),
        ((-3.01, -4.0), (-3.0, 4.0)),
        ((-3.0, 4.0), (0.0, 4.01)),
        ((-3.0, -4.01), (0.0, -4.0)),
    ]
    way, there = steer_to_goal(Gap(), walls, (2.0, 0.4), start=start)
    assert there
    assert way.clearance > WHEELS.radius_m


@pytest.mark.parametrize("bad", [math.nan, 0.0, -math.inf])
@pytest.mark.parametrize("speed", [0.0, 0.1])
@pytest.mark.parametrize("method", IN_THE_AIR)
def test_a_faulty_beam_does_not_raise_the_speed(method: Settings, speed: float, bad: float) -> None:
    for beam in range(0, 32, 5):
        made = steering(method, WINGS)
        for tick in range(20):
            scan = sweep(ORIGIN, [], tick, **RING)
            if tick >= 2:
                scan.ranges[beam] = bad
            decision = made.steer(observation_from(ORIGIN, scan, tick), Task((speed, 0.0)))
            assert math.hypot(*decision.velocity) <= speed + 1e-9


def hovering(method: Settings, task: Task, boxes: list[Box]) -> float:
    return math.hypot(*steering(method, WINGS).steer(seen(boxes, **RING), task).velocity)


@pytest.mark.parametrize("method", [Gap(), Vfh()])
@pytest.mark.parametrize("yaw_rate", [0.0, 1e-6, 0.1])
def test_a_hovering_vehicle_goes_on_hovering(method: Settings, yaw_rate: float) -> None:
    for aim, leader in ((None, None), ((3.0, 0.0), None), ((0.02, 0.0), (1.0, 0.0))):
        assert hovering(method, Task((0.0, 0.0), yaw_rate, aim, leader), AHEAD) == 0.0


@pytest.mark.parametrize("method", [Gap(), Vfh()])
def test_a_vehicle_that_keeps_a_place_in_the_air_stays_near_it(method: Settings) -> None:
    """Its place is 2 cm off, an obstacle 0.7 m away: it neither leaves nor hurries."""
    for aside in np.linspace(-math.pi, math.pi, 9):
        aim = 0.02 * math.cos(aside), 0.02 * math.sin(aside)
        assert hovering(method, Task((0.8 * aim[0], 0.8 * aim[1]), 0.0, aim, (1.0, 1.0)), AHEAD) <= 0.017


def test_a_follower_in_the_air_catches_up_in_proportion_to_distance() -> None:
    task = Task((0.1, 0.0), 0.0, (0.5, 0.0), (1.0, 0.0))
    assert hovering(Vfh(level=1), task, AHEAD) == pytest.approx(0.4)


@pytest.mark.parametrize("speed", [0.5, 3.0])
def test_vanished_returns_do_not_raise_a_limited_speed(speed: float) -> None:
    made, task = steering(PotentialField(max_speed=3.0), WINGS), Task((speed, 0.0), max_speed=3.0)
    near = [((2.9 if speed > 1.0 else 1.1, -3.0), (3.5, 3.0))]
    before, after = made.steer(seen(near, **RING), task), made.steer(seen([], 1, **RING), task)
    assert made.level >= 1
    assert math.hypot(*after.velocity) <= math.hypot(*before.velocity) + 1e-9 < speed


class RecordingVfh:
    """Method: Vfh; records the present velocity of each task."""

    def __init__(self) -> None:
        self.now = list[tuple[float, float]]()

    def decide(self, view: View, task: Task) -> Any:
        self.now.append(task.now)
        return Vfh().method(WHEELS, 0.1).decide(view, task)


def test_a_method_receives_the_command_after_all_limits() -> None:
    made, recorder = steering(Vfh()), RecordingVfh()
    made._method = recorder
    wall: list[Box] = [((0.4, -0.1), (0.5, 0.1))]
    for tick in range(3):
        made.drive(seen(wall, tick), (0.5, 0.1), (0.3, 0.0))
    made.limit(seen(wall, 3), (0.02, 0.2))
    last = made.drive(seen(wall, 4), (0.5, 0.1), (0.3, 0.0))
    assert recorder.now[0] == (0.0, 0.0)
    assert recorder.now[1][0] <= 0.4 * (0.4 - 0.23 - 0.03) + 1e-9  # distance 0.4 m, keep 0.23 m
    assert recorder.now[3] == (0.02, 0.2)
    made.steer(observation_from(ORIGIN, None, 5), Task((0.5, 0.0)))
    made.drive(seen(wall, 6), (0.5, 0.1), (0.3, 0.0))
    assert recorder.now[4] == (0.0, 0.0) != (last.velocity[0], last.yaw_rate)


# --- laws of all methods ---

ALL: list[tuple[Settings, Body]] = [
    *((method, body) for method in IN_THE_AIR for body in (ROBOT, DRONE)),
    (DynamicWindow(), ROBOT),
]
BOTH_SIDES = [(each, body, math.pi) for each, body in ALL]
BOTH_SIDES += [(each, body, math.tau) for each, body in ALL if not isinstance(each, Vfh)]  # sectors of Vfh begin at a side
places = st.none() | st.tuples(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0))


@pytest.mark.parametrize(("method", "body"), ALL)
@given(st.floats(-0.1, 0.6), st.floats(-1.2, 1.2), places)
def test_without_near_returns_the_task_is_unchanged(
    method: Settings, body: Body, v: float, w: float, aim: Point | None
) -> None:
    for free_view in (view(np.full(64, math.inf), math.tau), view(np.full(64, 2.0))):
        assert method.method(body, 0.1).decide(free_view, Task((v, 0.0), w, aim)) == ((v, 0.0), w, "task")


@pytest.mark.parametrize(("method", "body"), ALL)
@given(
    scans=st.lists(
        arrays.arrays(float, st.integers(2, 60), elements=st.sampled_from([0.0, 0.3, 1.2, math.inf]) | st.floats(0.0, 4.0)),
        min_size=1,
        max_size=3,
    ),
    fov=st.sampled_from([0.5, math.pi, 4.0, math.tau]),
    speeds=st.tuples(st.floats(-0.1, 1.0), st.floats(-1.0, 1.0), st.floats(-2.0, 2.0)),
    aim=places,
    leader=places,
    most=st.floats(0.1, 3.0),
)
def test_any_scan_gives_a_decision_within_the_limits(
    method: Settings,
    body: Body,
    scans: list[Array],
    fov: float,
    speeds: tuple[float, float, float],
    aim: Point | None,
    leader: Point | None,
    most: float,
) -> None:
    v, across, w = speeds
    made, task = method.method(body, 0.1), Task((v, across if body.flies else 0.0), w, aim, leader, most)
    for ranges in scans:
        (ahead, left), turning, mode = made.decide(view(ranges, fov), task)
        if mode == "task":
            assert ((ahead, left), turning) == (task.velocity, w)
        elif mode == "turn":
            assert (ahead, left, round(abs(turning), 9)) == (0.0, 0.0, 0.6)
        else:
            assert math.hypot(ahead, left) <= most + 1e-9
            assert body.flies or (ahead >= min(v, 0.0) and left == 0.0 and abs(turning) <= 1.2 + 1e-9)


def task_and_mirrored(rng: np.random.Generator, body: Body) -> list[Task]:
    """A task and its mirror image: without aim, with an aim, or behind a leader."""
    (x, y), (lead_x, lead_y), turn, kind = rng.uniform(-2, 2, 2), rng.uniform(-2, 2, 2), rng.normal(), rng.integers(3)
    across = 0.1 if body.flies else 0.0
    return [
        Task((0.3, side * across), side * turn, (x, side * y) if kind else None, (lead_x, side * lead_y) if kind == 2 else None)
        for side in (1, -1)
    ]


@pytest.mark.parametrize(("method", "body", "fov"), BOTH_SIDES)
def test_a_mirrored_scan_gives_the_mirrored_decision(method: Settings, body: Body, fov: float) -> None:
    rng, modes = np.random.default_rng(3), set()
    for number in range(60):
        nearest = 2.5 if number % 10 == 0 else 0.3  # m; few random scans are free
        ranges = np.repeat(rng.uniform(nearest, nearest + 1.7, int(rng.integers(5, 40))), 4)
        other = ranges[::-1] if fov == math.pi else np.roll(ranges[::-1], 1)  # a whole turn begins straight behind
        task, mirrored = task_and_mirrored(rng, body)
        here, there = method.method(body, 0.1), method.method(body, 0.1)
        for k in range(3):
            one, two = here.decide(view(ranges + 0.1 * k, fov), task), there.decide(view(other + 0.1 * k, fov), mirrored)
            modes.add(one.mode)
            assert two.mode == one.mode
            assert (*two.velocity, two.yaw_rate) == pytest.approx((one.velocity[0], -one.velocity[1], -one.yaw_rate), abs=1e-9)
    assert {"task", "avoid"} <= modes


DECIDING = pytest.mark.parametrize(("method", "body"), [(Vfh(), ROBOT), (Vfh(), DRONE), (DynamicWindow(), ROBOT)])


@DECIDING
@pytest.mark.parametrize("ranges", [np.zeros(64), np.full(64, 0.28)])
def test_where_there_is_no_way_it_turns_to_one_side(method: Settings, body: Body, ranges: Array) -> None:
    made = method.method(body, 0.1)
    decisions = [made.decide(view(ranges), Task((0.3, 0.0), 0.0, (2.0, 0.3))) for _ in range(5)]
    assert all(each.velocity == (0.0, 0.0) and each.mode == "turn" for each in decisions)
    assert abs(decisions[0].yaw_rate) == 0.6
    assert len({each.yaw_rate for each in decisions}) == 1


# --- motion around obstacles, on wheels ---

DRIVING = pytest.mark.parametrize("method", [Vfh(), DynamicWindow()])
KEPT_M = ROBOT.radius_m + 0.05 - 0.02  # obstacles between two beams are not seen
DOOR = [((-0.1, -5.0), (0.1, -0.45)), ((-0.1, 0.45), (0.1, 5.0))]
ROOM = [((-0.1, -5.0), (0.1, 5.0)), ((-4.0, -2.0), (0.0, -1.9)), ((-4.0, 1.9), (0.0, 2.0)), ((-4.1, -2.0), (-4.0, 2.0))]


def driven(method: Settings, start: Pose, **options: Any) -> DriveResult:
    return drive(method.method(ROBOT, 0.1), start, to_goal, reached, beams=128, fov=math.pi, **options)


@DRIVING
@pytest.mark.parametrize("start", np.random.default_rng(1).uniform((-3.5, -0.6, -0.6), (-2.5, 0.6, 0.6), (20, 3)).tolist())
def test_it_gets_around_a_pillar_without_dithering(method: Settings, start: list[float]) -> None:
    x, y, yaw = start
    way = driven(method, (x, y, yaw), seconds=100.0)
    assert reached(way.end)
    assert way.clearance > KEPT_M
    modes = [each.mode for each in way.decisions]
    assert isinstance(method, DynamicWindow) or sum(a != b for a, b in pairwise(modes)) <= 4


@DRIVING
@pytest.mark.parametrize(("room", "through"), [(DOOR, True), (ROOM, False)], ids=["a door", "none"])
def test_it_goes_through_a_door_and_touches_nothing_without_one(method: Settings, room: list[Box], through: bool) -> None:
    way = driven(method, (-3.0, 0.3, 0.1), boxes=room)
    assert reached(way.end) if through else way.end[0] < -0.1
    assert way.clearance > KEPT_M


def test_by_vfh_it_gets_around_a_wall() -> None:
    way = driven(Vfh(), (-3.0, 0.3, 0.1), boxes=[((-0.1, -2.0), (0.1, 2.0))])
    assert reached(way.end)
    assert way.clearance > KEPT_M


# --- bearings of beams ---


@pytest.mark.parametrize("first", [0.0, -math.pi, 2.0, 5.0])
def test_of_equal_sides_the_left_one_counts_as_roomier(first: float) -> None:
    assert view([0.5] * 36, math.tau, first).roomier_side(1.4) == 1


@pytest.mark.parametrize("method", [Vfh(), DynamicWindow(), Gap()])
@pytest.mark.parametrize("first", [0.0, -math.pi, 2.9])
def test_where_there_is_no_way_it_turns_to_the_side_with_more_room(method: Settings, first: float) -> None:
    for side in (1, -1):
        walls: list[Box] = [((0.26, -3.0), (0.4, 3.0)), ((-0.4, -3.0), (-0.26, 3.0))]
        near, far = sorted((side * 0.3, side * 0.4)), sorted((-side * 0.8, -side * 0.9))
        walls += [((-3.0, near[0]), (3.0, near[1])), ((-3.0, far[0]), (3.0, far[1]))]
        decision = steering(method).drive(seen(walls, beams=180, fov=math.tau, first=first), (0.3, 0.0))
        assert (decision.mode, decision.velocity[0]) == ("turn", 0.0)
        assert math.copysign(1.0, decision.yaw_rate) == -side


@pytest.mark.parametrize("turns", [-1, 0, 1])
def test_bearings_count_modulo_whole_turns(turns: int) -> None:
    """A scanner that looks back, with a gap in the wanted direction."""
    ranges = np.full(181, 0.8)
    ranges[150:176] = 5.0  # 230 to 255 degrees
    back = view(ranges, first=math.radians(80.0))
    found, places = gaps_ahead(back, math.radians(-118.0) + math.tau * turns, 1.2)
    assert np.degrees(found.bearing).tolist() == pytest.approx([242.5])
    assert np.degrees(places).tolist() == pytest.approx([242.5])
    for bearing in np.radians(range(-360, 361, 7)):
        if back.sees(bearing):
            assert len(gaps_ahead(back, bearing, 1.2)[0].begin) <= 2


# --- slow tasks, and tasks at rest ---


@pytest.mark.parametrize("method", METHODS, ids=NAMES)
def test_a_turn_on_the_spot_has_no_speed(method: Settings) -> None:
    walls = [*AHEAD, ((-1.0, -0.1), (-0.55, 0.1))]
    made = steering(method)
    for tick in range(10):
        assert made.drive(seen(walls, tick, fov=math.tau), (0.0, 0.8), (3.0, 0.0)).velocity[0] == 0.0


@pytest.mark.parametrize("v", [0.0, 0.05])
def test_obstacles_behind_do_not_speed_up_a_robot(v: float) -> None:
    made = steering(PotentialField())
    behind: list[Box] = [((-1.2, -0.25), (-0.7, 0.25))]
    for tick in range(10):
        assert 0.0 <= made.drive(seen(behind, tick, fov=math.tau), (v, 0.8)).velocity[0] <= v


@pytest.mark.parametrize("aside", [0.0, 0.05, 0.1])
def test_between_two_boxes_the_field_does_not_oscillate(aside: float) -> None:
    boxes: list[Box] = [((0.75, 0.1 + aside), (1.25, 0.6 + aside)), ((0.75, -0.6 + aside), (1.25, -0.1 + aside))]
    way, _ = steer_to_goal(PotentialField(), boxes, (6.0, 0.0), seconds=30.0)
    rates = [each.yaw_rate for each in way.decisions if abs(each.yaw_rate) > 0.05]
    assert sum(a * b < 0.0 for a, b in pairwise(rates)) <= 3


def test_a_flying_vehicle_resumes_its_task_beside_obstacles() -> None:
    """It keeps its heading, and its aim is out of view; a vehicle on wheels would first have to see a free way."""
    made = steering(Gap(), WINGS)
    made.steer(seen(AHEAD), Task((0.3, 0.0), 0.0, (3.0, 0.0)))
    beside: list[Box] = [((0.9, -0.9), (1.0, -0.7))]
    assert made.steer(seen(beside, 1), Task((-0.3, 0.0), 0.0, (-3.0, 0.0))).mode == "task"


# --- scanners that change ---


def test_changed_beams_are_accepted_after_half_a_second() -> None:
    made = steering(Gap())
    modes = [made.drive(seen([], beams=2), (0.3, 0.0)).mode]
    modes += [made.drive(seen([], k), (0.3, 0.0)).mode for k in range(1, 10)]
    assert modes == ["task"] + ["blind"] * 5 + ["task"] * 4


def test_beams_that_keep_changing_are_never_accepted() -> None:
    made = steering(Gap())
    modes = {made.drive(seen([], k, beams=100 + k), (0.3, 0.0)).mode for k in range(1, 30)}
    again = made.drive(seen([], 30, beams=101), (0.3, 0.0)).mode
    assert (modes, again) == ({"task", "blind"}, "task")  # the beams of the first scan


def test_a_future_scan_is_not_used() -> None:
    made = steering(Gap())
    modes = [made.drive(observation_from(ORIGIN, sweep(ORIGIN, [], 3), k), (0.3, 0.0)).mode for k in range(5)]
    assert modes == ["blind", "blind", "blind", "task", "task"]


# --- scanners off the middle, or with another field of view ---


@pytest.mark.parametrize("method", METHODS, ids=NAMES)
def test_the_distance_kept_does_not_depend_on_the_place_of_the_scanner(method: Settings) -> None:
    """A wall across the way: if ranges were taken from the middle of the body, it would come nearer by the offset."""
    made, x, wall = AvoidanceSteering(method), 0.0, [((2.0, -5.0), (2.2, 5.0))]
    made.start(info(body=WHEELS, sensors=("scan",), beside_m={"scan": 0.15}))
    for tick in range(300):
        scan = sweep((x - 0.15, 0.0, 0.0), wall, tick)
        x += 0.1 * made.drive(observation_from((x, 0.0, 0.0), scan, tick, 0.3), (0.3, 0.0)).velocity[0]
    assert 2.0 - x >= method.clearance_m(WHEELS) - 1e-9


@pytest.mark.parametrize("method", METHODS, ids=NAMES)
def test_a_robot_moves_slowly_outside_its_field_of_view(method: Settings) -> None:
    made, back = steering(method), seen([], first=0.5 * math.pi)
    assert made.drive(back, (0.6, 0.1)) == ((0.1, 0.0), 0.1, "task")
    assert made.drive(back, (-0.3, 0.0)).velocity == (-0.3, 0.0)
    made = steering(method)
    assert made.drive(seen([]), (-0.3, 0.0)).velocity == (-0.1, 0.0)
    assert made.drive(seen([]), (0.6, 0.0)).velocity == (0.6, 0.0)
