"""VFH+: enlargement of obstacles, blocked sectors and their duration, and the chosen direction."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.agents.obstacle_fields import DRONE, ROBOT
from tests.support.agents.scans import view as scan
from vcmvsp.agents.avoidance import Task, Vfh, View
from vcmvsp.agents.avoidance.vfh import _Vfh, histogram, openings
from vcmvsp.cosim.frames import wrap

pytestmark = pytest.mark.slow

AHEAD = Task((0.3, 0.0))


def posts(*places: tuple[float, float], beams: int = 361, fov: float = math.tau) -> View:
    """Thin posts at (distance, bearing), each on the nearest beam."""
    view = scan(np.full(beams, math.inf), fov)
    ranges = view.ranges.copy()
    for distance, bearing in places:
        ranges[int(np.abs((view.bearings - bearing + math.pi) % math.tau - math.pi).argmin())] = distance
    return view._replace(ranges=ranges)


@given(st.floats(0.05, 3.0), st.floats(-math.pi, math.pi), st.floats(0.1, 0.8), st.sampled_from((36, 72, 128)))
def test_an_obstacle_blocks_the_directions_in_which_a_disc_touches_it(
    distance: float, bearing: float, keep: float, sectors: int
) -> None:
    near = histogram(scan([distance, math.inf], 1.0, bearing), keep, sectors)
    for k in range(sectors):
        off = abs(wrap(math.tau * k / sectors - bearing))
        aside = distance * math.sin(off)  # distance of the post from the axis of the disc's way
        if abs(aside - keep) < 1e-9 or abs(off - math.pi / 2) < 1e-9:
            continue
        touches = off < math.pi / 2 and aside < keep
        assert near[k] == (distance if touches else math.inf)


@given(st.lists(st.booleans(), min_size=8, max_size=40))
def test_openings_are_the_runs_of_free_sectors_around_the_turn(free: list[bool]) -> None:
    found = [[(first + k) % len(free) for k in range(count)] for first, count in openings(np.array(free))]
    assert sorted(k for run in found for k in run) == [k for k, each in enumerate(free) if each]
    if not all(free):
        for run in found:
            assert not free[run[0] - 1]
            assert not free[(run[-1] + 1) % len(free)]


def test_a_sector_is_blocked_from_near_and_freed_from_afar() -> None:
    method = Vfh(blocked_m=1.2, freed_m=1.4).method(DRONE, 0.1)
    modes = [method.decide(posts((distance, 0.0)), AHEAD).mode for distance in (1.3, 1.1, 1.3, 1.39, 1.41, 1.3)]
    assert modes == ["task", "avoid", "avoid", "avoid", "task", "task"]


def test_a_wide_opening_is_entered_forty_degrees_beside_its_edge() -> None:
    view = posts((1.0, 0.0), beams=360)
    decision = Vfh(keep_m=0.49).method(DRONE, 0.1).decide(view, AHEAD)  # blocked to 29.3 degrees: the first free one is at 30
    assert abs(math.degrees(math.atan2(decision.velocity[1], decision.velocity[0]))) == pytest.approx(70.0)
    assert math.hypot(*decision.velocity) == pytest.approx(0.3)


def test_a_narrow_opening_is_entered_in_its_middle() -> None:
    view = posts((1.0, math.radians(-60.0)), (1.0, math.radians(80.0)), (1.0, 0.2 + math.pi), beams=360, fov=math.tau)
    decision = Vfh(keep_m=0.9, wide_deg=200.0).method(DRONE, 0.1).decide(view, AHEAD)  # each blocks 64 degrees on either side
    assert math.degrees(math.atan2(decision.velocity[1], decision.velocity[0])) == pytest.approx(10.0, abs=3.0)


def test_it_keeps_to_the_side_it_has_chosen() -> None:
    method = Vfh().method(DRONE, 0.1)
    first = method.decide(posts((1.0, 0.05)), AHEAD).velocity[1]  # slightly on the left: past it on the right
    assert first < 0.0
    assert method.decide(posts((1.0, -0.05)), AHEAD).velocity[1] < 0.0
    assert Vfh().method(DRONE, 0.1).decide(posts((1.0, -0.05)), AHEAD).velocity[1] > 0.0


def test_blocked_sectors_keep_their_place_while_the_vehicle_turns() -> None:
    """A post seen once near, then between both thresholds, from a robot that turns as commanded."""
    method = Vfh().method(ROBOT, 0.1)
    bearing, now = 0.0, (0.0, 0.0)
    for _ in range(8):
        decision = method.decide(posts((1.1 if bearing == 0.0 else 1.3, bearing), beams=720), AHEAD._replace(now=now))
        assert decision.mode == "avoid"
        now = decision.velocity[0], decision.yaw_rate
        bearing -= 0.1 * decision.yaw_rate


def test_the_previous_direction_keeps_its_place_while_the_vehicle_turns() -> None:
    method = Vfh().method(ROBOT, 0.1)
    assert isinstance(method, _Vfh)
    rate = method.decide(posts((1.0, 0.1)), AHEAD).yaw_rate
    before = method._previous
    method.decide(posts((1.0, 0.1)), Task((0.0, 0.0), now=(0.0, rate)))
    assert rate < 0.0
    assert method._previous == pytest.approx(before - 0.1 * rate)


def test_a_moving_robot_does_not_turn_past_obstacles_on_its_circle() -> None:
    beside = posts((0.9, math.radians(-40.0)), beams=361, fov=math.pi)
    right = Task((0.6, 0.0), -0.8, (0.3, -1.7))  # aim at -80 degrees
    assert Vfh().method(ROBOT, 0.1).decide(beside, right).mode == "task"  # at rest
    moving = right._replace(now=(0.6, 0.0))  # at 0.6 m/s and 1.2 rad/s the radius is 0.5 m
    decision = Vfh().method(ROBOT, 0.1).decide(beside, moving)
    assert decision.mode == "avoid"
    assert decision.yaw_rate > -1.5 * math.radians(40.0)


def test_inconsistent_settings_are_refused() -> None:
    with pytest.raises(ValueError, match=r"freed_m = 1 must not be less than blocked_m = 1.2"):
        Vfh(freed_m=1.0).method(ROBOT, 0.1)
    with pytest.raises(ValueError, match=r"blocked_m = 1.2 must exceed the distance kept from obstacles, 1.5 m"):
        Vfh(keep_m=1.5).method(ROBOT, 0.1)
