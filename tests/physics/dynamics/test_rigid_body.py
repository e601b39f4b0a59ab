"""Rigid bodies of a fleet against Bullet and Newton's laws."""

import math
from typing import Any

import numpy as np
import pybullet
import pytest

from vcmvsp.physics.dynamics import quadrotor_laws as laws
from vcmvsp.physics.dynamics.quadrotor_fleet import QuadrotorFleet
from vcmvsp.physics.vehicles.models import Quadrotor

MODEL = Quadrotor(inertia=(0.0040, 0.0055, 0.0073))  # three different moments of inertia: it tumbles
NOTHING = np.zeros((1, 3))


def single(model: Quadrotor = MODEL, **state: Any) -> QuadrotorFleet:
    fleet = QuadrotorFleet([model], [(0.0, 0.0, 5.0)], [0.0])
    for name, value in state.items():
        getattr(fleet, name)[0] = value
    return fleet


def rotation(fleet: QuadrotorFleet, row: int = 0) -> Any:
    return np.reshape(laws.rotation(tuple(fleet.attitude.T), row), (3, 3))


def precession(fleet: QuadrotorFleet, row: int, torque: tuple[float, float, float], dt: float) -> Any:
    state: Any = fleet._state
    state.clock[laws.STEP] = dt
    for component, value in zip(state.moment, torque, strict=True):
        component[row] = value
    return np.array(laws.precession(state, fleet._model, row))


@pytest.mark.parametrize("hz", [60, 120, 240])
@pytest.mark.parametrize("rate", [(3.0, -5.0, 8.0), (0.0, 0.0, 0.0), (1e-4, 2e-4, -1e-4)], ids=["tumbling", "still", "slow"])
@pytest.mark.parametrize("pushed", [True, False])
def test_it_moves_as_in_bullet(hz: int, rate: tuple[float, float, float], *, pushed: bool) -> None:
    fleet = single(velocity=(1.0, -2.0, 3.0), attitude=(0.5, -0.5, 0.1, 0.7), rate=rate)
    client = pybullet.connect(pybullet.DIRECT)
    try:
        body = pybullet.createMultiBody(MODEL.mass_kg, physicsClientId=client)
        still = {"localInertiaDiagonal": MODEL.inertia, "linearDamping": 0, "angularDamping": 0}
        pybullet.changeDynamics(body, -1, **still, physicsClientId=client)
        pybullet.setGravity(0, 0, -9.81, physicsClientId=client)
        pybullet.setTimeStep(1.0 / hz, physicsClientId=client)
        w, x, y, z = fleet.attitude[0].tolist()
        pybullet.resetBasePositionAndOrientation(body, (0, 0, 5), (x, y, z, w), client)
        spin = (rotation(fleet) @ fleet.rate[0]).tolist()
        pybullet.resetBaseVelocity(body, (1, -2, 3), spin, client)
        for step in range(hz):
            time = step / hz
            force = np.array([[math.sin(9 * time), 0.3, 7.0]]) * pushed
            torque = np.array([[0.02 * math.cos(5 * time), 0.02, -0.01]]) * pushed
            place, _ = pybullet.getBasePositionAndOrientation(body, client)
            pybullet.applyExternalForce(body, -1, force[0].tolist(), place, pybullet.WORLD_FRAME, client)
            pybullet.applyExternalTorque(body, -1, torque[0].tolist(), pybullet.WORLD_FRAME, client)
            pybullet.stepSimulation(client)
            fleet.integrate(force, torque, 1.0 / hz)
        position, (x, y, z, w) = pybullet.getBasePositionAndOrientation(body, client)
        velocity, spin = pybullet.getBaseVelocity(body, client)
    finally:
        pybullet.disconnect(client)
    assert fleet.position[0] == pytest.approx(position, abs=1e-9)
    assert fleet.velocity[0] == pytest.approx(velocity, abs=1e-9)
    assert fleet.attitude[0] * np.sign(fleet.attitude[0, 0] * w) == pytest.approx((w, x, y, z), abs=1e-9)
    assert rotation(fleet) @ fleet.rate[0] == pytest.approx(spin, abs=1e-9)


def test_without_gravity_or_force_motion_is_straight() -> None:
    fleet = QuadrotorFleet([MODEL], [(0.0, 0.0, 5.0)], [0.0], gravity=1e-300)
    fleet.velocity[0] = 1.0, 2.0, 3.0
    for _ in range(100):
        fleet.integrate(NOTHING, NOTHING, 0.01)
    assert fleet.position[0] == pytest.approx((1.0, 2.0, 8.0))


@pytest.mark.parametrize("hz", [60, 120, 240])
@pytest.mark.parametrize("inertia", [(0.0040, 0.0055, 0.0073), (0.0040, 0.0040, 0.0073)], ids=["three", "two"])
def test_with_the_torque_of_precession_tumbling_keeps_energy_and_momentum(hz: int, inertia: tuple[float, float, float]) -> None:
    """Correction of `QuadrotorFleet.wrench`: energy and magnitude of momentum are conserved; the vector deviates by less than
    1.5 dt of its length.
    """
    fleet, moments, dt = single(Quadrotor(inertia=inertia), rate=(5.0, 0.3, 2.0)), np.array(inertia), 1.0 / hz
    before, energy = rotation(fleet) @ (moments * fleet.rate[0]), float(moments @ fleet.rate[0] ** 2)
    for _ in range(5 * hz):
        torque = precession(fleet, 0, (0.0, 0.0, 0.0), dt)
        fleet.integrate(NOTHING, (rotation(fleet) @ torque)[None], dt)
        after = rotation(fleet) @ (moments * fleet.rate[0])
        assert np.linalg.norm(after - before) < 1.5 * dt * np.linalg.norm(before)
    assert float(moments @ fleet.rate[0] ** 2) == pytest.approx(energy, rel=1e-9)
    assert np.linalg.norm(after) == pytest.approx(np.linalg.norm(before), rel=1e-9)


def test_slow_rotation_gets_no_correction() -> None:
    fleet = QuadrotorFleet([MODEL] * 2, [(0.0, 0.0, 5.0)] * 2, [0.0] * 2)
    fleet.rate[:] = [[5.0, 0.3, 2.0], [0.1, 0.2, 0.0]]
    assert np.abs(precession(fleet, 0, (0.0, 0.0, 0.0), 0.01)).max() > 0.0
    assert precession(fleet, 1, (0.0, 0.0, 0.0), 0.01).tolist() == [0.0, 0.0, 0.0]


def test_rotations_agree_with_quaternions() -> None:
    rng = np.random.default_rng(1)
    attitude = rng.normal(size=(4, 50))
    attitude /= np.linalg.norm(attitude, axis=0)
    vector = rng.normal(size=(3, 50))
    w, xyz = attitude[0], attitude[1:]
    twice = 2.0 * np.cross(xyz, vector, axis=0)
    turned = vector + w * twice + np.cross(xyz, twice, axis=0)
    for k in range(50):
        matrix = laws.rotation(tuple(attitude), k)
        assert laws.into_world(matrix, *vector[:, k]) == pytest.approx(turned[:, k], abs=1e-14)
        assert laws.into_body(matrix, *turned[:, k]) == pytest.approx(vector[:, k], abs=1e-14)


def test_motion_needs_no_autopilot() -> None:
    state: Any = {"attitude": (0.5, -0.5, 0.1, 0.7), "rate": (3.0, -5.0, 8.0)}
    flown, thrown = single(**state), single(**state)
    for _ in range(10):
        force, torque = flown.wrench(0.01, NOTHING)
        for _ in range(2):
            flown.integrate(force, torque, 0.01)
            thrown.integrate(force, torque, 0.01)
        flown.attitude[0] = thrown.attitude[0] = thrown.attitude[0, [0, 2, 3, 1]]  # as a contact solver would
    assert (flown.attitude == thrown.attitude).all()
    assert (flown.rate == thrown.rate).all()
    assert (flown.position == thrown.position).all()
