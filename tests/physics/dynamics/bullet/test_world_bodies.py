"""Bodies of a Bullet world: movables are pushed and sleep, moving obstacles follow their timetable, zones change friction."""

import gc
import math
from collections.abc import Callable
from typing import Any

import pytest

from tests.support.physics.engines import engine
from vcmvsp.cosim.clock import SECOND_NS, Ticks
from vcmvsp.physics.dynamics.bullet import p
from vcmvsp.physics.dynamics.engine import on_time
from vcmvsp.physics.vehicles.models import P2DX, AmigoBot, Quadrotor
from vcmvsp.physics.world.solids import Box
from vcmvsp.physics.world.world import Movable, Moving, World, Zone

Make = Callable[..., Any]
pytestmark = pytest.mark.slow


def crate(x: float, mass_kg: float, friction: float = 0.5) -> Movable:
    return Movable(name="crate", solid=Box(center=(x, 0.0, 0.2), size=(0.4, 0.4, 0.4)), mass_kg=mass_kg, friction=friction)


def test_rebuilding_a_world_takes_no_further_memory() -> None:
    x_m = 7.0625  # of corners
    world = World(solids=(Box(center=(x_m + 0.5, 0.0, 0.5), size=(1.0, 1.0, 1.0)),))
    corners = []
    for _ in range(2):
        engine((P2DX(), (0.0, 0.0, 0.0)), world=world).close()
        places = [each for each in gc.get_objects() if type(each) is list and len(each) == 3]
        corners.append(sum(type(each[0]) is float and each[0] == x_m for each in places))
    assert corners[0] > 0
    assert corners[0] == corners[1]


def test_a_movable_falls_asleep_and_wakes_when_it_is_pushed(either: Make) -> None:
    moved = either((P2DX(), (0.0, 0.0, 0.0)), world=World(movables=(crate(1.0, 1.0),)))
    moved.advance(4 * SECOND_NS)
    rests = moved.movables()
    moved.advance(6 * SECOND_NS)
    assert moved.movables().position.tobytes() == rests.position.tobytes()  # no tremor: the body sleeps
    assert rests.position[0] == pytest.approx((1.0, 0.0, 0.2), abs=2e-3)
    moved.command(0, (0.3, 0.0, 0.0), 0.0)
    moved.advance(12 * SECOND_NS)
    pushed, robot = moved.movables(), moved.read()
    front = robot.position[0, 0] + 0.5 * 0.511 - 0.04
    assert pushed.position[0, 0] - 0.2 == pytest.approx(front, abs=0.02)
    assert pushed.velocity[0, 0] == pytest.approx(0.3, rel=0.1)
    assert {(touch.row, touch.other) for touch in moved.touching(passing=True)} == {(0, 1)}


def test_heavy_movables_stay(either: Make) -> None:
    moved = either((AmigoBot(), (0.0, 0.0, 0.0)), world=World(movables=(crate(0.6, 100.0),)))
    moved.command(0, (0.3, 0.0, 0.0), 0.0)
    moved.advance(5 * SECOND_NS)
    assert moved.movables().position[0, 0] == pytest.approx(0.6, abs=0.01)


@pytest.mark.parametrize("floor", [0.0, 0.1])
def test_zones_change_nothing_for_movables(floor: float) -> None:
    def slid(*zones: Zone) -> float:
        moved = engine(world=World(movables=(crate(0.0, 3.0),), floor_friction=floor, zones=zones))
        p.resetBaseVelocity(moved._things.movables[0], (1.0, 0.0, 0.0), (0.0, 0.0, 0.0), moved._client)
        moved.advance(3 * SECOND_NS)
        return float(moved.movables().position[0, 0])

    expected = 3.0 if floor == 0.0 else 1.0 / (2.0 * 0.5 * floor * 9.81)  # v2 / (2 mu g)
    there, far = (Zone(center=(x, 0.0), size=(20.0, 20.0), friction=0.9) for x in (0.0, 50.0))
    assert [slid(), slid(there), slid(far)] == pytest.approx([expected] * 3, rel=0.02)


def test_a_robot_has_the_friction_of_its_zone_on_any_floor(either: Make) -> None:
    def start_distance(floor: float, *zones: Zone) -> float:
        """Distance in 2 s of a start with spinning wheels, m."""
        moved = either((P2DX(accel=10.0), (0.0, 0.0, 0.0)), world=World(floor_friction=floor, zones=zones))
        moved.command(0, (1.5, 0.0, 0.0), 0.0)
        moved.advance(2 * SECOND_NS)
        return float(moved.read().position[0, 0])

    icy, far = (Zone(center=(x, 0.0), size=(20.0, 20.0), friction=0.05) for x in (0.0, 50.0))
    distances = [*(start_distance(floor, icy) for floor in (1.0, 0.3, 0.0)), start_distance(0.05, far)]
    assert distances == pytest.approx([start_distance(0.05)] * 4, rel=1e-6)
    assert start_distance(0.0, far) == pytest.approx(0.0, abs=1e-3)


def gate(speed: float) -> Moving:
    solid = Box(center=(0.0, 0.0, 0.0), size=(0.2, 2.0, 1.0))
    return Moving(
        name="gate",
        solid=solid,
        times_s=(0.0, 2.0, 12.0),
        way=((-3.0, 0.0, 0.55, 0.0), (-3.0, 0.0, 0.55, 0.0), (-3.0 + 10.0 * speed, 0.0, 0.55, 0.0)),
    )


def test_a_moving_obstacle_keeps_its_timetable_and_pushes() -> None:
    world = World(moving=(gate(0.5),), movables=(crate(-1.0, 5.0),))
    moved = engine((P2DX(), (0.5, 0.0, 0.0)), (Quadrotor(), (0.0, 0.9, 0.04)), world=world)
    touches = set()
    for tick in range(1, 91):
        moved.advance(tick * SECOND_NS // 10)
        place, _ = p.getBasePositionAndOrientation(moved._things.moving[0], moved._client)
        assert place == pytest.approx(world.moving[0].pose(0.1 * tick)[:3], abs=2e-3)
        touches |= {(touch.row, touch.other) for touch in moved.touching(passing=True)}
    face = world.moving[0].pose(9.0)[0] + 0.1
    assert moved.movables().position[0, 0] - 0.2 > face - 0.02  # pushed ahead, though asleep before
    assert moved.read().position[0, 0] - 0.04 - 0.5 * 0.511 > face - 0.05  # the robot too, with motors braking
    assert (1, 3) in touches  # the quadrotor in the obstacle's path; row 2 is the crate


def test_moving_obstacles_have_the_speeds_of_their_timetable() -> None:
    turning = Moving(
        name="door", solid=Box(center=(0, 0, 0), size=(1, 0.1, 2)), times_s=(0.0, 2.0), way=((0, 0, 1, 0.0), (1, 2, 1, 3.0))
    )
    motion = on_time((turning,), SECOND_NS)
    assert motion.position[0] == pytest.approx((0.5, 1.0, 1.0))
    assert motion.velocity[0] == pytest.approx((0.5, 1.0, 0.0))
    assert motion.angular_velocity[0] == pytest.approx((0.0, 0.0, 1.5))
    assert motion.attitude[0] == pytest.approx((math.cos(0.75), 0.0, 0.0, math.sin(0.75)))
    assert on_time((turning,), 3 * SECOND_NS).velocity[0] == pytest.approx((0.0, 0.0, 0.0))


@pytest.mark.parametrize("hz", [60.0, 120.0, 240.0])
def test_a_looping_obstacle_keeps_its_speed(hz: float) -> None:
    way = ((0.0, 0.0, 0.5, 0.0), (0.8, 0.0, 0.5, math.tau))
    mill = Moving(name="mill", solid=Box(center=(0, 0, 0), size=(1, 1, 1)), times_s=(0.0, 0.4), way=way, loop=True)
    for step in range(round(10.0 * hz)):
        motion = on_time((mill,), Ticks.rate(hz).at(step))
        assert (motion.velocity[0, 0], motion.angular_velocity[0, 2]) == pytest.approx((2.0, math.tau / 0.4))


def test_grip_is_lost_on_ice_and_found_again_behind_it(either: Make) -> None:
    abrupt = P2DX(accel=1e6, decel=1e6)
    ice = Zone(center=(2.0, 0.0), size=(2.0, 4.0), friction=0.03)

    def stop_m(*zones: Zone, floor: float = 1.0) -> float:
        """Braking distance of a robot, m, from 1 m/s with maximum deceleration from x = 1.5 m."""
        moved = either((abrupt, (0.0, 0.0, 0.0)), world=World(zones=zones, floor_friction=floor))
        moved.command(0, (1.0, 0.0, 0.0), 0.0)
        tick = 0
        while moved.read().position[0, 0] < 1.5:
            tick += 1
            moved.advance(tick * SECOND_NS // 60)
        x = moved.read().position[0, 0]
        moved.command(0, (0.0, 0.0, 0.0), 0.0)
        moved.advance(tick * SECOND_NS // 60 + 5 * SECOND_NS)
        return float(moved.read().position[0, 0] - x)

    dry = stop_m()
    assert dry < 0.2
    assert stop_m(Zone(center=(50.0, 0.0), size=(1.0, 1.0), friction=0.0)) == pytest.approx(dry, abs=0.01)
    assert 1.2 < stop_m(ice) < 1.8  # across the ice, and stopped behind it
    assert stop_m(ice, Zone(center=(2.0, 0.0), size=(9.0, 9.0), yaw_rad=0.3, friction=1.0)) == pytest.approx(dry, abs=0.01)
