"""Vehicles without bodies against closed forms and against numerical integration of their equations."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.step_responses import overshoot, servo_step
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.frames import arc, wrap
from vcmvsp.cosim.types import Vec3
from vcmvsp.physics.dynamics.kinematic import AerialEngine, GroundEngine
from vcmvsp.physics.federate import KinematicPhysics
from vcmvsp.physics.vehicles.models import P2DX, AmigoBot, GroundVehicle, Inertial, Kinematic, Lag, Point, Quadrotor

pytestmark = pytest.mark.slow

speeds = st.floats(-2.0, 2.0)
rates = st.floats(-3.0, 3.0)
spans = st.integers(1, 3 * SECOND_NS)


def engine(*models: GroundVehicle, pose: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> GroundEngine:
    x, y, yaw = pose
    return GroundEngine(models, [(x, y, 0.0)] * len(models), [yaw] * len(models))


def row(moved: GroundEngine, number: int = 0) -> tuple[float, float, float, float, float]:
    """x, y, yaw, v, w."""
    x, y, yaw, v, w = moved.read().odometry[number].tolist()
    return x, y, yaw, v, w


@given(v=speeds, w=rates, yaw=rates, span_ns=spans)
@pytest.mark.parametrize("model", [Kinematic(), P2DX(), AmigoBot()], ids=lambda model: type(model).__name__)
def test_ideal_vehicles_move_on_exact_arcs(model: GroundVehicle, v: float, w: float, yaw: float, span_ns: int) -> None:
    moved = engine(model, pose=(1.0, -2.0, yaw))
    moved.command(0, (v, 0.0, 0.0), w)
    moved.advance(span_ns)
    x, y, turned = arc((1.0, -2.0, yaw), v, w, span_ns / SECOND_NS)
    assert row(moved)[:2] == pytest.approx((x, y), abs=1e-12)
    assert wrap(row(moved)[2] - turned) == pytest.approx(0.0, abs=1e-12)
    assert row(moved)[3:] == (v, w)


@given(v=speeds, w=rates, cuts=st.lists(spans, max_size=6), span_ns=spans)
@pytest.mark.parametrize(
    ("model", "exact_m"), [(Kinematic(), 1e-11), (Lag(), 2e-4), (Inertial(), 2e-4)], ids=["kinematic", "lag", "inertial"]
)
def test_reading_in_between_has_no_effect(
    model: GroundVehicle, exact_m: float, v: float, w: float, cuts: list[int], span_ns: int
) -> None:
    once, often = engine(model), engine(model)
    for moved, spans in ((once, [span_ns]), (often, sorted(cut for cut in [*cuts, span_ns] if cut <= span_ns))):
        moved.command(0, (v, 0.0, 0.0), w)
        for span in spans:
            moved.advance(span)
    assert row(often)[3:] == pytest.approx(row(once)[3:], abs=1e-12)
    assert row(often)[:2] == pytest.approx(row(once)[:2], abs=exact_m)
    assert wrap(row(often)[2] - row(once)[2]) == pytest.approx(0.0, abs=1e-11)


commands = st.lists(st.tuples(speeds, rates), min_size=1, max_size=8)


@settings(max_examples=15, deadline=None)
@given(commands)
@pytest.mark.parametrize(
    "model", [Lag(), Inertial(), Inertial(tau_v_s=0.0, tau_w_s=0.0, max_speed=0.1)], ids=["lag", "inertial", "ramps only"]
)
def test_agrees_with_a_plain_integration(model: Lag, sequence: list[tuple[float, float]]) -> None:
    h, steps = 2e-4, 500
    servo, moved = model.servo, engine(model)
    x = y = yaw = v = w = 0.0
    for k, (wanted_v, wanted_w) in enumerate(sequence, 1):
        moved.command(0, (wanted_v, 0.0, 0.0), wanted_w)
        moved.advance(k * SECOND_NS // 10)
        goal_v = min(max(wanted_v, -servo.max_speed), servo.max_speed)
        goal_w = min(max(wanted_w, -servo.max_yaw_rate), servo.max_yaw_rate)
        for _ in range(steps):
            x, y, yaw = x + h * v * math.cos(yaw), y + h * v * math.sin(yaw), yaw + h * w
            v += h * min(max((goal_v - v) / max(servo.tau_v_s, h), -servo.decel), servo.accel)
            w += h * min(max((goal_w - w) / max(servo.tau_w_s, h), -servo.yaw_accel), servo.yaw_accel)
    got = row(moved)
    assert got[:2] == pytest.approx((x, y), abs=2e-3)
    assert wrap(got[2] - yaw) == pytest.approx(0.0, abs=2e-3)
    assert got[3:] == pytest.approx((v, w), abs=2e-3)


@pytest.mark.parametrize(
    ("model", "in_between"),
    [
        (Lag(), (0.6, -0.4)),
        (Inertial(), (0.3, -0.75)),
        (Inertial(tau_v_s=0.0, tau_w_s=0.0), (0.3, -0.75)),
        (Kinematic(), (0.0, 0.0)),
    ],
    ids=["lag", "inertial", "ramps only", "kinematic"],
)
def test_accelerations_are_changes_of_speed(model: GroundVehicle, in_between: tuple[float, float]) -> None:
    moved = engine(model)
    for speed, at_ns, least_or_most in ((0.6, 0, in_between[0]), (0.1, SECOND_NS, in_between[1])):
        moved.command(0, (speed, 0.0, 0.0), 0.0)
        moved.advance(at_ns + SECOND_NS // 2)
        acceleration, before = float(moved.read().acceleration[0, 0]), row(moved)[3]
        moved.advance(at_ns + SECOND_NS // 2 + 1000)
        assert acceleration == pytest.approx((row(moved)[3] - before) / 1e-6, abs=1e-3)
        assert abs(acceleration) <= abs(least_or_most) + 1e-9
        moved.advance(at_ns + SECOND_NS)


def slot_errors(model: GroundVehicle, k1: float, period_s: float = 0.1) -> list[float]:
    """Errors z, m, of a vehicle with v = 0.3 + k1 z behind a slot that moves at 0.3 m/s, 0.5 m ahead at the start."""
    moved, period_ns = engine(model), round(period_s * SECOND_NS)
    moved.command(0, (0.3, 0.0, 0.0), 0.0)
    moved.advance(60 * SECOND_NS)  # steady speed at the start
    start_m, errors = row(moved)[0], []
    for k in range(round(40.0 / period_s)):
        z = start_m + 0.5 + 0.3 * k * period_s - row(moved)[0]
        errors.append(z)
        moved.command(0, (0.3 + k1 * z, 0.0, 0.0), 0.0)
        moved.advance(60 * SECOND_NS + (k + 1) * period_ns)
    return errors


@pytest.mark.parametrize(("k1", "percent"), [(0.4, 0.0), (0.8, 2.6), (2.0, 20.6), (4.0, 39.6), (8.0, 62.2)])
def test_sampled_servo_overshoots_by_its_transition_matrix(k1: float, percent: float) -> None:
    exact = servo_step(k1, 0.1, 0.5, 400)
    assert overshoot(exact) == pytest.approx(percent / 100.0, abs=5e-4)
    assert slot_errors(Lag(), k1) == pytest.approx(0.5 * exact, abs=1e-6)


def test_through_the_federate(drive: Callable[..., Any]) -> None:
    moved = drive(KinematicPhysics, P2DX(), [(0.0, 0.3, 0.15)], 2.0 * math.pi / 0.15)
    assert moved.position[-1] == pytest.approx((0.0, 0.0, 0.0), abs=1e-8)  # once round the circle of 2 m
    assert np.hypot(moved.position[:, 0], moved.position[:, 1] - 2.0) == pytest.approx(2.0, abs=1e-12)
    assert np.array_equal(moved.odometry[:, :2], moved.position[:, :2])


numbers = st.floats(-4.0, 4.0)
places = st.tuples(numbers, numbers, numbers)
air_spans = st.integers(1, 4 * SECOND_NS)


def airborne(*models: Point | Quadrotor, at: Vec3 = (0.0, 0.0, 2.0), heading: float = 0.0) -> AerialEngine:
    return AerialEngine(models, [at] * len(models), [heading] * len(models))


def yaw(moved: AerialEngine) -> float:
    w, _, _, z = moved.read().attitude[0].tolist()
    return 2.0 * math.atan2(z, w)


@given(velocity=places, span_ns=air_spans)
def test_without_lag_it_moves_exactly_as_commanded(velocity: Vec3, span_ns: int) -> None:
    for model in (Point(max_climb=9.0), Quadrotor(max_climb=9.0)):
        moved = airborne(model)
        moved.command(0, velocity, 0.2)
        moved.advance(span_ns)
        span_s = span_ns / SECOND_NS
        assert moved.read().position[0] == pytest.approx(np.array([0.0, 0.0, 2.0]) + np.array(velocity) * span_s, abs=1e-12)
        assert moved.read().velocity[0] == pytest.approx(velocity)
        assert yaw(moved) == pytest.approx(0.2 * span_s)
        assert moved.read().angular_velocity[0] == pytest.approx((0.0, 0.0, 0.2))


def test_the_lag_is_exponential() -> None:
    moved = airborne(Point(tau_s=0.4))
    moved.command(0, (2.0, -1.0, 0.5), 0.0)
    for t in (0.1, 0.37, 0.9, 3.0):
        moved.advance(round(t * SECOND_NS))
        share, way = 1.0 - math.exp(-t / 0.4), t - 0.4 * (1.0 - math.exp(-t / 0.4))
        assert moved.read().velocity[0] == pytest.approx((2.0 * share, -share, 0.5 * share), abs=1e-12)
        assert moved.read().position[0] == pytest.approx((2.0 * way, -way, 2.0 + 0.5 * way), abs=1e-12)
        assert moved.read().acceleration[0] == pytest.approx(np.array((2.0, -1.0, 0.5)) * (1.0 - share) / 0.4, abs=1e-12)


@given(place=places, speed=st.floats(0.2, 9.0), tau=st.sampled_from([0.0, 0.4, 1.3]), velocity=places)
def test_a_way_point_is_reached_from_any_motion_and_kept(place: Vec3, speed: float, tau: float, velocity: Vec3) -> None:
    moved = airborne(Point(tau_s=tau))
    moved.command(0, velocity, 0.0)
    moved.advance(SECOND_NS)
    moved.go_to(0, place, 1.0, speed)
    moved.advance(300 * SECOND_NS)
    assert moved.read().position[0] == pytest.approx(place, abs=1e-9)
    assert moved.read().velocity[0] == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    assert yaw(moved) == pytest.approx(1.0, abs=1e-9)


@given(place=places, speed=st.floats(0.2, 9.0), cuts=st.lists(air_spans, max_size=6), span_ns=air_spans)
@pytest.mark.parametrize("tau", [0.0, 0.4])
def test_reading_in_between_has_no_effect_in_the_air(
    tau: float, place: Vec3, speed: float, cuts: list[int], span_ns: int
) -> None:
    once, often = airborne(Point(tau_s=tau)), airborne(Point(tau_s=tau))
    for moved, spans in ((once, [span_ns]), (often, sorted(cut for cut in [*cuts, span_ns] if cut <= span_ns))):
        moved.command(0, (1.0, 0.5, 0.0), -0.3)
        moved.advance(SECOND_NS // 3)
        moved.go_to(0, place, 2.0, speed)
        for span in spans:
            moved.advance(SECOND_NS // 3 + span)
    assert often.read().position == pytest.approx(once.read().position, abs=1e-10)
    assert often.read().attitude == pytest.approx(once.read().attitude, abs=1e-10)


def test_the_path_to_a_way_point_is_straight_at_the_given_speed() -> None:
    moved = airborne(Point())
    moved.go_to(0, (3.0, 4.0, 2.0), None, 2.0)
    for k in range(1, 25):
        moved.advance(k * SECOND_NS // 10)
        x, y, z = moved.read().position[0].tolist()
        assert (x, y, z) == pytest.approx((0.12 * k, 0.16 * k, 2.0))
        assert moved.read().velocity[0] == pytest.approx((1.2, 1.6, 0.0))
    moved.advance(26 * SECOND_NS // 10)
    assert moved.read().velocity[0] == pytest.approx((0.0, 0.0, 0.0))
    climbing = airborne(Point(max_climb=0.5))
    climbing.go_to(0, (1.0, 0.0, 4.0), None, None)
    climbing.advance(2 * SECOND_NS)
    assert climbing.read().position[0] == pytest.approx((0.5, 0.0, 3.0))  # both axes together, at the pace of the slower one


def test_greatest_speeds_are_kept_in_the_commanded_direction() -> None:
    moved = airborne(Point(max_speed=5.0, max_climb=2.0, max_yaw_rate=1.0))
    moved.command(0, (30.0, 40.0, 9.0), -7.0)
    moved.advance(SECOND_NS)
    assert moved.read().velocity[0] == pytest.approx((3.0, 4.0, 2.0))
    assert moved.read().angular_velocity[0] == pytest.approx((0.0, 0.0, -1.0))


def test_it_turns_the_shorter_way() -> None:
    moved = airborne(Point(max_yaw_rate=0.5), heading=3.0)
    moved.go_to(0, (0.0, 0.0, 2.0), -3.0, None)
    moved.advance(SECOND_NS // 10)
    assert moved.read().angular_velocity[0, 2] == pytest.approx(0.5)
    moved.advance(SECOND_NS)
    assert math.cos(yaw(moved) + 3.0) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("make", "models"),
    [
        (engine, [Kinematic(), Lag(), Inertial(), P2DX(), Lag(tau_v_s=1.0, tau_w_s=0.0)]),
        (airborne, [Point(), Point(tau_s=0.4), Point(tau_s=1.0, max_speed=1.0), Quadrotor()]),
    ],
    ids=["ground", "air"],
)
def test_a_fleet_moves_as_single_vehicles(make: Callable[..., Any], models: list[Any]) -> None:
    fleet, alone = make(*models), [make(model) for model in models]
    draws = np.random.default_rng(3).uniform(-3.0, 3.0, (20, len(models), 4))
    for k, velocities in enumerate(draws, 1):
        for number, (x, y, z, w) in enumerate(velocities.tolist()):
            for moved, place in ((fleet, number), (alone[number], 0)):
                if make is engine or (k + number) % 3:
                    moved.command(place, (x, y, z), w)
                else:
                    moved.go_to(place, (x, y, z), w, None)
        for moved in (fleet, *alone):
            moved.advance(k * SECOND_NS // 10)
    for number, moved in enumerate(alone):
        for whole, single in zip(fleet.read(), moved.read(), strict=True):
            assert whole[number] == pytest.approx(single[0], abs=1e-12, nan_ok=True)
