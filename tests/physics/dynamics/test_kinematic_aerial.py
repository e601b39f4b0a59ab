"""Vehicles in the air without a body against closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Vec3
from vcmvsp.physics.dynamics.kinematic import AerialEngine
from vcmvsp.physics.vehicles.models import Point, Quadrotor

numbers = st.floats(-4.0, 4.0)
places = st.tuples(numbers, numbers, numbers)
spans = st.integers(1, 4 * SECOND_NS)


def engine(*models: Point | Quadrotor, at: Vec3 = (0.0, 0.0, 2.0), heading: float = 0.0) -> AerialEngine:
    return AerialEngine(models, [at] * len(models), [heading] * len(models))


def yaw(moved: AerialEngine) -> float:
    w, _, _, z = moved.read().attitude[0].tolist()
    return 2.0 * math.atan2(z, w)


@given(velocity=places, span_ns=spans)
def test_without_lag_it_moves_exactly_as_commanded(velocity: Vec3, span_ns: int) -> None:
    for model in (Point(max_climb=9.0), Quadrotor(max_climb=9.0)):
        moved = engine(model)
        moved.command(0, velocity, 0.2)
        moved.advance(span_ns)
        span_s = span_ns / SECOND_NS
        assert moved.read().position[0] == pytest.approx(np.array([0.0, 0.0, 2.0]) + np.array(velocity) * span_s, abs=1e-12)
        assert moved.read().velocity[0] == pytest.approx(velocity)
        assert yaw(moved) == pytest.approx(0.2 * span_s)
        assert moved.read().angular_velocity[0] == pytest.approx((0.0, 0.0, 0.2))


def test_the_lag_is_exponential() -> None:
    moved = engine(Point(tau_s=0.4))
    moved.command(0, (2.0, -1.0, 0.5), 0.0)
    for t in (0.1, 0.37, 0.9, 3.0):
        moved.advance(round(t * SECOND_NS))
        share, way = 1.0 - math.exp(-t / 0.4), t - 0.4 * (1.0 - math.exp(-t / 0.4))
        assert moved.read().velocity[0] == pytest.approx((2.0 * share, -share, 0.5 * share), abs=1e-12)
        assert moved.read().position[0] == pytest.approx((2.0 * way, -way, 2.0 + 0.5 * way), abs=1e-12)
        assert moved.read().acceleration[0] == pytest.approx(np.array((2.0, -1.0, 0.5)) * (1.0 - share) / 0.4, abs=1e-12)


@given(place=places, speed=st.floats(0.2, 9.0), tau=st.sampled_from([0.0, 0.4, 1.3]), velocity=places)
def test_a_way_point_is_reached_from_any_motion_and_kept(place: Vec3, speed: float, tau: float, velocity: Vec3) -> None:
    moved = engine(Point(tau_s=tau))
    moved.command(0, velocity, 0.0)
    moved.advance(SECOND_NS)
    moved.go_to(0, place, 1.0, speed)
    moved.advance(300 * SECOND_NS)
    assert moved.read().position[0] == pytest.approx(place, abs=1e-9)
    assert moved.read().velocity[0] == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    assert yaw(moved) == pytest.approx(1.0, abs=1e-9)


@given(place=places, speed=st.floats(0.2, 9.0), cuts=st.lists(spans, max_size=6), span_ns=spans)
@pytest.mark.parametrize("tau", [0.0, 0.4])
def test_looking_in_between_changes_nothing(tau: float, place: Vec3, speed: float, cuts: list[int], span_ns: int) -> None:
    once, often = engine(Point(tau_s=tau)), engine(Point(tau_s=tau))
    for moved in (once, often):
        moved.command(0, (1.0, 0.5, 0.0), -0.3)
        moved.advance(SECOND_NS // 3)
        moved.go_to(0, place, 2.0, speed)
    for cut in sorted(SECOND_NS // 3 + cut for cut in cuts if cut < span_ns):
        often.advance(cut)
    once.advance(SECOND_NS // 3 + span_ns)
    often.advance(SECOND_NS // 3 + span_ns)
    assert often.read().position == pytest.approx(once.read().position, abs=1e-10)
    assert often.read().attitude == pytest.approx(once.read().attitude, abs=1e-10)


def test_the_way_to_a_way_point_is_straight_and_takes_as_long_as_its_speed_says() -> None:
    moved = engine(Point())
    moved.go_to(0, (3.0, 4.0, 2.0), None, 2.0)
    for k in range(1, 25):
        moved.advance(k * SECOND_NS // 10)
        x, y, z = moved.read().position[0].tolist()
        assert (x, y, z) == pytest.approx((0.12 * k, 0.16 * k, 2.0))
        assert moved.read().velocity[0] == pytest.approx((1.2, 1.6, 0.0))
    moved.advance(26 * SECOND_NS // 10)
    assert moved.read().velocity[0] == pytest.approx((0.0, 0.0, 0.0))
    climbing = engine(Point(max_climb=0.5))
    climbing.go_to(0, (1.0, 0.0, 4.0), None, None)
    climbing.advance(2 * SECOND_NS)
    assert climbing.read().position[0] == pytest.approx((0.5, 0.0, 3.0))  # together, at the slower one's pace


def test_greatest_speeds_are_kept_in_the_commanded_direction() -> None:
    moved = engine(Point(max_speed=5.0, max_climb=2.0, max_yaw_rate=1.0))
    moved.command(0, (30.0, 40.0, 9.0), -7.0)
    moved.advance(SECOND_NS)
    assert moved.read().velocity[0] == pytest.approx((3.0, 4.0, 2.0))
    assert moved.read().angular_velocity[0] == pytest.approx((0.0, 0.0, -1.0))


def test_it_turns_the_shorter_way() -> None:
    moved = engine(Point(max_yaw_rate=0.5), heading=3.0)
    moved.go_to(0, (0.0, 0.0, 2.0), -3.0, None)
    moved.advance(SECOND_NS // 10)
    assert moved.read().angular_velocity[0, 2] == pytest.approx(0.5)
    moved.advance(SECOND_NS)
    assert math.cos(yaw(moved) + 3.0) == pytest.approx(1.0)


def test_a_fleet_moves_as_each_of_it_alone() -> None:
    models: list[Point | Quadrotor] = [Point(), Point(tau_s=0.4), Point(tau_s=1.0, max_speed=1.0), Quadrotor()]
    fleet, alone = engine(*models), [engine(model) for model in models]
    draws = np.random.default_rng(3).uniform(-3.0, 3.0, (20, len(models), 4))
    for k, wanted in enumerate(draws, 1):
        for number, (x, y, z, w) in enumerate(wanted.tolist()):
            for moved, row in ((fleet, number), (alone[number], 0)):
                if (k + number) % 3:
                    moved.command(row, (x, y, z), w)
                else:
                    moved.go_to(row, (x, y, z), w, None)
        for moved in (fleet, *alone):
            moved.advance(k * SECOND_NS // 10)
    for number, moved in enumerate(alone):
        assert fleet.read().position[number] == pytest.approx(moved.read().position[0], abs=1e-12)
        assert fleet.read().attitude[number] == pytest.approx(moved.read().attitude[0], abs=1e-12)
