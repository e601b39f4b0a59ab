"""Datagrams of programs under routing: their arrivals are reported in time, and their ends once no copy can come."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from tests.support.netsim.routing_runs import HOP_NS, MS, line, message_at, names, run
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.types import Datagrams, Traffic, frozen
from vcmvsp.netsim.routing.distance_vector import DistanceVector
from vcmvsp.netsim.routing.router import BROADCAST, HEADER_BYTES, Flooding, Routing, Static


def handed(at_ns: int, *rows: tuple[int, int, int], sent_ns: int | None = None, payloads: Sequence[bytes] = ()) -> Event:
    """Offered datagrams (number, sender, receiver) of 100 B."""
    number, sender, to = np.array(rows).T
    size, sent = np.full(len(rows), 100), np.full(len(rows), at_ns if sent_ns is None else sent_ns)
    value = Datagrams(
        number=frozen(number, np.int64),
        sender=frozen(sender, np.int32),
        to=frozen(to, np.int32),
        size_bytes=frozen(size, np.int64),
        sent_ns=frozen(sent, np.int64),
        payloads=tuple(payloads),
    )
    return Event("bridge/sent", at_ns, value)


def arrivals(traffic: Sequence[Traffic]) -> list[tuple[int, int, int]]:
    rows = [zip(each.number.tolist(), each.receiver.tolist(), each.arrival_ns.tolist(), strict=True) for each in traffic]
    return [row for some in rows for row in some]


def settled(traffic: Sequence[Traffic]) -> list[int]:
    return [number for each in traffic for number in each.settled.tolist()]


def test_a_datagram_goes_over_three_hops() -> None:
    outcome = run(Static(chain=names(4)), line(4), handed(10 * MS, (7, 0, 3)))
    assert arrivals(outcome.traffic) == [(7, 3, 10 * MS + 3 * HOP_NS)]
    frames = [(report.sender, report.size_bytes) for each in outcome.traffic for report in each.reports]
    assert frames == [(f"car{i}", 100 + HEADER_BYTES) for i in (1, 2, 3)]
    assert np.concatenate([each.carries for each in outcome.traffic]).tolist() == [7, 7, 7]
    assert settled(outcome.traffic) == [7]
    assert not outcome.frames  # they are in the traffic
    assert not outcome.routed_receptions  # no agent receives it


def test_an_arrival_is_reported_once_the_last_frame_is_sent() -> None:
    """The bridge can deliver on time; not so for broadcasts, of which a copy may arrive earlier by another way."""
    both = handed(10 * MS, (7, 0, 3)), handed(10 * MS, (8, 0, BROADCAST))
    outcome = run(Static(chain=names(4)), line(4), *both, delay={"seconds": 0.05})
    reported = zip(outcome.traffic_ns, outcome.traffic, strict=True)
    report_ns = {number: at_ns for at_ns, each in reported for number in each.number.tolist()}
    arrival_ns = {number: at_ns for number, _, at_ns in arrivals(outcome.traffic)}
    assert report_ns[7] == arrival_ns[7] - 50 * MS == 110 * MS
    assert report_ns[8] == arrival_ns[8]


def test_agents_receive_messages_at_their_destination() -> None:
    outcome = run(Static(chain=names(4)), line(4), handed(10 * MS, (1, 0, 3), payloads=[b"hello"]))
    (message,) = [each.message for each in outcome.receptions]
    assert (message.sender, message.body, message.to) == ("car1", b"hello", "car4")


@pytest.mark.parametrize("mac", ["ideal", "dcf"])
@pytest.mark.parametrize(
    "router", [Flooding(jitter_s=0.02), Static(chain=names(5)), DistanceVector()], ids=lambda each: type(each).__name__
)
def test_each_is_settled_once_and_nothing_comes_of_it_afterwards(router: Routing, mac: str) -> None:
    datagrams = [handed((k + 1) * 50 * MS, (2 * k, k % 5, BROADCAST)) for k in range(60)]
    datagrams += [handed((k + 1) * 50 * MS + 25 * MS, (2 * k + 1, (k + 1) % 5, k % 5)) for k in range(60)]
    agents: list[Any] = [message_at("car3", k * 70 * MS) for k in range(40)]
    layers: dict[str, Any] = {"loss": {"probability": 0.2}, "mac": {"kind": mac}, "delivery": {"duplicate": 0.2}}
    outcome = run(router, line(5), *datagrams, *agents, seconds=4.0, **layers)
    assert Counter(settled(outcome.traffic)) == Counter(range(120))
    over = set[int]()
    for each in outcome.traffic:
        assert not over & {*each.number.tolist(), *each.carries.tolist()}
        over.update(each.settled.tolist())
    came = arrivals(outcome.traffic)
    assert max(Counter((number, receiver) for number, receiver, _ in came).values()) == 1
    assert all(number % 2 == 0 or receiver == number // 2 % 5 for number, receiver, _ in came)
    assert len(came) > 0.4 * (60 * 4 + 60)
    numbers = [each.number for each in outcome.routed if each.origin == "car3"]
    assert len({*numbers}) == len(numbers)


def test_one_without_a_route_is_settled_at_once() -> None:
    outcome = run(DistanceVector(), line(3), handed(1 * MS, (0, 0, 2)))
    assert (arrivals(outcome.traffic), settled(outcome.traffic)) == ([], [0])
    assert not any(each.reports for each in outcome.traffic)


def test_a_late_datagram_is_sent_at_its_time_and_forwarded_once_known() -> None:
    """A run that receives a program's datagram 30 ms late: the first hop is over by then, the second begins."""
    outcome = run(Static(chain=names(3)), line(3), handed(40 * MS, (0, 0, 2), sent_ns=10 * MS))
    first, second = (report for each in outcome.traffic for report in each.reports)
    assert (first.sent_ns, first.received_ns.tolist()) == (10 * MS, [10 * MS + HOP_NS])
    assert second.sent_ns == 40 * MS + 1
    assert arrivals(outcome.traffic) == [(0, 2, 40 * MS + 1 + HOP_NS)]


def test_receivers_of_a_late_datagram_are_reported_in_order_of_time() -> None:
    for seed in range(10):
        late = handed(40 * MS, (0, 0, BROADCAST), sent_ns=10 * MS)
        delay = {"seconds": 0.01, "jitter_s": 0.009}
        (message,) = run(Flooding(), line(4, 10.0), late, seed=seed, delay=delay).messages
        assert len(message.received_ns) == 3
        assert list(message.received_ns) == sorted(message.received_ns)


def test_frames_of_programs_and_agents_are_distinguished() -> None:
    outcome = run(Flooding(), line(3), handed(100 * MS, (5, 0, BROADCAST)), message_at("car1", 100 * MS))
    assert (len(outcome.frames), sum(len(each.reports) for each in outcome.traffic)) == (3, 3)
    frames_of_each = [each.frames for each in outcome.messages]
    assert sorted(frame for some in frames_of_each for frame in some) == list(range(6))


@pytest.mark.parametrize("router", [Flooding(), Static(chain=names(4))])
@pytest.mark.parametrize("to", [BROADCAST, 3])
def test_the_named_frame_is_the_one_that_delivered(router: Routing, to: int) -> None:
    outcome = run(router, line(4), handed(10 * MS, (7, 0, to), (8, 1, to)))
    reports = {report.frame: report for each in outcome.traffic for report in each.reports}
    named = [frame for each in outcome.traffic for frame in each.frame.tolist()]
    rows = list(zip(named, arrivals(outcome.traffic), strict=True))
    assert len({frame for frame, _ in rows}) > 1
    for frame, (_, receiver, at_ns) in rows:
        report = reports[frame]
        assert report.received_ns[report.receivers.index(names(4)[receiver])] == at_ns
