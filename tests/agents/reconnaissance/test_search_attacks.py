"""What others can do to one who searches by what they send: nothing to its own looks, little to those of others."""

from functools import cache
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.agents.agent_loop import received
from tests.support.agents.search_agents import Team, info, looks, of_map, searcher, see
from vcmvsp.agents.reconnaissance.exchange import Ledger
from vcmvsp.agents.reconnaissance.search import Search
from vcmvsp.cosim.agent import Radio
from vcmvsp.cosim.types import Message, Reception

S = 1_000_000_000
NAMES = ("a", "b", "c")
NOW_NS = 20 * S
NUMBERS = st.integers(-(2**63), 2**64 - 1) | st.floats() | st.booleans() | st.none()
ANYTHING = st.recursive(
    NUMBERS | st.text(max_size=5) | st.binary(max_size=600) | st.sampled_from(["l", "d", "c", "ms", "do", "track"]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(["l", "d", "c", "ms", "do", "at", "x"]), inner),
    max_leaves=12,
)
SENDERS = st.sampled_from([*NAMES, "stranger", ""])


def told_by(sender: str, body: Any) -> Reception:
    return received(Message(sender=sender, body=body, size_bytes=10))


class Seat:
    """Vehicle a, which has looked around for two seconds, and has heard the others once."""

    def __init__(self, **params: Any) -> None:
        self.agent, self.radio, self.now_ns = searcher(**params), Radio("a", NAMES), NOW_NS
        self.agent.start(info("a", NAMES))
        for second in (1, 2):
            self.hear(*(told_by(name, body) for name in ("b", "c") for body in said(name)[:1]), second=second)

    def hear(self, *heard: Reception, second: int | None = None) -> None:
        """The next tick."""
        self.now_ns = self.now_ns + S // 10 if second is None else second * S
        obs = see((10.0, 30.0, 20.0), self.now_ns, *heard)
        if second is not None:
            obs.readings["looks"] = looks(10.0, 30.0, self.now_ns, np.random.default_rng(second))
        self.agent.act(obs, self.radio)
        if second is not None:
            self.now_ns = NOW_NS

    @property
    def counts(self) -> np.ndarray:
        mind = self.agent.map._mind
        assert isinstance(mind, Ledger)
        return mind.counts


@cache
def history() -> Team:
    team = Team({name: searcher() for name in NAMES})
    team.run(15.0)
    return team


def said(name: str) -> list[dict[str, Any]]:
    """Messages of the map that a vehicle has sent in 15 s, in their order."""
    return [each.body for each in of_map(history().sent[name]) if isinstance(each.body, dict)]


@settings(max_examples=150)
@given(sender=SENDERS, bodies=st.lists(ANYTHING, min_size=1, max_size=3))
def test_nonsense_changes_nothing(sender: str, bodies: list[Any]) -> None:
    seat = seated()
    before, odds = seat.counts, seat.agent.map.odds.copy()
    seat.hear(*(told_by(sender, body) for body in bodies))
    assert np.array_equal(seat.counts, before)
    assert np.array_equal(seat.agent.map.odds, odds)


@cache
def seated() -> Seat:
    """The same for all examples, as none of them may change it."""
    return Seat()


@pytest.mark.parametrize("sender", ["a", "stranger", ""])
def test_what_is_true_counts_only_from_a_member_and_not_from_oneself(sender: str) -> None:
    seat = Seat()
    before = seat.counts
    seat.hear(*(told_by(sender, body) for name in NAMES for body in said(name)))
    assert np.array_equal(seat.counts, before)
    seat.hear(*(told_by("b", body) for body in said("b")))
    assert not np.array_equal(seat.counts, before)


@settings(max_examples=60)
@given(
    number=st.integers(0, 10),
    place=st.integers(0, 2000),
    change=st.binary(min_size=1, max_size=4),
    how=st.sampled_from(["replaced", "inserted", "cut"]),
    relay=st.booleans(),
)
def test_a_message_that_was_damaged_changes_no_own_count(number: int, place: int, change: bytes, how: str, relay: bool) -> None:
    """Nor, where nobody is believed about others, the count of a third."""
    raw = msgspec.msgpack.encode(said("b")[number])
    place %= len(raw)
    end = raw[place + len(change) :] if how == "replaced" else raw[place:] if how == "inserted" else b""
    damaged = raw[:place] + (change if how != "cut" else b"") + end
    try:
        body = msgspec.msgpack.decode(damaged)
    except (msgspec.DecodeError, UnicodeDecodeError):
        body = damaged
    seat = Seat(relay=relay)
    before = seat.counts
    seat.hear(told_by("b", body))
    assert np.array_equal(seat.counts[0], before[0])
    assert (seat.counts >= before).all()
    if not relay:
        assert np.array_equal(seat.counts[2], before[2])


@settings(max_examples=40)
@given(picks=st.lists(st.tuples(st.sampled_from(["b", "c"]), st.integers(0, 14)), min_size=1, max_size=12), data=st.data())
def test_the_order_and_copies_of_messages_make_no_difference(picks: list[tuple[str, int]], data: st.DataObject) -> None:
    seats = Seat(), Seat()
    for name, number in picks:
        seats[0].hear(told_by(name, said(name)[number]))
    for name, number in data.draw(st.permutations([*picks, *picks[::2]])):
        seats[1].hear(told_by(name, said(name)[number]))
    assert np.array_equal(seats[0].counts, seats[1].counts)
    for row, name in enumerate(NAMES):
        mind = history().agents[name].map._mind
        assert isinstance(mind, Ledger)
        if name != "a":
            assert (seats[0].counts[row] <= mind.counts[row]).all()


def test_the_future_is_not_believed_but_within_the_bound_of_clocks() -> None:
    body = {**said("b")[-1], "ms": (NOW_NS + 2 * S) // 1_000_000}
    for bound_s, believed in ((0.0, False), (5.0, True)):
        seat = Seat(clock_bound_s=bound_s)
        before = seat.counts
        seat.hear(told_by("b", body))
        assert np.array_equal(seat.counts, before) is not believed


def test_other_algorithms_of_the_vehicle_may_talk() -> None:
    """Reports, rosters, and anything else are not messages of the map, and are not refused either."""
    seat = Seat()
    before = seat.counts
    report = {"seq": 1, "t_ns": NOW_NS, "x": 1.0, "y": 2.0, "th": 0.0, "v": 0.3, "w": 0.0, "vx": 1.0}
    roster = {"do": "track", "ms": NOW_NS // 1_000_000, "tg": "alpha", "at": [1.0, 2.0], "since": 5}
    seat.hear(told_by("b", report), told_by("c", roster), told_by("b", b"\x00\x01"))
    assert np.array_equal(seat.counts, before)
    assert isinstance(seat.agent, Search)
