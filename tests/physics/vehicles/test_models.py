"""Parameters of a quadrotor against the measurements behind them, and refused values."""

import math

import msgspec
import numpy as np
import pytest

from vcmvsp.physics.dynamics.quadrotor_fleet import QuadrotorFleet
from vcmvsp.physics.vehicles.models import P2DX, Point, Quadrotor
from vcmvsp.physics.vehicles.specification import body_of
from vcmvsp.physics.world.solids import Hull

MODEL = Quadrotor()
RPM = math.tau / 60.0


def test_rotors_lift_and_drag_as_measured() -> None:
    speed = 4626 * RPM
    assert MODEL.thrust_factor * speed**2 == pytest.approx(0.190 * 9.81, rel=0.01)
    assert MODEL.torque_factor * speed**3 == pytest.approx(16.8, rel=0.01)  # W


def test_it_lifts_nearly_three_times_its_weight() -> None:
    assert MODEL.max_rotor_thrust == pytest.approx(5.55, rel=0.01)
    assert 4 * MODEL.max_rotor_thrust / (MODEL.mass_kg * 9.81) == pytest.approx(2.8, rel=0.02)


def test_its_hull_is_the_cylinder_around_arms_and_propellers() -> None:
    assert MODEL.hull.size == pytest.approx((0.534, 0.534, 0.08))
    assert MODEL.hull.kind == "cylinder"
    assert MODEL.arm_m + MODEL.rotor_radius_m == pytest.approx(MODEL.radius_m, abs=1e-3)


def test_its_inertia_is_that_of_a_flat_body() -> None:
    x, y, z = MODEL.inertia
    assert x == y
    assert x < z < x + y  # true for every rigid body; z is close to x + y for a flat one
    assert z > 0.9 * (x + y)


@pytest.mark.parametrize(
    ("key", "value"), [("mass_kg", 0.0), ("inertia", (0.004, 0.004, 0.0)), ("motor_lag_s", -0.1), ("drag", (-1.0, 0, 0))]
)
def test_numbers_outside_their_range_are_refused(key: str, value: object) -> None:
    with pytest.raises(msgspec.ValidationError, match="Expected `float`"):
        msgspec.convert({key: value}, Quadrotor)


@pytest.mark.parametrize(
    ("kind", "key", "value"), [(Quadrotor, "max_tilt_rad", 1.6), (Quadrotor, "max_thrust", 1.1), (P2DX, "clearance_m", 0.22)]
)
def test_impossible_numbers_are_refused(kind: type, key: str, value: float) -> None:
    with pytest.raises(msgspec.ValidationError, match=key):
        msgspec.convert({key: value}, kind)


def test_an_empty_fleet() -> None:
    fleet = QuadrotorFleet([], np.empty((0, 3)), [])
    force, torque = fleet.wrench(0.01, np.empty((0, 3)))
    fleet.integrate(force, torque, 0.01)
    assert force.shape == torque.shape == fleet.position.shape == (0, 3)


@pytest.mark.parametrize(
    ("hull", "width", "radius"),
    [
        (Hull((0.5, 0.5, 0.2), kind="cylinder"), 0.5, 0.25),
        (Hull((0.5, 0.5, 0.2), (0.3, 0.4, 0.0), "cylinder"), 1.3, 0.75),
        (Hull((0.6, 0.4, 0.2)), 0.4, math.hypot(0.3, 0.2)),
        (Hull((0.6, 0.4, 0.2), (-0.1, 0.05, 0.0)), 0.5, math.hypot(0.4, 0.25)),
    ],
)
def test_a_hull_beside_the_reference_point_counts(hull: Hull, width: float, radius: float) -> None:
    class Placed(Point):
        @property
        def hull(self) -> Hull:
            return placed

    placed = hull
    body = body_of(Placed())
    assert (body.width_m, body.radius_m) == pytest.approx((width, radius))
