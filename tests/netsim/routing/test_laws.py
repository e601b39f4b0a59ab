"""Laws of forwarded messages: arrival times, delivery, number of copies, and reach."""

import math
from collections import Counter
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.support.netsim.routing_runs import AIR_NS, HOP_NS, MS, Run, line, message_at, names, run
from vcmvsp.netsim.routing.router import HEADER_BYTES, Flooding, Routing, Static

pytestmark = pytest.mark.slow

LOSS = 0.2
LADDER = [(60.0 * i, y) for i in range(4) for y in (0.0, 30.0)]
"""Two rows of four; from one pair to the next there are four ways (60 and 67 m of 86)."""


def often(count: int, sender: str = "car1", to: str | None = None) -> list[Any]:
    return [message_at(sender, k * 100 * MS, to=to) for k in range(count)]


def share(outcome: Run, receiver: str, count: int) -> float:
    return sum(each.receiver == receiver for each in outcome.routed_receptions) / count


def spread(share: float, count: int) -> float:
    """Band, 4.5 standard deviations, of a binomial share."""
    return 4.5 * math.sqrt(share * (1.0 - share) / count)


@pytest.mark.parametrize("delay_s", [0.0, 0.02])
def test_over_a_chain_of_perfect_links_a_message_takes_hops_times_air_and_delay(delay_s: float) -> None:
    router = Static(chain=names(6))
    messages = [message_at("car1", 5 * MS, to="car6"), message_at("car3", 300 * MS, to="car1")]
    hop_ns = max(HOP_NS, round(delay_s * 1e9))
    outcome = run(router, line(6), *messages, delay={"seconds": delay_s})
    took = [(each.receiver, each.received_ns - each.sent_ns) for each in outcome.routed_receptions]
    assert took == [("car6", 5 * hop_ns), ("car1", 2 * hop_ns)]
    last = [(each.hops[-1], each.receivers[-1], each.via[-1]) for each in outcome.messages]
    assert last == [(5, "car6", "car5"), (2, "car1", "car2")]
    assert [frame.sender for frame in outcome.frames] == ["car1", "car2", "car3", "car4", "car5", "car3", "car2"]


def test_a_flooded_message_takes_air_time_per_hop_plus_waits() -> None:
    jitter_ns = 8 * MS
    outcome = run(Flooding(jitter_s=jitter_ns / 1e9), line(5), *often(20), seconds=3.0)
    assert len(outcome.routed_receptions) == 80
    sent_ns = {frame.frame: frame.sent_ns for frame in outcome.frames}
    waits = []
    for message in outcome.messages:
        assert message.receivers == ("car2", "car3", "car4", "car5")
        assert message.hops == (1, 2, 3, 4)
        begins = [sent_ns[frame] for frame in message.frames]
        assert [at - begin for at, begin in zip(message.received_ns, begins, strict=False)] == [HOP_NS] * 4
        waits += [begin - at for at, begin in zip(message.received_ns[:3], begins[1:4], strict=True)]
    assert 0 <= min(waits) < max(waits) < jitter_ns
    assert np.mean(waits) == pytest.approx(jitter_ns / 2, abs=4.5 * jitter_ns / math.sqrt(12 * len(waits)))


@pytest.mark.parametrize("contends", ["ideal", "dcf"])
def test_a_reception_is_of_the_original_message(contends: str) -> None:
    messages = [message_at("car1", 7 * MS), message_at("car1", 400 * MS, to="car4")]
    outcome = run(Flooding(), line(4), *messages, mac={"kind": contends})
    assert Counter(each.message.to for each in outcome.receptions) == {None: 3, "car4": 1}
    for each in outcome.receptions:
        sent = messages[each.message.to is not None]
        assert (each.message, each.sent_ns) == (sent.value, sent.time_ns)
    for i, each in zip((1, 2, 3), outcome.receptions, strict=False):
        frame = next(frame for frame in outcome.frames if frame.sender == f"car{i}")
        assert each.rssi_dbm == frame.rssi_dbm[frame.receivers.index(f"car{i + 1}")]


def test_frames_are_as_long_as_message_and_header() -> None:
    outcome = run(Static(chain=names(3)), line(3), message_at("car1", 0, to="car3", size_bytes=250))
    assert [frame.size_bytes for frame in outcome.frames] == [250 + HEADER_BYTES] * 2
    assert [(each.size_bytes, each.frame_bytes) for each in outcome.messages] == [(250, 250 + HEADER_BYTES)]
    assert run(None, line(3), message_at("car1", 0, to="car2", size_bytes=250)).frames[0].size_bytes == 250


@pytest.mark.parametrize("router", [Static(chain=names(4)), Flooding(jitter_s=0.0)], ids=["static", "flooding"])
def test_over_a_chain_with_losses_each_hop_takes_its_share(router: Routing) -> None:
    count = 1500
    outcome = run(router, line(4), *often(count, to="car4"), seconds=count / 10, loss={"probability": LOSS})
    expected = (1.0 - LOSS) ** 3
    assert share(outcome, "car4", count) == pytest.approx(expected, abs=spread(expected, count))


def test_where_there_are_several_ways_flooding_is_better_than_the_best_of_them() -> None:
    count = 500
    outcome = run(Flooding(jitter_s=0.02), LADDER, *often(count), seconds=count / 10, loss={"probability": LOSS})
    best = (1.0 - LOSS) ** 3
    assert share(outcome, "car7", count) > best + spread(best, count)


def test_each_vehicle_hears_a_flooded_message_once() -> None:
    delivery = {"duplicate": 0.5, "duplicate_delay_s": 0.004}
    outcome = run(Flooding(), LADDER, *often(30), *often(30, "car8"), seconds=4.0, delivery=delivery)
    different = {(each.receiver, each.sender, each.sent_ns) for each in outcome.routed_receptions}
    assert len(outcome.routed_receptions) == len(different) == 2 * 30 * 7
    assert not [each for each in outcome.routed_receptions if each.receiver == each.sender]
    assert all(len(message.frames) == len(LADDER) for message in outcome.messages)  # each vehicle sent each once


@pytest.mark.parametrize("limit", [1, 2, 5])
def test_a_message_goes_no_further_than_its_hop_limit(limit: int) -> None:
    outcome = run(Flooding(hop_limit=limit), line(7), message_at("car1", 0))
    assert [each.receiver for each in outcome.routed_receptions] == [f"car{i + 2}" for i in range(limit)]
    assert len(outcome.frames) == limit


def test_routing_works_with_contention() -> None:
    outcome = run(Flooding(jitter_s=0.02), LADDER, *often(50), seconds=6.0, mac={"kind": "dcf"})
    assert len(outcome.routed_receptions) > 0.98 * 50 * 7
    assert {word for frame in outcome.frames for word in frame.outcome} >= {"received", "below sensitivity"}
    chain = run(Static(chain=names(5)), line(5), *often(50, to="car5"), seconds=6.0, mac={"kind": "dcf"})
    assert len(chain.routed_receptions) == 50
    assert all(each.received_ns - each.sent_ns >= 4 * HOP_NS for each in chain.routed_receptions)


def test_without_routing_nothing_is_passed_on() -> None:
    outcome = run(None, line(3), message_at("car1", 0))
    assert [(each.receiver, each.received_ns) for each in outcome.routed_receptions] == [("car2", AIR_NS)]
    assert not outcome.routed


def test_messages_under_way_at_the_end_are_reported_with_their_progress() -> None:
    outcome = run(Static(chain=names(5)), line(5), message_at("car1", 0, to="car5"), seconds=(2.5 * HOP_NS) / 1e9)
    (message,) = outcome.routed
    assert (message.receivers, message.hops) == (("car2", "car3"), (1, 2))
    assert message.under_way
    assert not outcome.routed_receptions


@pytest.mark.parametrize("mac", ["ideal", "dcf"])
def test_arrived_lost_and_unfinished_messages_are_distinguished(mac: str) -> None:
    """An arrived message, a lost one, and one on the air at the end of the run, or between two of its frames."""
    plan = (("car1", 0, "car3"), ("car1", 500 * MS, "car3"), ("car2", 999 * MS, "car1"))
    messages = [message_at(sender, at_ns, to=to) for sender, at_ns, to in plan]
    deaf = {"from_s": 0.4, "to_s": 0.9, "links": ["car1/car2"], "loss": 1.0}
    outcome = run(Static(chain=names(3)), line(3), *messages, mac={"kind": mac}, script={"kind": "script", "changes": [deaf]})
    assert [each.under_way for each in outcome.messages] == [False, False, True]
    waiting = run(Flooding(jitter_s=5.0), line(3), message_at("car1", 0), mac={"kind": mac})
    assert [(each.receivers, each.under_way) for each in waiting.messages] == [(("car2",), True)]


@settings(max_examples=40)
@given(
    st.lists(st.tuples(st.floats(0.0, 200.0), st.floats(0.0, 200.0)), min_size=2, max_size=8),
    st.integers(0, 100),
    st.integers(1, 7),
    st.sampled_from([0.0, 0.01, 0.1]),
)
def test_flooding_reaches_at_most_the_graph_of_perfect_links(
    position: list[tuple[float, float]], seed: int, limit: int, jitter_s: float
) -> None:
    """By brute force: only vehicles within the hop limit, with links of at most 86 m, receive it, and only once.

    All of them do where the limit does not matter, or where without waiting no copy over a longer way comes first.
    """
    points = np.array(position)
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    assume(bool((np.abs(apart - 85.6) > 0.2).all()))
    outcome = run(Flooding(hop_limit=limit, jitter_s=jitter_s), position, message_at("car1", 0), seed=seed, seconds=2.0)
    reached = np.arange(len(position)) == 0
    for _ in range(limit):
        reached = reached | (np.maximum(apart, 1.0) <= 85.6)[reached].any(axis=0)
    receivers = [each.receiver for each in outcome.routed_receptions]
    within = [f"car{i + 1}" for i in np.flatnonzero(reached).tolist() if i]
    assert len(receivers) == len(set(receivers))
    assert set(receivers) <= set(within)
    if limit >= len(position) - 1 or jitter_s == 0.0:
        assert sorted(receivers) == within


def test_a_first_copy_that_came_the_longer_way_may_end_at_the_limit() -> None:
    """Nine in a row, each in range of the next two: 4 hops are enough for the last, but not always for the first copy."""
    count, position = 40, [(30.0 * i, 0.0) for i in range(9)]
    outcomes = [run(Flooding(hop_limit=4, jitter_s=each), position, *often(count), seconds=5.0) for each in (0.0, 0.01)]
    assert share(outcomes[0], "car9", count) == 1.0
    assert 0.0 < share(outcomes[1], "car9", count) < 1.0
