"""Shapes: slots of the members."""

import math
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.agents.formation.team.shape import (
    ROOT,
    ShapeName,
    Slot,
    TopologyName,
    ancestors,
    named_parents,
    parents,
    ranks,
    slots,
)

GROWING: tuple[ShapeName, ...] = ("column", "line", "echelon", "wedge", "box", "diamond")
shapes, counts, spacings = st.sampled_from(GROWING), st.integers(1, 60), st.floats(0.1, 10.0)


def distance(one: Slot, other: Slot) -> float:
    return math.hypot(one[0] - other[0], one[1] - other[1])


@given(shapes, counts, spacings)
def test_the_leader_is_at_the_origin_and_neighbours_are_one_spacing_apart(shape: ShapeName, count: int, spacing: float) -> None:
    """Every member's nearest neighbour is at the spacing: no common slots, no isolated member."""
    places = slots(shape, count, spacing)
    assert len(places) == count
    assert places[0] == (0.0, 0.0)
    for i, place in enumerate(places):
        others = [distance(place, other) for j, other in enumerate(places) if j != i]
        assert min(others, default=spacing) == pytest.approx(spacing)


@given(shapes, counts, spacings)
def test_no_slot_is_ahead_of_the_leader(shape: ShapeName, count: int, spacing: float) -> None:
    assert max(x for x, _ in slots(shape, count, spacing)) == 0.0


@given(st.sampled_from(("column", "line", "echelon", "wedge")), st.integers(1, 40))
def test_in_open_shapes_another_member_moves_no_slot(shape: ShapeName, count: int) -> None:
    assert slots(shape, count + 1, 1.0)[:count] == slots(shape, count, 1.0)


def test_a_wedge_of_three_is_the_standard_triangle() -> None:
    """1 m at 30 degrees to either side; the first follower is behind on the right."""
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


def test_a_box_has_rows_of_the_square_root_of_its_number() -> None:
    assert slots("box", 5, 1.0) == ((0, 0), (0, -1), (0, -2), (-1, 0), (-1, -1))
    assert slots("box", 4, 1.0) == ((0, 0), (0, -1), (-1, 0), (-1, -1))


def test_a_diamond_has_rows_of_1_2_3_2_1() -> None:
    s = math.sqrt(0.5)
    rows: dict[int, list[float]] = {}
    for x, y in slots("diamond", 9, 1.0):
        rows.setdefault(round(-x / s), []).append(round(y / s, 9))
    assert rows == {0: [0], 1: [1, -1], 2: [2, 0, -2], 3: [1, -1], 4: [0]}
    assert slots("diamond", 7, 1.0) == slots("diamond", 9, 1.0)[:7]


def test_an_own_shape_has_its_offsets() -> None:
    offsets = ((0.0, 0.0), (-1.0, 2.0), (3.0, 0.5))
    assert slots("own", 3, 7.0, offsets) == offsets
    assert slots("own", 2, 7.0, offsets) == offsets[:2]
    assert set(get_args(ShapeName)) == {*GROWING, "own"}


@pytest.mark.parametrize(
    ("offsets", "says"),
    [
        (((1.0, 0.0), (0.0, 0.0), (2.0, 0.0)), r"offsets.0. is the leader's place and must be \[0, 0\], not \[1.0, 0.0\]"),
        (((0.0, 0.0), (1.0, 0.0), (1.0, 0.0)), r"offsets.1. and offsets.2. are both \[1.0, 0.0\]"),
    ],
)
def test_wrong_offsets_are_named(offsets: tuple[Slot, ...], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        slots("own", 3, 1.0, offsets)


# --- parents ---


CARS = ("car1", "car2", "car3", "car4")


def depth(tree: tuple[int, ...]) -> int:
    """Number of hops from the root to the farthest place."""
    return max(len(ancestors(tree, place)) for place in range(len(tree)))


@given(st.sampled_from(("star", "chain", "k-tree")), st.integers(1, 80), st.integers(1, 5))
def test_every_member_descends_from_the_first(topology: TopologyName, count: int, branching: int) -> None:
    tree = parents(topology, count, branching)
    assert len(tree) == count
    assert tree[0] == ROOT
    for place in range(1, count):
        assert 0 <= tree[place] < place
        assert ancestors(tree, place)[-1] == 0
    assert ranks(tree) == tuple(range(count))  # so that places follow all places on which they depend


def test_stars_chains_and_trees() -> None:
    assert parents("star", 4) == (ROOT, 0, 0, 0)
    assert parents("chain", 4) == parents("k-tree", 4, 1) == (ROOT, 0, 1, 2)
    assert parents("k-tree", 7, 2) == (ROOT, 0, 0, 1, 1, 2, 2)
    assert depth(parents("star", 9)) == 1
    assert depth(parents("chain", 9)) == 8
    assert depth(parents("chain", 1)) == 0
    assert ancestors(parents("chain", 4), 3) == (2, 1, 0)


@given(st.integers(1, 400), st.integers(2, 6))
def test_the_depth_of_a_tree_is_the_logarithm_of_its_number(count: int, k: int) -> None:
    """It is filled row by row: 1 + k + ... + k^(d - 1) < N <= 1 + k + ... + k^d, so that d <= ceil(log_k N)."""
    tree = parents("k-tree", count, k)
    d = depth(tree)
    assert sum(k**row for row in range(d)) < count <= sum(k**row for row in range(d + 1))
    assert k ** (d - 1) < count
    assert d <= math.ceil(math.log(count, k) - 1e-9)
    assert max((tree.count(place) for place in range(count)), default=0) <= k


def test_a_graph_is_given_by_names() -> None:
    tree = named_parents({"car4": "car1", "car3": "car4", "car2": "car3"}, CARS)
    assert tree == (ROOT, 2, 3, 0)
    assert ranks(tree) == (0, 3, 2, 1)
    with pytest.raises(ValueError, match="names, not places"):
        parents("graph", 4)


@pytest.mark.parametrize(
    ("given_parents", "says"),
    [
        ({"car2": "car1", "car3": "cat2", "car4": "car1"}, r"unknown member 'cat2'; did you mean 'car2'\?"),
        ({"car2": "car1", "card": "car2", "car4": "car1"}, r"unknown member 'card'; did you mean 'car\d'\?"),
        ({"car2": "car1", "car4": "car1"}, r"car3 has no parent, and only car1 may lead"),
        ({"car1": "car4", "car2": "car1", "car3": "car1", "car4": "car1"}, r"car1 is the first member and leads"),
        ({"car2": "car3", "car3": "car2", "car4": "car1"}, r"car2 follows car3, car3 follows car2: a cycle"),
        ({"car2": "car1", "car3": "car3", "car4": "car1"}, r"car3 follows car3: a cycle"),
        (
            {"car2": "car4", "car3": "car2", "car4": "car3"},
            r"car2 follows car4, car4 follows car3, car3 follows car2: a cycle without a leader",
        ),
    ],
)
def test_graphs_that_are_no_trees_are_refused(given_parents: dict[str, str], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        named_parents(given_parents, CARS)
