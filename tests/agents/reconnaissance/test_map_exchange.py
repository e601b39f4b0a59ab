"""Shared maps: without loss all equal the central map; with loss the ledger catches up."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.agents.shared_maps import (
    GRID,
    KINDS,
    SENSOR,
    SMALL,
    TEAM,
    S,
    full_state,
    ledger,
    look,
    over_the_air,
    size,
    tell,
)
from vcmvsp.agents.reconnaissance.exchange import Kind, Ledger, MapExchange, exchange
from vcmvsp.agents.reconnaissance.probability_map import log_odds
from vcmvsp.cosim.agent import Radio

pytestmark = pytest.mark.slow

# -- without loss


@pytest.mark.parametrize(
    ("kind", "max_bytes", "ticks", "within"), [("ledger", 100, 40, 0.0), ("ledger", 1400, 40, 0.0), ("delta", 1400, 6, 1e-9)]
)
def test_without_loss_all_have_the_central_map(kind: Kind, max_bytes: int, ticks: int, within: float) -> None:
    """A ledger bit for bit."""
    rng, central = np.random.default_rng(1), ledger("a")
    minds = {name: exchange(kind, SMALL, SENSOR, name, TEAM, max_bytes=max_bytes) for name in TEAM}
    for tick in range(1, ticks):
        for mind in minds.values():
            central.look(*look(mind, rng, tick * S), tick * S)
        for name, mind in minds.items():
            tell(mind, {other: minds[other] for other in TEAM if other != name}, name, tick * S)
        for mind in minds.values():
            assert np.abs(mind.log_odds - central.log_odds).max() <= within
    assert len(np.unique(central.log_odds)) > 10


def test_in_consensus_all_end_up_with_the_nth_part_of_all_evidence() -> None:
    rng, central = np.random.default_rng(4), ledger("a", prior=0.3)
    minds: dict[str, MapExchange] = {name: exchange("consensus", SMALL, SENSOR, name, TEAM, prior=0.3) for name in TEAM}
    nothing = np.empty(0, int), np.empty(0, bool)
    for tick in range(1, 12):
        for mind in minds.values():
            central.look(*look(mind, rng, tick * S), tick * S) if tick < 4 else mind.look(*nothing, tick * S)
        if tick > 1:  # at the end of a step, before the next begins: no evidence lost
            total = sum(mind.log_odds - log_odds(0.3) for mind in minds.values())
            assert total == pytest.approx(central.log_odds - log_odds(0.3), abs=tick * 3 * 0.5 / 1600)
        for name, mind in minds.items():
            tell(mind, {other: minds[other] for other in TEAM if other != name}, name, tick * S)
    for mind in minds.values():
        assert mind.log_odds - log_odds(0.3) == pytest.approx((central.log_odds - log_odds(0.3)) / 3, abs=0.005)


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


# -- any order, any copies, any relay


@st.composite
def histories(draw: st.DrawFn) -> tuple[list[tuple[str, Any]], Ledger]:
    """All messages sent and relayed in some seconds, some of them lost; and the central map."""
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


@settings(max_examples=25)
@given(history=histories(), data=st.data())
def test_messages_may_come_in_any_order_and_any_number_of_times(
    history: tuple[list[tuple[str, Any]], Ledger], data: st.DataObject
) -> None:
    air, _ = history
    received = [each for each in air if each[0] != "c"]
    copies = data.draw(st.lists(st.sampled_from(received), max_size=10))
    mixed = data.draw(st.permutations(received + copies))
    straight, shuffled = ledger("c", max_bytes=400), ledger("c", max_bytes=400)
    for mind, messages in ((straight, received), (shuffled, mixed)):
        for sender, body in messages:
            before = mind.counts
            assert mind.take(sender, body, 10 * S)
            assert (mind.counts >= before).all()
    assert full_state(straight) == full_state(shuffled)
    for sender, body in air:  # with c's own messages relayed by the others: still no looks that c did not have
        straight.take(sender, body, 10 * S)
    assert not straight.counts[2].any()


@settings(max_examples=25)
@given(history=histories(), data=st.data())
def test_merging_is_associative(history: tuple[list[tuple[str, Any]], Ledger], data: st.DataObject) -> None:
    """Relayed counts equal received ones: (a + b) + c = a + (b + c)."""
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


def test_lost_looks_are_repeated_until_all_have_them() -> None:
    """One message of 100 bytes a second, half of them lost: in the end no look is missing."""
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


def test_the_latest_changes_are_sent_first() -> None:
    mind = ledger("a", GRID, max_bytes=100)
    tile = {cell: mind.tiling.index[cell] // mind.tiling.per_tile for cell in (0, 1000, 2400)}
    for tick, cell in enumerate(tile, start=1):
        mind.look(np.array([cell]), np.array([True]), tick * S)
    tiles = [entry[1] for body in mind.messages(4 * S, 10) for entry in body["l"]]
    assert tiles == [tile[2400], tile[1000], tile[0]]
    mind.look(np.array([0]), np.array([True]), 5 * S)
    (body,) = mind.messages(5 * S, 1)
    assert [entry[1] for entry in body["l"]][:2] == [tile[0], tile[2400]]


def test_repeated_changes_are_sent_again() -> None:
    mind, every = ledger("a", GRID, max_bytes=100), np.arange(GRID.rows * GRID.columns)
    mind.look(every, every < 0, S)
    first = mind.messages(S, 1)[0]["l"][0][1]
    mind.look(every[mind.tiling.index // mind.tiling.per_tile == first], np.zeros(16, bool), 2 * S)
    assert mind.messages(2 * S, 1)[0]["l"][0][1] == first


def test_own_looks_are_sent_before_relayed_ones() -> None:
    a, b = ledger("a", GRID), ledger("b", GRID)
    for mind, cell, at_ns in ((b, 0, S), (a, 1, 2 * S)):
        mind.look(np.array([cell]), np.array([True]), at_ns)
    tell(a, {"b": b}, "a", 2 * S)
    assert [entry[0] for body in b.messages(2 * S, 10) for entry in body["l"]] == [1, 0]


def test_tiles_relayed_by_another_are_relayed_later() -> None:
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
    bodies = {ms: {"ms": ms, "c": [[0, np.full(256, odds * 1600, "<i2").tobytes()]]} for ms, odds in ((1, 6), (2, 9))}
    mind.look(*nothing, S)
    values = []
    for arrivals in ([1], [], [1], [2, 1], []):
        for ms in arrivals:
            assert mind.take("b", bodies[ms], S)
        mind.look(*nothing, S)
        values.append(mind.log_odds[0, 0])
    assert values == pytest.approx([2.0, 2.0, 2.0, 2.0 * 2 / 3 + 3.0, 2.0 * 2 / 3 + 3.0])


# --- messages of a shared map: sizes and filling ---


@pytest.mark.parametrize("max_bytes", [40, 64, 100, 127, 300, 1400, 2312])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("busy", [False, True])
def test_messages_are_no_larger_than_allowed_and_pass_the_radio(kind: Kind, max_bytes: int, busy: bool) -> None:
    rng, now_ns = np.random.default_rng(6), 1_800_000_000 * S  # wall-clock time, with long numbers
    mind = exchange(kind, GRID, SENSOR, "a", TEAM, max_bytes=max_bytes)
    every = np.arange(GRID.rows * GRID.columns)
    for _ in range(400 if busy else 1):  # more than one byte
        mind.look(every, rng.random(len(every)) < 0.9, now_ns - 3600 * S)
    bodies = mind.messages(now_ns, 3000)
    radio = Radio("a", TEAM)
    for body in bodies:
        assert size(body) <= max_bytes
        radio.send(body)
    assert [message.body for message in radio.drain()] == bodies
    assert (bodies == []) == (kind == "none")
    listener = exchange(kind, GRID, SENSOR, "b", TEAM, max_bytes=max_bytes)
    assert all(listener.take("a", over_the_air(body), now_ns) for body in bodies)
    if kind == "ledger" or (kind == "delta" and not busy):  # delta clamps sums, not increments
        assert listener.log_odds == pytest.approx(mind.log_odds)


@pytest.mark.parametrize("kind", ["ledger", "delta"])
def test_messages_of_many_tiles_are_no_larger_than_allowed(kind: Kind) -> None:
    for max_bytes in range(8300, 8500):  # 15 to 16 tiles of 16 x 16: longer header of a list
        mind = exchange(kind, GRID, SENSOR, "a", TEAM, max_bytes=max_bytes)
        mind.look(np.arange(2500), np.zeros(2500, bool), S)
        assert max(map(size, mind.messages(S, 9))) <= max_bytes


@pytest.mark.parametrize("max_bytes", [100, 1400])
def test_messages_are_well_filled(max_bytes: int) -> None:
    """Share of counts: above 0.97 of a full message of 1400 bytes, above 0.6 of one of 100."""
    mind = ledger("a", GRID, max_bytes=max_bytes)
    every = np.arange(GRID.rows * GRID.columns)
    mind.look(every, every % 7 == 0, S)
    bodies = mind.messages(S, 2000)[:-1]
    counts = sum(len(entry[3]) for body in bodies for entry in body["l"])
    assert counts / sum(size(body) for body in bodies) > (0.97 if max_bytes == 1400 else 0.6)


def test_no_more_messages_than_asked_for() -> None:
    for kind in KINDS:
        mind = exchange(kind, GRID, SENSOR, "a", TEAM, max_bytes=100)
        mind.look(np.arange(2500), np.zeros(2500, bool), S)
        assert [len(mind.messages(S, most)) for most in (0, 1, 3)] == ([0, 0, 0] if kind == "none" else [0, 1, 3])


@pytest.mark.parametrize("kind", ["consensus", "delta"])
def test_tiles_without_room_are_sent_next(kind: Kind) -> None:
    mind = exchange(kind, GRID, SENSOR, "a", TEAM, max_bytes=100)
    mind.look(np.arange(2500), np.zeros(2500, bool), S)
    tiles = [entry[0] for _ in range(600) for body in mind.messages(S, 1) for entry in body[kind[0]]]
    assert len(set(tiles)) == 169  # ceil(50 / 4)^2
    assert kind == "consensus" or len(tiles) == 169


def test_counts_saturate_at_two_bytes() -> None:
    a, b, cell = ledger("a"), ledger("b"), np.array([5])
    a._own[0, 0, :, 5] = 65534
    for tick in range(3):
        a.look(cell, np.array([True]), tick * S)
    assert a.counts[0, :, 0, 5].tolist() == [65535, 65534]
    a.look(cell, np.array([False]), 4 * S)
    tell(a, {"b": b}, "a", 5 * S)
    assert b.counts[0, :, 0, 5].tolist() == [65535, 65535]


# --- malformed and false messages, and clocks: they never change own looks, and little else ---


COUNTS = bytes(range(200)) + bytes(312)  # hits and misses of a tile of 16 x 16


def told(*entries: Any, ms: Any = 1000, key: str = "l") -> dict[str, Any]:
    return {"ms": ms, key: [list(entry) for entry in entries]}


def known_ledger() -> Ledger:
    """Ledger of b after an exchange with a and c (grid of 50 x 50, tiles of 16 x 16)."""
    b, rng = ledger("b", GRID), np.random.default_rng(7)
    b.look(np.arange(2500), rng.random(2500) < 0.1, S)
    for name in ("a", "c"):
        mind = ledger(name, GRID)
        mind.look(np.arange(2500), rng.random(2500) < 0.1, S)
        tell(mind, {"b": b}, name, S)
    return b


GOOD = (0, 0, 5, COUNTS)
BAD_ENTRIES = [
    (-1, 0, 5, COUNTS), (3, 0, 5, COUNTS), (2**63, 0, 5, COUNTS),
    (0.0, 0, 5, COUNTS), ("a", 0, 5, COUNTS), (True, 0, 5, COUNTS),
    (0, -1, 5, COUNTS), (0, 16, 5, COUNTS), (0, 2**63, 5, COUNTS), (0, None, 5, COUNTS),
    (0, 0, -1, COUNTS), (0, 0, 1001, COUNTS), (0, 0, -(2**63), COUNTS), (0, 0, 2**64 - 1, COUNTS), (0, 0, math.nan, COUNTS),
    (0, 0, 5, b""), (0, 0, 5, COUNTS[:-1]), (0, 0, 5, COUNTS + b"x"), (0, 0, 5, COUNTS * 4),
    (0, 0, 5, list(COUNTS)), (0, 0, 5, "x" * 512),
    (0, 3, 5, COUNTS),  # counts beyond the grid
    (0, 0, 5), (0, 0, 5, 5, COUNTS), (), (None,),
]  # fmt: skip
BAD_BODIES: list[Any] = [
    b"", b"\x00" * 50, None, {}, {"ms": 1000}, {"l": []},
    {"ms": 1000, "l": None}, {"ms": 1000, "l": {}}, {"ms": 1000, "l": [5]},
    *[told(GOOD, ms=ms) for ms in (-1, 1001, 2**63, 2**53 + 1, 1e3, math.nan, math.inf, "1", None, True)],
    told(GOOD, key="c"), told(GOOD, key="d"), {"ms": 1000, "d": [[0, COUNTS]]},
]  # fmt: skip


@pytest.mark.parametrize(
    "body", [*BAD_BODIES, *[told(GOOD, bad) for bad in BAD_ENTRIES], *[told(bad, GOOD) for bad in BAD_ENTRIES]]
)
def test_a_ledger_ignores_malformed_messages_completely(body: Any) -> None:
    b = known_ledger()
    before = full_state(b)
    assert not b.take("a", body, S)
    assert full_state(b) == before


@pytest.mark.parametrize("sender", ["b", "x", "", "A"])
def test_messages_of_non_members_and_own_ones_are_ignored(sender: str) -> None:
    b = known_ledger()
    before = full_state(b)
    assert not b.take(sender, told(GOOD), S)
    assert full_state(b) == before


JUNK = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.binary(max_size=8) | st.just(COUNTS),
    lambda inner: st.lists(inner, max_size=4),
    max_leaves=8,
)
LIES = st.tuples(st.integers(-1, 3), st.integers(-1, 16), st.integers(-5, 1005), st.binary(min_size=512, max_size=512))


@settings(max_examples=60)
@given(
    sender=st.sampled_from(["a", "c"]),
    ms=st.integers(0, 1001) | JUNK,
    entries=st.lists(st.one_of(LIES, JUNK, st.tuples(st.integers(0, 2), st.integers(0, 15), st.just(5), JUNK)), max_size=4),
    kind=st.sampled_from(KINDS),
)
def test_any_message_leaves_the_map_finite_and_own_looks_unchanged(
    sender: str, ms: Any, entries: list[Any], kind: Kind
) -> None:
    for key in ("l", "d", "c"):
        mind = exchange(kind, GRID, SENSOR, "b", TEAM)
        mind.take(sender, {"ms": ms, key: entries}, S)
        mind.look(np.array([7]), np.array([True]), S)
        assert np.isfinite(mind.log_odds).all()
        assert np.abs(mind.log_odds).max() <= 20.0
    b = known_ledger()
    before = b.counts
    b.take(sender, {"ms": ms, "l": entries}, S)
    assert (b.counts[1] == before[1]).all()
    assert (b.counts >= before).all()


@pytest.mark.parametrize(("kind", "raw"), [("delta", COUNTS), ("consensus", bytes(512))])
def test_delta_and_consensus_ignore_malformed_messages_completely(kind: Kind, raw: bytes) -> None:
    far = np.full(256, 32001, "<i2").tobytes()  # |l| > 20
    good, key = (0, raw), kind[0]
    bad: list[Any] = [(-1, raw), (16, raw), (2**63, raw), (0.0, raw), (0, raw[:-1]), (0, raw + b"x"), (0, list(raw)), (0,), ()]
    bad += [(1, far)] if kind == "consensus" else [good, (3, raw)]  # a tile twice; counts beyond the grid
    for body in [
        *BAD_BODIES[:-2],
        *[told(good, each, key=key) for each in bad],
        *[told(good, key=key, ms=ms) for ms in (-1, 1001, 2**63)],
    ]:
        mind = exchange(kind, GRID, SENSOR, "b", TEAM)
        assert not mind.take("a", body, S)
        mind.look(np.empty(0, int), np.empty(0, bool), S)
        assert not mind.log_odds.any()
    for stranger in ("b", "x"):
        assert not exchange(kind, GRID, SENSOR, "b", TEAM).take(stranger, told(good, key=key), S)
    assert exchange(kind, GRID, SENSOR, "b", TEAM).take("a", told(good, key=key), S)


def test_copies_and_late_messages_add_nothing_to_delta() -> None:
    b, entry = exchange("delta", GRID, SENSOR, "b", TEAM), (0, COUNTS)
    assert b.take("a", told(entry, key="d", ms=900), S)
    once = b.log_odds
    for ms in (900, 899):
        assert b.take("a", told(entry, key="d", ms=ms), S)
        assert (b.log_odds == once).all()


@pytest.mark.parametrize("relay", [True, False])
def test_a_false_relay_lasts_until_the_next_own_report(relay: bool) -> None:
    """c claims that a saw a target everywhere: b may accept it where it has no newer report of a, until a's next report."""
    rng, a, b, honest = np.random.default_rng(8), ledger("a", GRID), ledger("b", GRID, relay=relay), ledger("b", GRID)
    a.look(np.arange(2500), rng.random(2500) < 0.1, S)
    for mind in (b, honest):
        tell(a, {"b": mind}, "a", 2 * S)
    lie = [(0, tile, 0, np.full(512, 255, np.uint8).tobytes()) for tile in (0, 1, 2)]
    for ms in (1000, 2000):  # no newer than a's own report
        assert b.take("c", told(*lie, ms=ms), 3 * S)
        assert full_state(b)[0] == full_state(honest)[0]
        assert b.log_odds.tobytes() == honest.log_odds.tobytes()
    assert not b.take("c", told(*lie, ms=3001), 3 * S)  # from the future
    assert b.take("c", told(*lie, ms=3000), 3 * S)
    assert (b.counts >= honest.counts).all()
    assert (b.log_odds.tobytes() == honest.log_odds.tobytes()) == (not relay)
    assert b.take("c", told(*[(0, tile, 0, bytes(512)) for tile in (0, 1, 2, 4)], ms=3001), 4 * S)  # as if a had no looks
    assert (b.counts == honest.counts).all()
    assert b.take("c", told(*lie, ms=3002), 4 * S)
    for mind in (b, honest):
        tell(a, {"b": mind}, "a", 4 * S)  # no new looks, but a's own report
    assert (b.counts == honest.counts).all()
    assert b.log_odds.tobytes() == honest.log_odds.tobytes()
    assert not ledger("a", GRID).take("a", told(*lie), 5 * S)


def test_two_false_relays_of_one_time_merge_in_any_order() -> None:
    lies = [told((0, 0, 0, bytes([value]) * 512)) for value in (3, 5)]
    minds = []
    for order in (lies, lies[::-1]):
        minds.append(ledger("b", GRID))
        for lie in order:
            assert minds[-1].take("c", lie, S)
    assert full_state(minds[0]) == full_state(minds[1])


def test_looks_older_than_the_age_field_are_refused() -> None:
    now_ms, b = 1_800_000_000_000, ledger("b", GRID)
    assert b.take("a", told((0, 0, 2**32 - 1, COUNTS), ms=now_ms), now_ms * 1_000_000)
    assert not b.take("a", told((0, 1, 2**32, COUNTS), ms=now_ms), now_ms * 1_000_000)
    assert not b.take("a", told((0, 1, 0, COUNTS), ms=1), now_ms * 1_000_000)


def test_without_relay_only_own_looks_are_sent() -> None:
    b = known_ledger()
    for relay, contributors in ((True, {0, 1, 2}), (False, {1})):
        b.relay = relay
        assert {entry[0] for body in b.messages(2 * S, 1000) for entry in body["l"]} == contributors


def test_clocks_may_differ_by_the_bound_that_is_given() -> None:
    a, b, c = (ledger(name, clock_bound_s=0.1) for name in TEAM)
    a.look(np.array([3]), np.array([True]), S)
    tell_a = a.messages(S, 1)[0]
    assert b.take("a", over_the_air(tell_a), S - 90_000_000)
    passed_on = b.messages(S - 80_000_000, 1)[0]  # earlier, by b's clock, than a's look
    assert c.take("b", over_the_air(passed_on), S - 80_000_000)
    assert c.counts[0].sum() == 1
    assert not b.take("a", over_the_air(tell_a), S - 110_000_000)
