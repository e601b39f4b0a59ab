"""A leader along a way: it reaches every point, within the speed limits and close to the line."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.support.agents.agent_loop import Floats, Pose, Vehicle, bodies, info, observe, present
from vcmvsp.agents.formation.leaders.route import Point, Route
from vcmvsp.cosim.agent import Radio

T = 0.1


@dataclass
class Tour:
    """Records of every tick, before its command."""

    poses: Floats  # (ticks, 3)
    commands: Floats  # (ticks, 2), v and w
    points: list[int]  # number of the next point
    reports: list[dict[str, Any]]
    notes: list[dict[str, Any]]


def tour(agent: Route, duration_s: float, pose: Pose = (0.0, 0.0, 0.0), tau: tuple[float, float] = (0.0, 0.0)) -> Tour:
    agent.start(info("car1", ("car1", "car2")))
    car, radio = Vehicle(pose, 0.0, 0.0, *tau), Radio("car1", ("car1", "car2"))
    done = Tour(np.empty(0), np.empty(0), [], [], [])
    poses, commands = [], []
    for tick in range(round(duration_s / T)):
        command = agent.act(observe(car.pose, round(tick * T * 1e9), v=car.v, w=car.w), radio)
        poses.append(car.pose)
        commands.append((command.linear[0], command.yaw_rate))
        done.points.append(present(agent._stage).number)
        done.notes.append(agent.drain_notes())
        done.reports += bodies(radio)
        car.move(command, T)
    done.poses, done.commands = np.array(poses), np.array(commands)
    return done


def distances_to_line(done: Tour, way: Sequence[Point]) -> Floats:
    """Distance of the vehicle from its present line, m, at every tick until arrival."""
    corners = np.array([done.poses[0, :2], *way])
    apart = []
    for place, point in zip(done.poses[:, :2], done.points, strict=True):
        if point == len(way):
            break
        start, end = corners[point], corners[point + 1]
        share = np.clip((place - start) @ (end - start) / max((end - start) @ (end - start), 1e-12), 0.0, 1.0)
        apart.append(np.hypot(*(place - start - share * (end - start))))
    return np.array(apart)


POINTS = st.tuples(st.floats(-3, 3), st.floats(-3, 3))


@settings(max_examples=30)
@given(
    way=st.lists(POINTS, min_size=1, max_size=4),
    yaw=st.floats(-math.pi, math.pi),
    speed=st.floats(0.1, 1.0),
    arrive_m=st.floats(0.03, 0.3),
    lookahead_m=st.floats(0.3, 1.5),
)
def test_all_points_are_reached_within_the_limits(
    way: list[Point], yaw: float, speed: float, arrive_m: float, lookahead_m: float
) -> None:
    agent = Route(tuple(way), speed=speed, yaw_rate=1.0, arrive_m=arrive_m, lookahead_m=lookahead_m)
    length = sum(math.dist(a, b) for a, b in zip([(0.0, 0.0), *way], way, strict=False))
    # Twice the time at full speed, half a turn at each point, and the end: ever slower down to its tolerance.
    done = tour(agent, 2.0 * length / speed + 5.0 * (len(way) + 1) + 5.0 * math.log(10.0 / arrive_m), (0.0, 0.0, yaw))
    for number, point in enumerate(way):
        nearest = min(math.dist(place, point) for place in done.poses[:, :2])
        assert nearest <= arrive_m, (number, point)
    assert done.points == sorted(done.points)
    assert done.points[-1] == len(way)
    assert done.commands[-1] == pytest.approx((0.0, 0.0))
    assert math.dist(done.poses[-1, :2], way[-1]) <= arrive_m
    v, w = done.commands.T
    assert v.min() >= 0.0
    assert v.max() <= speed
    assert np.abs(w).max() <= 1.0
    # A line begins within arrive_m of its start. From a heading error th0 <= 0.8 rad the lateral offset of linearised pure
    # pursuit is y = th0 l e^(-s/l) sin(s/l) after s metres, greatest at s = l pi / 4; sampling adds the way of one period.
    aside = 0.8 * lookahead_m * math.exp(-math.pi / 4) * math.sin(math.pi / 4)
    assert distances_to_line(done, way).max(initial=0.0) <= arrive_m + aside + speed * T


def test_on_a_straight_line_it_drives_at_its_speed_and_slows_down_evenly_at_the_end() -> None:
    done = tour(Route(((5.0, 0.0),), deceleration=0.05, arrive_m=0.02), 40.0)
    v, x = done.commands[:, 0], done.poses[:, 0]
    braking = 0.3**2 / (2 * 0.05)
    assert v[x < 5.0 - braking - 1e-9] == pytest.approx(0.3, abs=1e-9)
    slowing = (x > 5.0 - braking) & (x < 4.9)
    assert v[slowing] == pytest.approx(np.sqrt(2 * 0.05 * (5.0 - x[slowing])), abs=1e-9)
    assert np.abs(done.poses[:, 1:]).max() == 0.0
    assert 4.98 <= x[-1] <= 5.0


def test_it_returns_to_the_line() -> None:
    """After a corner cut by less than arrive_m, with a servo lag."""
    done = tour(Route(((3.0, 0.0), (3.0, 6.0)), arrive_m=0.25), 45.0, tau=(0.5, 0.3))
    on_second = np.array([n == 1 for n in done.points])
    apart = np.abs(done.poses[on_second, 0] - 3.0)
    assert apart.max() > 0.1
    assert apart[-50:].max() < 0.01


def test_it_turns_on_the_spot_to_a_point_behind() -> None:
    done = tour(Route(((-2.0, 0.1),)), 15.0)
    turning = done.commands[:, 0] == 0.0
    first = int(np.argmin(turning))
    assert first > 20
    assert np.abs(done.poses[:first, :2]).max() == 0.0
    assert np.abs(done.commands[:first, 1]).max() == 0.8
    assert done.points[-1] == 1


def test_a_loop_goes_round_and_round() -> None:
    square = ((2.0, 0.0), (2.0, 2.0), (0.0, 2.0), (0.0, 0.0))
    done = tour(Route(square, loop=True), 120.0)
    visits = [b for a, b in zip(done.points, done.points[1:], strict=False) if a != b]
    assert len(visits) >= 12
    assert visits == [(1 + i) % 4 for i in range(len(visits))]
    assert done.commands[-20:, 0].max() > 0.2


def test_points_on_one_spot_do_not_hang() -> None:
    done = tour(Route(((1.0, 0.0), (1.0, 0.0), (1.05, 0.0)), loop=True), 20.0)
    assert np.hypot(*(done.poses[-1, :2] - (1.0, 0.0))) < 0.2


def test_its_next_point_is_noted() -> None:
    notes = tour(Route(((0.5, 0.0), (1.0, 0.0))), 8.0).notes
    assert notes[0] == {"point": 0.0}
    assert [note["point"] for note in notes if "point" in note] == [0.0, 1.0, 2.0]
    assert notes[-1] == {"status": "arrived"}
    arrived = ["status" in note for note in notes]
    assert arrived == sorted(arrived)
    assert not arrived[30]  # 0.9 m on


@given(way=st.lists(POINTS, min_size=1, max_size=3), yaw=st.floats(-3, 3))
@settings(max_examples=15)
def test_plans_are_carried_out(way: list[Point], yaw: float) -> None:
    """Without noise and lag the plan of a report equals the later commands."""
    assume(math.dist(way[0], (0.0, 0.0)) > 0.2)
    done = tour(Route(tuple(way), estimator="plan"), 12.0, (0.0, 0.0, yaw))
    for tick in range(0, len(done.reports) - 21, 7):
        plan = np.array(done.reports[tick]["plan"]).reshape(-1, 2)
        np.testing.assert_allclose(plan, done.commands[tick + 1 : tick + 21], atol=1e-9)


def test_an_empty_way_is_refused() -> None:
    with pytest.raises(ValueError, match="way needs at least one point"):
        Route(())
