"""Nearest point of all solids: closed form, prisms against triangles of equal solids, paths against single places."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.physics.random_worlds import beyond_box
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Array
from vcmvsp.physics.world.solids import AnySolid, Box, Cylinder, Mesh, Prism
from vcmvsp.physics.world.world import Movable, Moving, World

pytestmark = pytest.mark.slow

metres = st.floats(-4.0, 4.0)
BOX = Box(center=(0.5, -0.3, 0.6), size=(1.0, 2.0, 0.8), yaw_rad=0.7)
SOLIDS = (
    BOX,
    Prism(outline=((-2.0, 1.0), (-1.0, 1.0), (-1.0, 3.0), (-3.0, 2.0)), height=1.5, bottom=0.5),
    Cylinder(center=(2.0, 2.0, 1.0), radius=0.4, height=2.0),
)


def nearest(world: World, place: Array, reach_m: float = 50.0) -> float:
    near = world.clearance.nearest(place, reach_m)
    assert near is not None
    assert np.linalg.norm(near.point - place) == pytest.approx(near.distance_m, abs=1e-9)
    return near.distance_m


@given(metres, metres, metres)
def test_of_a_box_by_closed_form(x: float, y: float, z: float) -> None:
    expected = np.linalg.norm(np.maximum(beyond_box(BOX, np.array([[x, y, z]])), 0.0))
    assert nearest(World(solids=SOLIDS[:1]), np.array([x, y, z])) == pytest.approx(expected, abs=1e-9)


@given(metres, metres, metres)
def test_prisms_and_triangles_of_the_same_solids_agree(x: float, y: float, z: float) -> None:
    world, place = World(solids=SOLIDS), np.array([x, y, z])
    vertices, triangles = world.mesh()
    outside = nearest(world, place)
    if outside > 0.0:  # a mesh has no interior
        meshed = World(solids=(Mesh(triangles=vertices[triangles]),))
        assert nearest(meshed, place) == pytest.approx(outside, abs=1e-9)


def test_only_within_reach() -> None:
    world, place = World(solids=SOLIDS[2:]), np.array([2.0, 5.0, 1.0])
    assert nearest(world, place) == pytest.approx(2.6, abs=0.002)
    assert world.clearance.nearest(place, 2.5) is None
    assert nearest(world, place, 2.61) == nearest(world, place)
    assert World().clearance.nearest(place, 100.0) is None


# --- of ways ----------------------------------------------------------------------------------------------------------------


def scattered(rng: np.random.Generator, count: int, *, meshed: bool) -> World:
    """Boxes, cylinders and a wedge across 20 x 20 m; as triangles if ``meshed``."""
    solids: list[AnySolid] = []
    for x, y, z in rng.uniform((-10, -10, 0.0), (10, 10, 2.0), (count, 3)).tolist():
        size = tuple(rng.uniform(0.05, 2.0, 3).tolist())
        solids.append(Box(center=(x, y, z), size=size, yaw_rad=rng.uniform(0.0, 3.0)))
        solids.append(Cylinder(center=(y, -x, z), radius=0.3 * size[0], height=size[2]))
    solids.append(Prism(outline=((-9.0, 9.0), (9.0, 9.5), (9.0, 9.6)), height=1.0))
    if not meshed:
        return World(solids=tuple(solids))
    vertices, triangles = World(solids=tuple(solids)).mesh()
    return World(solids=(Mesh(triangles=vertices[triangles]), *solids[:3]))


def random_walk(rng: np.random.Generator, count: int) -> Array:
    heading = np.cumsum(rng.normal(0.0, 0.2, count))
    steps = 0.05 * np.column_stack([np.cos(heading), np.sin(heading), rng.normal(0.0, 0.3, count)])
    return np.cumsum(steps, axis=0) + rng.uniform((-10.0, -10.0, 0.0), (10.0, 10.0, 4.0))


@pytest.mark.parametrize("meshed", [False, True])
@pytest.mark.parametrize("seed", range(12))
def test_of_a_path_it_is_the_least_of_all(seed: int, meshed: bool) -> None:
    """For paths of any length, also discontinuous ones, against each place by itself."""
    rng = np.random.default_rng(seed)
    clearance = scattered(rng, 1 + 5 * (seed % 4), meshed=meshed).clearance
    for count in (1, 31, 33, 70):
        way = random_walk(rng, count) if seed % 3 else rng.uniform(-12.0, 12.0, (count, 3))
        near = [clearance.nearest(place, 100.0) for place in way]
        expected = min(each.distance_m for each in near if each is not None)
        assert clearance.least_m(way) == pytest.approx(expected, abs=1e-12)
        assert clearance.least_m(way, 0.5 * expected) == 0.5 * expected  # no place is nearer than the bound
        assert clearance.least_m(way, 2.0 * expected + 1.0) == pytest.approx(expected, abs=1e-12)


def test_above_a_wall_the_height_counts_and_beside_it_the_corner() -> None:
    wall = World(solids=(Box(center=(0.0, 0.0, 1.0), size=(0.2, 4.0, 2.0)),))
    over = np.array([[(x, y, z) for x in np.linspace(-3.0, 3.0, 61)] for y, z in ((0.0, 2.7), (2.3, 2.4))])
    time_ns = np.arange(61) * SECOND_NS
    for way, expected in zip(over, (0.7, 0.5), strict=True):
        assert wall.least_clearance_m(time_ns, way.T[:, :, None]) == pytest.approx(expected)
    assert wall.least_clearance_m(time_ns, over.T) == pytest.approx(0.5)  # over both vehicles


def test_an_absent_vehicle_has_no_clearance() -> None:
    wall = World(solids=(Box(center=(0.0, 0.0, 1.0), size=(0.2, 4.0, 2.0)),))
    position = np.array([[(5.0, 0.0, 0.0), (np.nan,) * 3], [(4.0, 0.0, 0.0), (9.0, 0.0, 0.0)]]).transpose(2, 0, 1)
    assert wall.least_clearance_m(np.array([0, 1]), position) == pytest.approx(3.9)
    assert wall.least_clearance_m(np.array([0, 1]), np.full((3, 2, 2), np.nan)) is None
    assert wall.least_clearance_m(np.empty(0, np.int64), np.empty((3, 0, 2))) is None


def test_floor_and_movables_alone_have_no_clearance() -> None:
    crate = Movable(name="crate", solid=Box(center=(0, 0, 0.5), size=(1, 1, 1)), mass_kg=1.0)
    assert World(movables=(crate,)).least_clearance_m(np.array([0]), np.zeros((3, 1, 1))) is None


@pytest.mark.parametrize(
    "solid", [Box(center=(9, 9, 9), size=(0.6, 1.4, 1.0)), Cylinder(center=(9, 9, 9), radius=0.4, height=0.8)]
)
def test_obstacles_follow_their_timetable(solid: Box | Cylinder) -> None:
    """Against a world with the obstacle at rest, at each instant; it moves back and forth and turns."""
    way = ((0.0, -2.0, 0.5, 0.0), (1.0, 2.0, 0.5, 2.0), (0.0, -2.0, 0.5, 0.0))
    cart = Moving(name="cart", solid=solid, times_s=(0.0, 4.0, 8.0), way=way, loop=True)
    rng = np.random.default_rng(5)
    time_ns = np.arange(100) * (SECOND_NS // 4)
    position = rng.uniform((-3.0, -3.0, 0.0), (3.0, 3.0, 3.0), (100, 4, 3))
    for count in (1, 4):
        expected = math.inf
        for now_ns, places in zip(time_ns.tolist(), position[:, :count], strict=True):
            x, y, z, yaw = cart.pose(now_ns / SECOND_NS)
            if isinstance(solid, Box):
                beyond = beyond_box(Box(center=(x, y, z), size=solid.size, yaw_rad=yaw), places)
            else:
                dx, dy, dz = (places - (x, y, z)).T
                beyond = np.column_stack([np.hypot(dx, dy) - solid.radius, np.abs(dz) - 0.5 * solid.height])
            expected = min(expected, np.linalg.norm(np.maximum(beyond, 0.0), axis=1).min())
        found = World(moving=(cart,)).least_clearance_m(time_ns, position[:, :count].transpose(2, 0, 1))
        assert found == pytest.approx(expected, abs=1e-12)
