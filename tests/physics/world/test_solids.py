"""Solids in pieces and as a mesh: closed, outward orientation, volume; colours; ground picture."""

import math
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util.polygons import area_m2, overlap_m, problem_of
from vcmvsp.physics.world.floor import GroundPicture, Mark
from vcmvsp.physics.world.solids import MATERIAL_COLORS, AnySolid, Box, Cylinder, Mesh, Prism, color_of, rectangle
from vcmvsp.physics.world.world import Light, Moving, World, Zone
from vcmvsp.physics.worlds.surroundings import Boxes, Empty

pytestmark = pytest.mark.slow

place = st.tuples(*[st.floats(-50.0, 50.0)] * 3)
edge = st.floats(0.05, 20.0)
boxes = st.builds(Box, center=place, size=st.tuples(edge, edge, edge), yaw_rad=st.floats(-7.0, 7.0))
cylinders = st.builds(Cylinder, center=place, radius=st.floats(0.01, 10.0), height=edge)
radii = st.lists(st.floats(0.3, 5.0), min_size=3, max_size=9)


def star(lengths: list[float]) -> tuple[tuple[float, float], ...]:
    angles = math.tau * np.arange(len(lengths)) / len(lengths)
    return tuple((r * math.cos(a), r * math.sin(a)) for r, a in zip(lengths, angles, strict=True))


def cart(times_s: tuple[float, ...], count: int | None = None) -> Moving:
    way = ((0.0, 0.0, 0.5, 0.0),) * (len(times_s) if count is None else count)
    return Moving(name="cart", solid=Box(center=(0, 0, 0.5), size=(1, 1, 1)), times_s=times_s, way=way)


def volume_of(points: Array, triangles: Array) -> float:
    """Volume by the divergence theorem: positive only if triangles are counter-clockwise seen from outside."""
    a, b, c = (points - points.mean(axis=0))[triangles].transpose(1, 0, 2)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def check_closed(points: Array, triangles: Array) -> None:
    """Each edge occurs equally often in both directions, by places: shared faces of pieces cancel."""
    _, number = np.unique(points.round(9), axis=0, return_inverse=True)
    corners = number.reshape(-1)[triangles]
    edges = Counter((int(t[i]), int(t[(i + 1) % 3])) for t in corners for i in range(3))
    assert all(edges[b, a] == count for (a, b), count in edges.items())


@settings(deadline=None)
@given(solids=st.lists(boxes | cylinders, min_size=1, max_size=4))
def test_the_mesh_of_boxes_and_cylinders(solids: list[AnySolid]) -> None:
    for solid in solids:
        points, triangles = World(solids=(solid,)).mesh()
        check_closed(points, triangles)
        if isinstance(solid, Box):
            assert volume_of(points, triangles) == pytest.approx(math.prod(solid.size))
        elif isinstance(solid, Cylinder):
            full = math.pi * solid.radius**2 * solid.height
            assert 0.97 * full < volume_of(points, triangles) < full
    points, triangles = World(solids=tuple(solids)).mesh()
    assert triangles.min(initial=0) >= 0
    assert triangles.max(initial=0) < len(points)


@settings(deadline=None)
@given(lengths=radii, bottom=st.floats(-3.0, 3.0), height=edge, clockwise=st.booleans())
def test_the_mesh_of_a_prism_has_its_volume(lengths: list[float], bottom: float, height: float, clockwise: bool) -> None:
    outline = star(lengths)[:: -1 if clockwise else 1]
    assume(not problem_of(outline))
    points, triangles = World(solids=(Prism(outline=outline, bottom=bottom, height=height),)).mesh()
    assert volume_of(points, triangles) == pytest.approx(abs(area_m2(np.array(outline))) * height, rel=1e-6)
    assert points[:, 2].min() == bottom
    assert points[:, 2].max() == bottom + height


def test_a_courtyard_stays_open() -> None:
    prism = Prism(outline=((0, 0), (6, 0), (6, 6), (0, 6)), holes=(((2, 2), (4, 2), (4, 4), (2, 4)),), height=3.0)
    world = World(solids=(prism,))
    assert volume_of(*world.mesh()) == pytest.approx((36.0 - 4.0) * 3.0)
    small = np.array([[2.5, 2.5], [3.5, 2.5], [3.5, 3.5], [2.5, 3.5]])
    assert world.blocking(small, 0.0, 1.0) is None
    assert world.blocking(small + 1.2, 0.0, 1.0) is not None


def test_shapes_name_their_solid() -> None:
    triangle = np.array([[(0, 0, 0), (1, 0, 0), (0, 1, 0)]], float)
    solids = (
        Cylinder(center=(9, 9, 1), radius=0.5, height=2.0),
        Mesh(triangles=triangle),
        Box(center=(0, 0, 1), size=(1, 1, 2)),
        Prism(outline=((0, 0), (3, 0), (3, 1), (1, 1), (1, 3), (0, 3)), height=1.0),
    )
    shapes = World(solids=solids).shapes
    assert {int(k) for group in shapes.groups for k in group.solid} == {0, 2, 3}
    assert shapes.triangle_solid.tolist() == [1]
    assert min(group.corners.shape[1] for group in shapes.groups) == 4
    (fours,) = [group for group in shapes.groups if group.corners.shape[1] == 4]
    assert sorted(fours.solid.tolist()) == [2, 3, 3]


def test_an_empty_world_has_an_empty_mesh() -> None:
    points, triangles = World().mesh()
    assert points.shape == (0, 3)
    assert triangles.shape == (0, 3)


@given(radius=st.floats(0.001, 2.6))
def test_a_cylinder_is_a_polygon_just_inside_the_circle(radius: float) -> None:
    (piece,) = Cylinder(center=(1.0, 2.0, 0.0), radius=radius, height=1.0).uprights()
    corners = piece.corners - (1.0, 2.0)
    assert np.hypot(*corners.T) == pytest.approx(radius)
    middles = 0.5 * (corners + np.roll(corners, -1, axis=0))
    assert radius - np.hypot(*middles.T).min() <= max(0.002, 0.02 * radius) + 1e-12  # 16 corners: 1.9 % of the radius


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Box(center=(0, 0, 0), size=(0.0, 1.0, 1.0)), "positive sizes"),
        (lambda: Box(center=(0, 0, 0), size=(1.0, math.nan, 1.0)), "positive sizes"),
        (lambda: Zone(center=(0, 0), size=(1.0, -1.0), friction=0.5), "a zone needs .* two positive sizes"),
        (lambda: Zone(center=(0, 0), size=(1.0, math.nan), friction=0.5), "a zone needs"),
        (lambda: Light(direction=(0.0, 0.0, 0.0)), "direction"),
        (lambda: Light(direction=(0.0, math.inf, 1.0)), "direction"),
        (lambda: cart((0.0, 0.0)), "cart"),
        (lambda: cart((0.0,), count=2), "cart"),
        (lambda: cart(()), "cart"),
        (lambda: cart((0.0, math.nan)), "cart"),
        (lambda: Cylinder(center=(0, 0, math.inf), radius=1.0, height=1.0), "finite"),
        (lambda: Cylinder(center=(0, 0, 0), radius=-1.0, height=1.0), "positive"),
        (lambda: Cylinder(center=(0, 0, 0), radius=1.0, height=0.0), "positive"),
        (lambda: Prism(outline=((0, 0), (1, 1)), height=1.0), "at least three corners"),
        (lambda: Prism(outline=((0, 0), (1, 0), (1, 1)), height=0.0), "positive height"),
        (lambda: Prism(outline=((0, 0), (1, 0), (1, 1)), height=math.inf), "positive height"),
        (lambda: Prism(outline=((0, 0), (1, 0), (1, 1)), height=1.0, bottom=math.nan), "finite bottom"),
        (lambda: Mesh(triangles=np.zeros((3, 3))), "shape"),
        (lambda: Mesh(triangles=np.array([[(0, 0, 0)] * 3, [(0, 0, math.nan)] * 3])), "triangle 1 of a mesh"),
        (Mark, "one of"),
        (lambda: Mark(radius=1.0, outline=((0, 0), (1, 0), (0, 1))), "one of"),
        (lambda: Mark(outline=((0, 0), (1, 0))), "3 points"),
        (lambda: GroundPicture(size=(5000.0, 5000.0), marks=(Mark(radius=1.0),)), "resolution_m = 0.1"),
    ],
)
def test_wrong_solids_are_refused(make: object, words: str) -> None:
    assert callable(make)
    with pytest.raises(ValueError, match=words):
        make()


def test_colours_are_checked_and_have_a_default() -> None:
    with pytest.raises(msgspec.ValidationError, match="255"):
        msgspec.convert({"center": [0, 0, 0], "size": [1, 1, 1], "color": [0, 0, 256]}, Box)
    assert color_of(Box(center=(0, 0, 0), size=(1, 1, 1), material="brick")) == MATERIAL_COLORS["brick"]
    assert color_of(Box(center=(0, 0, 0), size=(1, 1, 1), material="brick", color=(1, 2, 3))) == (1, 2, 3)
    assert len(color_of(Box(center=(0, 0, 0), size=(1, 1, 1), material="cheese"))) == 3


# --- ground -------------------------------------------------------------------------------------------------------------------


def at(ground: GroundPicture, x: float, y: float) -> list[int]:
    """The colour of the pixel at a place."""
    picture = ground.image
    assert picture is not None
    rows, columns = picture.shape[:2]
    column = (x - ground.center[0] + 0.5 * ground.size[0]) / ground.size[0] * columns
    row = (ground.center[1] + 0.5 * ground.size[1] - y) / ground.size[1] * rows
    return picture[int(row), int(column)].tolist()


def test_marks_are_at_their_places() -> None:
    square = Mark(outline=((1, 1), (3, 1), (3, 2), (1, 2)), color=(255, 0, 0))
    disc = Mark(center=(-5.0, 5.0), radius=2.0, color=(0, 255, 0))
    line = Mark(line=((-8, -8), (8, -8)), width=0.4, color=(0, 0, 255))
    ground = GroundPicture(
        center=(1.0, -1.0), size=(20.0, 24.0), color=(9, 9, 9), resolution_m=0.05, marks=(square, disc, line)
    )
    picture = ground.image
    assert picture is not None
    assert picture.shape == (480, 400, 3)
    for x, y, color in ((1.1, 1.1, (255, 0, 0)), (2.9, 1.9, (255, 0, 0)), (-5.0, 6.9, (0, 255, 0)), (5.0, -8.1, (0, 0, 255))):
        assert at(ground, x, y) == list(color)
    for x, y in ((0.9, 1.5), (3.1, 1.5), (2.0, 2.1), (-5.0, 7.1), (-2.9, 5.0), (5.0, -8.3), (5.0, -7.7)):
        assert at(ground, x, y) == [9, 9, 9]
    reds = (picture == (255, 0, 0)).all(axis=2).sum() * 0.05**2
    greens = (picture == (0, 255, 0)).all(axis=2).sum() * 0.05**2
    assert reds == pytest.approx(2.0, rel=0.06)  # edges are blended
    assert greens == pytest.approx(4.0 * math.pi, rel=0.06)


@pytest.mark.parametrize("yaw", [0.0, 0.5 * math.pi, 0.7])
def test_a_picture_has_its_yaw(tmp_path: Path, yaw: float) -> None:
    pixels = np.zeros((40, 60, 3), np.uint8)
    pixels[:20, 30:] = (255, 255, 255)  # north-eastern quarter
    pixels[20:, :30] = (0, 0, 200)  # red in OpenCV's BGR: south-western quarter
    cv2.imwrite(str(tmp_path / "poster.png"), pixels)
    poster = Mark(picture=str(tmp_path / "poster.png"), center=(2.0, 1.0), size=(6.0, 4.0), yaw_rad=yaw)
    ground = GroundPicture(size=(30.0, 30.0), color=(50, 60, 70), marks=(poster,))
    c, s = math.cos(yaw), math.sin(yaw)
    for u, v, color in (
        (1.5, 1.0, (255, 255, 255)),
        (-1.5, -1.0, (200, 0, 0)),
        (1.5, -1.0, (0, 0, 0)),
        (3.3, 0.0, (50, 60, 70)),
        (0.0, 2.3, (50, 60, 70)),
    ):
        assert at(ground, 2.0 + c * u - s * v, 1.0 + s * u + c * v) == list(color)


def test_a_picture_is_cut_off_at_the_rim_and_omitted_outside(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "white.png"), np.full((8, 8, 3), 255, np.uint8))
    marks = tuple(Mark(picture=str(tmp_path / "white.png"), center=(x, 0.0), size=(4.0, 4.0)) for x in (5.0, 50.0))
    ground = GroundPicture(size=(10.0, 10.0), color=(0, 0, 0), marks=marks)
    assert at(ground, 4.9, 0.0) == [255, 255, 255]
    picture = ground.image
    assert picture is not None
    assert picture.mean() == pytest.approx(255 * 2.0 * 4.0 / 100.0, rel=0.05)


def test_a_plain_ground_has_no_picture_and_files_are_checked(tmp_path: Path) -> None:
    assert GroundPicture().image is None
    with pytest.raises(ValueError, match=r"there is no picture file .*nothing\.png"):
        _ = GroundPicture(picture=str(tmp_path / "nothing.png")).image
    (tmp_path / "text.png").write_text("text")
    with pytest.raises(ValueError, match=r"text\.png is not a picture"):
        _ = GroundPicture(picture=str(tmp_path / "text.png")).image


def test_a_picture_is_painted_once_and_cannot_be_changed() -> None:
    ground = GroundPicture(size=(5.0, 5.0), marks=(Mark(radius=1.0),))
    picture = ground.image
    assert picture is not None
    assert ground.image is picture
    assert not picture.flags.writeable
    assert ground == GroundPicture(size=(5.0, 5.0), marks=(Mark(radius=1.0),))


bars = st.builds(rectangle, *[st.floats(-3, 3)] * 2, *[st.floats(0.1, 2)] * 2, st.floats(-4, 4))


@given(one=bars, other=bars)
def test_overlap_is_the_least_shift(one: Array, other: Array) -> None:
    """Distance of the origin from the boundary of the Minkowski difference around it."""
    rim = ConvexHull((one[:, None] - other).reshape(-1, 2)).equations[:, 2]
    assert overlap_m(one, other) == pytest.approx(max(0.0, -rim.max()), abs=1e-6)


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
def test_a_looping_obstacle_never_exceeds_its_timetable_speed(time_s: float, span_s: float) -> None:
    box = Box(center=(0.0, 0.0, 0.0), size=(1.0, 1.0, 1.0))
    way = ((0.0, 0.0, 0.5, 0.0), (2.0 * span_s, 0.0, 0.5, 3.0 * span_s), (0.0, span_s, 0.5, 6.0 * span_s))
    around = Moving(name="cart", solid=box, times_s=(0.0, span_s, 2.0 * span_s), way=way, loop=True)
    rates = around.rates(time_s)
    first, second = ((2.0, 0.0, 0.0, 3.0), (-2.0, 1.0, 0.0, 3.0))
    assert rates in (pytest.approx(first), pytest.approx(second))
    here, soon = (np.array(around.pose(each)) for each in (time_s, time_s + 1e-6))
    if np.abs(soon - here).max() < 1e-5:  # no restart in between and no corner
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


def test_distance_out_of_bounds() -> None:
    world = World(bounds=(-10.0, -5.0, 10.0, 5.0))
    assert [world.outside(0, 0), world.outside(10, 5), world.outside(12, 0), world.outside(-13, -9)] == [0.0, 0.0, 2.0, 5.0]
    assert World().outside(1e9, 0) == 0.0


def test_a_body_in_a_solid_is_found_with_the_shortest_way_out() -> None:
    wall, post = Box(center=(3.0, 0.0, 1.0), size=(1.0, 8.0, 2.0)), Cylinder(center=(-3.0, 0.0, 0.5), radius=0.5, height=1.0)
    world = World(solids=(wall, post))
    assert blocking(world, square(0.0, 0.0), 0.0, 1.0) is None
    assert blocking(world, square(2.0, 0.0), 0.0, 1.0) is None  # in contact only
    assert blocking(world, square(2.2, 0.0), 0.0, 1.0) == (wall, pytest.approx(0.2))
    assert blocking(world, square(2.2, 0.0), 1.95, 2.5) == (wall, pytest.approx(0.05))  # shorter upwards
    assert blocking(world, square(2.2, 0.0), 2.0, 2.5) is None
    assert blocking(world, square(-3.0, 0.9), 0.0, 1.0) == (post, pytest.approx(0.1))


def test_the_deepest_overlap_counts() -> None:
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
def test_a_mesh_blocks_like_its_box(box: Box, yaw: float, x: float, bottom: float, height: float) -> None:
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
        assert 0.0 < as_mesh[1] <= min(map(min, out)) + 1e-9  # a body outside the bounding box is free


def test_a_body_inside_a_closed_mesh_is_found_without_contact() -> None:
    points, triangles = World(solids=(Box(center=(0.0, 0.0, 5.0), size=(10.0, 10.0, 10.0)),)).mesh()
    mesh = Mesh(triangles=points[triangles])
    assert blocking(World(solids=(mesh,)), square(3.0, 0.1), 4.0, 5.0) == (mesh, pytest.approx(2.5))
    room = Mesh(triangles=points[triangles][:, ::-1])  # faces inwards: a room
    assert World(solids=(room,)).blocking(square(3.0, 0.1), 4.0, 5.0) is None
    assert World(solids=(room,)).blocking(square(4.9, 0.1), 4.0, 5.0) is not None
    roof = Mesh(triangles=mesh.triangles[mesh.triangles[:, :, 2].min(axis=1) > 9.0])
    assert World(solids=(roof,)).blocking(square(3.0, 0.1), 4.0, 5.0) is None
