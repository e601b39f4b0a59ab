"""Places of a new shape are dealt out so that no two ways cross."""

import itertools
import math
from collections.abc import Sequence

import pytest
import scipy.optimize  # noqa: F401  loaded before the first example is timed
from hypothesis import given
from hypothesis import strategies as st

from tests.support.agents.straight_paths import crosses
from vcmvsp.agents.formation.team.shape import ShapeName, Slot, slots
from vcmvsp.agents.formation.team.team import assign

shapes = st.sampled_from(("column", "line", "echelon", "wedge", "box", "diamond"))
points = st.tuples(st.floats(-10, 10), st.floats(-10, 10))


def ways(positions: Sequence[Slot], places: Sequence[Slot], order: Sequence[int]) -> list[tuple[Slot, Slot]]:
    return [(positions[member], place) for member, place in zip(order, places, strict=True)]


def crossings(pairs: Sequence[tuple[Slot, Slot]]) -> int:
    return sum(crosses(*one, *other) for one, other in itertools.combinations(pairs, 2))


@given(shapes, st.integers(1, 25).flatmap(lambda count: st.lists(points, min_size=count, max_size=count)))
def test_no_two_ways_cross_wherever_the_members_are(shape: ShapeName, positions: list[Slot]) -> None:
    places = slots(shape, len(positions), 1.0)
    order = assign(positions, places)
    assert sorted(order) == list(range(len(positions)))
    assert order[0] == 0  # the leader leads on
    assert crossings(ways(positions, places, order)[1:]) == 0


@given(shapes, shapes, st.integers(1, 30))
def test_no_two_ways_cross_from_shape_to_shape(before: ShapeName, after: ShapeName, count: int) -> None:
    positions, places = slots(before, count, 1.0), slots(after, count, 1.0)
    order = assign(positions, places)
    assert crossings(ways(positions, places, order)) == 0


@given(shapes, st.lists(points, min_size=2, max_size=6))
def test_the_sum_of_all_ways_is_the_least_there_is(shape: ShapeName, positions: list[Slot]) -> None:
    places = slots(shape, len(positions), 1.0)

    def total(order: Sequence[int]) -> float:
        return sum(math.dist(*way) for way in ways(positions, places, order))

    least = min(total((0, *rest)) for rest in itertools.permutations(range(1, len(positions))))
    assert total(assign(positions, places)) == pytest.approx(least)


def test_who_is_there_already_stays() -> None:
    places = slots("wedge", 7, 1.0)
    assert assign(places, places) == tuple(range(7))


def test_keeping_the_numbers_would_cross() -> None:
    """A wedge that becomes a column by numbers crosses paths; the check sees it."""
    positions, places = slots("wedge", 9, 1.0), slots("line", 9, 1.0)[:1] + slots("line", 9, 1.0)[:0:-1]
    assert crossings(ways(positions, places, range(9))) > 0
