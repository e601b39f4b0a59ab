"""The federate with aerial and ground vehicles, and refusals before the start."""

import math
from typing import Any

import numpy as np
import pytest

from tests.support.physics.engines import KINDS
from tests.support.physics.runs import Command, steps_of
from vcmvsp.cosim.errors import FederateError, ScenarioError
from vcmvsp.cosim.types import Vec3, Velocity, Waypoint
from vcmvsp.physics.federate import BulletPhysics, Physics
from vcmvsp.physics.sensors.positioning import Positioning
from vcmvsp.physics.vehicles.models import P2DX, Kinematic, Point, Quadrotor
from vcmvsp.physics.vehicles.specification import Vehicle, VehicleSpec
from vcmvsp.physics.world.solids import Box
from vcmvsp.physics.world.world import Movable, Moving, Wind, World

pytestmark = pytest.mark.slow

HIGH = (0.0, 0.0, 3.0)


def spec(name: str, model: Vehicle, position: Vec3 = HIGH, **also: Any) -> VehicleSpec:
    return VehicleSpec(name=name, model=model, position=position, **also)


def values_by_step(physics: Physics, commands: list[Command], duration_s: float) -> list[dict[str, Any]]:
    """Values by key, every 0.1 s; each command is delivered at its own time."""
    return [{event.key: event.value for event in events} for events in steps_of(physics, commands, duration_s)]


@KINDS
@pytest.mark.parametrize("model", [Point(), Quadrotor()], ids=["point", "quadrotor"])
def test_a_velocity_is_in_the_world_frame_and_a_way_point_is_reached(kind: type[Physics], model: Vehicle) -> None:
    physics = kind(world=World(), vehicles=[spec("uav", model, heading=1.0)])
    commands: list[Command] = [
        (0.0, "uav", Velocity(linear=(0.0, 1.5, 0.5))),
        (4.0, "uav", Waypoint(position=(2.0, 2.0, 4.0), yaw=-1.0)),
    ]
    steps = values_by_step(physics, commands, 14.0)
    before, end = steps[40]["uav/estimate"], steps[-1]["uav/estimate"]
    assert before.velocity == pytest.approx((0.0, 1.5, 0.5), abs=0.06)
    assert end.position == pytest.approx((2.0, 2.0, 4.0), abs=0.1)
    assert end.yaw == pytest.approx(-1.0, abs=0.05)
    assert "uav/odometry" not in steps[0]  # no wheels


@KINDS
def test_ground_and_air_move_together_each_in_its_place(kind: type[Physics]) -> None:
    models: dict[str, Vehicle] = {"point": Point(), "car": P2DX(), "uav": Quadrotor(), "unicycle": Kinematic()}
    vehicles = [spec(name, model, (3.0 * k, 0.0, 2.0)) for k, (name, model) in enumerate(models.items())]
    commands: list[Command] = [(0.0, name, Velocity(linear=(0.4, 0.0, 0.0))) for name in models]
    steps = values_by_step(kind(world=World(), vehicles=vehicles), commands, 5.0)
    first, last = steps[0]["world/states"], steps[-1]["world/states"]
    assert last.names == tuple(models)
    assert first.position[:, 2] == pytest.approx((2.0, 0.0, 2.0, 0.0), abs=1e-9)
    assert last.position[:, 0] - first.position[:, 0] == pytest.approx((2.0, 2.0, 2.0, 2.0), abs=0.4)
    assert last.position[:, 1:] == pytest.approx(first.position[:, 1:], abs=0.05)
    assert [key for key in steps[1] if key.endswith("/odometry")] == ["car/odometry", "unicycle/odometry"]


@KINDS
def test_a_way_point_for_a_vehicle_on_the_ground_is_refused_by_name(kind: type[Physics]) -> None:
    physics, command = kind(world=World(), vehicles=[spec("car", P2DX())]), Waypoint(position=(1.0, 0.0, 0.0))
    with pytest.raises(FederateError, match=r"car received a Waypoint but cannot fly: send Velocity"):
        values_by_step(physics, [(0.0, "car", command)], 1.0)


@KINDS
@pytest.mark.parametrize(
    "command",
    [
        Velocity(linear=(0.0, math.nan, 0.0)),
        Velocity(linear=(0.0, 0.0, math.inf)),
        Waypoint(position=(0.0, math.nan, 1.0)),
        Waypoint(position=(0.0, 0.0, 1.0), yaw=math.inf),
        Waypoint(position=(0.0, 0.0, 1.0), speed=math.nan),
        Waypoint(position=(0.0, 0.0, 1.0), speed=0.0),
    ],
)
def test_non_finite_commands_stop_the_run_and_name_the_vehicle(kind: type[Physics], command: Velocity | Waypoint) -> None:
    with pytest.raises(FederateError, match="uav"):
        values_by_step(kind(world=World(), vehicles=[spec("uav", Quadrotor())]), [(0.0, "uav", command)], 1.0)


def test_a_quadrotor_uses_its_fixes_and_has_no_odometry() -> None:
    sensor = Positioning(rate_hz=5.0)
    uav = spec("uav", Quadrotor(), pose_source="positioning", positioning=sensor)
    command = Velocity(linear=(1.0, 0.0, 0.0), yaw_rate=0.3)
    steps = values_by_step(BulletPhysics(world=World(), vehicles=[uav]), [(0.0, "uav", command)], 2.0)
    fix: Any = None
    for at in steps:
        fix = at.get("uav/fix", fix)
        estimate, states = at["uav/estimate"], at["world/states"]
        assert estimate.position == fix.position
        assert estimate.yaw == pytest.approx(fix.yaw)
        assert estimate.velocity == tuple(states.velocity[0])
        tilts = [1.0 - 2.0 * (q[1] ** 2 + q[2] ** 2) for q in (estimate.attitude, states.attitude[0])]
        assert tilts[0] == pytest.approx(tilts[1])  # only the heading comes from the fix
    with pytest.raises(ScenarioError, match="needs wheels") as raised:
        spec("uav", Quadrotor(), pose_source="odometry")
    assert raised.value.key == "pose_source"


def test_a_start_below_the_floor_is_raised_onto_it() -> None:
    assert spec("uav", Quadrotor(), (1.0, 2.0, 0.0)).start == (1.0, 2.0, 0.04)
    assert spec("uav", Quadrotor(), (1.0, 2.0, 0.5)).start == (1.0, 2.0, 0.5)
    assert spec("car", P2DX(), (1.0, 2.0, 0.5)).start == (1.0, 2.0, 0.0)
    steps = values_by_step(BulletPhysics(world=World(), vehicles=[spec("uav", Quadrotor(), (0.0, 0.0, 0.0))]), [], 1.0)
    assert steps[-1]["world/states"].position[0] == pytest.approx((0.0, 0.0, 0.04), abs=2e-3)
    assert not any("world/contact" in at for at in steps)


# --- refused before the start ------------------------------------------------------------------------------------------------


ROOF = World(solids=(Box(center=(0.0, 0.0, 2.0), size=(2.0, 2.0, 0.5)),), bounds=(-10.0, -10.0, 10.0, 10.0), name="yard")


def refusal(*vehicles: VehicleSpec, world: World = ROOF, kind: type[Physics] = BulletPhysics) -> ScenarioError:
    with pytest.raises(ScenarioError) as raised:
        values_by_step(kind(world=world, vehicles=vehicles), [], 0.1)
    return raised.value


def test_bodies_inside_others_are_refused_with_the_overlap() -> None:
    error = refusal(spec("uav", Quadrotor(), (0.0, 0.0, 2.2)))
    assert (error.key, "uav and the box at (0.0, 0.0, 2.0)" in error.problem) == ("vehicle.uav.position", True)
    assert "by 0.09 m" in error.problem  # 2.25 - (2.2 - 0.04)
    error = refusal(spec("a", Quadrotor(), (5.0, 0.0, 1.0)), spec("b", Quadrotor(), (5.0, 0.0, 1.05)))
    assert error.key == "vehicle.b.position"
    assert "b and a overlap at the start, by 0.03 m" in error.problem
    table = Movable(name="table", solid=Box(center=(5.0, 0.0, 0.4), size=(1.0, 1.0, 0.8)), mass_kg=5.0)
    error = refusal(spec("car", P2DX(), (5.0, 0.6, 0.0)), world=World(movables=(table,)))
    assert "car and table overlap" in error.problem
    gate = Moving(name="gate", solid=Box(center=(0, 0, 0), size=(1.0, 1.0, 1.0)), times_s=(0.0,), way=((5.0, 0.0, 0.5, 0.0),))
    assert "car and gate overlap" in refusal(spec("car", P2DX(), (5.0, 0.6, 0.0)), world=World(moving=(gate,))).problem


def test_above_below_and_beside_are_free() -> None:
    vehicles = [
        spec("car", P2DX(), (0.0, 0.0, 0.0)),
        spec("under", Quadrotor(), (0.0, 0.0, 1.0)),
        spec("over", Quadrotor(), (0.0, 0.0, 2.5)),
        spec("higher", Quadrotor(), (0.0, 0.0, 2.7)),
        spec("beside", Quadrotor(), (1.4, 0.0, 2.0)),
    ]
    assert len(values_by_step(BulletPhysics(world=ROOF, vehicles=vehicles), [], 0.1)) == 2


@KINDS
def test_vehicles_outside_the_world_are_refused_by_name(kind: type[Physics]) -> None:
    error = refusal(spec("car", Kinematic(), (12.5, 0.0, 0.0)), kind=kind)
    assert (error.key, "car starts 2.5 m outside the world (yard)" in error.problem) == ("vehicle.car.position", True)
    assert "0.5 m below the floor" in refusal(spec("uav", Point(), (0.0, 0.0, -0.5)), kind=kind).problem
    assert "not finite" in refusal(spec("uav", Point(), (0.0, math.nan, 1.0)), kind=kind).problem


# --- contacts, and others in the run -----------------------------------------------------------------------------------------


def test_gusts_move_a_quadrotor_and_follow_the_seed() -> None:
    def end(world: World) -> Any:
        steps = values_by_step(BulletPhysics(world=world, vehicles=[spec("uav", Quadrotor())]), [], 3.0)
        return steps[-1]["world/states"].position[0]

    still, gusty = end(World()), end(World(wind=Wind(gust=2.0)))
    assert still == pytest.approx(HIGH, abs=1e-6)
    assert np.abs(gusty - still).max() > 0.01
    assert np.array_equal(gusty, end(World(wind=Wind(gust=2.0))))
