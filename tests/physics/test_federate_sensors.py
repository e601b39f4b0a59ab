"""Times of sensor readings, and the scenes given to sensors."""

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
import pytest

from tests.support.physics.engines import KINDS
from tests.support.physics.runs import run, values
from vcmvsp.cosim.clock import SECOND_NS, Ticks
from vcmvsp.cosim.federate import Instants
from vcmvsp.cosim.types import Measured
from vcmvsp.physics.federate import BulletPhysics, Physics
from vcmvsp.physics.sensors.detectors import Bumper
from vcmvsp.physics.sensors.positioning import Positioning
from vcmvsp.physics.sensors.sensor import Sensor
from vcmvsp.physics.vehicles.models import P2DX, Point, Quadrotor
from vcmvsp.physics.vehicles.specification import VehicleSpec
from vcmvsp.physics.world.solids import Box, Cylinder
from vcmvsp.physics.world.world import Movable, Moving, Scene, World

FIFTH = (Instants(Ticks.every(0.2)),)


@dataclass(kw_only=True)
class SceneRecorder(Sensor):
    """Records the scenes given to it."""

    scenes: ClassVar[list[tuple[int, Scene]]] = []
    offset: float = field(default=0.0)

    def measure(self, scene: Scene, row: int, rng: np.random.Generator) -> Measured:
        SceneRecorder.scenes.append((row, scene))
        return Measured(time_ns=scene.now_ns, values={"z": float(scene.position[row, 2]) + self.offset})


@pytest.fixture(autouse=True)
def clear_scenes() -> None:
    SceneRecorder.scenes.clear()


@KINDS
def test_states_are_published_at_instants_and_readings_at_own_ticks(kind: type[Physics]) -> None:
    sensors: Any = {"witness": SceneRecorder(rate_hz=20.0, phase_s=0.1, latency_s=0.05)}
    car = VehicleSpec(name="car", model=P2DX(), sensors=sensors, positioning=Positioning(rate_hz=4.0))
    times: dict[str, list[float]] = {}
    for event in run(kind(world=World(), vehicles=[car]), (), 1.0, FIFTH):
        times.setdefault(event.key, []).append(event.time_ns / 1e9)
    assert times["world/states"] == times["car/estimate"] == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])
    assert times["car/fix"] == pytest.approx([0.0, 0.25, 0.5, 0.75, 1.0])
    assert [scene.now_ns / 1e9 for _, scene in SceneRecorder.scenes] == pytest.approx(np.arange(0.1, 1.001, 0.05))
    assert times["car/witness"] == pytest.approx(np.arange(0.15, 1.051, 0.05))  # delivered 0.05 s later


@KINDS
def test_a_sensor_gets_all_published_bodies_read_only(kind: type[Physics]) -> None:
    crate = Movable(name="crate", solid=Box(center=(1.0, 0.0, 0.2), size=(0.4, 0.4, 0.4)), mass_kg=1.0)
    gate = Moving(
        name="gate",
        solid=Box(center=(0, 0, 0), size=(1.0, 1.0, 1.0)),
        times_s=(0.0, 1.0),
        way=((9.0, 0, 1, 0), (9.0, 2.0, 1, 0)),
    )
    world = World(movables=(crate,), moving=(gate,))
    sensors: Any = {"witness": SceneRecorder(rate_hz=5.0)}
    vehicles = [
        VehicleSpec(name="car", model=P2DX()),
        VehicleSpec(name="uav", model=Quadrotor(), position=(0.0, 0.0, 2.0), sensors=sensors),
        VehicleSpec(name="point", model=Point(), position=(0.0, 1.0, 2.0)),
    ]
    states = values(run(kind(world=world, vehicles=vehicles), [(0.0, "car", 0.3, 0.0)], 1.0, FIFTH), "world/states")
    assert len(SceneRecorder.scenes) == len(states) == 6
    for (row, scene), published in zip(SceneRecorder.scenes, states, strict=True):
        assert (row, scene.vehicles, len(scene.hulls)) == (1, ("car", "uav", "point"), 5)
        assert np.array_equal(scene.position[:3], published.position)
        assert scene.position[3] == pytest.approx((1.0, 0.0, 0.2), abs=0.05)
        assert scene.position[4] == pytest.approx((9.0, 2.0 * scene.now_ns / 1e9, 1.0))
        assert scene.acceleration.shape == (3, 3)
        assert scene.wheels.shape == (3, 2)
        assert np.isnan(scene.wheels[1:]).all()
        for array in (scene.position, scene.velocity, scene.attitude, scene.angular_velocity, scene.acceleration, scene.wheels):
            assert not array.flags.writeable
    wheels = SceneRecorder.scenes[-1][1].wheels[0]
    assert wheels == pytest.approx(wheels.mean(), rel=1e-3)
    travelled = SceneRecorder.scenes[-1][1].position[0, 0]
    assert wheels.mean() * P2DX().wheel_radius_m == pytest.approx(travelled, abs=2e-3)


def test_accelerations_are_means_over_the_last_step() -> None:
    sensors: Any = {"witness": SceneRecorder(rate_hz=120.0)}
    vehicles = [
        VehicleSpec(name="car", model=P2DX(), sensors=sensors),
        VehicleSpec(name="uav", model=Quadrotor(), position=(0.0, 3.0, 2.0)),
    ]
    run(BulletPhysics(world=World(), vehicles=vehicles), [(0.0, "car", 0.3, 0.2)], 1.0, FIFTH)
    scenes = [scene for _, scene in SceneRecorder.scenes]
    assert len(scenes) == 121
    for before, after in pairwise(scenes):
        by_difference = (after.velocity[:2] - before.velocity[:2]) * 120.0
        assert after.acceleration == pytest.approx(by_difference, abs=1e-9)
    assert max(scene.acceleration[0, 0] for scene in scenes) > 0.2


def contacts(**sensors: Any) -> list[tuple[int, Any]]:
    """Times and contacts of a quadrotor that bounces off a wall between two publications; other sensors ask in between."""
    wall = World(solids=(Box(center=(3.0, 0.0, 2.0), size=(0.2, 4.0, 4.0)),))
    uav = VehicleSpec(name="uav", model=Quadrotor(), position=(0.0, 0.0, 2.0), sensors=sensors)
    events = run(BulletPhysics(world=wall, vehicles=[uav]), [(0.0, "uav", 3.0, 0.0)], 3.0, FIFTH)
    return [(event.time_ns, event.value) for event in events if event.key == "world/contact"]


def test_more_sensors_lose_no_contact() -> None:
    expected = contacts()
    assert expected
    for rate_hz in (5.0, 20.0, 120.0):
        assert contacts(witness=SceneRecorder(rate_hz=rate_hz)) == expected


def test_a_sensor_gets_contacts_only_while_they_last() -> None:
    """Hence no sensor affects the scene of another one."""

    def contact_flags(**others: Any) -> list[bool]:
        SceneRecorder.scenes.clear()
        contacts(witness=SceneRecorder(rate_hz=20.0), **others)
        return [bool(scene.touching) for _, scene in SceneRecorder.scenes if scene.now_ns % (SECOND_NS // 20) == 0]

    assert contact_flags() == contact_flags(bumper=Bumper(rate_hz=120.0))


def test_a_sensor_gets_all_contact_points() -> None:
    """A robot drives straight into two posts."""
    posts = World(solids=tuple(Cylinder(center=(1.0, y, 0.5), radius=0.05, height=1.0) for y in (0.15, -0.15)))
    sensors: Any = {"witness": SceneRecorder(rate_hz=20.0)}
    car = VehicleSpec(name="car", model=P2DX(), sensors=sensors)
    run(BulletPhysics(world=posts, vehicles=[car]), [(0.0, "car", 0.3, 0.0)], 5.0, FIFTH)
    sides = [{round(float(place[1]) / 0.15) for _, _, place in scene.touching} for _, scene in SceneRecorder.scenes]
    assert {1, -1} in sides
    assert sides[0] == set()
    row, other, place = SceneRecorder.scenes[-1][1].touching[0]
    assert (row, other) == (0, None)
    assert place[0] == pytest.approx(0.95, abs=0.02)
    assert all(side <= {1, -1} for side in sides)
