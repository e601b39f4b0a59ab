"""Quadrotors: response to commands, wind and upsets, at 120 and 240 Hz."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.types import ORIGIN
from vcmvsp.physics.dynamics.quadrotor_fleet import QuadrotorFleet, model_of
from vcmvsp.physics.dynamics.quadrotor_laws import mixed
from vcmvsp.physics.vehicles.models import Quadrotor

pytestmark = pytest.mark.slow

MODEL = Quadrotor()
both_rates = pytest.mark.parametrize("hz", [120.0, 240.0])


def fly(fleet: QuadrotorFleet, seconds: float, hz: float, wind: Any = ORIGIN, push: Any = ORIGIN) -> SimpleNamespace:
    """States after every step: t (steps,), others (steps, n) or (steps, n, 3)."""
    air = np.broadcast_to(np.asarray(wind, float), fleet.position.shape)
    samples = []
    for _ in range(round(seconds * hz)):
        force, torque = fleet.wrench(1.0 / hz, air)
        fleet.integrate(force + push, torque, 1.0 / hz)
        samples.append((fleet.position.copy(), fleet.velocity.copy(), fleet.attitude.copy(), fleet.rate.copy()))
    position, velocity, attitude, rate = map(np.array, zip(*samples, strict=True))
    w, x, y, z = np.moveaxis(attitude, -1, 0)
    return SimpleNamespace(
        t=np.arange(1, len(position) + 1) / hz,
        position=position,
        velocity=velocity,
        rate=rate,
        tilt=np.arccos(np.clip(1 - 2 * (x * x + y * y), -1, 1)),
        yaw=np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)), axis=0),
    )


def fleet_of(n: int, model: Quadrotor = MODEL, height: float = 10.0) -> QuadrotorFleet:
    return QuadrotorFleet([model] * n, [(3.0 * row, 0.0, height) for row in range(n)], np.zeros(n))


@both_rates
def test_it_hovers_in_its_place_and_carries_its_weight(hz: float) -> None:
    fleet = fleet_of(1)
    fly(fleet, 2.0, hz)
    force, torque = fleet.wrench(1.0 / hz, np.zeros((1, 3)))
    assert force[0] == pytest.approx((0.0, 0.0, MODEL.mass_kg * 9.81), abs=1e-9)
    assert torque[0] == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    assert fleet.position[0] == pytest.approx((0.0, 0.0, 10.0), abs=1e-9)


@both_rates
def test_steps_of_velocity(hz: float) -> None:
    fleet = fleet_of(4)
    for row, velocity in enumerate([(2.0, 0.0, 0.0), (5.0, 0.0, 0.0), (0.0, -2.0, 0.0), (0.0, 0.0, 1.5)]):
        fleet.set_velocity(row, velocity, 0.0)
    flight = fly(fleet, 6.0, hz)
    slow, fast = flight.velocity[:, :2, 0].T
    right, up = -flight.velocity[:, 2, 1], flight.velocity[:, 3, 2]
    assert flight.t[np.argmax(slow > 0.95 * 2.0)] <= 0.80
    assert flight.t[np.argmax(fast > 0.90 * 5.0)] <= 1.42
    assert slow.max() <= 1.04 * 2.0
    assert fast.max() <= 1.04 * 5.0
    assert up.max() <= 1.04 * 1.5
    assert right == pytest.approx(slow, abs=1e-6)  # equal inertia about both axes
    after = flight.t > 3.0
    assert np.abs(slow[after] - 2.0).max() <= 0.01 * 2.0
    assert np.abs(fast[after] - 5.0).max() <= 0.022 * 5.0
    assert np.abs(up[after] - 1.5).max() <= 0.02 * 1.5
    assert math.degrees(flight.tilt.max()) <= 25.1
    assert np.abs(flight.position[:, 0, 2] - 10.0).max() <= 0.02
    assert np.abs(flight.position[:, 1, 2] - 10.0).max() <= 0.05


@both_rates
def test_tilt_in_steady_flight_balances_drag(hz: float) -> None:
    fleet = fleet_of(1, Quadrotor(drag=(0.3, 0.3, 0.3)))
    fleet.set_velocity(0, (4.0, 0.0, 0.0), 0.0)
    flight = fly(fleet, 15.0, hz)
    assert flight.velocity[-1, 0] == pytest.approx((4.0, 0.0, 0.0), abs=1e-3)
    assert math.tan(flight.tilt[-1, 0]) == pytest.approx(0.3 * 4.0 / (MODEL.mass_kg * 9.81), rel=1e-3)


@both_rates
def test_a_side_gust_pushes_it_and_is_compensated(hz: float) -> None:
    flight = fly(fleet_of(1), 6.0, hz, wind=(0.0, 6.0, 0.0))
    sideways = flight.velocity[:, 0, 1]
    assert 0.3 <= sideways.max() <= 0.71
    assert sideways[-1] == pytest.approx(0.0, abs=0.02)
    assert math.sin(flight.tilt[-1, 0]) * MODEL.mass_kg * 9.81 == pytest.approx(0.25 * 6.0, rel=0.1)  # tilt balances the drag


@both_rates
def test_it_turns_at_the_set_rate(hz: float) -> None:
    fleet = fleet_of(2)
    fleet.set_velocity(0, (2.0, 0.0, 0.0), 1.0)
    fleet.set_velocity(1, (0.0, 0.0, 0.0), -100.0)
    flight = fly(fleet, 8.0, hz)
    settled = flight.t > 3.5
    rates = np.diff(flight.yaw[settled], axis=0) * hz
    assert rates[:, 0] == pytest.approx(1.0, abs=0.05)  # uneven while tilted
    assert rates[:, 0].mean() == pytest.approx(1.0, abs=0.01)
    assert rates[:, 1] == pytest.approx(-MODEL.max_yaw_rate, abs=0.01)
    assert np.abs(flight.rate[:, 1, 2]).max() <= 1.04 * MODEL.max_yaw_rate
    assert flight.velocity[settled][:, 0] == pytest.approx(np.tile((2.0, 0.0, 0.0), (settled.sum(), 1)), abs=0.03)
    assert flight.position[-1, 1] == pytest.approx((3.0, 0.0, 10.0), abs=0.01)


def test_limits_of_speed() -> None:
    fleet = fleet_of(2, Quadrotor(max_speed=4.0, max_climb=1.0))
    fleet.set_velocity(0, (30.0, 40.0, 9.0), 0.0)
    fleet.set_velocity(1, (0.0, 0.0, -9.0), 0.0)
    flight = fly(fleet, 12.0, 120.0)
    assert flight.velocity[-1, 0] == pytest.approx((2.4, 3.2, 1.0), abs=0.01)
    assert flight.velocity[-1, 1] == pytest.approx((0.0, 0.0, -1.0), abs=0.01)


@both_rates
def test_way_points_are_reached_without_passing_them(hz: float) -> None:
    places = [(1.0, 0.0, 0.0), (-8.0, 15.0, 5.0), (0.0, 0.0, -6.0), (40.0, 0.0, 0.0)]
    fleet = fleet_of(len(places))
    start = fleet.position.copy()
    for row, way in enumerate(places):
        fleet.set_waypoint(row, start[row] + way, yaw=2.5, speed=None)
    flight = fly(fleet, 16.0, hz)
    for row, way in enumerate(places):
        distance = np.linalg.norm(way)
        along = (flight.position[:, row] - start[row]) @ np.array(way) / distance
        assert along.max() <= 1.05 * distance
        assert along.max() <= distance + 0.08
        assert flight.position[-1, row] == pytest.approx(start[row] + way, abs=0.02)
    assert flight.yaw[-1] == pytest.approx(2.5, abs=1e-3)
    assert flight.yaw.max() <= 1.05 * 2.5


def test_way_points_are_approached_at_the_given_speed() -> None:
    fleet = fleet_of(1)
    fleet.set_waypoint(0, (20.0, 0.0, 10.0), speed=1.5)
    flight = fly(fleet, 20.0, 120.0)
    speed = flight.velocity[:, 0, 0]
    assert speed.max() <= 1.04 * 1.5
    assert speed[(flight.t > 3.0) & (flight.t < 11.0)] == pytest.approx(1.5, rel=0.01)
    assert flight.position[-1, 0] == pytest.approx((20.0, 0.0, 10.0), abs=0.02)
    assert flight.yaw == pytest.approx(0.0, abs=0.01)  # no yaw commanded: the present one is held


def test_the_climb_to_way_points_is_limited() -> None:
    fleet = fleet_of(2, Quadrotor(max_climb=1.5))
    fleet.set_waypoint(0, (0.0, 0.0, 20.0))
    fleet.set_waypoint(1, (13.0, 0.0, 0.0))
    flight = fly(fleet, 20.0, 120.0)
    assert np.abs(flight.velocity[:, :, 2]).max() <= 1.04 * 1.5
    assert flight.position[-1] == pytest.approx(np.array([(0.0, 0.0, 20.0), (13.0, 0.0, 0.0)]), abs=0.02)
    halfway = flight.position[np.argmax(flight.position[:, 1, 2] < 5.0), 1]
    assert halfway[0] == pytest.approx(8.0, abs=0.3)  # straight path


def test_a_blocked_turn_is_not_compensated_later() -> None:
    fleet = fleet_of(1)
    fleet.set_velocity(0, (0.0, 0.0, 0.0), 1.0)
    for _ in range(600):  # 5 s
        fleet.integrate(*fleet.wrench(1 / 120, np.zeros((1, 3))), 1 / 120)
        fleet.attitude[0], fleet.rate[0] = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    fleet.set_velocity(0, (0.0, 0.0, 0.0), 0.0)
    flight = fly(fleet, 5.0, 120.0)
    assert 0.0 < flight.yaw.max() < 1.0


def test_the_shorter_way_round_is_turned() -> None:
    fleet = QuadrotorFleet([MODEL], [(0.0, 0.0, 5.0)], [3.0])
    fleet.set_waypoint(0, (0.0, 0.0, 5.0), yaw=-3.0)
    flight = fly(fleet, 5.0, 120.0)
    assert flight.yaw[-1, 0] - 3.0 == pytest.approx(math.tau - 6.0, abs=1e-3)


def test_rotors_as_an_x_fly_like_rotors_as_a_plus() -> None:
    """The mixer takes rotor positions into account; inertia and drag are equal about both pairs of axes."""
    plus, x = (
        QuadrotorFleet([Quadrotor(frame=frame)] * 2, [(0.0, 0.0, 9.0), (9.0, 0.0, 9.0)], [0.3, 0.3]) for frame in ("plus", "x")
    )
    for fleet in (plus, x):
        fleet.set_velocity(0, (2.0, -1.0, 0.5), 0.4)
        fleet.set_waypoint(1, (5.0, 3.0, 8.0), yaw=1.0)
        fly(fleet, 0.2, 240.0)
    assert np.abs(x.rotor - plus.rotor).max() > 1.0  # with different rotor speeds
    for fleet in (plus, x):
        fly(fleet, 4.0, 240.0)
    assert x.position == pytest.approx(plus.position, abs=3e-3)  # rotor lag is not linear in thrust
    assert x.attitude == pytest.approx(plus.attitude, abs=1e-3)


@pytest.mark.parametrize(
    ("frame", "signs"),
    [
        ("plus", {0: (0, -1, -1), 1: (1, 0, 1), 2: (0, 1, -1), 3: (-1, 0, 1)}),
        ("x", {0: (-1, -1, -1), 1: (1, -1, 1), 2: (1, 1, -1), 3: (-1, 1, 1)}),  # front right, front left, back left, back right
    ],
)
def test_driven_rotors_turn_the_body_by_their_places_and_directions(frame: str, signs: dict[int, tuple[int, int, int]]) -> None:
    """A rotor above hover speed lifts its arm and turns the body against its own direction of rotation (x, y, z)."""
    hover = math.sqrt(0.25 * MODEL.mass_kg * 9.81 / MODEL.thrust_factor)
    for rotor, about in signs.items():
        fleet = QuadrotorFleet([Quadrotor(frame=frame)], [(0.0, 0.0, 9.0)], [0.0])  # type: ignore[arg-type]
        speeds = [hover] * 4
        speeds[rotor] += 50.0
        fleet.drive(0, speeds)
        fly(fleet, 0.05, 240.0)
        rate = np.where(np.abs(fleet.rate[0]) < 0.01, 0.0, fleet.rate[0])  # rad/s; rotation so far couples the axes
        assert np.sign(rate).tolist() == list(about)


def test_a_vehicle_that_is_released_holds_its_place() -> None:
    fleet = fleet_of(2)
    for _ in range(20):
        fleet.drive(0, [630.0] * 4)  # above hover speed
        fly(fleet, 0.1, 240.0)
    assert fleet.position[0, 2] > 11.0
    assert fleet.position[1, 2] == pytest.approx(10.0, abs=0.01)  # the other vehicle is not driven
    there = fleet.position[0].copy()
    fleet.release(0)
    fly(fleet, 10.0, 240.0)
    assert fleet.position[0] == pytest.approx(there, abs=0.02)


def test_it_catches_itself_from_a_fall_straight_down() -> None:
    fleet = fleet_of(1, height=100.0)
    fleet.velocity[0, 2] = -30.0  # full lift, no sideways motion
    flight = fly(fleet, 5.0, 120.0)
    weight, lift = MODEL.mass_kg * 9.81, MODEL.max_thrust * 4 * MODEL.max_rotor_thrust
    shortest = 30.0**2 / (2 * (lift + 0.35 * 30.0 - weight) / MODEL.mass_kg)
    assert 100.0 - shortest > flight.position[-1, 0, 2] > 100.0 - 1.5 * shortest
    assert flight.velocity[-1, 0] == pytest.approx((0.0, 0.0, 0.0), abs=0.05)


@pytest.mark.parametrize("way", [(0.0, 0.0, -1.0), (1.0, 0.0, 0.0)], ids=["on the floor", "at a wall"])
def test_pushing_against_an_obstacle_causes_no_windup(way: tuple[float, float, float]) -> None:
    fleet = fleet_of(1)
    fleet.set_velocity(0, way, 0.0)
    for _ in range(1200):  # 10 s
        force, torque = fleet.wrench(1 / 120, np.zeros((1, 3)))
        fleet.integrate(force, torque, 1 / 120)
        fleet.position[0], fleet.velocity[0] = (0.0, 0.0, 10.0), (0.0, 0.0, 0.0)
    back = -np.array(way)
    fleet.set_velocity(0, back.tolist(), 0.0)
    flight = fly(fleet, 4.0, 120.0)
    assert (flight.velocity[:, 0] @ back).max() <= 1.5
    assert flight.position[flight.t <= 1.5, 0][-1] @ back - (0.0, 0.0, 10.0) @ back >= 0.0
    assert flight.velocity[-1, 0] == pytest.approx(back, abs=0.2)


def test_rotors_lag() -> None:
    fleet = fleet_of(1)
    fleet.rotor[0] = 0.0
    fleet.wrench(0.05, np.zeros((1, 3)))
    hover = math.sqrt(0.25 * MODEL.mass_kg * 9.81 / MODEL.thrust_factor)
    assert fleet.rotor[0] == pytest.approx((1.0 - math.exp(-1.0)) * hover)
    fleet.wrench(1e9, np.zeros((1, 3)))
    assert fleet.rotor[0] == pytest.approx(hover)


def test_vehicles_of_a_fleet_are_independent() -> None:
    kinds = [MODEL, Quadrotor(mass_kg=1.1, velocity_gain=2.0), Quadrotor(motor_lag_s=0.03)]
    starts, wind = np.array([(0.0, 0.0, 1.0), (9.0, 1.0, 2.0), (-4.0, 0.5, 3.0)]), np.array([(1.0, 2.0, 0.0)] * 3)

    def fleet(rows: list[int]) -> Any:
        some = QuadrotorFleet([kinds[row] for row in rows], starts[rows], np.array([0.3, -0.2, 1.5])[rows])
        for place, row in enumerate(rows):
            if row == 1:
                some.set_waypoint(place, (5.0, 5.0, 5.0), yaw=1.0)
            else:
                some.set_velocity(place, (1.0, row, 0.0), 0.5)
        some.fly(240, 1 / 240, wind[rows])
        return np.hstack([some.position, some.velocity, some.attitude, some.rate, some.rotor])

    together, apart = fleet([0, 1, 2]), np.vstack([fleet([row]) for row in range(3)])
    assert (together == apart).all()


CALM = np.zeros((1, 3))


def euler(roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> tuple[float, float, float, float]:
    """The quaternion of Rz(yaw) Ry(pitch) Rx(roll)."""
    (a, b, c), (d, e, f) = ([trig(0.5 * angle) for angle in (roll, pitch, yaw)] for trig in (math.cos, math.sin))
    return a * b * c + d * e * f, d * b * c - a * e * f, a * e * c + d * b * f, a * b * f - d * e * c


# Signs: x forward, y left, z up; positive pitch: nose down; positive roll: left side up.


def test_thrust_points_forward_with_nose_down_and_right_with_left_side_up() -> None:
    for angles, direction in [({"pitch": 10.0}, (0.174, 0.0, 0.985)), ({"roll": 10.0}, (0.0, -0.174, 0.985))]:
        fleet = fleet_of(1)
        fleet.attitude[0] = euler(**{name: math.radians(angle) for name, angle in angles.items()})
        force, _ = fleet.wrench(1e-9, CALM)
        assert force[0] / np.linalg.norm(force) == pytest.approx(direction, abs=5e-4)


def test_torques_are_those_of_the_arms() -> None:
    fleet = fleet_of(1)
    fleet.rotor[0] = 300.0, 500.0, 450.0, 400.0
    front, left, back, right = MODEL.thrust_factor * fleet.rotor[0] ** 2
    kappa = MODEL.torque_factor / MODEL.thrust_factor
    force, torque = fleet.wrench(1e-9, CALM)
    expected = (MODEL.arm_m * (left - right), MODEL.arm_m * (back - front), kappa * (-front + left - back + right))
    assert torque[0] == pytest.approx(expected, rel=1e-5)
    assert force[0] == pytest.approx((0.0, 0.0, front + left + back + right), rel=1e-5)


def test_rates_are_damped_as_if_the_body_were_a_ball() -> None:
    model = Quadrotor(inertia=(0.0040, 0.0055, 0.0073), motor_lag_s=1e-9, drag=(0.0, 0.0, 0.0), yaw_rate_gain=20.0)
    fleet, rate, dt = fleet_of(1, model), np.array([1.0, -1.5, 0.3]), 1e-6
    fleet.rate[0] = rate
    fleet.integrate(*fleet.wrench(dt, CALM), dt)
    assert (fleet.rate[0] - rate) / dt == pytest.approx(-20.0 * rate, rel=1e-4)  # gyroscopic torque is compensated


# The mixer.

numbers = st.floats(-3.0, 3.0)


@given(roll=numbers, pitch=numbers, yaw=st.floats(-0.3, 0.3), thrust=st.floats(-5.0, 40.0))
def test_the_mixer_gives_roll_and_pitch_first(roll: float, pitch: float, yaw: float, thrust: float) -> None:
    speeds = np.array(mixed(model_of([MODEL], 9.81), 0, roll, pitch, yaw, thrust))
    most = MODEL.max_rotor_thrust
    front, left, back, right = lifts = MODEL.thrust_factor * speeds**2
    assert (lifts >= 0.0).all()
    assert (lifts <= most * (1 + 1e-12)).all()

    got = MODEL.arm_m * (left - right), MODEL.arm_m * (back - front)
    scale = min(1.0, 0.8 * most * MODEL.arm_m / max(abs(roll), abs(pitch), 1e-9))
    assert got == pytest.approx((scale * roll, scale * pitch), abs=1e-9)  # in full, or at least in direction

    kappa = MODEL.torque_factor / MODEL.thrust_factor
    turning = kappa * (-front + left - back + right)
    kept_for_it = min(abs(yaw), 0.4 * kappa * most)  # a tenth of the total
    assert kept_for_it - 1e-9 <= turning * math.copysign(1.0, yaw) <= abs(yaw) + 1e-9

    reach = max(abs(got[0]), abs(got[1])) / (2 * MODEL.arm_m)
    yaw_share = min(abs(yaw) / (4 * kappa), 0.1 * most)
    assert lifts.sum() / 4 == pytest.approx(min(max(thrust / 4, reach + yaw_share), most - reach - yaw_share), abs=1e-9)


# With the gains, body and limits below, the controller is the cascade of proportional laws of A. Toh's thesis 2012, 3.2, in
# explicit form: a = kv (clip(kp (p* - p), 1.5) - v), plus rate and attitude loops; figures of an independent simulation.

CASCADE = Quadrotor(
    mass_kg=1.0,
    inertia=(0.0096, 0.0096, 0.017),
    drag=(0.0, 0.0, 0.0),
    motor_lag_s=1e-4,
    position_gain=1.2,
    velocity_gain=2.4,
    velocity_integral=0.0,
    attitude_gain=8.0,
    rate_gain=20.0,
    max_tilt_rad=0.6,
    braking=1e9,
)


def test_the_plain_cascade_goes_one_metre() -> None:
    fleet = fleet_of(1, CASCADE)
    fleet.set_waypoint(0, (1.0, 0.0, 10.0), speed=1.5)
    flight = fly(fleet, 6.0, 500.0)
    x, _, z = flight.position[:, 0].T
    assert x.max() - 1.0 == pytest.approx(0.045, rel=0.05)
    assert flight.t[np.flatnonzero(np.abs(x - 1.0) > 0.05)[-1]] == pytest.approx(1.54, rel=0.02)
    assert np.abs(z - 10.0).max() < 1e-3


def test_the_plain_cascade_follows_a_velocity() -> None:
    fleet = fleet_of(1, CASCADE)
    fleet.set_velocity(0, (1.0, 0.0, 0.0), 0.0)
    flight = fly(fleet, 2.0, 500.0)
    assert flight.t[np.argmax(flight.velocity[:, 0, 0] > 1.0 - math.exp(-1.0))] == pytest.approx(0.44, rel=0.02)


def test_without_an_integral_a_constant_push_leaves_an_offset() -> None:
    fleet = fleet_of(1, CASCADE)
    fleet.set_waypoint(0, (0.0, 0.0, 10.0))
    flight = fly(fleet, 15.0, 240.0, push=(0.5, 0.0, 0.0))  # N on 1 kg
    assert flight.position[-1, 0, 0] == pytest.approx(0.5 / (1.2 * 2.4), abs=1e-4)


def test_an_integral_removes_the_offset() -> None:
    fleet = fleet_of(1)
    fleet.set_waypoint(0, (0.0, 0.0, 10.0))
    flight = fly(fleet, 25.0, 240.0, push=(0.5, 0.0, -0.5))
    assert flight.position[-1, 0] == pytest.approx((0.0, 0.0, 10.0), abs=1e-4)


@pytest.mark.parametrize("gravity", [0.0, 1e-12])
def test_without_gravity_it_is_driven_by_its_rotors_alone(gravity: float) -> None:
    fleet = QuadrotorFleet([Quadrotor()] * 3, [(0.0, 3.0 * row, 5.0) for row in range(3)], [0.0] * 3, gravity)
    fleet.set_velocity(1, (1.0, 0.0, 1.0), 0.5)
    fleet.set_waypoint(2, (1.0, 6.0, 7.0))
    fleet.fly(240, 1 / 120, np.zeros((3, 3)))
    assert all(np.isfinite(each).all() for each in (fleet.position, fleet.velocity, fleet.attitude, fleet.rate, fleet.rotor))
    assert fleet.position[0] == pytest.approx((0.0, 0.0, 5.0), abs=1e-3)  # at rest
    assert (fleet.velocity[1:, 2] > 0.3).all()
