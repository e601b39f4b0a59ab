"""Quadrotors in a Bullet world: NumPy dynamics in free air; near other bodies, they land, bounce and push in Bullet."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.support.physics.engines import engine
from tests.support.physics.random_worlds import beyond_box
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.physics.dynamics.bullet.bodies import base_motion
from vcmvsp.physics.dynamics.bullet.engine import BulletEngine
from vcmvsp.physics.dynamics.bullet.quadrotors import REACH_M, SolidsMap, near_each_other
from vcmvsp.physics.dynamics.engine import BodyMotion, Touch
from vcmvsp.physics.dynamics.quadrotor_fleet import QuadrotorFleet
from vcmvsp.physics.vehicles.models import P2DX, Quadrotor
from vcmvsp.physics.world.solids import Box, Cylinder, Mesh, Prism
from vcmvsp.physics.world.world import Movable, Moving, World

Make = Callable[..., Any]
pytestmark = pytest.mark.slow

UAV = Quadrotor()
WALL = World(solids=(Box(center=(9.0, 9.0, 0.5), size=(0.2, 0.2, 1.0)), Box(center=(5.0, 0.0, 1.5), size=(0.2, 6.0, 3.0))))
HZ = 120


def steps(moved: BulletEngine, count: int) -> None:
    moved.advance((moved._step + count) * SECOND_NS // round(1.0 / moved._step_s) + 1)


def equal_motion(a: BodyMotion, b: BodyMotion) -> bool:
    """Whether the motions of the first vehicles are equal to the last bit."""
    return all(x[0].tobytes() == y[0].tobytes() for x, y in zip(a, b, strict=True))


def test_free_air_motion_is_numpys_to_the_bit() -> None:
    moved, fleet = engine((UAV, (0.0, 0.0, 5.0))), QuadrotorFleet([UAV], [(0.0, 0.0, 5.0)], [0.0], 9.81)
    moved.command(0, (2.0, 1.0, 0.3), 0.5)
    fleet.set_velocity(0, (2.0, 1.0, 0.3), 0.5)
    for _ in range(3 * HZ):
        force, torque = fleet.wrench(1.0 / HZ, np.zeros((1, 3)))
        fleet.integrate(force, torque, 1.0 / HZ)
    steps(moved, 3 * HZ)
    assert not moved._flyers.near.any()
    assert np.array_equal(moved.read().position, fleet.position)
    assert np.array_equal(moved.read().attitude, fleet.attitude)
    z = base_motion(moved._client, moved._flyers.bodies).position[0, 2]
    assert z < -1000.0  # its body is parked


def test_near_bodies_without_contact_change_no_bit() -> None:
    low = World(solids=(Box(center=(3.0, 0.0, 0.5), size=(0.5, 6.0, 1.0)),))
    over, alone = engine((UAV, (0.0, 0.0, 1.35)), world=low), engine((UAV, (0.0, 0.0, 1.35)))
    beside = engine((UAV, (0.0, 0.0, 1.35)), (UAV, (0.0, 0.6, 1.35)), (P2DX(), (3.0, 0.0, 0.0)))
    beside.command(1, (1.5, 0.0, 0.0), 0.0)
    beside.command(2, (0.3, 0.0, 0.0), 0.2)
    nearby = 0
    for _ in range(40):
        for moved in (over, alone, beside):
            moved.command(0, (1.5, 0.0, 0.0), 0.3)
            steps(moved, HZ // 10)
        nearby += bool(over._flyers.near[0])
        assert equal_motion(over.read(), alone.read())
        assert equal_motion(beside.read(), alone.read())
    assert nearby > 10
    assert not alone._flyers.near.any()
    assert over.touching(passing=True) == beside.touching(passing=True) == []


def test_bodies_that_touch_nothing_move_in_bullet_as_in_numpy() -> None:
    moved = engine((UAV, (0.0, 0.0, 0.3)))
    moved.command(0, (1.0, 0.5, 0.0), 0.4)
    steps(moved, 1)
    worst = 0.0
    for _ in range(2 * HZ):
        steps(moved, 1)
        bullet, fleet = base_motion(moved._client, moved._flyers.bodies), moved._flyers.fleet
        off = (bullet.position - fleet.position, bullet.velocity - fleet.velocity, bullet.angular_velocity - fleet.rate)
        worst = max(worst, *(float(np.abs(each).max()) for each in off))
    assert moved._flyers.near.all()
    assert worst < 1e-9  # the contact threshold is 1e-7


@pytest.mark.parametrize("hz", [120, 240])
def test_it_takes_off_and_lands(hz: int) -> None:
    moved = engine((UAV, (1.0, 2.0, 0.5 * UAV.height_m)), hz=hz)
    steps(moved, hz)
    assert moved.read().position[0] == pytest.approx((1.0, 2.0, 0.04), abs=2e-3)
    moved.go_to(0, (1.0, 2.0, 1.5), None, None)
    steps(moved, 6 * hz)
    assert moved.read().position[0] == pytest.approx((1.0, 2.0, 1.5), abs=0.05)
    assert not moved._flyers.near.any()
    moved.command(0, (0.0, 0.0, -0.4), 0.0)
    steps(moved, 6 * hz)
    landed = moved.read()
    assert landed.position[0] == pytest.approx((1.0, 2.0, 0.04), abs=2e-3)
    assert landed.attitude[0] == pytest.approx((1.0, 0.0, 0.0, 0.0), abs=2e-3)
    assert np.abs(landed.velocity).max() < 0.01
    assert moved.touching(passing=True) == []  # standing on the floor is not a contact


def test_a_wall_stops_it_and_is_named(either: Make) -> None:
    moved = either((UAV, (0.0, 0.0, 2.0)), world=WALL)
    moved.command(0, (4.0, 0.0, 0.0), 0.0)
    touches = []
    for _ in range(20):
        steps(moved, HZ // 10)
        touches += moved.touching(passing=True)
        assert moved.read().position[0, 0] < 4.9 - 0.04 + 0.02  # no penetration, even on edge
    assert {(touch.row, touch.other) for touch in touches} == {(0, None)}
    assert touches[0].place == pytest.approx((4.9, 0.0, 2.0), abs=0.1)


def test_a_bounce_between_two_reads_is_reported_once(either: Make) -> None:
    moved = either((UAV, (4.0, 0.0, 2.0)), world=WALL)
    moved._flyers.fleet.velocity[0] = 3.0, 0.0, 0.0
    moved.command(0, (-2.0, 0.0, 0.0), 0.0)
    steps(moved, HZ)
    assert moved.read().position[0, 0] < 4.6  # no contact any more
    assert moved.touching(passing=False) == []  # does not clear the contact
    assert {(touch.row, touch.other) for touch in moved.touching(passing=True)} == {(0, None)}
    assert moved.touching(passing=True) == []


@pytest.mark.parametrize("hz", [30, 40, 120])
@pytest.mark.parametrize("speed", [12.0, 16.0, 20.0, 24.0, 28.0])
def test_it_wakes_before_fast_bodies_at_any_check_rate(hz: int, speed: float) -> None:
    """Awake at least one step before contact: Bullet leaves a body out of the step in which it wakes."""
    cube = Box(center=(0, 0, 0), size=(0.5, 0.5, 0.5))
    ram = Moving(name="ram", solid=cube, times_s=(0.0, 40.0 / speed), way=((-20.0, 0.0, 2.0, 0.0), (20.0, 0.0, 2.0, 0.0)))
    moved = engine((UAV, (0.0, 0.0, 2.0)), world=World(moving=(ram,)), hz=hz)
    steps(moved, 1)
    while not moved._flyers.near[0]:
        steps(moved, 1)
    woke, touch_s = moved._step - 1, (20.0 - 0.25 - UAV.radius_m) / speed
    assert woke < math.floor(touch_s * hz)


@pytest.mark.parametrize("speed", [2.0, 6.0, 12.0])
def test_no_penetration(speed: float, either: Make) -> None:
    """From all sides into a pillar, a roof and a wall, at any phase of the proximity checks: centres stay outside."""
    world = World(
        solids=(
            Cylinder(center=(0.0, 0.0, 5.0), radius=0.6, height=10.0),
            Prism(outline=((20.0, -3.0), (23.0, 0.0), (20.0, 3.0)), height=10.0),
        )
    )
    angles = np.arange(12) * math.tau / 12 + 0.1
    around = [(x + 4.0 * math.cos(a), 4.0 * math.sin(a), 4.0 + 0.07 * k) for x in (0.0, 21.0) for k, a in enumerate(angles)]
    fast = Quadrotor(max_speed=20.0)
    moved = either(*((fast, place) for place in around), world=world)
    for row, ((x, y, _), middle) in enumerate(zip(around, [0.0] * 12 + [21.0] * 12, strict=True)):
        moved._flyers.fleet.velocity[row] = -speed * (x - middle) / 4.0, -speed * y / 4.0, 0.0
        moved.command(row, (-speed * (x - middle) / 4.0, -speed * y / 4.0, 0.0), 0.0)
    hit = set()
    for _ in range(24):
        steps(moved, HZ // 12)
        hit |= {touch.row for touch in moved.touching(passing=True)}
        at = moved.read().position
        assert np.hypot(at[:12, 0], at[:12, 1]).min() > 0.6
        for row in range(12, 24):
            inside = 20.0 < at[row, 0] < 23.0 - abs(at[row, 1])
            assert not inside
    assert len(hit) == 24


def test_a_collision_names_both_and_conserves_momentum(either: Make) -> None:
    moved = either((UAV, (0.0, 0.0, 9.0)), (replace(UAV, mass_kg=1.6), (0.8, 0.0, 9.0)))
    steps(moved, 1)
    for row, speed in ((0, 1.5), (1, -0.5)):
        moved._flyers.fleet.velocity[row] = speed, 0.0, 0.0
        moved.command(row, (speed, 0.0, 0.0), 0.0)
    touches: list[Touch] = []
    while not touches:
        before = moved.read().velocity[:, 0]
        steps(moved, 1)
        touches = moved.touching(passing=True)
    after = moved.read().velocity[:, 0]
    assert {(touch.row, touch.other) for touch in touches} == {(0, 1)}
    assert after[0] - after[1] < 0.5 * (before[0] - before[1])
    assert 0.8 * after[0] + 1.6 * after[1] == pytest.approx(0.8 * before[0] + 1.6 * before[1], abs=0.05)  # thrust acts too
    assert after[0] < 0.5 * before[0]


def test_it_can_stand_on_a_robot_and_press_on_a_movable(either: Make) -> None:
    world = World(movables=(Movable(name="table", solid=Box(center=(3.0, 0.0, 0.3), size=(1.0, 1.0, 0.6)), mass_kg=10.0),))
    moved = either((UAV, (0.0, 0.0, 0.6)), (P2DX(), (0.0, 0.0, 0.0)), (UAV, (3.0, 0.0, 1.0)), world=world)
    moved.command(0, (0.0, 0.0, -0.4), 0.0)
    moved.command(2, (0.0, 0.0, -0.4), 0.0)
    steps(moved, 4 * HZ)
    at = moved.read().position
    assert at[0, 2] == pytest.approx(0.22 + 0.04, abs=5e-3)
    assert at[2, 2] == pytest.approx(0.6 + 0.04, abs=5e-3)
    assert {(touch.row, touch.other) for touch in moved.touching(passing=True)} == {(0, 1), (2, 3)}


def test_the_map_finds_everything_within_the_margin() -> None:
    rng = np.random.default_rng(5)
    solids = tuple(
        Box(center=(*rng.uniform(-40, 40, 2), 3.0), size=(*rng.uniform(0.2, 9.0, 2), 6.0), yaw_rad=float(rng.uniform(0, 3)))
        for _ in range(40)
    )
    world = World(solids=solids)
    places = np.column_stack([rng.uniform(-45, 45, (4000, 2)), rng.uniform(0.3, 9.0, 4000)])
    margin = rng.uniform(0.1, REACH_M, 4000)
    near = SolidsMap(world.shapes).near(places, margin)
    distance = np.full(4000, np.inf)
    for box in solids:
        distance = np.minimum(distance, np.linalg.norm(np.maximum(beyond_box(box, places), 0.0), axis=1))
    assert near[distance < margin].all()
    assert not near[distance > 1.75 * margin].any()  # conservative at corners
    assert 0.05 < (distance < margin).mean() < 0.95


def test_the_map_finds_meshes_too() -> None:
    rng = np.random.default_rng(7)
    middles = rng.uniform(-8.0, 8.0, (300, 1, 3))
    sizes = np.where(np.arange(300) % 3, 0.3, 2.0)[:, None, None]
    triangles = middles + sizes * rng.uniform(-1.0, 1.0, (300, 3, 3))
    places, margin = rng.uniform(-9.0, 9.0, (500, 3)), rng.uniform(0.1, 1.0, 500)
    near = SolidsMap(World(solids=(Mesh(triangles=triangles),)).shapes).near(places, margin)
    weights = rng.dirichlet((1.0, 1.0, 1.0), 60)
    points = np.concatenate([(weights @ each) for each in triangles])  # 60 points per triangle
    distance = np.array([np.sqrt(np.square(points - place).sum(axis=1).min()) for place in places])
    assert near[distance < margin].all()
    assert not near[distance > margin + 4.0].any()


def test_pairs_are_near_before_they_can_meet() -> None:
    rng = np.random.default_rng(6)
    position, velocity, radius = rng.uniform(0, 12, (60, 3)), rng.normal(0, 4, (60, 3)), rng.uniform(0.1, 0.3, 60)
    near = near_each_other(position, velocity, radius, 0.05, 0.1)
    for a in range(60):
        gaps = [
            np.linalg.norm(position[a] - position[b])
            - np.linalg.norm(velocity[a] - velocity[b]) * 0.05
            - radius[a]
            - radius[b]
            - 0.1
            for b in range(60)
            if b != a
        ]
        assert near[a] == (min(gaps) < 0.0)
