"""What nonsense, liars and clocks can do to a shared map: never touch own looks, and little besides."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.agents.shared_maps import GRID, KINDS, SENSOR, TEAM, S, everything, ledger, over_the_air, tell
from vcmvsp.agents.reconnaissance.exchange import Kind, Ledger, exchange

COUNTS = bytes(range(200)) + bytes(312)  # hits and misses of a tile of 16 x 16


def told(*entries: Any, ms: Any = 1000, key: str = "l") -> dict[str, Any]:
    return {"ms": ms, key: [list(entry) for entry in entries]}


def known() -> Ledger:
    """What b knows after some seconds with a and c (grid of 50 x 50, tiles of 16 x 16)."""
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
    (0, 3, 5, COUNTS),  # counts of cells beyond the grid
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
def test_a_ledger_takes_nothing_from_a_message_with_nonsense_in_it(body: Any) -> None:
    b = known()
    before = everything(b)
    assert not b.take("a", body, S)
    assert everything(b) == before


@pytest.mark.parametrize("sender", ["b", "x", "", "A"])
def test_nobody_else_is_a_contributor_and_nobody_hears_itself(sender: str) -> None:
    b = known()
    before = everything(b)
    assert not b.take(sender, told(GOOD), S)
    assert everything(b) == before


JUNK = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.binary(max_size=8) | st.just(COUNTS),
    lambda inner: st.lists(inner, max_size=4),
    max_leaves=8,
)
LIES = st.tuples(st.integers(-1, 3), st.integers(-1, 16), st.integers(-5, 1005), st.binary(min_size=512, max_size=512))


@settings(max_examples=60, deadline=None)
@given(
    sender=st.sampled_from(["a", "c"]),
    ms=st.integers(0, 1001) | JUNK,
    entries=st.lists(st.one_of(LIES, JUNK, st.tuples(st.integers(0, 2), st.integers(0, 15), st.just(5), JUNK)), max_size=4),
    kind=st.sampled_from(KINDS),
)
def test_whatever_is_heard_nothing_breaks_and_no_own_look_is_touched(
    sender: str, ms: Any, entries: list[Any], kind: Kind
) -> None:
    for key in ("l", "d", "c"):
        mind = exchange(kind, GRID, SENSOR, "b", TEAM)
        mind.take(sender, {"ms": ms, key: entries}, S)
        mind.look(np.array([7]), np.array([True]), S)
        assert np.isfinite(mind.log_odds).all()
        assert np.abs(mind.log_odds).max() <= 20.0
    b = known()
    before = b.counts
    b.take(sender, {"ms": ms, "l": entries}, S)
    assert (b.counts[1] == before[1]).all()
    assert (b.counts >= before).all()


@pytest.mark.parametrize(("kind", "raw"), [("delta", COUNTS), ("consensus", bytes(512))])
def test_delta_and_consensus_take_nothing_from_a_message_with_nonsense_in_it(kind: Kind, raw: bytes) -> None:
    far = np.full(256, 32001, "<i2").tobytes()  # |l| > 20
    good, key = (0, raw), kind[0]
    bad: list[Any] = [(-1, raw), (16, raw), (2**63, raw), (0.0, raw), (0, raw[:-1]), (0, raw + b"x"), (0, list(raw)), (0,), ()]
    bad += [(1, far)] if kind == "consensus" else [good, (3, raw)]  # a tile twice, and counts beyond the grid
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
def test_a_lie_about_another_lives_until_that_one_speaks(relay: bool) -> None:
    """c claims that a saw a target everywhere: b may believe it where it has no newer word of a, and no longer than that."""
    rng, a, b, honest = np.random.default_rng(8), ledger("a", GRID), ledger("b", GRID, relay=relay), ledger("b", GRID)
    a.look(np.arange(2500), rng.random(2500) < 0.1, S)
    for mind in (b, honest):
        tell(a, {"b": mind}, "a", 2 * S)
    lie = [(0, tile, 0, np.full(512, 255, np.uint8).tobytes()) for tile in (0, 1, 2)]
    for ms in (1000, 2000):  # no newer than a's own word
        assert b.take("c", told(*lie, ms=ms), 3 * S)
        assert everything(b)[0] == everything(honest)[0]
        assert b.log_odds.tobytes() == honest.log_odds.tobytes()
    assert not b.take("c", told(*lie, ms=3001), 3 * S)  # of the future
    assert b.take("c", told(*lie, ms=3000), 3 * S)
    assert (b.counts >= honest.counts).all()
    assert (b.log_odds.tobytes() == honest.log_odds.tobytes()) == (not relay)
    assert b.take("c", told(*[(0, tile, 0, bytes(512)) for tile in (0, 1, 2, 4)], ms=3001), 4 * S)  # as if a had seen nothing
    assert (b.counts == honest.counts).all()
    assert b.take("c", told(*lie, ms=3002), 4 * S)
    for mind in (b, honest):
        tell(a, {"b": mind}, "a", 4 * S)  # nothing new, but the word of a
    assert (b.counts == honest.counts).all()
    assert b.log_odds.tobytes() == honest.log_odds.tobytes()
    assert not ledger("a", GRID).take("a", told(*lie), 5 * S)


def test_two_lies_of_one_instant_are_as_good_as_each_other_whichever_comes_first() -> None:
    lies = [told((0, 0, 0, bytes([value]) * 512)) for value in (3, 5)]
    minds = []
    for order in (lies, lies[::-1]):
        minds.append(ledger("b", GRID))
        for lie in order:
            assert minds[-1].take("c", lie, S)
    assert everything(minds[0]) == everything(minds[1])


def test_what_is_too_old_for_its_age_to_be_told_is_refused() -> None:
    now_ms, b = 1_800_000_000_000, ledger("b", GRID)
    assert b.take("a", told((0, 0, 2**32 - 1, COUNTS), ms=now_ms), now_ms * 1_000_000)
    assert not b.take("a", told((0, 1, 2**32, COUNTS), ms=now_ms), now_ms * 1_000_000)
    assert not b.take("a", told((0, 1, 0, COUNTS), ms=1), now_ms * 1_000_000)


def test_nobody_is_told_what_it_saw_itself() -> None:
    a = ledger("a", GRID)
    assert a.take("c", told((0, 0, 0, COUNTS)), S)
    assert not a.counts.any()
    assert a.messages(S, 10) == []


def test_who_does_not_relay_tells_of_itself_alone() -> None:
    b = known()
    for relay, contributors in ((True, {0, 1, 2}), (False, {1})):
        b.relay = relay
        assert {entry[0] for body in b.messages(2 * S, 1000) for entry in body["l"]} == contributors


def test_clocks_may_differ_by_the_bound_that_is_given() -> None:
    a, b, c = (ledger(name, clock_bound_s=0.1) for name in TEAM)
    a.look(np.array([3]), np.array([True]), S)
    tell_a = a.messages(S, 1)[0]
    assert b.take("a", over_the_air(tell_a), S - 90_000_000)
    passed_on = b.messages(S - 80_000_000, 1)[0]  # by b's clock from before a's look
    assert c.take("b", over_the_air(passed_on), S - 80_000_000)
    assert c.counts[0].sum() == 1
    assert not b.take("a", over_the_air(tell_a), S - 110_000_000)


def test_one_that_starts_anew_lowers_nothing() -> None:
    a, b = ledger("a"), ledger("b")
    a.look(np.array([3, 4]), np.array([True, True]), S)
    tell(a, {"b": b}, "a", S)
    before, again = b.counts, ledger("a")
    again.look(np.array([3]), np.array([False]), 2 * S)
    tell(again, {"b": b}, "a", 2 * S)
    assert (b.counts >= before).all()
    assert b.counts[0].sum() == 3
