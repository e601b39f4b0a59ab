"""Messages of a shared map: real sizes, and how full they are."""

import numpy as np
import pytest

from tests.support.agents.shared_maps import GRID, KINDS, SENSOR, TEAM, S, ledger, over_the_air, size, tell
from vcmvsp.agents.reconnaissance.exchange import Kind, exchange
from vcmvsp.cosim.agent import Radio


@pytest.mark.parametrize("max_bytes", [40, 64, 100, 127, 300, 1400, 2312])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("busy", [False, True])
def test_messages_are_no_larger_than_allowed_and_pass_the_radio(kind: Kind, max_bytes: int, busy: bool) -> None:
    rng, now_ns = np.random.default_rng(6), 1_800_000_000 * S  # as of a clock on a wall, whose numbers are long
    mind = exchange(kind, GRID, SENSOR, "a", TEAM, max_bytes=max_bytes)
    every = np.arange(GRID.rows * GRID.columns)
    for _ in range(400 if busy else 1):  # beyond one byte
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
    if kind == "ledger" or (kind == "delta" and not busy):  # which clamps sums, not increments
        assert listener.log_odds == pytest.approx(mind.log_odds)


@pytest.mark.parametrize("kind", ["ledger", "delta"])
def test_messages_of_many_tiles_are_no_larger_than_allowed(kind: Kind) -> None:
    for max_bytes in range(8300, 8500):  # 15 to 16 tiles of 16 x 16, where a list needs more bytes to say how long it is
        mind = exchange(kind, GRID, SENSOR, "a", TEAM, max_bytes=max_bytes)
        mind.look(np.arange(2500), np.zeros(2500, bool), S)
        assert max(map(size, mind.messages(S, 9))) <= max_bytes


@pytest.mark.parametrize("max_bytes", [100, 1400])
def test_messages_are_well_filled(max_bytes: int) -> None:
    """Nearly all of a full message of 1400 bytes, and most of one of 100, is counts."""
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
def test_what_has_no_room_comes_next(kind: Kind) -> None:
    mind = exchange(kind, GRID, SENSOR, "a", TEAM, max_bytes=100)
    mind.look(np.arange(2500), np.zeros(2500, bool), S)
    told = [entry[0] for _ in range(600) for body in mind.messages(S, 1) for entry in body[kind[0]]]
    assert len(set(told)) == 169  # ceil(50 / 4)^2
    assert kind == "consensus" or len(told) == 169


def test_a_message_must_hold_a_cell() -> None:
    with pytest.raises(ValueError, match="max_bytes = 39"):
        ledger("a", max_bytes=39)


def test_counts_end_at_what_two_bytes_hold() -> None:
    a, b, cell = ledger("a"), ledger("b"), np.array([5])
    a._own[0, 0, :, 5] = 65534
    for tick in range(3):
        a.look(cell, np.array([True]), tick * S)
    assert a.counts[0, :, 0, 5].tolist() == [65535, 65534]
    a.look(cell, np.array([False]), 4 * S)
    tell(a, {"b": b}, "a", 5 * S)
    assert b.counts[0, :, 0, 5].tolist() == [65535, 65535]
