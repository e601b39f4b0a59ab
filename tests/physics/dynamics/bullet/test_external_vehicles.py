"""External vehicles as bodies in Bullet: they stop and push other bodies, and no body moves them."""

from typing import Any

import numpy as np
import pytest

from tests.support.physics.external_vehicles import Course, Courses, spec, straight
from tests.support.physics.runs import run, values
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.types import VehicleState
from vcmvsp.physics.dynamics.bullet import p
from vcmvsp.physics.dynamics.bullet.engine import BulletEngine
from vcmvsp.physics.dynamics.kinematic import ExternalEngine
from vcmvsp.physics.federate import MujocoPhysics, Physics
from vcmvsp.physics.sensors.detectors import Bumper
from vcmvsp.physics.vehicles.models import P2DX, AmigoBot, Lag, Quadrotor
from vcmvsp.physics.world.solids import Box, Cylinder
from vcmvsp.physics.world.world import Movable, World

pytestmark = pytest.mark.slow

BACK = 0.5 * P2DX().length_m + P2DX().axle_ahead_m  # m, from the reference point
FRONT = 0.5 * P2DX().length_m - P2DX().axle_ahead_m
DEEP_M = 0.002  # greatest penetration of two bodies


def track(events: list[Event], row: int) -> np.ndarray:
    """Positions of the vehicle of a row, (n, 3) m."""
    return np.array([states.position[row] for states in values(events, "world/states")])


def contacts(events: list[Event]) -> list[tuple[str, str | None]]:
    return [(contact.vehicle, contact.other) for contact in values(events, "world/contact")]


@pytest.mark.parametrize("v", [0.3, 1.0, 1.6])
def test_a_robot_stops_at_one_without_penetration(v: float, kind: type[Physics]) -> None:
    at = 1.2 + v * v / 0.6  # long enough to reach v at 0.3 m/s2
    physics = kind(world=World(), vehicles=[spec("car"), spec("real", at)], outside=Courses(real=straight(at)))
    events = run(physics, [(0.0, "car", v, 0.0)], round(2.0 + at / v + v / 0.6, 1))
    assert max(states.velocity[0, 0] for states in values(events, "world/states")) == pytest.approx(v, rel=0.02)
    assert track(events, 0)[:, 0].max() < at - BACK - FRONT + DEEP_M + v / 120.0  # detected one step later
    assert track(events, 0)[-1] == pytest.approx((at - BACK - FRONT, 0.0, 0.0), abs=DEEP_M)
    assert set(map(tuple, track(events, 1).tolist())) == {(at, 0.0, 0.0)}
    assert contacts(events) == [("car", "real")]


@pytest.mark.parametrize("names", [("car", "real"), ("real", "car")])
def test_one_that_moves_pushes_a_robot_ahead_of_it(names: tuple[str, str], kind: type[Physics]) -> None:
    places = {"car": 0.0, "real": -1.0}
    vehicles = [spec(name, places[name]) for name in names]
    events = run(kind(world=World(), vehicles=vehicles, outside=Courses(real=straight(-1.0, 0.5))), seconds=6.0)
    car, real = (track(events, names.index(name)) for name in ("car", "real"))
    assert real[:, 0] == pytest.approx(-1.0 + 0.05 * np.arange(61), abs=1e-12)
    apart = car[:, 0] - real[:, 0]
    assert apart.min() > BACK + FRONT - DEEP_M - 0.5 / 120.0  # detected one step later
    assert apart[-1] == pytest.approx(BACK + FRONT, abs=DEEP_M)  # pushed, with motors braking
    assert contacts(events) == [names]  # once, the scenario's first vehicle first


def test_it_pushes_things_and_is_a_body_of_any_kind(kind: type[Physics]) -> None:
    crate = Movable(name="crate", solid=Box(center=(0.0, 0.0, 0.2), size=(0.4, 0.4, 0.4)), mass_kg=3.0)
    for model in (Lag(), AmigoBot(), P2DX()):
        hull = model.hull
        real = spec("real", -1.5, model=model)
        physics = kind(world=World(movables=(crate,)), vehicles=[real], outside=Courses(real=straight(-1.5, 0.5)))
        events = run(physics, (), 4.0)
        assert {other for _, other in contacts(events)} == {"crate"}
        crate_x = values(events, "world/pushed")[-1].position[0, 0]
        assert crate_x > 0.5 + hull.offset[0] + 0.5 * hull.size[0] + 0.2 - DEEP_M - 0.5 / 120.0


def test_contacts_with_walls_and_each_other_count(kind: type[Physics]) -> None:
    """External vehicles pass through the wall and each other; each contact is still published."""
    world = World(solids=(Box(center=(2.0, 0.0, 0.5), size=(0.2, 4.0, 1.0)),))
    courses = Courses(a=straight(0.0, 0.5), b=straight(-2.0, 1.2))
    events = run(kind(world=world, vehicles=[spec("a"), spec("b", -2.0)], outside=courses), seconds=4.0)
    touches: list[Any] = [event for event in events if event.key == "world/contact"]
    touched = {(event.value.vehicle, event.value.other): event.time_ns / 1e9 for event in touches}
    expected = {("a", "b"): (2.0 - BACK - FRONT) / 0.7, ("b", None): (3.9 - FRONT) / 1.2, ("a", None): (1.9 - FRONT) / 0.5}
    assert touched == pytest.approx(expected, abs=0.14 if kind is MujocoPhysics else 0.11)


def test_a_quadrotor_bumps_into_one_as_into_a_solid_of_its_shape(kind: type[Physics]) -> None:
    tall = Quadrotor(height_m=1.0)  # too tall to pass over
    solid = Cylinder(center=(3.0, 0.0, 1.5), radius=tall.radius_m, height=tall.height_m)
    uav, real = spec("uav", z=1.5, model=Quadrotor()), spec("real", 3.0, z=1.5, model=tall)
    physics = kind(world=World(), vehicles=[uav, real], outside=Courses(real=straight(3.0, z=1.5)))
    commands = [(0.0, "uav", 1.5, 0.0)]
    shown, stood = run(physics, commands, 2.7), run(kind(world=World(solids=(solid,)), vehicles=[uav]), commands, 2.7)
    once = slice(1) if kind is MujocoPhysics else slice(None)  # in MuJoCo it bounces
    assert contacts(shown)[once] == [("uav", "real")]
    assert contacts(stood)[once] == [("uav", None)]
    assert track(shown, 0)[:, 0].max() > 3.0 - 2.0 * tall.radius_m  # close to the solid, tilted
    assert track(shown, 0) == pytest.approx(track(stood, 0), abs=2e-2 if kind is MujocoPhysics else 2e-3)


def test_a_quadrotor_in_free_air_is_hit_by_an_external_one(kind: type[Physics]) -> None:
    courses = Courses(real=straight(-4.0, 1.0, z=3.0))
    model = Quadrotor(height_m=1.0) if kind is MujocoPhysics else Quadrotor()  # too tall to pass over
    vehicles = [spec("real", -4.0, z=3.0, model=model), spec("uav", z=3.0, model=model)]
    events = run(kind(world=World(), vehicles=vehicles, outside=courses), (), 4.5)
    assert contacts(events)[0] == ("real", "uav")
    apart = np.linalg.norm(track(events, 0) - track(events, 1), axis=1)
    assert apart.min() > 2 * Quadrotor().radius_m - 0.05


def test_bumpers_of_both_feel_the_other(kind: type[Physics]) -> None:
    vehicles = [spec("car", sensors={"bumper": Bumper()}), spec("real", 1.0, sensors={"bumper": Bumper()})]
    events = run(kind(world=World(), vehicles=vehicles, outside=Courses(real=straight(1.0))), [(0.0, "car", 0.3, 0.0)], 4.0)
    for name in ("car", "real"):
        felt = [sum(reading.values.values()) for reading in values(events, f"{name}/bumper")]
        assert felt[0] == 0.0
        assert max(felt[-10:]) > 0.0


def test_the_body_is_at_its_published_pose_before_each_step() -> None:
    """Also between instants, by extrapolation at constant velocity. After a step, Bullet has moved the body on by that step."""
    state = VehicleState(
        position=(1.0, 2.0, 0.0), velocity=(0.4, -0.3, 0.0), attitude=quaternion_from_yaw(0.5), angular_velocity=(0.0, 0.0, 0.7)
    )
    vehicle = spec("real", 1.0, 2.0, heading=0.5)
    reflected = ExternalEngine(Courses(real=lambda _: state), [vehicle])
    engine = BulletEngine(world=World(), vehicles=[vehicle], rate_hz=120.0, iterations=50, gravity=9.81, external=reflected)
    reflected.update(0)
    for step in range(1, 61):
        engine.advance(step * SECOND_NS // 120)
        (place, (x, y, z, w)) = p.getBasePositionAndOrientation(engine._external_bodies.bodies[0], engine._client)  # type: ignore[union-attr]
        expected, _ = reflected.at(step * SECOND_NS // 120)
        assert place == pytest.approx(expected.position[0], abs=1e-6)
        assert (w, x, y, z) == pytest.approx(expected.attitude[0], abs=1e-6)
    engine.close()


def jump_course(x: float, jump: float) -> Course:
    """Course at rest that jumps after 1 s."""
    return lambda t: VehicleState(position=(x + (jump if t >= 1.0 else 0.0), 0.0, 0.0))


@pytest.mark.parametrize("jump", [0.1, 0.3, 0.6, 0.95])
def test_a_jumping_estimate_pushes_a_robot_aside_without_throwing_it(jump: float, kind: type[Physics]) -> None:
    real = -BACK - FRONT - 0.02
    physics = kind(world=World(), vehicles=[spec("car"), spec("real", real)], outside=Courses(real=jump_course(real, jump)))
    events = run(physics, seconds=4.0)
    speed = np.array([np.linalg.norm(states.velocity[0]) for states in values(events, "world/states")])
    assert speed.max() < 0.55
    rolls_on_m = 0.02 if kind is MujocoPhysics else 0.0  # from 0.5 m/s, after the body behind it has stopped
    assert track(events, 0)[-1] == pytest.approx((jump - 0.02, 0.0, 0.0), abs=DEEP_M + rolls_on_m)
    offsets = track(events, 1)[:, 0] - real
    assert offsets.tolist() == pytest.approx([0.0] * 10 + [jump] * 31)  # published rows jump as the course does
