"""Boxes, footprints, and the mesh that stands for all boxes."""

import math
from collections import Counter

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from physics.vehicles import P2DX
from physics.world import Box, Footprint, World
from physics.worlds import Boxes, Empty

footprints = st.builds(
    Footprint,
    x=st.floats(-3, 3),
    y=st.floats(-3, 3),
    half_length=st.floats(0.1, 2),
    half_width=st.floats(0.1, 2),
    yaw=st.floats(-4, 4),
)


@given(a=footprints, b=footprints)
def test_overlap_lies_between_the_inner_and_the_outer_circles(a: Footprint, b: Footprint) -> None:
    apart = math.hypot(a.x - b.x, a.y - b.y)
    assert a.overlaps(b) == b.overlaps(a)
    if apart < min(a.half_length, a.half_width) + min(b.half_length, b.half_width) - 1e-9:
        assert a.overlaps(b)
    if apart > math.hypot(a.half_length, a.half_width) + math.hypot(b.half_length, b.half_width) + 1e-9:
        assert not a.overlaps(b)


@given(a=footprints, b=footprints)
def test_a_shared_point_means_overlap(a: Footprint, b: Footprint) -> None:
    grid = np.linspace(-0.999, 0.999, 15)
    u, v = (axis.ravel() for axis in np.meshgrid(grid * a.half_length, grid * a.half_width))
    x = a.x + u * math.cos(a.yaw) - v * math.sin(a.yaw) - b.x
    y = a.y + u * math.sin(a.yaw) + v * math.cos(a.yaw) - b.y
    along, across = x * math.cos(b.yaw) + y * math.sin(b.yaw), -x * math.sin(b.yaw) + y * math.cos(b.yaw)
    if ((np.abs(along) < b.half_length) & (np.abs(across) < b.half_width)).any():
        assert a.overlaps(b)


def test_crossed_bars_overlap_though_no_corner_lies_in_the_other() -> None:
    bar = Footprint(x=0.0, y=0.0, half_length=2.0, half_width=0.1, yaw=0.0)
    assert bar.overlaps(Footprint(x=0.5, y=0.0, half_length=2.0, half_width=0.1, yaw=1.5))


def test_diagonal_neighbours_do_not_overlap_though_their_bounding_boxes_do() -> None:
    a = Footprint(x=0.0, y=0.0, half_length=1.0, half_width=0.1, yaw=math.pi / 4)
    assert not a.overlaps(Footprint(x=0.4, y=-0.4, half_length=1.0, half_width=0.1, yaw=math.pi / 4))


def test_a_box_overhead_blocks_no_one() -> None:
    under = P2DX().footprint((0.0, 0.0, 0.0))
    assert Box(center=(0.0, 0.0, 0.5), size=(1.0, 1.0, 1.0)).blocks(under, 0.22)
    assert not Box(center=(0.0, 0.0, 1.0), size=(1.0, 1.0, 1.0)).blocks(under, 0.22)


def test_the_outline_lies_behind_the_axle() -> None:
    outline = P2DX().footprint((1.0, 2.0, math.pi / 2))
    assert (outline.x, outline.y) == pytest.approx((1.0, 1.96))  # the axle is 0.04 m ahead of the middle, heading north


def test_the_mesh_is_closed_and_holds_the_volume_of_the_boxes() -> None:
    boxes = (Box(center=(1.0, 2.0, 0.5), size=(0.2, 4.0, 1.0), yaw_rad=0.3), Box(center=(-5.0, 0.0, 1.0), size=(1.0, 1.0, 2.0)))
    points, indices = World(boxes=boxes).mesh()
    triangles = np.array(indices).reshape(-1, 3)
    assert triangles.shape == (24, 3)
    edges = Counter((int(t[i]), int(t[(i + 1) % 3])) for t in triangles for i in range(3))
    assert set(edges.values()) == {1}
    assert all((b, a) in edges for a, b in edges)  # each edge is run once each way: no hole, all normals outwards
    a, b, c = np.array(points)[triangles].transpose(1, 0, 2)
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0 == pytest.approx(0.2 * 4.0 * 1.0 + 2.0)


def test_worlds_are_read_from_plain_tables() -> None:
    table = {"boxes": [{"center": [2, 0, 0.5], "size": [0.2, 4, 1], "material": "brick"}], "floor_friction": 0.5}
    world = msgspec.convert(table, Boxes).build()
    assert world == World(boxes=(Box(center=(2.0, 0.0, 0.5), size=(0.2, 4.0, 1.0), material="brick"),), floor_friction=0.5)
    assert Empty().build() == World()


@pytest.mark.parametrize("size", [(0.0, 1.0, 1.0), (1.0, -1.0, 1.0), (1.0, math.nan, 1.0)])
def test_impossible_boxes_are_refused(size: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="positive sizes"):
        Box(center=(0.0, 0.0, 0.0), size=size)
