"""Forwarded messages in the recording: metrics, and the origin of the information in each frame."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.federate import Event, RunInfo
from vcmvsp.cosim.metrics.age import age_metrics, links
from vcmvsp.cosim.metrics.radio import Parts, informed, receptions
from vcmvsp.cosim.metrics.routing import Routing, unreached_s
from vcmvsp.cosim.recording.recorder import Recorder
from vcmvsp.cosim.tables.columns import names_of, numbers
from vcmvsp.cosim.tables.schema import RunFacts, radio_table
from vcmvsp.cosim.types import FrameReport, Routed

NAMES = ("a", "b", "c")
FACTS = RunFacts(scenario="test", seed=1, end_ns=10**10, vehicles=NAMES)


def frame(number: int, sender: str, sent_ns: int, **received_ns: int) -> FrameReport:
    """Report of a frame; a receiver without a time loses it."""
    others = tuple(name for name in NAMES if name != sender)
    times = [received_ns.get(name, -1) for name in others]
    zeros = np.zeros(len(others))
    return FrameReport(
        frame=number, sender=sender, sent_ns=sent_ns, size_bytes=58, receivers=others, distance_m=zeros, rssi_dbm=zeros,
        received_ns=np.array(times, np.int64), outcome=tuple("received" if each >= 0 else "random loss" for each in times),
    )  # fmt: skip


def routed(*frames: int, **parts: Any) -> Routed:
    """Report of a message; of each receiver, by its name: hops, via and time, ns."""
    arrivals = {name: parts.pop(name) for name in NAMES if name in parts}
    hops, via, times = zip(*arrivals.values(), strict=True) if arrivals else ((), (), ())
    fields: dict[str, Any] = {"origin": "a", "number": 0, "to": None, "sent_ns": 0, "update": False, "under_way": False} | parts
    return Routed(
        frames=frames, receivers=tuple(arrivals), hops=hops, via=via, received_ns=times, size_bytes=50, frame_bytes=58, **fields
    )


REPORTS = [
    frame(0, "a", 100, b=200),  # a message of a: b receives it and forwards it to c
    frame(1, "b", 250, a=350, c=350),
    frame(2, "b", 400, a=500, c=500),  # route update of b
    frame(3, "a", 600, b=700),  # to c, via b
    frame(4, "b", 700, c=800),
    frame(5, "a", 900),  # received by no vehicle
]
MESSAGES = [
    routed(0, 1, sent_ns=100, b=(1, "a", 200), c=(2, "b", 350)),
    routed(2, origin="b", sent_ns=400, update=True, a=(1, "b", 500), c=(1, "b", 500)),
    routed(3, 4, number=1, to="c", sent_ns=600, b=(1, "a", 700), c=(2, "b", 800)),
    routed(5, number=2, sent_ns=900),
    routed(to="c", number=3, sent_ns=950),
]


@pytest.fixture
def routing() -> Routing:
    found = Routing(NAMES)
    for each in MESSAGES:
        found.take(each)
    return found


def test_routing_metrics(routing: Routing) -> None:
    assert routing.metrics() == {
        "messages": 4,
        "arrivals": 3,  # b and c of the first, c of the second
        "delivery_ratio": 0.5,  # of 2 + 1 + 2 + 1
        "hops_mean": pytest.approx(5 / 3),
        "hops_max": 2,
        "delay_s": pytest.approx({"mean": 550e-9 / 3, "p50": 200e-9, "p95": 245e-9, "p99": 249e-9, "max": 250e-9}),
        "forwarded": 2,
        "no_route": 1,
        "control_frames": 1,
        "control_bytes": 58,
    }


def test_without_messages_the_ratio_is_none() -> None:
    assert not Routing(NAMES)
    nothing = Routing(NAMES)
    nothing.take(routed(2, origin="b", update=True))
    assert nothing
    assert nothing.metrics()["delivery_ratio"] is None


def test_a_message_under_way_at_the_end_is_no_loss(routing: Routing) -> None:
    routing.take(routed(6, to="c", sent_ns=960, under_way=True, b=(1, "a", 970)))
    routing.take(routed(7, sent_ns=960, under_way=True))
    assert routing.metrics()["delivery_ratio"] == 0.5
    routing.take(routed(8, sent_ns=960, under_way=True, b=(1, "a", 970)))
    assert (routing.metrics()["messages"], routing.metrics()["delivery_ratio"]) == (7, 4 / 7)


def test_a_frame_names_its_messages_origin(routing: Routing) -> None:
    table = routing.table(radio_table(REPORTS, FACTS))
    origins, by = names_of(table, "origin")
    ends, to = names_of(table, "destination")
    sent_ns, number = numbers(table, "origin_sent_ns").tolist(), numbers(table, "origin_number", null=-1).tolist()
    rows = zip(numbers(table, "frame").tolist(), by.tolist(), to.tolist(), sent_ns, number, strict=True)
    assert {(frame, origins[a], ends[b], *rest) for frame, a, b, *rest in rows} == {
        (0, "a", "", 100, 0), (1, "a", "", 100, 0), (2, "", "", 400, -1), (3, "a", "c", 600, 1), (4, "a", "c", 600, 1),
        (5, "a", "", 900, 2),
    }  # fmt: skip
    assert table["message"].to_pylist() == ["over"] * 4 + [""] * 2 + ["over"] * 6


def test_links_of_information_go_from_origin_to_destination(routing: Routing) -> None:
    table = routing.table(radio_table(REPORTS, FACTS))
    known = links(table)
    times = {key: (link.sent_ns.tolist(), link.received_ns.tolist()) for key, link in known.items()}
    assert times == {("b", "a"): ([100], [200]), ("c", "a"): ([100, 600], [350, 800])}
    assert age_metrics(Parts(table, informed), (), {}, (0.0, None), 10**10)["mean"] is None


def test_a_table_without_routing_is_read_as_it_is() -> None:
    table = radio_table(REPORTS, FACTS)
    assert informed(table).sent_ns.tolist() == receptions(table).sent_ns.tolist()
    assert set(links(table)) == {("b", "a"), ("a", "b"), ("c", "b")}


def test_times_of_unreached_messages(routing: Routing) -> None:
    table = routing.table(radio_table(REPORTS, FACTS))
    assert unreached_s(table, "c", "a").tolist() == [900e-9]
    assert unreached_s(table, "b", "a").tolist() == [900e-9]  # the message to c is no loss
    assert unreached_s(table, "a", "b").tolist() == []


def test_simultaneous_messages_are_missed_separately() -> None:
    routing = Routing(NAMES)
    for number in range(4):
        routing.take(routed(number, number=number, to="b", sent_ns=100, under_way=number == 3))
    table = routing.table(radio_table([frame(0, "a", 100, b=200), *(frame(k, "a", 100) for k in (1, 2, 3))], FACTS))
    assert unreached_s(table, "b", "a").tolist() == [100e-9] * 2  # one arrived, one is under way
    assert unreached_s(table, "c", "a").tolist() == []


@pytest.mark.parametrize(("messages", "known"), [((), 0), ((routed(to="c"),), 0), (MESSAGES[1:2], 0), (MESSAGES[:1], 4)])
def test_frames_of_an_aborted_run_have_no_origin(messages: Sequence[Routed], known: int) -> None:
    """Reported before the end: nothing, a message without a route, a route update, or the first message."""
    routing = Routing(NAMES)
    for each in messages:
        routing.take(each)
    table = routing.table(radio_table(REPORTS, FACTS))
    origins, by = names_of(table, "origin")
    assert [origins[code] for code in by.tolist()] == ["a"] * known + [""] * (12 - known)
    assert (
        table["origin_sent_ns"].to_pylist()
        == table["sent_ns"].to_pylist()[:2] + ([100] * 2 if known else [250] * 2) + (table["sent_ns"].to_pylist()[4:])
    )
    assert table["message"].to_pylist() == ["over"] * known + [""] * (12 - known)


def test_a_frame_without_receivers_has_no_rows() -> None:
    routing = Routing(("a",))
    for number in range(3):
        routing.take(routed(number, number=number))
    nothing = np.empty(0)
    none = {"receivers": (), "outcome": (), "distance_m": nothing, "rssi_dbm": nothing, "received_ns": nothing.astype(np.int64)}
    lonely = [replace(frame(number, "a", 0), **none) for number in range(3)]
    table = routing.table(radio_table(lonely, replace(FACTS, vehicles=("a",))))
    assert table.num_rows == 0
    assert routing.metrics()["delivery_ratio"] is None


def test_a_failure_of_routing_keeps_the_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    """A second attempt still finds the frames."""
    info = RunInfo(scenario="test", seed=1, duration_ns=10**10, vehicles=NAMES)
    recorder = Recorder(info, record_ticks=Ticks.every(0.1), mcap=None, agents=[], radius_m={})
    recorder.on(Event("radio/routed", 0, routed(to="c")))
    for each in REPORTS:
        recorder.on(Event("radio/frame", each.sent_ns, each))
    recorder.close(10**10)
    with monkeypatch.context() as patch:
        patch.setattr(Routing, "table", lambda self, radio: 1 // 0)
        with pytest.raises(ZeroDivisionError):
            recorder.metrics(window=(0.0, None))
    assert recorder.radio.num_rows == 12
