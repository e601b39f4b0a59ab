"""Ground effect and downwash against the formulas they are named after."""

import math

import numpy as np
import pytest

from vcmvsp.physics.dynamics.quadrotor_fleet import QuadrotorFleet
from vcmvsp.physics.dynamics.wind import AIR_KG_M3, downwash, ground_effect
from vcmvsp.physics.vehicles.models import Quadrotor

R = 0.1016
WEIGHT = 0.8 * 9.81


@pytest.mark.parametrize(("radii", "factor"), [(0.5, 4 / 3), (1.0, 16 / 15), (2.0, 64 / 63), (100.0, 1.0), (0.0, 4 / 3)])
def test_thrust_near_the_floor(radii: float, factor: float) -> None:
    assert ground_effect(np.array([radii * R]), np.array([R])) == pytest.approx(factor, rel=1e-5)


def below(*places: tuple[float, float, float]) -> list[float]:
    """Downwash of a hovering quadrotor at (0, 0, 10) at places where others are, too light to matter."""
    position = np.array([(0.0, 0.0, 10.0), *places]).T
    n = position.shape[1]
    speeds: list[float] = downwash(position, np.array([WEIGHT] + [0.0] * (n - 1)), np.full(n, R)).tolist()
    assert speeds[0] == 0.0
    return speeds[1:]


def test_the_wind_below_rotors_carries_their_weight() -> None:
    (close,) = below((0.0, 0.0, 9.7))
    area = 4 * math.pi * R**2
    assert AIR_KG_M3 * (0.5 * area) * close**2 == pytest.approx(WEIGHT)  # momentum of the jet, half as wide as the rotors


def test_it_dies_away_downwards_and_sideways_and_is_not_felt_above() -> None:
    close, far, farther, aside, wide, above = below(
        (0, 0, 9.7), (0, 0, 5.0), (0, 0, 0.0), (0.094 * 5, 0, 5.0), (2.0, 0, 5.0), (0, 0, 10.3)
    )
    assert far < close
    assert farther == pytest.approx(far / 2)  # as 1 / distance
    assert aside == pytest.approx(far / 2)  # its half width
    assert wide < 1e-3
    assert above == 0.0


def pair(*, upper: bool) -> QuadrotorFleet:
    models = [Quadrotor(downwash=True), Quadrotor(downwash=True)]
    return QuadrotorFleet(models, [(0.0, 0.0, 5.0), (0.0 if upper else 9.0, 0.0, 6.0)], [0.0, 0.0])


def test_it_pushes_those_below_by_their_drag() -> None:
    force, _ = pair(upper=True).wrench(1e-9, np.zeros((2, 3)))
    (speed,) = below((0.0, 0.0, 9.0))
    assert force[0, 2] == pytest.approx(WEIGHT - 0.35 * speed, rel=1e-6)
    assert force[1, 2] == pytest.approx(WEIGHT, rel=1e-6)
    alone, _ = pair(upper=False).wrench(1e-9, np.zeros((2, 3)))
    assert alone[:, 2] == pytest.approx(WEIGHT, rel=1e-6)


def test_only_models_that_ask_for_it_feel_the_floor() -> None:
    fleet = QuadrotorFleet([Quadrotor(ground_effect=True), Quadrotor()], [(0.0, 0.0, 0.05), (2.0, 0.0, 0.05)], [0.0, 0.0])
    force, _ = fleet.wrench(1e-9, np.zeros((2, 3)))
    assert force[:, 2] / WEIGHT == pytest.approx((4 / 3, 1.0), rel=0.02)


def test_the_autopilot_holds_its_height_in_both() -> None:
    fleet = pair(upper=True)
    fleet.set_waypoint(0, (0.0, 0.0, 5.0))
    fleet.set_waypoint(1, (0.0, 0.0, 6.0))
    for _ in range(1200):
        force, torque = fleet.wrench(1 / 120, np.zeros((2, 3)))
        fleet.integrate(force, torque, 1 / 120)
    assert fleet.position[:, 2] == pytest.approx((5.0, 6.0), abs=0.01)
    assert fleet.rotor[0].mean() > 1.1 * fleet.rotor[1].mean()
