"""A member's view of its formation, and distribution of a new shape to all members."""

import itertools
import math
from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.agents.formation.team.shape import Formation, ShapeName, Slot, TopologyName, slots
from vcmvsp.agents.formation.team.team import Team, assign

pytestmark = pytest.mark.slow

CARS = tuple(f"car{number}" for number in range(1, 8))
topologies = st.sampled_from(("star", "chain", "k-tree"))


def teams(cars: tuple[str, ...] = CARS, **formation: Any) -> list[Team]:
    return [Team(Formation(**formation), cars, name) for name in cars]


@given(topologies, st.integers(1, 9), st.integers(1, 3))
def test_members_agree_on_parents(topology: TopologyName, count: int, branching: int) -> None:
    everybody = teams(tuple(f"car{n}" for n in range(count)), topology=topology, branching=branching)
    by_name = {team.name: team for team in everybody}
    assert [team.parent for team in everybody].count(None) == 1
    for team in everybody:
        assert all(by_name[child].parent == team.name for child in team.children)
        if team.parent is not None:
            assert team.name in by_name[team.parent].children
            assert team.ancestors == (team.parent, *by_name[team.parent].ancestors)


def test_the_place_beside_a_parent_is_the_difference_of_the_slots() -> None:
    everybody = teams(shape="column", topology="chain", spacing=0.8)
    assert [team.beside(team.parent) for team in everybody if team.parent] == [pytest.approx((-0.8, 0.0))] * 6
    wedge = teams(shape="wedge", topology="chain")
    for one, other in zip(wedge[1:], slots("wedge", 7, 1.0)[1:], strict=True):
        assert one.slot == other
    assert wedge[2].beside("car2") == pytest.approx((0.0, 1.0))  # left of the member on the right


def test_a_subset_of_the_vehicles_in_another_order() -> None:
    team = Team(Formation(members=("car3", "car1", "car5"), topology="chain"), CARS, "car5")
    assert (team.parent, team.ancestors, team.place) == ("car1", ("car1", "car3"), 2)


def test_a_graph_keeps_its_names_when_places_change() -> None:
    formation = Formation(shape="line", topology="graph", parents={"b": "a", "c": "b", "d": "b"})
    leader, b = (Team(formation, tuple("abcd"), name) for name in "ab")
    leader.change("column", {"b": (-5.0, 0.0), "c": (-1.0, 0.0), "d": (-2.0, 0.0)})
    assert b.take(leader.fields)
    assert (b.parent, b.children) == ("a", ("c", "d"))
    assert b.slot == (-3.0, 0.0)  # it was last and remains last


def test_reports_have_no_shape_until_it_changes() -> None:
    leader, *_ = teams()
    assert leader.fields == {}
    leader.change("column", {})
    assert leader.fields["shape"] == "column"
    assert leader.fields["sn"] == 1


def test_parents_by_place_change_with_the_place() -> None:
    everybody = teams(CARS[:4], shape="line", topology="chain", spacing=1.0)
    leader = everybody[0]
    leader.change("column", {"car2": (-3.0, 0.0), "car3": (-2.0, 0.0), "car4": (-1.0, 0.0)})
    assert leader.fields["order"] == [0, 3, 2, 1]
    for team in everybody[1:]:
        assert team.take(leader.fields)
    assert [team.parent for team in everybody] == [None, "car3", "car4", "car1"]
    assert [team.slot for team in everybody] == [(0, 0), (-3, 0), (-2, 0), (-1, 0)]
    assert all(team.beside(str(team.parent)) == (-1.0, 0.0) for team in everybody[1:])
    assert leader.children == ("car4",)


def test_members_without_reports_are_assumed_in_their_slots() -> None:
    one, other, *_ = (Team(Formation(shape="wedge"), CARS, "car1") for _ in range(2))
    one.change("line", {})
    other.change("line", dict(zip(CARS, slots("wedge", 7, 1.0), strict=True)))
    assert one.fields == other.fields


@given(st.lists(st.sampled_from(("column", "line", "wedge", "box")), min_size=1, max_size=6), st.data())
def test_the_newest_shape_wins_in_any_order_and_with_copies(shapes: list[Any], data: st.DataObject) -> None:
    leader, *rest = teams(shape="diamond")
    bodies = []
    for shape in shapes:
        leader.change(shape, {})
        bodies.append(leader.fields)
    received = data.draw(st.lists(st.sampled_from(bodies), max_size=12))
    for body in [*received, bodies[-1], *received]:
        before = rest[3].changed
        assert rest[3].take(body) == (body["sn"] > before)
    assert (rest[3].shape, rest[3].changed, rest[3].fields) == (leader.shape, leader.changed, leader.fields)


GOOD = {"shape": "column", "sn": 3, "order": [0, 2, 1]}


@pytest.mark.parametrize(
    "wrong",
    [
        {"shape": "wdge"},
        {"shape": None},
        {"shape": ["column"]},
        {"shape": "own"},  # without offsets
        {"sn": 0},
        {"sn": -1},
        {"sn": "3"},
        {"sn": True},
        {"sn": 3.0},
        {"order": [0, 1]},
        {"order": [0, 1, 1]},
        {"order": [0, 1, 3]},
        {"order": [1, 0, 2]},  # the leader must remain first
        {"order": [0, 1, 2.0]},
        {"order": [0, 2, True]},
        {"order": [0, 2, "1"]},
        {"order": [0, [1], 2]},
        {"order": {"0": 0, "1": 1}},
        {"order": None},
    ],
)
def test_malformed_shapes_are_ignored(wrong: dict[str, Any]) -> None:
    team = Team(Formation(), CARS[:3], "car2")
    assert not team.take({**GOOD, **wrong})
    assert (team.shape, team.changed, team.place) == ("wedge", 0, 1)
    assert team.take(GOOD)
    assert (team.shape, team.changed, team.place) == ("column", 3, 2)


# --- loss of members ---


@given(topologies, st.lists(st.booleans(), min_size=7, max_size=7))
def test_living_members_follow_living_members_and_one_leads(topology: TopologyName, living: list[bool]) -> None:
    """With equal knowledge: each follows its nearest living ancestor; exactly one leads; no cycles."""
    everybody = [team for team, lives in zip(teams(topology=topology), living, strict=True) if lives]
    alive = {team.name for team in everybody}
    parents = {team.name: team.whom(lambda name: name in alive) for team in everybody}
    assert list(parents.values()).count(None) == min(1, len(everybody))
    for team in everybody:
        path = [team.name]
        while (parent := parents[path[-1]]) is not None:
            assert parent in alive
            assert parent not in path
            path.append(parent)
        nearest = [name for name in team.ancestors if name in alive]
        if nearest:
            assert parents[team.name] == nearest[0]


@given(st.permutations(range(1, 6)), st.lists(st.frozensets(st.sampled_from(CARS[:6])), min_size=6, max_size=6), topologies)
def test_there_is_no_cycle_of_parents_with_different_receptions(
    order: list[int], senders: list[frozenset[str]], topology: TopologyName
) -> None:
    everybody = teams(CARS[:6], topology=topology)
    parents = {}
    for team, hears in zip(everybody, senders, strict=True):
        team.take({"shape": "column", "sn": 1, "order": [0, *order]})
        parents[team.name] = team.whom(lambda name, hears=hears: name in hears)  # type: ignore[misc]
    for name in parents:
        path = [name]
        while (parent := parents[path[-1]]) is not None:
            assert parent not in path
            path.append(parent)


def test_in_a_star_the_lowest_living_member_leads() -> None:
    star = teams(CARS[:4])
    assert [team.whom(lambda name: name in {"car3", "car4"}) for team in star[2:]] == [None, "car3"]


# --- refusals ---


@pytest.mark.parametrize(
    ("formation", "says"),
    [
        ({"members": ("car1", "cra2")}, r"formation.members: unknown vehicle 'cra2'; did you mean 'car2'\?"),
        ({"members": ("car1", "car2", "car1")}, r"formation.members names car1 twice"),
        ({"members": ("car1", "car3")}, r"formation.members \(car1, car3\) does not contain car2"),
        ({"topology": "graph", "parents": {"car2": "car3", "car3": "car2"}}, r"car2 follows car3, car3 follows car2"),
        ({"shape": "own", "offsets": ((0.0, 0.0), (1.0, 0.0))}, r"needs offsets for all 3 members, not 2"),
        ({"changes": ((5.0, "own"),)}, r"needs offsets for all 3 members"),
    ],
)
def test_formations_that_do_not_fit_are_refused(formation: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        Team(Formation(**formation), CARS[:3], "car2")


def test_a_shape_without_slots_is_refused() -> None:
    with pytest.raises(ValueError, match="unknown shape 'own'"):
        Team(Formation(), CARS, "car1").change("own", {})


# --- slots of a new shape are assigned with the least sum of ways, so that ways do not cross ---


shapes = st.sampled_from(("column", "line", "echelon", "wedge", "box", "diamond"))
points = st.tuples(st.floats(-10, 10), st.floats(-10, 10))


def ways(positions: Sequence[Slot], places: Sequence[Slot], order: Sequence[int]) -> list[tuple[Slot, Slot]]:
    return [(positions[member], place) for member, place in zip(order, places, strict=True)]


@given(shapes, st.lists(points, min_size=2, max_size=6))
def test_the_sum_of_all_ways_is_the_minimum(shape: ShapeName, positions: list[Slot]) -> None:
    places = slots(shape, len(positions), 1.0)

    def total(order: Sequence[int]) -> float:
        return sum(math.dist(*way) for way in ways(positions, places, order))

    order = assign(positions, places)
    assert order[0] == 0  # the leader remains first
    assert sorted(order) == list(range(len(positions)))
    assert total(order) == pytest.approx(min(total((0, *rest)) for rest in itertools.permutations(order[1:])))
