"""The dynamic window: lengths of free arcs, stopping before contact, and acceleration limits."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.agents.obstacle_fields import ROBOT, rooms
from tests.support.agents.scans import view as scan
from vcmvsp.agents.avoidance import DynamicWindow, Task, View
from vcmvsp.agents.avoidance.dynamic_window import clearances
from vcmvsp.cosim.agent import Body
from vcmvsp.cosim.types import Array

pytestmark = pytest.mark.slow

KEEP = 0.266
PERIOD_S, BRAKING = 0.1, 0.3


def points_of(view: View) -> Array:
    hits = np.isfinite(view.ranges)
    return view.units[hits] * view.ranges[hits, None]


def along(curvature: float, length: float, step: float = 2e-4) -> Array:
    """Places on an arc, (n, 2)."""
    ways = np.arange(0.0, length + step, step)
    half = 0.5 * curvature * ways
    chord = ways * np.sinc(half / math.pi)
    return np.column_stack([chord * np.cos(half), chord * np.sin(half)])


def stopping_m(v: float) -> float:
    return v * PERIOD_S + v * v / (2.0 * BRAKING)


@settings(max_examples=75)
@given(st.integers(0, 2**32), st.sampled_from((0.0, 1e-12, -1e-6, 0.01)) | st.floats(-8.0, 8.0), st.floats(0.05, 0.6))
def test_free_arc_lengths_agree_with_small_steps(seed: int, curvature: float, keep: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.5, 1.5, (12, 2))
    points = points[np.hypot(*points.T) > keep + 1e-3]
    length = 1.5 if curvature == 0.0 else min(1.5, math.tau / abs(curvature))
    places = along(curvature, length)
    apart = np.hypot(*(places[:, None, :] - points).T).min(axis=0, initial=math.inf)
    touched = np.flatnonzero(apart < keep)
    found = float(clearances(points, np.array([curvature]), keep)[0])
    if len(touched):
        assert found == pytest.approx(2e-4 * touched[0], abs=1e-3)
    elif apart.min() > keep + 1e-6:
        assert found > length - 1e-3


@settings(max_examples=8)
@given(st.integers(0, 2**32), st.floats(-3.0, 3.0))
def test_many_arcs_at_once_equal_single_arcs(seed: int, turned: float) -> None:
    points = np.random.default_rng(seed).uniform(-1.5, 1.5, (30, 2))
    curvatures = np.linspace(-4.0, 4.0, 23) + turned
    alone = [min(float(clearances(point[None], np.array([k]), KEEP)[0]) for point in points) for k in curvatures]
    assert clearances(points, curvatures, KEEP) == pytest.approx(alone)


def test_a_touched_obstacle_stops_approach_and_not_departure() -> None:
    for x, departs in ((0.1, False), (-0.1, True)):
        free = float(clearances(np.array([[x, 0.05]]), np.zeros(1), KEEP)[0])
        assert free > 1e6 if departs else free == 0.0
    assert clearances(np.array([[0.0, 0.2]]), np.array([5.0, 100.0]), KEEP).tolist() == [0.0, 0.0]  # on a circle around it, too
    assert clearances(np.empty((0, 2)), np.array([0.0, 1.0]), KEEP).tolist() == [math.inf, math.inf]


@settings(max_examples=75)
@given(
    st.integers(0, 2**32), st.floats(0.0, 0.6), st.floats(-1.0, 1.0), st.floats(-1.5, 1.5), st.sampled_from((math.pi, math.tau))
)
def test_every_command_allows_a_stop_before_contact(seed: int, v: float, w: float, y: float, fov: float) -> None:
    method, now = DynamicWindow().method(ROBOT, PERIOD_S), (v, w)
    view = scan(rooms(seed), fov)
    for _ in range(3):
        decision = method.decide(view, Task((v, 0.0), w, (2.0, y), now=now))
        now = decision.velocity[0], decision.yaw_rate
        speed = decision.velocity[0]
        assert speed >= 0.0
        assert decision.velocity[1] == 0.0
        if speed > 1e-6:
            places = along(decision.yaw_rate / speed, stopping_m(speed), 1e-3)
            assert np.hypot(*(places[:, None, :] - points_of(view)).T).min() > KEEP - 1e-3


@given(st.integers(0, 2**32))
def test_commands_stay_within_the_acceleration_window(seed: int) -> None:
    set_to = DynamicWindow()
    method, ranges = set_to.method(ROBOT, PERIOD_S), rooms(seed) + 0.3
    last = method.decide(scan(np.full(181, math.inf)), Task((0.3, 0.0), 0.2, (2.0, 0.0)))
    for k in range(5):
        task = Task((0.3, 0.0), 0.2, (2.0, 0.0), (2.0, 0.0), now=(last.velocity[0], last.yaw_rate))  # with a leader
        now = method.decide(scan(ranges - 0.02 * k), task)
        if now.mode == "avoid":
            assert abs(now.velocity[0] - last.velocity[0]) <= set_to.acceleration * PERIOD_S + 1e-12
            assert abs(now.yaw_rate - last.yaw_rate) <= set_to.turn_acceleration * PERIOD_S + 1e-12
        last = now


def test_flying_vehicles_are_refused() -> None:
    with pytest.raises(ValueError, match='"dynamic_window" is for vehicles on wheels'):
        DynamicWindow().method(Body(width_m=0.5, radius_m=0.25, flies=True), PERIOD_S)
