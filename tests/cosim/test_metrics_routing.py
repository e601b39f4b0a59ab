"""What the recording makes of messages that are passed on: numbers, and whose information a frame carried."""

import numpy as np
import pytest

from cosim.record.columns import names_of, numbers
from cosim.record.metrics import Routing, age_metrics, informed, links, receptions, unreached_s
from cosim.record.tables import RunFacts, radio_table
from cosim.types import FrameReport, Routed

NAMES = ("a", "b", "c")
FACTS = RunFacts(scenario="test", seed=1, end_ns=10**10, vehicles=NAMES)


def frame(number: int, sender: str, sent_ns: int, **received_ns: int) -> FrameReport:
    """Received where a time is given, else lost."""
    others = tuple(name for name in NAMES if name != sender)
    times = [received_ns.get(name, -1) for name in others]
    zeros = np.zeros(len(others))
    return FrameReport(
        frame=number,
        sender=sender,
        sent_ns=sent_ns,
        size_bytes=58,
        receivers=others,
        distance_m=zeros,
        rssi_dbm=zeros,
        received_ns=np.array(times, np.int64),
        outcome=tuple("received" if each >= 0 else "random loss" for each in times),
    )


def routed(
    *frames: int, origin: str = "a", to: str | None = None, sent_ns: int = 0, update: bool = False, **came: tuple[int, str, int]
) -> Routed:
    """``came``: hops, via and time, by receiver."""
    hops, via, times = zip(*came.values(), strict=True) if came else ((), (), ())
    return Routed(
        origin=origin,
        number=0,
        to=to,
        sent_ns=sent_ns,
        size_bytes=50,
        frame_bytes=58,
        frames=frames,
        receivers=tuple(came),
        hops=hops,
        via=via,
        received_ns=times,
        update=update,
    )


REPORTS = [
    frame(0, "a", 100, b=200),  # a message of a: b hears it, and passes it on to c
    frame(1, "b", 250, a=350, c=350),
    frame(2, "b", 400, a=500, c=500),  # b tells of routes
    frame(3, "a", 600, b=700),  # to c, over b
    frame(4, "b", 700, c=800),
    frame(5, "a", 900),  # heard by nobody
]
MESSAGES = [
    routed(0, 1, sent_ns=100, b=(1, "a", 200), c=(2, "b", 350)),
    routed(2, origin="b", sent_ns=400, update=True, a=(1, "b", 500), c=(1, "b", 500)),
    routed(3, 4, to="c", sent_ns=600, b=(1, "a", 700), c=(2, "b", 800)),
    routed(5, sent_ns=900),
    routed(to="c", sent_ns=950),
]


@pytest.fixture
def routing() -> Routing:
    found = Routing(NAMES)
    for each in MESSAGES:
        found.take(each)
    return found


def test_the_numbers(routing: Routing) -> None:
    assert routing.metrics() == {
        "messages": 4,
        "arrivals": 3,  # b and c of the first, c of the second
        "delivery_ratio": 0.5,  # of 2 + 1 + 2 + 1
        "hops_mean": pytest.approx(5 / 3),
        "hops_max": 2,
        "delay_s": {
            "mean": pytest.approx(550e-9 / 3),
            "p50": pytest.approx(200e-9),
            "p95": pytest.approx(245e-9),
            "p99": pytest.approx(249e-9),
            "max": pytest.approx(250e-9),
        },
        "forwarded": 2,
        "no_route": 1,
        "control_frames": 1,
        "control_bytes": 58,
    }


def test_without_routing_there_is_nothing_to_tell() -> None:
    assert not Routing(NAMES)
    nothing = Routing(NAMES)
    nothing.take(routed(2, origin="b", update=True))
    assert nothing
    assert nothing.metrics()["delivery_ratio"] is None


def test_a_frame_says_whose_message_it_carried(routing: Routing) -> None:
    table = routing.told(radio_table(REPORTS, FACTS))
    origins, by = names_of(table, "origin")
    ends, to = names_of(table, "destination")
    rows = zip(
        numbers(table, "frame").tolist(), by.tolist(), to.tolist(), numbers(table, "origin_sent_ns").tolist(), strict=True
    )
    assert {(number, origins[a], ends[b], sent_ns) for number, a, b, sent_ns in rows} == {
        (0, "a", "", 100),
        (1, "a", "", 100),
        (2, "", "", 400),
        (3, "a", "c", 600),
        (4, "a", "c", 600),
        (5, "a", "", 900),
    }


def test_information_is_of_its_origin_and_for_whom_it_was_meant(routing: Routing) -> None:
    table = routing.told(radio_table(REPORTS, FACTS))
    known = links(table)
    assert {key: (link.sent_ns.tolist(), link.received_ns.tolist()) for key, link in known.items()} == {
        ("b", "a"): ([100], [200]),
        ("c", "a"): ([100, 600], [350, 800]),
    }
    plain = receptions(table)
    assert {(plain.receivers[r], plain.senders[s]) for r, s in zip(plain.to, plain.by, strict=True)} == {
        ("b", "a"),
        ("a", "b"),
        ("c", "b"),
    }
    assert age_metrics(informed(table), (), {}, (0.0, None), 10**10)["mean"] is None


def test_a_table_without_routing_is_read_as_it_is() -> None:
    table = radio_table(REPORTS, FACTS)
    assert informed(table).sent_ns.tolist() == receptions(table).sent_ns.tolist()
    assert set(links(table)) == {("b", "a"), ("a", "b"), ("c", "b")}


def test_messages_that_came_over_nobody(routing: Routing) -> None:
    table = routing.told(radio_table(REPORTS, FACTS))
    assert unreached_s(table, "c", "a").tolist() == [900e-9]
    assert unreached_s(table, "b", "a").tolist() == [900e-9]  # what was meant for c is no loss
    assert unreached_s(table, "a", "b").tolist() == []


def test_frames_of_a_run_that_broke_off_are_of_nobody() -> None:
    routing = Routing(NAMES)
    routing.take(MESSAGES[0])
    table = routing.told(radio_table(REPORTS, FACTS))
    origins, by = names_of(table, "origin")
    assert [origins[code] for code in by.tolist()] == ["a"] * 4 + [""] * 8
