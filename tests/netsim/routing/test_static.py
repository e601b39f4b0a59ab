"""Static routes from the scenario."""

from typing import Any

import pytest

from tests.support.netsim.routing_runs import line, message_at, names, run
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.netsim.routing.router import Static

FOUR = names(4)


def opened(**keys: Any) -> None:
    binding.call(Static, keys, key="routing").open(FOUR, 1)


def test_tables_give_next_hops_and_other_messages_go_directly() -> None:
    router = Static(next_hop={"car1": {"car3": "car2"}})
    outcome = run(router, line(3, 40.0), message_at("car1", 0, to="car3"), message_at("car3", 10_000_000, to="car1"))
    assert [each.via for each in outcome.messages] == [("car1", "car2"), ("car3",)]


def test_a_table_wins_over_a_chain() -> None:
    router = Static(chain=FOUR, next_hop={"car1": {"car4": "car3"}})
    outcome = run(router, line(4, 40.0), message_at("car1", 0, to="car4"), message_at("car4", 10_000_000, to="car1"))
    assert [each.receivers for each in outcome.messages] == [("car3", "car4"), ("car3", "car2", "car1")]


def test_a_broadcast_is_passed_on_along_the_routes_alone() -> None:
    position = [*line(3), (60.0, 20.0)]  # car4 is beside car2, on no route
    outcome = run(Static(chain=names(3)), position, message_at("car1", 0))
    assert sorted(each.receiver for each in outcome.routed_receptions) == ["car2", "car3", "car4"]
    assert [frame.sender for frame in outcome.frames] == ["car1", "car2"]  # car3 has no vehicle behind it


def test_the_middle_of_a_chain_reaches_both_ends() -> None:
    outcome = run(Static(chain=names(5)), line(5), message_at("car3", 0))
    assert sorted(each.receiver for each in outcome.routed_receptions) == ["car1", "car2", "car4", "car5"]
    assert sorted(frame.sender for frame in outcome.frames) == ["car2", "car3", "car4"]


@pytest.mark.parametrize(
    ("keys", "where", "words"),
    [
        ({}, "routing", "static routing needs chain or next_hop"),
        ({"chain": ["car1", "car5"]}, "routing.chain", "unknown vehicle 'car5'"),
        ({"chain": ["car1", "car2", "car1"]}, "routing.chain", "contains car1 twice"),
        ({"chain": ["car1"]}, "routing.chain", "must have at least two vehicles"),
        ({"next_hop": 3}, "routing.next_hop", "must be a table, not 3"),
        ({"next_hop": {"car1": 3}}, "routing.next_hop.car1", "must be a table, not 3"),
        ({"next_hop": {"car1": {"car4": 3}}}, "routing.next_hop.car1.car4", "must be a string, not 3"),
        ({"next_hop": {"car1": {"car4": "cra2"}}}, "routing.next_hop.car1", "did you mean 'car2'?"),
        ({"next_hop": {"car1": {"car4": "car1"}}}, "routing.next_hop.car1.car4", "car1 cannot be its own next hop"),
        (
            {"next_hop": {"car1": {"car4": "car2"}, "car2": {"car4": "car1"}}},
            "routing.next_hop.car1.car4",
            "the route from car1 to car4, car1 -> car2 -> car1, is a loop",
        ),
        ({"chain": FOUR, "hop_limit": 2}, "routing.chain", "has more hops than hop_limit = 2: raise it"),
        ({"chain": FOUR, "hop_limit": 0}, "routing.hop_limit", "must be"),
    ],
)
def test_a_route_without_end_is_refused_with_its_place(keys: dict[str, Any], where: str, words: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        opened(**keys)
    assert caught.value.key == where
    assert words in caught.value.problem
