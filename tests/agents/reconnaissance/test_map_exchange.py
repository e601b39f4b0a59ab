"""Maps that are shared: without loss all have the central map, with loss the ledger catches up."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.agents.shared_maps import GRID, KINDS, SENSOR, SMALL, TEAM, S, everything, ledger, look, over_the_air, tell
from vcmvsp.agents.reconnaissance.exchange import Consensus, Kind, Ledger, MapExchange, exchange
from vcmvsp.agents.reconnaissance.probability_map import log_odds

# -- without loss


@pytest.mark.parametrize("max_bytes", [100, 1400])
def test_without_loss_a_ledger_is_the_central_map_bit_for_bit(max_bytes: int) -> None:
    rng = np.random.default_rng(1)
    central = ledger("a")
    minds: dict[str, MapExchange] = {name: ledger(name, max_bytes=max_bytes) for name in TEAM}
    for tick in range(1, 40):
        for mind in minds.values():
            central.look(*look(mind, rng, tick * S), tick * S)
        for name, mind in minds.items():
            tell(mind, {other: minds[other] for other in TEAM if other != name}, name, tick * S)
        for mind in minds.values():
            assert mind.log_odds.tobytes() == central.log_odds.tobytes()
    assert len(np.unique(central.log_odds)) > 20


def test_what_is_passed_on_reaches_those_who_cannot_hear_it_themselves() -> None:
    """a - b - c, each hears its neighbour only; a and c learn all, though b never looks."""
    rng, central = np.random.default_rng(2), ledger("a")
    a, b, c = (ledger(name) for name in TEAM)
    for tick in range(1, 20):
        for mind in (a, c):
            central.look(*look(mind, rng, tick * S), tick * S)
        tell(a, {"b": b}, "a", tick * S)
        tell(c, {"b": b}, "c", tick * S)
        tell(b, {"a": a, "c": c}, "b", tick * S)
        assert a.log_odds.tobytes() == b.log_odds.tobytes() == c.log_odds.tobytes() == central.log_odds.tobytes()


def test_without_loss_delta_adds_up_to_the_same() -> None:
    rng, central = np.random.default_rng(3), ledger("a")
    minds: dict[str, MapExchange] = {name: exchange("delta", SMALL, SENSOR, name, TEAM) for name in TEAM}
    for tick in range(1, 6):
        for mind in minds.values():
            central.look(*look(mind, rng, tick * S), tick * S)
        for name, mind in minds.items():
            tell(mind, {other: minds[other] for other in TEAM if other != name}, name, tick * S)
    for mind in minds.values():
        assert mind.log_odds == pytest.approx(central.log_odds, abs=1e-9)


def test_in_consensus_all_end_up_with_the_nth_part_of_all_evidence() -> None:
    rng, central = np.random.default_rng(4), ledger("a", prior=0.3)
    minds: dict[str, MapExchange] = {name: exchange("consensus", SMALL, SENSOR, name, TEAM, prior=0.3) for name in TEAM}
    nothing = np.empty(0, int), np.empty(0, bool)
    for tick in range(1, 12):
        for mind in minds.values():
            central.look(*look(mind, rng, tick * S), tick * S) if tick < 4 else mind.look(*nothing, tick * S)
        if tick > 1:  # at the end of a step, while the next has not begun: no evidence got lost
            total = sum(mind.log_odds - log_odds(0.3) for mind in minds.values())
            assert total == pytest.approx(central.log_odds - log_odds(0.3), abs=tick * 3 * 0.5 / 1600)
        for name, mind in minds.items():
            tell(mind, {other: minds[other] for other in TEAM if other != name}, name, tick * S)
    for mind in minds.values():
        assert mind.log_odds - log_odds(0.3) == pytest.approx((central.log_odds - log_odds(0.3)) / 3, abs=0.005)
        assert isinstance(mind, Consensus)
        mind._gain = 3.0  # as with scaled = True
        assert mind.log_odds == pytest.approx(central.log_odds, abs=0.015)


def test_scaled_consensus_decides_by_n_times_the_map() -> None:
    cells, hits = np.array([3]), np.array([True])
    plain, scaled = (exchange("consensus", SMALL, SENSOR, "a", TEAM, scaled=each) for each in (False, True))
    for mind in (plain, scaled):
        mind.look(cells, hits, S)
    assert plain.log_odds.ravel()[3] == pytest.approx(SENSOR.hit)
    assert scaled.log_odds == pytest.approx(3 * plain.log_odds)


@pytest.mark.parametrize("kind", KINDS)
def test_log_odds_are_clamped(kind: Kind) -> None:
    mind, cells = exchange(kind, SMALL, SENSOR, "a", TEAM, scaled=True), np.array([0, 1])
    for tick in range(30):
        mind.look(cells, np.array([True, False]), tick * S)
    assert mind.log_odds.ravel()[:3].tolist() == [20.0, -20.0, 0.0]


# -- any order, any copies, any way round


@st.composite
def histories(draw: st.DrawFn) -> tuple[list[tuple[str, Any]], Ledger]:
    """What was sent in a while, by all and relayed by all, some of it lost; and the central map."""
    rng, minds = np.random.default_rng(draw(st.integers(0, 1000))), {name: ledger(name, max_bytes=400) for name in TEAM}
    central, air = ledger("a"), []
    for tick in range(1, draw(st.integers(2, 5))):
        for mind in minds.values():
            central.look(*look(mind, rng, tick * S), tick * S)
        for name, mind in minds.items():
            for body in mind.messages(tick * S, 100):
                air.append((name, over_the_air(body)))
                for other in TEAM:
                    if other != name and rng.random() < 0.6:
                        assert minds[other].take(name, over_the_air(body), tick * S)
    return air, central


@settings(max_examples=25, deadline=None)
@given(history=histories(), data=st.data())
def test_messages_may_come_in_any_order_and_any_number_of_times(
    history: tuple[list[tuple[str, Any]], Ledger], data: st.DataObject
) -> None:
    air, _ = history
    heard = [each for each in air if each[0] != "c"]
    copies = data.draw(st.lists(st.sampled_from(heard), max_size=10))
    mixed = data.draw(st.permutations(heard + copies))
    straight, shuffled = ledger("c", max_bytes=400), ledger("c", max_bytes=400)
    for mind, messages in ((straight, heard), (shuffled, mixed)):
        for sender, body in messages:
            before = mind.counts
            assert mind.take(sender, body, 10 * S)
            assert (mind.counts >= before).all()
    assert everything(straight) == everything(shuffled)
    for sender, body in air:  # with what c said itself, by way of the others, still nothing that c did not see
        straight.take(sender, body, 10 * S)
    assert not straight.counts[2].any()


@settings(max_examples=25, deadline=None)
@given(history=histories(), data=st.data())
def test_merging_is_associative(history: tuple[list[tuple[str, Any]], Ledger], data: st.DataObject) -> None:
    """What b learns and passes on is worth as much as what it heard: (a + b) + c = a + (b + c)."""
    air, _ = history
    of_a = data.draw(st.lists(st.sampled_from([each for each in air if each[0] == "a"]), max_size=6))
    direct, b, c = ledger("c", max_bytes=400), ledger("b", max_bytes=400), ledger("c", max_bytes=400)
    for sender, body in of_a:
        direct.take(sender, body, 10 * S)
        b.take(sender, body, 10 * S)
    for body in b.messages(10 * S, 1000):
        assert c.take("b", over_the_air(body), 10 * S)
    assert (c.counts[0] == b.counts[0]).all()
    assert (direct.counts[0] == b.counts[0]).all()


@settings(max_examples=15, deadline=None)
@given(history=histories(), order=st.randoms(use_true_random=False))
def test_all_that_was_sent_makes_the_central_map(history: tuple[list[tuple[str, Any]], Ledger], order: Any) -> None:
    air, central = history
    order.shuffle(air)
    listener = exchange("ledger", SMALL, SENSOR, "z", (*TEAM, "z"), max_bytes=400)
    for sender, body in air:
        assert listener.take(sender, body, 10 * S)
    assert listener.log_odds.tobytes() == central.log_odds.tobytes()


def test_what_was_lost_is_told_again_until_all_know_it() -> None:
    """One message of 100 bytes a second, of which half are lost: in the end nothing is missing."""
    rng, central = np.random.default_rng(5), ledger("a")
    minds = {name: ledger(name, max_bytes=100) for name in TEAM}
    for tick in range(1, 400):
        for name, mind in minds.items():
            if tick < 10:
                central.look(*look(mind, rng, tick * S), tick * S)
            for body in mind.messages(tick * S, 1):
                for other in TEAM:
                    if other != name and rng.random() < 0.5:
                        assert minds[other].take(name, over_the_air(body), tick * S)
    assert {mind.log_odds.tobytes() for mind in minds.values()} == {central.log_odds.tobytes()}


def test_what_changed_last_is_told_first() -> None:
    mind = ledger("a", GRID, max_bytes=100)
    tile = {cell: mind.tiling.index[cell] // mind.tiling.per_tile for cell in (0, 1000, 2400)}
    for tick, cell in enumerate(tile, start=1):
        mind.look(np.array([cell]), np.array([True]), tick * S)
    told = [entry[1] for body in mind.messages(4 * S, 10) for entry in body["l"]]
    assert told == [tile[2400], tile[1000], tile[0]]
    mind.look(np.array([0]), np.array([True]), 5 * S)
    (body,) = mind.messages(5 * S, 1)
    assert [entry[1] for entry in body["l"]][:2] == [tile[0], tile[2400]]


def test_what_changed_again_is_news_again() -> None:
    mind, every = ledger("a", GRID, max_bytes=100), np.arange(GRID.rows * GRID.columns)
    mind.look(every, every < 0, S)
    first = mind.messages(S, 1)[0]["l"][0][1]
    mind.look(every[mind.tiling.index // mind.tiling.per_tile == first], np.zeros(16, bool), 2 * S)
    assert mind.messages(2 * S, 1)[0]["l"][0][1] == first


def test_own_looks_are_told_before_those_of_others() -> None:
    a, b = ledger("a", GRID), ledger("b", GRID)
    for mind, cell, at_ns in ((b, 0, S), (a, 1, 2 * S)):
        mind.look(np.array([cell]), np.array([True]), at_ns)
    tell(a, {"b": b}, "a", 2 * S)
    assert [entry[0] for body in b.messages(2 * S, 10) for entry in body["l"]] == [1, 0]


def test_what_somebody_else_passed_on_is_passed_on_later() -> None:
    a, b, c = (ledger(name, GRID) for name in TEAM)
    for tick, cell in ((1, 0), (2, 40)):  # in tiles 0 and 2
        a.look(np.array([cell]), np.array([True]), tick * S)
    tell(a, {"b": b, "c": c}, "a", 2 * S)
    assert [entry[1] for entry in b.messages(2 * S, 1)[0]["l"]] == [2, 0]
    (body,) = c.messages(2 * S, 1)
    assert b.take("c", {**body, "l": [body["l"][0]]}, 2 * S)
    assert [entry[1] for entry in b.messages(2 * S, 1)[0]["l"]] == [0, 2]


def test_consensus_moves_once_for_each_message_and_never_for_an_old_one() -> None:
    mind, nothing = exchange("consensus", SMALL, SENSOR, "a", TEAM), (np.empty(0, int), np.empty(0, bool))
    said = {ms: {"ms": ms, "c": [[0, np.full(256, odds * 1600, "<i2").tobytes()]]} for ms, odds in ((1, 6), (2, 9))}
    mind.look(*nothing, S)
    values = []
    for heard in ([1], [], [1], [2, 1], []):
        for ms in heard:
            assert mind.take("b", said[ms], S)
        mind.look(*nothing, S)
        values.append(mind.log_odds[0, 0])
    assert values == pytest.approx([2.0, 2.0, 2.0, 2.0 * 2 / 3 + 3.0, 2.0 * 2 / 3 + 3.0])


def test_me_must_be_a_member() -> None:
    with pytest.raises(ValueError, match="must include 'x'"):
        exchange("ledger", SMALL, SENSOR, "x", TEAM)
