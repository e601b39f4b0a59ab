"""The autopilot's laws: signs, saturation, and a published cascade that it becomes with other gains."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.physics.dynamics.quadrotor_fleet import Autopilot, QuadrotorFleet
from vcmvsp.physics.vehicles.models import Quadrotor

MODEL = Quadrotor()
CALM = np.zeros((1, 3))
FRONT, LEFT, BACK, RIGHT = range(4)


def euler(roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> tuple[float, float, float, float]:
    """The quaternion of Rz(yaw) Ry(pitch) Rx(roll)."""
    (a, b, c), (d, e, f) = ([trig(0.5 * angle) for angle in (roll, pitch, yaw)] for trig in (math.cos, math.sin))
    return a * b * c + d * e * f, d * b * c - a * e * f, a * e * c + d * b * f, a * b * f - d * e * c


def steps(
    fleet: QuadrotorFleet, seconds: float, hz: float = 240.0, push: Any = (0.0, 0.0, 0.0), wind: Any = CALM
) -> dict[str, Any]:
    """Fly on; time, position, velocity, rate and tilt of the first one after every step."""
    seen = []
    for step in range(round(seconds * hz)):
        force, torque = fleet.wrench(1.0 / hz, wind)
        fleet.integrate(force + push, torque, 1.0 / hz)
        _, x, y, _ = fleet.attitude[0]
        seen.append(
            [(step + 1) / hz, *fleet.position[0], *fleet.velocity[0], *fleet.rate[0], math.acos(1 - 2 * (x * x + y * y))]
        )
    t, *rest = np.array(seen).T
    return {
        "t": t,
        "position": np.array(rest[:3]),
        "velocity": np.array(rest[3:6]),
        "rate": np.array(rest[6:9]),
        "tilt": rest[9],
    }


def hovering(model: Quadrotor = MODEL, heading: float = 0.0) -> QuadrotorFleet:
    return QuadrotorFleet([model], [(0.0, 0.0, 10.0)], [heading])


# Signs: x forward, y left, z up; nose down is a positive pitch; the left side up a positive roll.


def test_thrust_of_a_nose_that_is_down_points_forward_and_of_a_left_side_that_is_up_to_the_right() -> None:
    for angles, direction in [({"pitch": 10.0}, (0.174, 0.0, 0.985)), ({"roll": 10.0}, (0.0, -0.174, 0.985))]:
        fleet = hovering()
        fleet.attitude[0] = euler(**{name: math.radians(angle) for name, angle in angles.items()})
        force, _ = fleet.wrench(1e-9, CALM)
        assert force[0] / np.linalg.norm(force) == pytest.approx(direction, abs=5e-4)


@pytest.mark.parametrize(
    ("stronger", "weaker", "torque"),
    [
        ([BACK], [FRONT], (0, 1, 0)),  # nose down: forward
        ([LEFT], [RIGHT], (1, 0, 0)),  # left side up: to the right
        ([LEFT, RIGHT], [FRONT, BACK], (0, 0, 1)),
    ],
)
def test_rotors_turn_the_body(stronger: list[int], weaker: list[int], torque: tuple[int, int, int]) -> None:
    fleet = hovering()
    fleet.rotor[0, stronger] = np.sqrt(fleet.rotor[0, stronger] ** 2 + 5e4)  # thrusts differ by the same
    fleet.rotor[0, weaker] = np.sqrt(fleet.rotor[0, weaker] ** 2 - 5e4)
    _, turning = fleet.wrench(1e-9, CALM)
    assert np.sign(np.round(turning[0], 5)).tolist() == list(torque)


def test_torques_are_those_of_the_arms() -> None:
    fleet = hovering()
    fleet.rotor[0] = 300.0, 500.0, 450.0, 400.0
    front, left, back, right = MODEL.thrust_factor * fleet.rotor[0] ** 2
    kappa = MODEL.torque_factor / MODEL.thrust_factor
    force, torque = fleet.wrench(1e-9, CALM)
    expected = (MODEL.arm_m * (left - right), MODEL.arm_m * (back - front), kappa * (-front + left - back + right))
    assert torque[0] == pytest.approx(expected, rel=1e-5)
    assert force[0] == pytest.approx((0.0, 0.0, front + left + back + right), rel=1e-5)


@pytest.mark.parametrize(
    ("velocity", "stronger", "weaker"),
    [((1, 0, 0), BACK, FRONT), ((-1, 0, 0), FRONT, BACK), ((0, 1, 0), RIGHT, LEFT), ((0, -1, 0), LEFT, RIGHT)],
)
def test_it_sets_off_with_the_rotor_opposite_to_where_it_goes(velocity: Any, stronger: int, weaker: int) -> None:
    fleet = hovering()
    fleet.set_velocity(0, velocity, 0.0)
    fleet.wrench(0.01, CALM)
    assert fleet.rotor[0, stronger] > fleet.rotor[0, weaker] + 10.0


def test_velocities_are_in_the_world_frame_whatever_the_heading() -> None:
    fleet = hovering(heading=2.0)
    fleet.set_velocity(0, (1.0, -2.0, 0.5), 0.0)
    assert steps(fleet, 6.0)["velocity"][:, -1] == pytest.approx((1.0, -2.0, 0.5), abs=0.01)


def test_rates_are_damped_as_if_the_body_were_a_ball() -> None:
    model = Quadrotor(inertia=(0.0040, 0.0055, 0.0073), motor_lag_s=1e-9, drag=(0.0, 0.0, 0.0), yaw_rate_gain=20.0)
    fleet, rate, dt = hovering(model), np.array([1.0, -1.5, 0.3]), 1e-6
    fleet.rate[0] = rate
    fleet.integrate(*fleet.wrench(dt, CALM), dt)
    assert (fleet.rate[0] - rate) / dt == pytest.approx(-20.0 * rate, rel=1e-4)  # gyroscopic torque is made up for


# The mixer.

numbers = st.floats(-3.0, 3.0)


@given(roll=numbers, pitch=numbers, yaw=st.floats(-0.3, 0.3), thrust=st.floats(-5.0, 40.0))
def test_the_mixer_gives_roll_and_pitch_first(roll: float, pitch: float, yaw: float, thrust: float) -> None:
    pilot = Autopilot([MODEL], [0.0], 9.81)
    speeds = pilot._mixed(np.array([[roll], [pitch], [yaw]]), np.array([thrust]))[:, 0]
    most = MODEL.max_rotor_thrust
    front, left, back, right = lifts = MODEL.thrust_factor * speeds**2
    assert (lifts >= 0.0).all()
    assert (lifts <= most * (1 + 1e-12)).all()

    got = MODEL.arm_m * (left - right), MODEL.arm_m * (back - front)
    scale = min(1.0, 0.8 * most * MODEL.arm_m / max(abs(roll), abs(pitch), 1e-9))
    assert got == pytest.approx((scale * roll, scale * pitch), abs=1e-9)  # in full, or their direction at least

    kappa = MODEL.torque_factor / MODEL.thrust_factor
    turning = kappa * (-front + left - back + right)
    kept_for_it = min(abs(yaw), 0.4 * kappa * most)  # a tenth of all
    assert kept_for_it - 1e-9 <= turning * math.copysign(1.0, yaw) <= abs(yaw) + 1e-9

    reach = max(abs(got[0]), abs(got[1])) / (2 * MODEL.arm_m)
    kept = min(abs(yaw) / (4 * kappa), 0.1 * most)
    assert lifts.sum() / 4 == pytest.approx(min(max(thrust / 4, reach + kept), most - reach - kept), abs=1e-9)


# With the gains, body and limits below it is the cascade of proportional laws of A. Toh's thesis 2012, 3.2, made explicit:
# a = kv (clip(kp (p* - p), 1.5) - v), and rate and attitude loops; figures of an independent simulation.

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
    fleet = hovering(CASCADE)
    fleet.set_waypoint(0, (1.0, 0.0, 10.0), speed=1.5)
    seen = steps(fleet, 6.0, hz=500.0)
    x = seen["position"][0]
    assert x.max() - 1.0 == pytest.approx(0.045, rel=0.05)
    assert seen["t"][np.flatnonzero(np.abs(x - 1.0) > 0.05)[-1]] == pytest.approx(1.54, rel=0.02)
    assert np.abs(seen["position"][2] - 10.0).max() < 1e-3


def test_the_plain_cascade_follows_a_velocity() -> None:
    fleet = hovering(CASCADE)
    fleet.set_velocity(0, (1.0, 0.0, 0.0), 0.0)
    seen = steps(fleet, 2.0, hz=500.0)
    assert seen["t"][np.argmax(seen["velocity"][0] > 1.0 - math.exp(-1.0))] == pytest.approx(0.44, rel=0.02)


def test_without_an_integral_a_constant_push_leaves_an_offset() -> None:
    fleet = hovering(CASCADE)
    fleet.set_waypoint(0, (0.0, 0.0, 10.0))
    seen = steps(fleet, 15.0, push=(0.5, 0.0, 0.0))  # N on 1 kg
    assert seen["position"][0, -1] == pytest.approx(0.5 / (1.2 * 2.4), abs=1e-4)


def test_with_it_there_is_none() -> None:
    fleet = hovering()
    fleet.set_waypoint(0, (0.0, 0.0, 10.0))
    seen = steps(fleet, 25.0, push=(0.5, 0.0, -0.5))
    assert seen["position"][:, -1] == pytest.approx((0.0, 0.0, 10.0), abs=1e-4)


@pytest.mark.parametrize("gravity", [0.0, 1e-12])
def test_without_gravity_it_is_driven_by_its_rotors_alone(gravity: float) -> None:
    fleet = QuadrotorFleet([Quadrotor()] * 3, [(0.0, 3.0 * row, 5.0) for row in range(3)], [0.0] * 3, gravity)
    fleet.set_velocity(1, (1.0, 0.0, 1.0), 0.5)
    fleet.set_waypoint(2, (1.0, 6.0, 7.0))
    for _ in range(240):
        fleet.integrate(*fleet.wrench(1 / 120, np.zeros((3, 3))), 1 / 120)
    assert all(np.isfinite(each).all() for each in (fleet.position, fleet.velocity, fleet.attitude, fleet.rate, fleet.rotor))
    assert fleet.position[0] == pytest.approx((0.0, 0.0, 5.0), abs=1e-3)  # nothing to do
    assert (fleet.velocity[1:, 2] > 0.3).all()
