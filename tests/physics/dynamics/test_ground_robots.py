"""Ground robots in both engines: tracking of commands, momentum, friction and walls."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.support.physics.engines import ENGINES, engine
from tests.support.physics.runs import play
from vcmvsp.cosim.clock import SECOND_NS, Ticks
from vcmvsp.cosim.federate import Instants
from vcmvsp.cosim.types import Contact
from vcmvsp.physics.federate import MujocoPhysics, Physics
from vcmvsp.physics.vehicles.models import P2DX, AmigoBot, DifferentialDrive
from vcmvsp.physics.vehicles.specification import VehicleSpec
from vcmvsp.physics.world.solids import Box
from vcmvsp.physics.world.world import World

pytestmark = [pytest.mark.slow, pytest.mark.parametrize("kind", ENGINES)]

Drive = Callable[..., Any]
ROBOTS = pytest.mark.parametrize("robot", [P2DX(), AmigoBot()], ids=["p2dx", "amigobot"])
WALL = World(solids=(Box(center=(2.0, 0.0, 0.5), size=(0.2, 4.0, 1.0)),))


def without_ramps(robot: DifferentialDrive) -> DifferentialDrive:
    """The robot without firmware ramps, limited by torque and friction only."""
    return replace(robot, accel=1e6, decel=1e6, yaw_accel=1e6)


@ROBOTS
def test_straight_ahead_is_tracked(kind: type[Physics], robot: DifferentialDrive, drive: Drive) -> None:
    moved = drive(kind, robot, [(0.0, 0.3, 0.0)], 5.0)
    steady = moved.t >= 2.0
    assert moved.speed[steady] == pytest.approx(0.3, rel=0.01)
    assert moved.position[-1, 0] == pytest.approx(0.3 * 5.0 - 0.3**2 / (2.0 * 0.3), abs=0.005)  # minus the ramp
    assert abs(moved.position[-1, 1]) < 0.001  # drift over 1.4 m
    assert np.abs(moved.position[:, 2]).max() < 1e-3


@ROBOTS
def test_a_circle_is_tracked(kind: type[Physics], robot: DifferentialDrive, drive: Drive) -> None:
    moved = drive(kind, robot, [(0.0, 0.3, 0.5)], 9.0)
    steady = moved.t >= 2.0
    assert moved.speed[steady] == pytest.approx(0.3, rel=0.01)
    assert moved.yaw_rate[steady] == pytest.approx(0.5, rel=0.01)
    centre = moved.position[steady][:, :2] + 0.6 * np.column_stack([-np.sin(moved.yaw[steady]), np.cos(moved.yaw[steady])])
    assert np.hypot(*(centre - centre[0]).T).max() < 0.01  # the centre of the circle of 0.6 m stays fixed


@ROBOTS
def test_turning_on_the_spot_stays_on_the_spot(kind: type[Physics], robot: DifferentialDrive, drive: Drive) -> None:
    moved = drive(kind, robot, [(0.0, 0.0, 1.0)], 7.0)
    assert moved.yaw[-1] - moved.yaw[10] == pytest.approx(6.0, rel=0.005)
    assert np.hypot(*moved.position[:, :2].T).max() < 0.005


@ROBOTS
def test_the_firmware_ramps_up_and_down(kind: type[Physics], robot: DifferentialDrive, drive: Drive) -> None:
    moved = drive(kind, robot, [(0.0, 0.3, 0.0), (3.0, 0.0, 0.0)], 6.0, hz=60.0)
    at_90_percent = moved.t[np.argmax(moved.speed >= 0.27)]
    assert at_90_percent == pytest.approx(0.27 / 0.3, abs=0.05)  # 0.3 m/s2
    stop_m = moved.position[-1, 0] - moved.position[180, 0]
    assert stop_m == pytest.approx(0.3**2 / (2.0 * robot.decel), rel=0.03)


@ROBOTS
def test_greatest_speeds_are_kept(kind: type[Physics], robot: DifferentialDrive, drive: Drive) -> None:
    moved = drive(kind, replace(robot, accel=2.0), [(0.0, 9.0, 0.0)], 4.0)
    assert moved.speed[-1] == pytest.approx(robot.max_speed, rel=0.01)


@ROBOTS
def test_without_ramps_the_motors_torque_limits_acceleration(
    kind: type[Physics], robot: DifferentialDrive, drive: Drive
) -> None:
    moved = drive(kind, without_ramps(robot), [(0.0, 1.0, 0.0)], 1.0, hz=60.0)
    # Force of two wheels minus caster friction, over the mass and the inertia of two discs (half their mass each). The
    # caster's load follows from the moments about the contact points of the wheels.
    m, base_kg = robot, robot.mass_kg - 2.0 * robot.wheel_mass_kg
    drag = m.caster_friction / m.caster_behind_m
    force = 2.0 * m.torque / m.wheel_radius_m - drag * base_kg * 9.81 * m.mass_behind_m
    moved_kg = m.mass_kg + m.wheel_mass_kg + drag * (base_kg * m.mass_height_m + 3.0 * m.wheel_mass_kg * m.wheel_radius_m)
    greatest = force / moved_kg
    early = moved.t <= 0.2
    assert np.polyfit(moved.t[early], moved.speed[early], 1)[0] == pytest.approx(greatest, rel=0.02)


@ROBOTS
def test_no_wheelie_even_without_ramps(kind: type[Physics], robot: DifferentialDrive, drive: Drive) -> None:
    moved = drive(kind, without_ramps(robot), [(0.0, 1.0, 0.0), (3.0, 0.0, 0.0), (4.0, -0.3, 0.0)], 6.0, hz=60.0)
    assert np.abs(moved.pitch).max() < math.radians(0.5)


@ROBOTS
def test_slip_on_a_slippery_floor_is_not_in_the_odometry(kind: type[Physics], robot: DifferentialDrive, drive: Drive) -> None:
    def slip_m(friction: float, model: DifferentialDrive) -> float:
        world = World(floor_friction=friction / robot.wheel_friction)
        moved = drive(kind, model, [(0.0, 1.0, 0.0)], 4.0, hz=60.0, world=world)
        return float(moved.odometry[-1, 0] - moved.position[-1, 0])

    assert 0.65 < slip_m(0.05, without_ramps(robot)) < 1.6
    assert 0.03 < slip_m(0.2, without_ramps(robot)) < 0.4
    assert abs(slip_m(0.2, robot)) < 3e-3  # the firmware's ramp stays below the friction limit


@ROBOTS
def test_odometry_agrees_with_the_truth_where_wheels_roll(kind: type[Physics], robot: DifferentialDrive, drive: Drive) -> None:
    commands = [(0.0, 0.4, 0.3), (4.0, 0.2, -0.8), (8.0, 0.5, 0.0)]
    moved = drive(kind, robot, commands, 12.0)
    assert np.hypot(*(moved.odometry[:, :2] - moved.position[:, :2]).T).max() < 0.02
    assert np.abs(np.angle(np.exp(1j * (moved.odometry[:, 2] - moved.yaw)))).max() < 0.02
    assert np.abs(moved.wheel_speed - moved.speed).max() < 0.01


@ROBOTS
@pytest.mark.parametrize("speed", [0.3, 1.6])
def test_walls_stop_a_robot(kind: type[Physics], robot: DifferentialDrive, speed: float, drive: Drive) -> None:
    moved = drive(kind, robot, [(0.0, speed, 0.0)], 8.0, world=WALL)
    front = moved.position[:, 0] + 0.5 * robot.length_m - robot.axle_ahead_m
    assert front.max() < 1.9 + 0.02
    assert front[-1] == pytest.approx(1.9, abs=0.01)
    assert moved.speed[-1] < 0.01
    assert np.abs(moved.position[:, 2]).max() < 0.005  # no climbing
    assert moved.contacts[0].value == Contact(vehicle="car", other=None)
    assert len(moved.contacts) == 1  # continuous contact counts once


def test_robots_collide_and_both_are_named(kind: type[Physics]) -> None:
    vehicles = [
        VehicleSpec(name="late", model=AmigoBot(), position=(2.0, 0.0, 0.0), heading=math.pi),
        VehicleSpec(name="early", model=P2DX(), position=(0.0, 0.0, 0.0)),
    ]
    steps = play(kind(world=World(), vehicles=vehicles), [(0.0, "early", 0.5, 0.0)], 5.0, [Instants(Ticks.every(0.1))])
    contacts = [event for events in steps for event in events if event.key == "world/contact"]
    assert contacts[0].value == Contact(vehicle="late", other="early")
    touch_s = 0.5 / 0.3 / 2.0 + (2.0 - (0.5 * 0.511 - 0.04) - (0.5 * 0.33 - 0.01)) / 0.5  # ramp, then the gap between bodies
    assert contacts[0].time_ns / 1e9 == pytest.approx(touch_s, abs=0.11)
    last: Any = steps[-1][0].value
    assert last.position[0, 0] > 2.1  # pushed


def test_wheels_and_boxes_do_not_widen_a_robot(kind: type[Physics], drive: Drive) -> None:
    robot = P2DX()
    walls = tuple(Box(center=(2.0, side * (0.5 * robot.width_m + 0.03 + 0.1), 0.5), size=(3.0, 0.2, 1.0)) for side in (1, -1))
    moved = drive(kind, robot, [(0.0, 0.4, 0.0)], 9.0, world=World(solids=walls))
    assert moved.contacts == []
    assert moved.position[-1, 0] > 3.0


@ROBOTS
def test_the_reference_points_velocity_is_the_derivative_of_its_position(kind: type[Physics], robot: DifferentialDrive) -> None:
    moved = engine((robot, (0.0, 0.0, 0.0)), kind=kind)
    moved.command(0, (0.3, 0.0, 0.0), 1.5)
    moved.advance(3 * SECOND_NS)
    before = moved.read()
    moved.advance(3 * SECOND_NS + SECOND_NS // 120)
    after = moved.read()
    by_difference = (after.position - before.position) * 120.0
    assert by_difference == pytest.approx(0.5 * (after.velocity + before.velocity), abs=2e-3)
    assert after.angular_velocity[0, 2] == pytest.approx(1.5, abs=0.01)
    bounces = 0.2 if kind is MujocoPhysics else 0.01  # rad/s, of the caster: 0.2 mm high
    assert np.abs(after.angular_velocity[0, :2]).max() < bounces
