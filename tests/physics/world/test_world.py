"""Boxes, footprints, and the mesh that stands for all boxes."""

import math
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.types import Array
from vcmvsp.physics.world.polygons import overlap_m
from vcmvsp.physics.world.solids import Box, Cylinder, Mesh, rectangle
from vcmvsp.physics.world.world import Moving, World
from vcmvsp.physics.worlds.surroundings import Boxes, Empty


class Bar(NamedTuple):
    """A rectangle."""

    x: float
    y: float
    half_length: float
    half_width: float
    yaw: float

    def overlap(self, other: "Bar") -> float:
        return overlap_m(rectangle(*self), rectangle(*other))


bars = st.builds(Bar, st.floats(-3, 3), st.floats(-3, 3), st.floats(0.1, 2), st.floats(0.1, 2), st.floats(-4, 4))


@given(a=bars, b=bars)
def test_overlap_lies_between_the_inner_and_the_outer_circles(a: Bar, b: Bar) -> None:
    apart = math.hypot(a.x - b.x, a.y - b.y)
    assert a.overlap(b) == pytest.approx(b.overlap(a), abs=1e-9)
    if apart < min(a.half_length, a.half_width) + min(b.half_length, b.half_width) - 1e-9:
        assert a.overlap(b) > 0.0
    if apart > math.hypot(a.half_length, a.half_width) + math.hypot(b.half_length, b.half_width) + 1e-9:
        assert a.overlap(b) == 0.0


@given(a=bars, b=bars)
def test_a_shared_point_means_overlap(a: Bar, b: Bar) -> None:
    grid = np.linspace(-0.999, 0.999, 15)
    u, v = (axis.ravel() for axis in np.meshgrid(grid * a.half_length, grid * a.half_width))
    x = a.x + u * math.cos(a.yaw) - v * math.sin(a.yaw) - b.x
    y = a.y + u * math.sin(a.yaw) + v * math.cos(a.yaw) - b.y
    along, across = x * math.cos(b.yaw) + y * math.sin(b.yaw), -x * math.sin(b.yaw) + y * math.cos(b.yaw)
    if ((np.abs(along) < b.half_length) & (np.abs(across) < b.half_width)).any():
        assert a.overlap(b) > 0.0


@given(a=bars, b=bars, way=st.floats(0, math.tau))
def test_who_is_moved_by_the_overlap_and_a_little_more_is_free_in_some_direction_only(a: Bar, b: Bar, way: float) -> None:
    depth = a.overlap(b)
    moved = a._replace(x=a.x + 0.99 * depth * math.cos(way), y=a.y + 0.99 * depth * math.sin(way))
    assert depth == 0.0 or moved.overlap(b) > 0.0  # it is the least way out


def test_diagonal_neighbours_do_not_overlap_though_their_bounding_boxes_do() -> None:
    assert Bar(0.0, 0.0, 1.0, 0.1, math.pi / 4).overlap(Bar(0.4, -0.4, 1.0, 0.1, math.pi / 4)) == 0.0


def test_worlds_are_read_from_plain_tables() -> None:
    table = {"boxes": [{"center": [2, 0, 0.5], "size": [0.2, 4, 1], "material": "brick"}], "floor_friction": 0.5}
    world = msgspec.convert(table, Boxes).build()
    wall = Box(center=(2.0, 0.0, 0.5), size=(0.2, 4.0, 1.0), material="brick")
    assert world == World(solids=(wall,), floor_friction=0.5, name="boxes")
    assert Empty().build() == World(name="empty")


def test_a_moving_obstacle_keeps_to_its_time_table() -> None:
    box = Box(center=(9.0, 9.0, 9.0), size=(1.0, 1.0, 1.0))
    way = ((0.0, 0.0, 0.5, 0.0), (4.0, 2.0, 0.5, 1.0))
    cart = Moving(name="cart", solid=box, times_s=(1.0, 3.0), way=way)
    assert cart.pose(0.0) == cart.pose(1.0) == way[0]
    assert cart.pose(2.0) == (2.0, 1.0, 0.5, 0.5)
    assert cart.pose(9.0) == way[1]
    around = Moving(name="cart", solid=box, times_s=(0.0, 2.0), way=way, loop=True)
    assert around.pose(1.0) == around.pose(5.0) == (2.0, 1.0, 0.5, 0.5)


@given(time_s=st.floats(0.0, 50.0), span_s=st.floats(0.3, 3.0))
def test_an_obstacle_that_goes_round_is_never_faster_than_its_time_table(time_s: float, span_s: float) -> None:
    box = Box(center=(0.0, 0.0, 0.0), size=(1.0, 1.0, 1.0))
    way = ((0.0, 0.0, 0.5, 0.0), (2.0 * span_s, 0.0, 0.5, 3.0 * span_s), (0.0, span_s, 0.5, 6.0 * span_s))
    around = Moving(name="cart", solid=box, times_s=(0.0, span_s, 2.0 * span_s), way=way, loop=True)
    rates = around.rates(time_s)
    first, second = ((2.0, 0.0, 0.0, 3.0), (-2.0, 1.0, 0.0, 3.0))
    assert rates in (pytest.approx(first), pytest.approx(second))
    here, soon = (np.array(around.pose(each)) for each in (time_s, time_s + 1e-6))
    if np.abs(soon - here).max() < 1e-5:  # neither back at the start by then nor at a bend
        assert rates == pytest.approx((soon - here) / 1e-6, abs=1e-3) or time_s % span_s > span_s - 2e-6


def test_an_obstacle_stands_before_its_first_and_after_its_last_time() -> None:
    box, still = Box(center=(0.0, 0.0, 0.0), size=(1.0, 1.0, 1.0)), (0.0, 0.0, 0.0, 0.0)
    cart = Moving(name="cart", solid=box, times_s=(1.0, 3.0), way=((0.0, 0.0, 0.5, 0.0), (4.0, 2.0, 0.5, 1.0)))
    assert [cart.rates(t) for t in (0.5, 1.0, 2.9, 3.0, 9.0)] == [still, *[(2.0, 1.0, 0.0, 0.5)] * 2, still, still]


# --- bodies in the way --------------------------------------------------------------------------------------------------------


def square(x: float, y: float, half: float = 0.5) -> Array:
    return rectangle(x, y, half, half, 0.0)


def blocking(world: World, *body: Any) -> Any:
    return world.blocking(*body)


def test_how_far_outside_the_bounds() -> None:
    world = World(bounds=(-10.0, -5.0, 10.0, 5.0))
    assert [world.outside(0, 0), world.outside(10, 5), world.outside(12, 0), world.outside(-13, -9)] == [0.0, 0.0, 2.0, 5.0]
    assert World().outside(1e9, 0) == 0.0


def test_a_body_in_a_solid_is_found_with_the_shortest_way_out() -> None:
    wall, post = Box(center=(3.0, 0.0, 1.0), size=(1.0, 8.0, 2.0)), Cylinder(center=(-3.0, 0.0, 0.5), radius=0.5, height=1.0)
    world = World(solids=(wall, post))
    assert blocking(world, square(0.0, 0.0), 0.0, 1.0) is None
    assert blocking(world, square(2.0, 0.0), 0.0, 1.0) is None  # touches
    assert blocking(world, square(2.2, 0.0), 0.0, 1.0) == (wall, pytest.approx(0.2))
    assert blocking(world, square(2.2, 0.0), 1.95, 2.5) == (wall, pytest.approx(0.05))  # upwards is shorter
    assert blocking(world, square(2.2, 0.0), 2.0, 2.5) is None
    assert blocking(world, square(-3.0, 0.9), 0.0, 1.0) == (post, pytest.approx(0.1))


def test_the_deepest_of_several_is_told() -> None:
    solids = tuple(Box(center=(x, 0.0, 1.0), size=(1.0, 1.0, 2.0)) for x in (-0.9, 0.7))
    assert blocking(World(solids=solids), square(0.0, 0.0), 0.0, 1.0) == (solids[1], pytest.approx(0.3))


solid_boxes = st.builds(
    Box,
    center=st.tuples(*[st.floats(-2.0, 2.0)] * 3),
    size=st.tuples(*[st.floats(0.3, 3.0)] * 3),
    yaw_rad=st.floats(-4.0, 4.0),
)


@given(
    box=solid_boxes, yaw=st.floats(-4.0, 4.0), x=st.floats(-3.0, 3.0), bottom=st.floats(-3.0, 3.0), height=st.floats(0.1, 2.0)
)
def test_a_mesh_blocks_as_the_box_it_is_made_of(box: Box, yaw: float, x: float, bottom: float, height: float) -> None:
    body = rectangle(x, 0.5, 0.4, 0.3, yaw)
    points, triangles = World(solids=(box,)).mesh()
    mesh = Mesh(triangles=points[triangles])
    as_box = World(solids=(box,)).blocking(body, bottom, bottom + height)
    as_mesh = World(solids=(mesh,)).blocking(body, bottom, bottom + height)
    if as_box is None or as_box[1] > 1e-6:
        assert (as_box is None) == (as_mesh is None)
    if as_mesh is not None and as_box is not None:
        assert as_mesh[0] is mesh
        low, high = points.min(axis=0), points.max(axis=0)
        out = [high[:2] - body.min(axis=0), body.max(axis=0) - low[:2], [high[2] - bottom, bottom + height - low[2]]]
        assert 0.0 < as_mesh[1] <= min(map(min, out)) + 1e-9  # out of the box around it is free of it


def test_a_body_deep_inside_a_closed_mesh_is_found_though_it_touches_no_triangle() -> None:
    points, triangles = World(solids=(Box(center=(0.0, 0.0, 5.0), size=(10.0, 10.0, 10.0)),)).mesh()
    mesh = Mesh(triangles=points[triangles])
    assert blocking(World(solids=(mesh,)), square(3.0, 0.1), 4.0, 5.0) == (mesh, pytest.approx(2.5))
    room = Mesh(triangles=points[triangles][:, ::-1])  # seen from inside: a room
    assert World(solids=(room,)).blocking(square(3.0, 0.1), 4.0, 5.0) is None
    assert World(solids=(room,)).blocking(square(4.9, 0.1), 4.0, 5.0) is not None
    roof = Mesh(triangles=mesh.triangles[mesh.triangles[:, :, 2].min(axis=1) > 9.0])
    assert World(solids=(roof,)).blocking(square(3.0, 0.1), 4.0, 5.0) is None
