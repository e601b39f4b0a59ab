"""Shapes: where each member belongs."""

import math
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.agents.formation.team.shape import ShapeName, Slot, slots

GROWING: tuple[ShapeName, ...] = ("column", "line", "echelon", "wedge", "box", "diamond")
shapes, counts, spacings = st.sampled_from(GROWING), st.integers(1, 60), st.floats(0.1, 10.0)


def distance(one: Slot, other: Slot) -> float:
    return math.hypot(one[0] - other[0], one[1] - other[1])


@given(shapes, counts, spacings)
def test_the_leader_is_at_the_origin_and_neighbours_are_one_spacing_apart(shape: ShapeName, count: int, spacing: float) -> None:
    """The nearest of all others is at the spacing for everybody, so that no two share a place and nobody is apart."""
    places = slots(shape, count, spacing)
    assert len(places) == count
    assert places[0] == (0.0, 0.0)
    for i, place in enumerate(places):
        others = [distance(place, other) for j, other in enumerate(places) if j != i]
        assert min(others, default=spacing) == pytest.approx(spacing)


@given(shapes, counts, spacings)
def test_nobody_belongs_ahead_of_the_leader(shape: ShapeName, count: int, spacing: float) -> None:
    assert max(x for x, _ in slots(shape, count, spacing)) == 0.0


@given(shapes, st.integers(2, 40), spacings, st.floats(1.1, 3.0))
def test_shapes_grow_in_proportion_to_the_spacing(shape: ShapeName, count: int, spacing: float, times: float) -> None:
    small, large = slots(shape, count, spacing), slots(shape, count, spacing * times)
    for (x, y), wide in zip(small, large, strict=True):
        assert wide == pytest.approx((x * times, y * times))


@given(st.sampled_from(("column", "line", "echelon", "wedge")), st.integers(1, 40))
def test_another_member_moves_nobody_where_the_shape_is_open(shape: ShapeName, count: int) -> None:
    assert slots(shape, count + 1, 1.0)[:count] == slots(shape, count, 1.0)


def test_a_wedge_of_three_is_the_standard_triangle() -> None:
    """1 m at 30 degrees to either side; the first follower is right-behind."""
    ahead, aside = math.cos(math.radians(30.0)), math.sin(math.radians(30.0))
    _, right, left = slots("wedge", 3, 1.0)
    assert right == pytest.approx((-ahead, -aside))
    assert left == pytest.approx((-ahead, aside))


def test_a_column_a_line_and_an_echelon() -> None:
    s = math.sqrt(0.5)
    assert slots("column", 4, 2.0) == ((0, 0), (-2, 0), (-4, 0), (-6, 0))
    assert slots("line", 5, 2.0) == ((0, 0), (0, -2), (0, 2), (0, -4), (0, 4))
    for i, place in enumerate(slots("echelon", 3, 1.0)):
        assert place == pytest.approx((-i * s, -i * s))


def test_a_box_has_rows_of_the_root_of_its_number() -> None:
    assert slots("box", 5, 1.0) == ((0, 0), (0, -1), (0, -2), (-1, 0), (-1, -1))
    assert slots("box", 4, 1.0) == ((0, 0), (0, -1), (-1, 0), (-1, -1))


def test_a_diamond_has_rows_of_1_2_3_2_1() -> None:
    s = math.sqrt(0.5)
    rows: dict[int, list[float]] = {}
    for x, y in slots("diamond", 9, 1.0):
        rows.setdefault(round(-x / s), []).append(round(y / s, 9))
    assert rows == {0: [0], 1: [1, -1], 2: [2, 0, -2], 3: [1, -1], 4: [0]}
    assert slots("diamond", 7, 1.0) == slots("diamond", 9, 1.0)[:7]


@pytest.mark.parametrize(
    ("shape", "count", "lane"),
    [("column", 6, 0.4), ("line", 4, 3.4), ("wedge", 3, 1.4), ("box", 9, 2.4), ("diamond", 4, 1.814)],
)
def test_the_lane_that_a_shape_needs(shape: ShapeName, count: int, lane: float) -> None:
    across = [y for _, y in slots(shape, count, 1.0)]
    assert max(across) - min(across) + 0.4 == pytest.approx(lane, abs=1e-3)  # with bodies 0.4 m wide


def test_an_own_shape_is_what_it_says() -> None:
    offsets = ((0.0, 0.0), (-1.0, 2.0), (3.0, 0.5))
    assert slots("own", 3, 7.0, offsets) == offsets
    assert slots("own", 2, 7.0, offsets) == offsets[:2]
    assert set(get_args(ShapeName)) == {*GROWING, "own"}


@pytest.mark.parametrize(
    ("offsets", "says"),
    [
        (((0.0, 0.0), (1.0, 0.0)), r"needs the offsets of all 3 members, but there are 2"),
        (((1.0, 0.0), (0.0, 0.0), (2.0, 0.0)), r"first of the offsets .* must be \[0, 0\], not \[1.0, 0.0\]"),
        (((0.0, 0.0), (1.0, 0.0), (1.0, 0.0)), r"offsets has the place \[1.0, 0.0\] twice, as its items 1 and 2"),
    ],
)
def test_wrong_offsets_are_named(offsets: tuple[Slot, ...], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        slots("own", 3, 1.0, offsets)
