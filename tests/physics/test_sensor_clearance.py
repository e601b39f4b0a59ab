"""The nearest point of all solids: closed form, and prisms against the triangles of the same solid."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.types import Array
from physics.sensors.clearance import Clearance
from physics.solids import Box, Cylinder, Mesh, Prism
from physics.world import World

metres = st.floats(-4.0, 4.0)
SOLIDS = (
    Box(center=(0.5, -0.3, 0.6), size=(1.0, 2.0, 0.8), yaw_rad=0.7),
    Prism(outline=((-2.0, 1.0), (-1.0, 1.0), (-1.0, 3.0), (-3.0, 2.0)), height=1.5, bottom=0.5),
    Cylinder(center=(2.0, 2.0, 1.0), radius=0.4, height=2.0),
)


def nearest(world: World, place: Array, reach_m: float = 50.0) -> float:
    near = Clearance(world).nearest(place, reach_m)
    assert near is not None
    assert np.linalg.norm(near.point - place) == pytest.approx(near.distance_m, abs=1e-9)
    return near.distance_m


@given(metres, metres, metres)
def test_of_a_box_by_closed_form(x: float, y: float, z: float) -> None:
    dx, dy, dz = x - 0.5, y + 0.3, z - 0.6
    local = (dx * math.cos(0.7) + dy * math.sin(0.7), dy * math.cos(0.7) - dx * math.sin(0.7), dz)
    expected = math.hypot(*(max(abs(a) - half, 0.0) for a, half in zip(local, (0.5, 1.0, 0.4), strict=True)))
    assert nearest(World(solids=SOLIDS[:1]), np.array([x, y, z])) == pytest.approx(expected, abs=1e-9)


@given(metres, metres, metres)
def test_prisms_and_triangles_of_the_same_solids_agree(x: float, y: float, z: float) -> None:
    world, place = World(solids=SOLIDS), np.array([x, y, z])
    vertices, triangles = world.mesh()
    outside = nearest(world, place)
    if outside > 0.0:  # a mesh has no inside
        meshed = World(solids=(Mesh(triangles=vertices[triangles]),))
        assert nearest(meshed, place) == pytest.approx(outside, abs=1e-9)


def test_only_within_reach() -> None:
    world, place = World(solids=SOLIDS[2:]), np.array([2.0, 5.0, 1.0])
    assert nearest(world, place) == pytest.approx(2.6, abs=0.002)
    assert Clearance(world).nearest(place, 2.5) is None
    assert nearest(world, place, 2.61) == nearest(world, place)
    assert Clearance(World()).nearest(place, 100.0) is None
