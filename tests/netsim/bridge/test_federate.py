"""The bridge's federate alone: the test stands in for the bridge process, the clock and the kernel."""

import time
from collections.abc import Callable, Sequence
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.netsim.channels import at_rest
from vcmvsp.cosim.federate import Event, RunInfo
from vcmvsp.cosim.received import receptions_at
from vcmvsp.cosim.types import RECEPTIONS, Array, Datagrams, Message, Reception, Traffic
from vcmvsp.netsim.bridge import messages
from vcmvsp.netsim.bridge.deliveries import Columns, Lateness
from vcmvsp.netsim.bridge.federate import AGAIN_NS, BEHIND_NS, PATIENCE_NS, Bridge
from vcmvsp.netsim.bridge.gateways.base import LARGEST

MS = 1_000_000
RUN = RunInfo(scenario="test", seed=1, duration_ns=10**10, vehicles=("a", "b"))


class Beside:
    """Stand-in for the bridge process."""

    has_outbox = False

    def __init__(self) -> None:
        self.says: list[Any] = []
        self.received: list[Any] = []

    def send_outbox(self) -> None:
        pass

    def read(self) -> list[Any]:
        pending, self.says = self.says, []
        return pending

    def send(self, message: Any) -> None:
        self.received.append(message)

    @property
    def spoken(self) -> list[messages.AgentDatagram]:
        return [each for each in self.received if isinstance(each, messages.AgentDatagram)]


class Clock:
    """A clock ``ahead_ns`` of the machine's that runs at a multiple of its rate."""

    ahead_ns = 0

    speed = 1

    def logical_ns(self, monotonic_ns: int) -> int:
        return self.speed * (monotonic_ns + self.ahead_ns)

    def monotonic_ns(self, logical_ns: int) -> int:
        return logical_ns // self.speed - self.ahead_ns


def made(
    air: Any = None,
    *,
    gateways: Sequence[messages.GatewaySpec] = (),
    agents: bool = False,
    tell: Callable[[str], None] = print,
) -> tuple[Bridge, Any, Clock]:
    clock: Any = Clock()
    bridge = Bridge(
        gateways,
        run="test",
        folder=".",
        vehicles=RUN.vehicles,
        agents=agents,
        levels_dbm=air,
        clock=clock,
        tell=tell,
        log=lambda *_: None,
        connect=False,
    )
    bridge.start(RUN)
    bridge._process = process = cast("Any", Beside())
    return bridge, process, clock


def came(first: int, *rows: tuple[int, int]) -> messages.NewDatagrams:
    """Sender and time of each broadcast."""
    sender, came_ns = np.array(rows, np.int64).T
    n = len(rows)
    return messages.NewDatagrams(
        number=np.arange(first, first + n),
        gateway=np.zeros(n, np.int32),
        sender=sender.astype(np.int32),
        to=np.full(n, -1, np.int32),
        size_bytes=np.full(n, 10),
        came_ns=came_ns,
    )


def ints(*values: int) -> Array:
    return np.array(values, np.int64)


def traffic(*rows: tuple[int, int, int, int], settled: tuple[int, ...] = ()) -> Traffic:
    """Number, receiver, time and frame of each arrival."""
    number, receiver, arrival_ns, frame = np.array(rows, np.int64).reshape(-1, 4).T
    return Traffic(
        reports=(), carries=ints(), number=number, receiver=receiver, arrival_ns=arrival_ns, frame=frame, settled=ints(*settled)
    )


def sent(bridge: Bridge, now_ns: int) -> list[Datagrams]:
    found = []
    for event in bridge.step(now_ns, []).events:
        assert (event.key, event.time_ns) == ("bridge/sent", now_ns)
        assert isinstance(event.value, Datagrams)
        found.append(event.value)
    return found


def test_a_run_that_is_behind_catches_up_before_it_takes_more(monkeypatch: pytest.MonkeyPatch) -> None:
    bridge, process, clock = made()
    wall_ns = 5_000 * MS
    monkeypatch.setattr(time, "monotonic_ns", lambda: wall_ns)
    clock.ahead_ns = 1_000 * MS - wall_ns  # run time 1 s
    process.says = [came(0, (0, wall_ns))]
    assert bridge.poll(1_000 * MS)
    assert len(sent(bridge, 1_000 * MS)) == 1

    process.says = [came(1, (0, wall_ns))]
    wall_ns += BEHIND_NS + 2 * MS
    assert bridge.poll(1_001 * MS)
    step = bridge.step(1_001 * MS, [])
    assert (step.events, step.next_ns) == ([], 1_002 * MS + BEHIND_NS)  # after it has caught up
    assert bridge.step(1_001 * MS, []).events == []  # nor when it is woken again at this instant
    assert bridge.poll(1_022 * MS)
    assert len(sent(bridge, 1_022 * MS)) == 1

    process.says = [came(2, (0, wall_ns))]
    wall_ns += PATIENCE_NS
    assert bridge.poll(1_023 * MS)  # it never catches up: programs are served nevertheless
    assert len(sent(bridge, 1_023 * MS)) == 1
    assert [each.taken for each in process.received] == [1, 2, 3]


def test_lateness_is_measured_on_the_wall_clock_at_any_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    bridge, process, clock = made()
    clock.speed = 10
    wall_ns, now_ns = 500 * MS, 5_000 * MS
    monkeypatch.setattr(time, "monotonic_ns", lambda: wall_ns)
    process.says = [came(0, (0, wall_ns))]
    assert bridge.poll(now_ns)
    process.has_outbox = True
    step = bridge.step(now_ns, [])
    assert (len(step.events), step.next_ns) == (1, now_ns + 10 * AGAIN_NS)  # a millisecond later
    wall_ns += BEHIND_NS - MS  # ten times as much in run time
    process.says = [came(1, (0, wall_ns))]
    assert bridge.poll(now_ns)
    assert len(sent(bridge, now_ns)) == 1
    wall_ns += 2 * MS
    process.says = [came(2, (0, wall_ns))]
    bridge.poll(now_ns)
    assert sent(bridge, now_ns) == []


def test_levels_are_those_at_the_time_of_the_query() -> None:
    bridge, process, _ = made(lambda states: states.position[:, None, 0] + states.position[:, 0])
    process.says = [messages.LevelsRequest()]
    bridge.poll(MS)
    bridge.step(MS, [Event("world/states", 0, at_rest(("a", "b"), [(1.0, 0.0, 0.0), (5.0, 0.0, 0.0)]))])
    (levels,) = process.received
    assert (levels.first, levels.dbm.tolist()) == (0, [[2.0, 6.0], [6.0, 10.0]])


def heard_by_b(message: Message, at_ns: int) -> Event:
    reception = Reception(message=message, rssi_dbm=0.0, sent_ns=MS, received_ns=at_ns)
    return Event(RECEPTIONS, at_ns, receptions_at("b", [reception], ("a", "b")))


def test_messages_of_agents_too_long_for_a_datagram_are_counted() -> None:
    bridge, process, _ = made(agents=True)
    process.says = [messages.Counts(counts={"a": {"of the process": 1}}), messages.Counts(counts={"b": {"of the process": 2}})]
    bridge.poll(MS)
    for size in (LARGEST, LARGEST + 1, LARGEST + 2):
        message = Message(sender="a", body=bytes(size), size_bytes=4)
        bridge.step(3 * MS, [heard_by_b(message, 3 * MS)])
    assert [len(each.payload) for each in process.spoken] == [LARGEST]
    assert bridge.lateness["counts"] == {
        "a": {"of the process": 1},
        "b": {"of the process": 2, "sent by agents in more than 65535 bytes": 2},
    }


KILLED = "bridge: its process did not end in time and was killed"


@pytest.mark.parametrize(
    ("killed", "kind", "expected"),
    [
        (False, "ip", []),
        (True, "udp", [KILLED]),
        (True, "ip", [f"{KILLED}: 'vcmvsp net down' removes the networks that it left"]),
    ],
)
def test_a_killed_process_is_reported_with_the_command_that_cleans_up(killed: bool, kind: str, expected: list[str]) -> None:
    lines: list[str] = []
    bridge, process, _ = made(gateways=[messages.GatewaySpec(name=kind, kind=kind, params={})], tell=lines.append)
    process.killed, process.close = killed, list
    bridge.close()
    assert lines == expected


def test_equal_payloads_of_a_program_and_an_agent_are_distinguished() -> None:
    bridge, process, _ = made(agents=True)
    process.says = [msgspec.structs.replace(came(0, (0, 0)), payloads=(b"same",))]
    bridge.poll(MS)
    sent(bridge, MS)
    message = Message(sender="a", body=b"same", size_bytes=4)
    reception = heard_by_b(message, 3 * MS)
    arrival = Event("radio/traffic", 3 * MS, traffic((0, 1, 3 * MS, 0), settled=(0,)))
    bridge.step(3 * MS, [reception, arrival])  # ordered by key
    assert not process.spoken
    bridge.step(3 * MS, [reception])
    (spoken,) = process.spoken
    assert (spoken.sender, spoken.receiver, spoken.payload) == (0, 1, b"same")
    bridge.step(4 * MS, [heard_by_b(message, 4 * MS)])
    assert len(process.spoken) == 2


def test_datagrams_at_the_end_of_the_run_are_not_sent() -> None:
    bridge, process, _ = made()
    process.says = [came(0, (0, 0))]
    assert not bridge.poll(RUN.duration_ns)
    assert bridge.step(RUN.duration_ns, []).events == []


@given(st.lists(st.lists(st.tuples(st.integers(0, 1), st.integers(-50, 50)), min_size=1, max_size=8), max_size=8), st.data())
def test_datagrams_are_sent_when_they_came_however_late_the_instant_is_in_order_and_within_the_run(
    batches: list[list[tuple[int, int]]], data: st.DataObject
) -> None:
    bridge, process, clock = made()
    newest, now_ns, number = {0: 0, 1: 0}, 0, 0
    for rows in batches:
        now_ns += data.draw(st.integers(1, 60))
        clock.ahead_ns = now_ns - time.monotonic_ns()
        process.says = [came(number, *((sender, now_ns - clock.ahead_ns + offset) for sender, offset in rows))]
        number += len(rows)
        bridge._took_ns = 0  # however slow the machine is
        assert bridge.poll(now_ns)
        (datagrams,) = sent(bridge, now_ns)
        assert datagrams.sender.tolist() == [sender for sender, _ in rows]
        for (sender, offset), sent_ns in zip(rows, datagrams.sent_ns.tolist(), strict=True):
            assert sent_ns == max(newest[sender], now_ns + offset)
            newest[sender] = sent_ns


def test_a_run_that_catches_up_asks_for_one_instant_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each requested instant would be one at which it is asked again."""
    bridge, process, clock = made()
    wall_ns = 5_000 * MS
    monkeypatch.setattr(time, "monotonic_ns", lambda: wall_ns)
    clock.ahead_ns = 1_000 * MS - wall_ns
    process.says = [came(0, (0, wall_ns))]
    assert bridge.poll(1_000 * MS)
    sent(bridge, 1_000 * MS)
    process.says = [came(1, (0, wall_ns))]
    wall_ns += 2 * BEHIND_NS
    assert bridge.poll(1_001 * MS)
    again_ns = bridge.step(1_001 * MS, []).next_ns
    assert again_ns is not None
    for now_ns in range(1_002 * MS, again_ns - BEHIND_NS, MS):
        wall_ns += MS // 10
        assert not bridge.poll(now_ns)
        assert bridge.step(now_ns, []).next_ns == again_ns  # as when traffic wakes it
    assert bridge.poll(again_ns)
    assert len(sent(bridge, again_ns)) == 1


def test_growing_columns_keep_their_content() -> None:
    columns = Columns("a", "b")
    for k in range(5000):
        columns.add(a=ints(k))
    columns.reach(100)
    assert columns["a"].tolist() == list(range(5000))
    assert set(columns["b"].tolist()) == {-1}
    columns["b"][ints(3, 4999)] = ints(7, 8)
    assert columns["b"][4999] == 8


def test_deliveries_are_reported_with_their_frame_and_lateness() -> None:
    lateness = Lateness(("a", "b"))
    lateness.sent(ints(0, 2), ints(0, 1), ints(1, 0), ints(0, 1), ints(100, 200))
    lateness.sent(ints(1), ints(0), ints(1), ints(-1), ints(150))
    lateness.due(traffic((2, 1, 1_200, 41), (0, 0, 1_100, 40), settled=(0, 2)), ints(5_000_000, 6_000_000))
    lateness.due(traffic((1, 0, 1_300, 42), settled=(1,)), ints(9_000_000))
    lateness.delivered(ints(1, 0), ints(6_500_000, 8_000_000))
    summary = lateness.summary({"a": {"longer than max_bytes": 2}})
    assert summary == {
        "datagrams": 3,
        "delivered": 2,
        "lost": 0,
        "p50_s": (0.0005 + 0.003) / 2,
        "p99_s": summary["p99_s"],
        "max_s": 0.003,
        "over_1ms": 1,
        "counts": {"a": {"longer than max_bytes": 2}},
    }
    first, second, third = lateness.table(("udp", "wss")).to_pylist()
    row = {"number": 2, "frame": 41, "door": "wss", "sender": "a", "receiver": "b", "came_ns": 200}
    assert first == {**row, "wanted_ns": 1_200, "late_s": 0.003}
    row = {"number": 0, "frame": 40, "door": "udp", "sender": "b", "receiver": "a", "came_ns": 100}
    assert second == {**row, "wanted_ns": 1_100, "late_s": 0.0005}
    assert (third["number"], third["frame"], third["late_s"]) == (1, 42, None)  # the run ended before


def test_losses_are_counted_per_intended_receiver() -> None:
    lateness = Lateness(tuple("abcd"))
    to_all, to_one = -1, 2
    lateness.sent(ints(0, 1, 2), ints(0, 0, 0), ints(0, 0, 0), ints(to_all, to_one, to_all), ints(1, 2, 3))
    lateness.due(traffic((0, 1, 10, 7), (0, 1, 12, 7)), ints(10, 12))  # duplicated on its way
    assert lateness.summary({})["lost"] == 0  # the others may still receive it
    lateness.due(traffic((0, 3, 20, 9), settled=(0, 1)), ints(20))
    assert lateness.summary({})["lost"] == 1 + 1  # the first at c, the second at c
    assert lateness.table(("udp",))["frame"].to_pylist() == [7, 7, 9]


def test_a_run_in_which_nothing_was_sent_has_no_lateness() -> None:
    summary = Lateness(("a",)).summary({})
    assert (summary["datagrams"], summary["delivered"], summary["p50_s"], summary["max_s"]) == (0, 0, None, None)
    assert Lateness(("a",)).table(("udp",)).num_rows == 0
