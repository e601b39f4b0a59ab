"""Bullet: masses, inertia and wheel loads of a robot, and release of Bullet's memory."""

import math

import pytest

from tests.support.physics.engines import engine
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.physics.dynamics.bullet import p
from vcmvsp.physics.vehicles.models import P2DX, AmigoBot, DifferentialDrive

ROBOTS = pytest.mark.parametrize("robot", [P2DX(), AmigoBot()], ids=["p2dx", "amigobot"])


@ROBOTS
def test_mass_and_centre_are_those_of_the_parameters(robot: DifferentialDrive) -> None:
    moved = engine((robot, (1.0, 2.0, 0.0)), headings=[0.7])
    body, client = moved._robots.bodies[0], moved._client
    masses = [p.getDynamicsInfo(body, link, physicsClientId=client)[0] for link in (-1, 0, 1)]
    assert sum(masses) == pytest.approx(robot.mass_kg)
    inertia = p.getDynamicsInfo(body, -1, physicsClientId=client)[2]
    assert inertia[2] == pytest.approx(masses[0] * (robot.length_m**2 + robot.width_m**2) / 12.0)
    motion = moved.read()
    assert motion.position[0] == pytest.approx((1.0, 2.0, 0.0), abs=1e-12)  # the axle, not the centre of mass
    assert motion.attitude[0] == pytest.approx((math.cos(0.35), 0.0, 0.0, math.sin(0.35)))
    assert motion.odometry[0] == pytest.approx((1.0, 2.0, 0.7, 0.0, 0.0))
    moved.advance(2 * SECOND_NS)
    contacts = p.getContactPoints(bodyA=body, physicsClientId=client)
    assert sum(contact[9] for contact in contacts) == pytest.approx(
        9.81 * robot.mass_kg, rel=0.01
    )  # the floor carries the weight
    on_caster = sum(contact[9] for contact in contacts if contact[3] == -1) / 9.81
    assert on_caster == pytest.approx(masses[0] * robot.mass_behind_m / robot.caster_behind_m, rel=0.02)


def test_closing_twice_has_no_effect_and_frees_the_client() -> None:
    moved = engine((P2DX(), (0.0, 0.0, 0.0)))
    client = moved._client
    moved.close()
    moved.close()
    assert not p.isConnected(client)
