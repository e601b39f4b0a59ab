import math
from collections.abc import Sequence
from itertools import pairwise

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.agents.obstacle_fields import PILLAR, ROBOT, Box, DriveResult, clearance, drive, look
from tests.support.agents.scans import Point, Pose, view
from vcmvsp.agents.avoidance import PotentialField, Task, View
from vcmvsp.agents.avoidance.method import Method
from vcmvsp.agents.avoidance.potential_field import repulsion
from vcmvsp.agents.formation.followers.laws import axle_velocity
from vcmvsp.cosim.agent import Body
from vcmvsp.cosim.frames import rotate2, wrap

pytestmark = pytest.mark.slow

AIR = Body(width_m=0.4, radius_m=0.25, flies=True)
REACH, CORE = 1.2, 0.6
MM = 0.001
RANGES = st.one_of(st.floats(0.0, 3.0), st.just(math.inf))


def field(body: Body = AIR, **settings: float) -> Method:
    return PotentialField(**settings).method(body, 0.1)  # type: ignore[arg-type]


def seen(ranges: list[float]) -> View:
    return view(ranges, math.tau, 0.0)


def one(range_m: float, beam: int = 0, beams: int = 32) -> View:
    """A single return."""
    return seen([range_m if i == beam else math.inf for i in range(beams)])


def ahead(speed: float, max_speed: float = 0.6) -> Task:
    return Task((speed, 0.0), max_speed=max_speed)


def drive_to(
    goal: Point, start: Pose, boxes: Sequence[Box] = (PILLAR,), *, beams: int = 128, fov: float = math.tau
) -> tuple[DriveResult, bool]:
    """A robot's path to a goal, and whether it arrived: it turns towards the goal, at a speed of 0.3 m/s cos(bearing)."""

    def task(pose: Pose) -> Task:
        bearing = wrap(math.atan2(goal[1] - pose[1], goal[0] - pose[0]) - pose[2])
        return Task((0.3 * max(0.0, math.cos(bearing)), 0.0), max(-0.8, min(0.8, 1.5 * bearing)))

    way = drive(field(ROBOT), start, task, lambda pose: math.dist(pose[:2], goal) < 0.1, boxes=boxes, beams=beams, fov=fov)
    return way, math.dist(way.end[:2], goal) < 0.1


# The force


@pytest.mark.parametrize(("range_m", "push"), [(0.9, 1.0), (0.7, 5.0), (1.1, 0.2), (1.2, 0.0), (2.0, 0.0), (math.inf, 0.0)])
def test_one_beam_of_32_pushes_as_printed(range_m: float, push: float) -> None:
    x, y, most = repulsion(one(range_m), REACH, CORE)
    assert (x, y, most) == pytest.approx((-push, 0.0, push), abs=1e-12)


@pytest.mark.parametrize("range_m", [0.65, 0.6, 0.3, 0.0, math.nan, -math.inf])
def test_at_the_core_and_inside_it_the_push_is_11(range_m: float) -> None:
    x, y, most = repulsion(one(range_m, beam=8), REACH, CORE)
    assert (x, y, most) == pytest.approx((0.0, -11.0, 11.0), abs=1e-12)


@given(ranges=st.lists(RANGES, min_size=2, max_size=64))
def test_the_push_is_at_most_11_for_each_of_32_beams(ranges: list[float]) -> None:
    x, y, most = repulsion(seen(ranges), REACH, CORE)
    assert math.hypot(x, y) <= most * (1 + 1e-12) <= 11 * 32 * (1 + 1e-9)


@given(ranges=st.lists(RANGES, min_size=3, max_size=64), by=st.integers(0, 63))
def test_a_turned_scan_pushes_the_turned_way(ranges: list[float], by: int) -> None:
    n = len(ranges)
    x, y, _ = repulsion(seen(ranges), REACH, CORE)
    turned = repulsion(seen([ranges[(i - by) % n] for i in range(n)]), REACH, CORE)
    assert turned[:2] == pytest.approx(rotate2(x, y, by * math.tau / n), abs=1e-9)


def test_the_push_depends_on_the_angle_filled_and_not_on_the_resolution() -> None:
    pushes = [repulsion(look((-1.1, 0.05, 0.0), [PILLAR], beams=n), REACH, CORE)[:2] for n in (512, 1024, 4096)]
    assert pushes[0] == pytest.approx(pushes[2], rel=0.03)
    assert pushes[1] == pytest.approx(pushes[2], rel=0.015)


def test_the_push_of_an_obstacle_does_not_depend_on_the_field_of_view() -> None:
    whole = repulsion(look((-1.1, 0.05, 0.0), [PILLAR], beams=512), REACH, CORE)
    half = repulsion(look((-1.1, 0.05, 0.0), [PILLAR], beams=257, fov=math.pi), REACH, CORE)
    behind = repulsion(look((-1.1, 0.05, math.pi), [PILLAR], beams=257, fov=math.pi), REACH, CORE)
    assert half == pytest.approx(whole, rel=1e-9)
    assert behind == (0.0, 0.0, 0.0)


# In the air


@pytest.mark.parametrize("c", [0.5, 1.0, 3.0])
def test_cruise_balances_at_the_closed_form(c: float) -> None:
    balance = (REACH + c * CORE) / (1 + c)
    decision = field(tang=0.0).decide(one(balance), ahead(0.1 * c))
    assert decision.velocity == pytest.approx((0.0, 0.0), abs=1e-12)
    assert field(tang=0.0).decide(one(balance + 0.01), ahead(0.1 * c)).velocity[0] > 0.0
    assert field(tang=0.0).decide(one(balance - 0.01), ahead(0.1 * c)).velocity[0] < 0.0


def test_the_side_is_kept_until_nothing_is_in_reach() -> None:
    left, right, free = one(0.9, beam=1), one(0.9, beam=31), one(math.inf)
    fresh = {view is left: field().decide(view, ahead(0.3)).velocity[1] for view in (left, right)}
    assert fresh[True] < 0.0 < fresh[False]  # past the obstacle on the nearer side
    method = field()
    assert method.decide(left, ahead(0.3)).velocity[1] == fresh[True]
    assert method.decide(right, ahead(0.3)).velocity[1] < 0.0  # the side chosen first
    method.decide(free, ahead(0.3))
    assert method.decide(right, ahead(0.3)).velocity[1] == fresh[False]


def test_straight_ahead_is_passed_on_the_right() -> None:
    assert field().decide(one(0.9), ahead(0.3)).velocity == pytest.approx((0.2, -0.1), abs=1e-12)


def test_a_vehicle_that_hovers_is_pushed_to_the_edge_of_the_reach_and_rests() -> None:
    method, x, y, vx, vy = field(), -0.5, 0.0, 0.0, 0.0
    for _ in range(600):
        x, y = x + 0.1 * vx, y + 0.1 * vy
        vx, vy = method.decide(look((x, y, 0.0), [PILLAR]), Task((0.0, 0.0))).velocity
    assert clearance((x, y), [PILLAR]) == pytest.approx(REACH, abs=0.01)
    assert math.hypot(vx, vy) < 1e-5


# On wheels


def test_the_hand_of_a_robot_moves_like_a_vehicle_in_the_air() -> None:
    view, task = one(1.0, beam=2), Task((0.3, 0.0), 0.2)
    hand = field().decide(view, Task((0.3, 0.2 * ROBOT.radius_m))).velocity
    v, w = axle_velocity(*hand, 0.0, ROBOT.radius_m)
    decision = field(ROBOT).decide(view, task)
    assert (*decision.velocity, decision.yaw_rate) == pytest.approx((v, 0.0, w))
    assert decision.mode == "avoid"


def test_a_robot_that_stands_remains_standing() -> None:
    assert field(ROBOT).decide(one(0.3), Task((0.0, 0.0))) == ((0.0, 0.0), 0.0, "task")


@pytest.mark.parametrize("side", [1, -1])
def test_a_robot_that_is_pushed_back_turns_on_the_spot_one_way_until_it_can_go(side: int) -> None:
    start = (-0.9, 0.05 * side, 0.0)
    way = drive(field(ROBOT, tang=0.0), start, lambda pose: ahead(0.3), lambda pose: pose[0] > 4.0, seconds=20.0)
    modes = [decision.mode for decision in way.decisions]
    turns = modes.index("avoid")
    assert modes == ["turn"] * turns + ["avoid"] * modes.count("avoid") + ["task"] * modes.count("task")
    assert {decision.yaw_rate for decision in way.decisions[:turns]} == {0.6 * side}
    assert way.decisions[-1].mode == "task"  # out of reach
    assert way.clearance == pytest.approx(0.65, abs=MM)  # no nearer than at the start


@pytest.mark.parametrize(("beams", "fov"), [(32, math.tau), (512, math.tau), (181, math.pi)])
@pytest.mark.parametrize("y0", [-0.3, 0.0, 0.1])
def test_a_robot_gets_around_a_pillar_without_entering_its_core(beams: int, fov: float, y0: float) -> None:
    way, there = drive_to((4.0, 0.0), (-3.0, y0, 0.0), beams=beams, fov=fov)
    assert there
    assert way.seconds < 32.0
    assert way.clearance > CORE
    modes = [decision.mode for decision in way.decisions]
    assert sum(a != b for a, b in pairwise(modes)) == 2  # around it once, without wavering


def gate(width: float) -> list[Box]:
    """A wall of 10 m with one gate."""
    return [((-0.1, width / 2), (0.1, 5.0)), ((-0.1, -5.0), (0.1, -width / 2))]


@pytest.mark.parametrize(("width", "through"), [(0.9, False), (1.2, False), (1.6, True)])
@pytest.mark.parametrize("y0", [0.0, 0.3])
def test_a_gate_hardly_wider_than_the_reach_is_closed_and_safe(width: float, y0: float, through: bool) -> None:
    way, there = drive_to((4.0, 0.0), (-3.0, y0, 0.0), gate(width))
    assert there == through
    assert way.clearance > CORE


# The table


def test_it_is_read_from_a_scenario_with_its_defaults() -> None:
    settings = msgspec.convert({"kind": "potential_field"}, PotentialField)
    assert settings == PotentialField(reach=1.2, core=0.6, gain=0.1, tang=1.0)
    assert (settings.reach_m, settings.clearance_m(AIR)) == (1.2, 0.6)
    assert settings.clearance_m(Body(width_m=2.0, radius_m=1.0)) == 1.05


def test_a_reach_within_the_core_is_refused() -> None:
    with pytest.raises(msgspec.ValidationError, match=r"reach must be greater than core \+ 0\.05 m = 0\.85 m, not 0\.8 m"):
        msgspec.convert({"kind": "potential_field", "reach": 0.8, "core": 0.8}, PotentialField)
