"""Convex parts against point-in-polygon tests, areas and winding; invalid outlines; overlap of convex polygons."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util.polygons import Point, area_m2, convex_parts, is_convex, outward, overlap_m, problem_of, width_m

pytestmark = pytest.mark.slow

L_SHAPE = ((0.0, 0.0), (3.0, 0.0), (3.0, 1.0), (1.0, 1.0), (1.0, 3.0), (0.0, 3.0))
TEETH = [(x + dx, y) for x in (6, 4, 2, 0) for dx, y in ((1, 1), (1, 3), (0, 3), (0, 1))]
COMB = ((0, 0), (7, 0), *TEETH[1:-1])
SPIRAL = ((0, 0), (8, 0), (8, 8), (2, 8), (2, 4), (4, 4), (4, 6), (6, 6), (6, 2), (0, 2))
PLUS = ((1, 0), (2, 0), (2, 1), (3, 1), (3, 2), (2, 2), (2, 3), (1, 3), (1, 2), (0, 2), (0, 1), (1, 1))
SAMPLES = np.random.default_rng(5).uniform(size=(4000, 2))

radii = st.lists(st.floats(0.05, 5.0), min_size=3, max_size=14)
odd_radii = st.sampled_from(range(5, 14, 2)).flatmap(
    lambda count: st.lists(st.floats(0.05, 5.0), min_size=count, max_size=count)
)
grid_points = st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=3, max_size=9, unique=True)


def star(lengths: list[float], at: tuple[float, float] = (0.0, 0.0)) -> list[Point]:
    """A star-shaped polygon: corners at distances ``lengths``, in equal steps of direction."""
    angles = math.tau * np.arange(len(lengths)) / len(lengths)
    return [(at[0] + r * math.cos(a), at[1] + r * math.sin(a)) for r, a in zip(lengths, angles, strict=True)]


def simple_polygon(points: list[tuple[int, int]]) -> list[Point]:
    """A simple polygon through points of a grid, by reversing at crossings (2-opt): with many corners in a line."""
    ring = [(float(x), float(y)) for x, y in points]
    for _ in range(200):
        worse = False
        for i, j in itertools.combinations(range(len(ring)), 2):
            a, b, c, d = ring[i], ring[(i + 1) % len(ring)], ring[j], ring[(j + 1) % len(ring)]
            if math.dist(a, c) + math.dist(b, d) < math.dist(a, b) + math.dist(c, d) - 1e-9:
                ring[i + 1 : j + 1] = ring[i + 1 : j + 1][::-1]
                worse = True
        if not worse:
            break
    return ring


def inside_polygon(ring: Array, points: Array) -> Array:
    """Which points are inside a polygon, convex or not: an odd number of edges to the east of them."""
    odd = np.zeros(len(points), bool)
    for (ax, ay), (bx, by) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        if ay != by:
            x = ax + (points[:, 1] - ay) * (bx - ax) / (by - ay)
            odd ^= ((ay > points[:, 1]) != (by > points[:, 1])) & (x > points[:, 0])
    return odd


def checked_parts(outline: list[Point] | tuple[Point, ...], holes: tuple[tuple[Point, ...], ...] = ()) -> list[Array]:
    """The parts are convex, run counter-clockwise, have the whole area, and contain each sample as often as the polygon."""
    parts = convex_parts(outline, holes)
    ring = np.array(outline, float)
    expected_m2 = abs(area_m2(ring)) - sum(abs(area_m2(np.array(hole, float))) for hole in holes)
    assert sum(area_m2(part) for part in parts) == pytest.approx(expected_m2, rel=1e-9, abs=1e-12)
    for part in parts:
        edges = np.roll(part, -1, axis=0) - part
        turns = edges[:, 0] * np.roll(edges[:, 1], -1) - edges[:, 1] * np.roll(edges[:, 0], -1)
        assert area_m2(part) > 0.0
        assert (turns >= -1e-9).all()
    low, high = ring.min(axis=0), ring.max(axis=0)
    points = low + SAMPLES * (high - low)
    inside = inside_polygon(ring, points)
    for hole in holes:
        inside &= ~inside_polygon(np.array(hole, float), points)
    count = np.sum([inside_polygon(part, points) for part in parts], axis=0)
    assert (count == inside).all()  # parts do not overlap
    return parts


@settings(deadline=None)
@given(lengths=radii, clockwise=st.booleans(), at=st.tuples(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4)))
def test_stars(lengths: list[float], clockwise: bool, at: tuple[float, float]) -> None:
    outline = star(lengths, at)[:: -1 if clockwise else 1]
    assume(not problem_of(outline))
    checked_parts(outline)


@settings(deadline=None)
@given(points=grid_points)
def test_polygons_on_a_grid(points: list[tuple[int, int]]) -> None:
    outline = simple_polygon(points)
    assume(not problem_of(outline))
    assert is_convex(outline) == is_convex(outline[::-1]) == (len(checked_parts(outline)) == 1)
    checked_parts(outline[::-1])


@settings(deadline=None)
@given(lengths=st.lists(st.floats(3.0, 5.0), min_size=5, max_size=9), places=st.integers(0, 15), share=st.floats(0.05, 0.95))
def test_holes(lengths: list[float], places: int, share: float) -> None:
    ring = star(lengths)
    middles = [(x, y) for k, (x, y) in enumerate(((0.8, 0.8), (-0.8, 0.8), (-0.8, -0.8), (0.8, -0.8))) if places >> k & 1]
    holes = tuple(tuple(star([0.7 * share, 0.7, 0.4 * share, 0.6, 0.7], at)) for at in middles)
    assert not problem_of(ring, holes)
    checked_parts(ring, holes)


def test_many_holes_in_a_row_need_bridges_at_the_same_corner() -> None:
    holes = tuple(((x, 1.0), (x + 0.5, 1.0), (x + 0.5, 2.0), (x, 2.0)) for x in (1.0, 2.0, 3.0, 4.0))
    checked_parts(((0.0, 0.0), (6.0, 1.5), (0.0, 3.0)), holes[:3])
    checked_parts(((0.0, 0.0), (6.0, 0.0), (6.0, 3.0), (0.0, 3.0)), holes)


@pytest.mark.parametrize(("outline", "most"), [(L_SHAPE, 2), (COMB, 7), (SPIRAL, 6), (PLUS, 5)])
def test_shapes_of_right_angles(outline: tuple[Point, ...], most: int) -> None:
    assert len(checked_parts(outline)) <= most
    checked_parts(outline[::-1])


def test_a_convex_outline_is_one_part_without_corners_in_a_line() -> None:
    (part,) = checked_parts(((0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (0, 2)))
    assert part.tolist() == [[0, 0], [2, 0], [2, 2], [0, 2]]


def test_corners_within_rounding_of_a_line() -> None:
    step = np.linspace(0.0, 1.0, 9)
    upper = [(x, 0.1 * x + 1e-17 * (-1) ** k) for k, x in enumerate(step.tolist())]
    checked_parts([*upper, (1.0, 1.0), (0.5, 0.7), (0.0, 1.0)])


@pytest.mark.parametrize(
    ("outline", "holes", "problem"),
    [
        (((0, 0), (1, 1)), (), "at least three corners"),
        (((0, 0), (1, 0), (math.nan, 1)), (), "not finite"),
        (((0, 0), (1, 0), (1, 0), (0, 1)), (), "two equal corners"),
        (((0, 0), (1, 0), (2, 0)), (), "no area"),
        (((0, 0), (2, 2), (2, 0), (0, 1)), (), "crosses or touches itself at edge 0 and edge 2"),
        (((0, 0), (4, 0), (4, 4), (2, 0), (0, 4)), (), "crosses or touches itself at edge 0 and edge 2"),
        (((0, 0), (4, 0), (2, 0), (2, 2)), (), "crosses or touches itself"),
        (L_SHAPE, (((2, 2), (2.5, 2), (2.5, 2.5)),), "hole (number 0) outside its outline"),
        (L_SHAPE, (((0.5, 0.5), (2, 2), (0.5, 2)),), "edge 2 and edge 0 of hole 0"),
        (PLUS, (((1.1, 1.1), (1.9, 1.1), (1.5, 1.9)), ((1.4, 1.2), (1.6, 1.2), (1.5, 1.4))), "hole (number 1) outside"),
    ],
)
def test_invalid_outlines(outline: tuple[Point, ...], holes: tuple[tuple[Point, ...], ...], problem: str) -> None:
    assert problem in problem_of(outline, holes)


@given(lengths=odd_radii)
def test_an_outline_is_refused_exactly_if_two_edges_cross(lengths: list[float]) -> None:
    pentagram = star(lengths)
    order = [pentagram[2 * k % len(pentagram)] for k in range(len(pentagram))]
    assert problem_of(order).startswith("crosses")
    assert not problem_of(pentagram)


@given(length=st.floats(0.1, 5.0), width=st.floats(0.1, 5.0), yaw=st.floats(-4.0, 4.0))
def test_the_width_of_a_rectangle_is_its_shorter_edge(length: float, width: float, yaw: float) -> None:
    c, s = math.cos(yaw), math.sin(yaw)
    corners = np.array([(0, 0), (length, 0), (length, width), (0, width)]) @ np.array([[c, s], [-s, c]])
    assert width_m(corners) == pytest.approx(min(length, width))
    assert overlap_m(corners, corners) == pytest.approx(min(length, width))


@given(st.integers(3, 9), st.floats(-4.0, 4.0), st.floats(0.1, 5.0))
def test_outward_normals_are_upright_on_the_edges_and_point_away(sides: int, turn: float, radius: float) -> None:
    angles = turn + np.arange(sides) * math.tau / sides
    corners = radius * np.column_stack([np.cos(angles), np.sin(angles)])
    normals, along = outward(corners), np.roll(corners, -1, axis=0) - corners
    assert np.hypot(*normals.T) == pytest.approx(1.0)
    assert (normals * along).sum(axis=1) == pytest.approx(0.0, abs=1e-9)
    assert (normals * corners).sum(axis=1) == pytest.approx(radius * math.cos(math.pi / sides))  # distance of each edge
    assert (outward(np.stack([corners, 2.0 * corners]))[0] == normals).all()
