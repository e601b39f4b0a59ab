"""Who follows whom."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.agents.formation.team.shape import ROOT, TopologyName, ancestors, named_parents, parents, ranks

CARS = ("car1", "car2", "car3", "car4")


def depth(tree: tuple[int, ...]) -> int:
    """How many hops the farthest place is from the root."""
    return max(len(ancestors(tree, place)) for place in range(len(tree)))


@given(st.sampled_from(("star", "chain", "k-tree")), st.integers(1, 80), st.integers(1, 5))
def test_everybody_follows_somebody_up_to_the_first(topology: TopologyName, count: int, branching: int) -> None:
    tree = parents(topology, count, branching)
    assert len(tree) == count
    assert tree[0] == ROOT
    for place in range(1, count):
        assert 0 <= tree[place] < place
        assert ancestors(tree, place)[-1] == 0
    assert ranks(tree) == tuple(range(count))  # so that places come after all that they depend on


def test_stars_and_chains() -> None:
    assert parents("star", 4) == (ROOT, 0, 0, 0)
    assert parents("chain", 4) == (ROOT, 0, 1, 2)
    assert depth(parents("star", 9)) == 1
    assert depth(parents("chain", 9)) == 8
    assert depth(parents("chain", 1)) == 0
    assert ancestors(parents("chain", 4), 3) == (2, 1, 0)


@given(st.integers(1, 400), st.integers(2, 6))
def test_a_tree_is_as_deep_as_the_logarithm_of_its_number(count: int, k: int) -> None:
    """It is filled row by row: 1 + k + ... + k^(d - 1) < N <= 1 + k + ... + k^d, so that d <= ceil(log_k N)."""
    tree = parents("k-tree", count, k)
    d = depth(tree)
    assert sum(k**row for row in range(d)) < count <= sum(k**row for row in range(d + 1))
    assert k ** (d - 1) < count
    assert d <= math.ceil(math.log(count, k) - 1e-9)
    assert max((tree.count(place) for place in range(count)), default=0) <= k


def test_a_tree_of_seven() -> None:
    assert parents("k-tree", 7, 2) == (ROOT, 0, 0, 1, 1, 2, 2)
    assert parents("k-tree", 4, 1) == parents("chain", 4)


def test_a_graph_follows_names() -> None:
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
        ({"car2": "car1", "car4": "car1"}, r"car3 follows nobody, but car1 leads already"),
        ({"car1": "car4", "car2": "car1", "car3": "car1", "car4": "car1"}, r"car1 is the first member and leads"),
        ({"car2": "car3", "car3": "car2", "car4": "car1"}, r"car2 follows car3, car3 follows car2: a circle"),
        ({"car2": "car1", "car3": "car3", "car4": "car1"}, r"car3 follows car3: a circle"),
        (
            {"car2": "car4", "car3": "car2", "car4": "car3"},
            r"car2 follows car4, car4 follows car3, car3 follows car2: a circle, which nobody leads",
        ),
    ],
)
def test_graphs_that_are_no_trees_are_refused(given_parents: dict[str, str], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        named_parents(given_parents, CARS)
