"""Programs and a run: kernel, radio, bridge process and sockets."""

import socket
import subprocess
import sys
import textwrap
import threading
import time
from typing import Any

import numpy as np
import pytest

from tests.support.cosim.receptions import receptions_in
from tests.support.netsim.bridge_runs import (
    BROADCAST,
    BridgeRun,
    PlainFederate,
    background_run,
    receive_all,
    receive_available,
    receive_each_of,
    wait_for,
)
from tests.support.netsim.gateway_context import PATIENCE_S
from vcmvsp.cosim.clock import SECOND_NS, WallClock
from vcmvsp.cosim.errors import FederateError
from vcmvsp.cosim.federate import Event, Releasable, RunInfo, Slot, Step
from vcmvsp.cosim.types import Message
from vcmvsp.cosim.util.codec import encode

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

MS = 1_000_000


def test_a_scenario_that_is_only_checked_opens_nothing() -> None:
    run = BridgeRun("a", "b", connect=False)
    assert isinstance(run.bridge, Releasable)
    run.kernel.start()
    with run.program(0), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(run.port(0, BROADCAST))
    assert run.bridge.fileno() == -1
    assert not run.bridge.poll(0)
    run.kernel.close()
    assert run.lines == []


def test_arrivals_equal_the_radios_reports_datagram_by_datagram() -> None:
    count = 1000
    run = BridgeRun("a", "b", "c", loss={"probability": 0.3}, delay={"seconds": 0.002, "jitter_s": 0.004})
    with run.program(1) as b, run.program(2) as c, background_run(run):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as a:
            for k in range(count):
                a.sendto(b"%d" % k, run.port(0, BROADCAST if k % 3 else 3))
                time.sleep(0.0001)
        wait_for(lambda: len(run.reports) == count)
        wait_for(lambda: run.left == sum(int((report.received_ns >= 0).sum()) for report in run.reports))
        received = {1: [int(each) for each in receive_available(b)], 2: [int(each) for each in receive_available(c)]}
    payloads: dict[int, int] = {}  # by number: sockets are read in turn, each in its order
    for to, own in ((-1, [k for k in range(count) if k % 3]), (2, [k for k in range(count) if not k % 3])):
        numbers = np.concatenate([value.number[value.to == to] for _, value in run.sent])
        payloads |= dict(zip(numbers.tolist(), own, strict=True))
    expected: dict[int, list[int]] = {1: [], 2: []}
    for report, number in zip(run.reports, run.carries, strict=True):
        assert report.receivers == (("b", "c") if payloads[number] % 3 else ("c",))
        for name, at_ns in zip(report.receivers, report.received_ns.tolist(), strict=True):
            if at_ns >= 0:
                expected["abc".index(name)].append(payloads[number])
    lateness, rows = run.bridge.lateness, run.bridge.table().to_pylist()
    for place in (1, 2):
        assert sorted(received[place]) == sorted(expected[place])
        left = [each for each in rows if each["receiver"] == "abc"[place]]
        left.sort(key=lambda each: each["wanted_ns"] + round(each["late_s"] * SECOND_NS))
        assert received[place] == [payloads[each["number"]] for each in left]
    assert lateness["datagrams"] == count
    assert lateness["delivered"] == len(received[1]) + len(received[2]) == len(rows)
    assert lateness["lost"] == sum(int((report.received_ns < 0).sum()) for report in run.reports) > 0
    frames = {report.frame: report for report in run.reports}
    for row in rows:
        report = frames[row["frame"]]
        place = report.receivers.index(row["receiver"])
        assert (row["sender"], row["came_ns"], row["wanted_ns"]) == ("a", report.sent_ns, report.received_ns[place])
        assert row["late_s"] >= 0.0


def test_datagrams_enter_when_they_came_in_order_and_none_before_the_beginning_or_after_it_was_taken() -> None:
    clock = WallClock()
    run = BridgeRun("a", "b", clock=clock)
    log, taken_ns = run.bridge._log, list[int]()

    def note(*entry: Any) -> None:
        log(*entry)
        taken_ns.append(clock.logical_ns(time.monotonic_ns()))  # of a late run, not the time that it believes

    run.bridge._log = note
    with run.program(1) as b, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as a:

        def early() -> None:
            a.sendto(b"early", run.port(0, BROADCAST))
            time.sleep(0.05)

        run.go(early)
        try:
            assert b.recv(100) == b"early"
            program_times_ns = []
            for _ in range(50):
                program_times_ns.append(time.monotonic_ns())
                a.sendto(b"x", run.port(0, BROADCAST))
            receive_all(b, 50)
        finally:
            run.stop()
    assert run.error is None
    first, *times = np.concatenate([value.sent_ns for _, value in run.sent]).tolist()
    assert first == 0
    assert times == sorted(times)
    for sent_ns, program_ns in zip(times, program_times_ns, strict=True):
        assert sent_ns >= clock.logical_ns(program_ns) - MS  # by two clocks
    assert all(value.sent_ns.max() <= now_ns for (_, value), now_ns in zip(run.sent, taken_ns, strict=True))
    assert [(key, time_ns) for key, time_ns, _ in run.logged] == [("bridge/sent", now_ns) for now_ns, _ in run.sent]
    assert [value for *_, value in run.logged] == [value for _, value in run.sent]


def test_a_flooding_program_costs_others_no_datagram() -> None:
    run = BridgeRun("a", "b", "c", "d")
    flood = textwrap.dedent("""
        import socket, sys
        s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        while True:
            s.sendto(bytes(1400), ("127.0.0.1", int(sys.argv[1])))
    """)
    with run.program(1) as b, background_run(run):
        flooding = subprocess.Popen([sys.executable, "-c", flood, str(run.port(2, 4)[1])])
        try:
            wait_for(lambda: len(run.reports) > 1000)
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as a:
                for k in range(300):
                    a.sendto(b"%d" % k, run.port(0, 2))
                    time.sleep(0.001)
                assert receive_all(b, 300) == [b"%d" % k for k in range(300)]
        finally:
            flooding.kill()
            flooding.wait()
    counts: dict[str, dict[str, int]] = run.bridge.lateness["counts"]
    assert set(counts) <= {"c"}  # no other loss on the way to the radio


def test_ports_in_use_end_the_run_before_it_begins_and_leave_no_process() -> None:
    run = BridgeRun("a", "b")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(run.port(1, BROADCAST))
        with pytest.raises(FederateError, match=rf"bridge: bridge.udp: port {run.port(1, 0)[1]} of 127.0.0.1 cannot be opened"):
            run.go()
    assert run.bridge._process is not None
    assert run.bridge._process._process.returncode is not None


class Agents(PlainFederate):
    """Sends for its vehicles ten times a second, and collects the receptions."""

    name, slot, wake_slot = "agents", Slot.AGENT, Slot.AGENT
    reads: tuple[str, ...] = ("radio/receptions",)

    def __init__(self, says: dict[str, Any]) -> None:
        self.says = says
        self.receptions: list[Event] = []

    def start(self, run: RunInfo) -> int:
        self._end_ns = run.duration_ns
        return 100_000_000

    def step(self, now_ns: int, inbox: Any) -> Step:
        self.receptions += inbox
        said = [Message(sender=name, body=body, size_bytes=20) for name, body in self.says.items()]
        events = [Event(f"{each.sender}/send", now_ns, each) for each in said]
        return Step(events, min(self._end_ns, now_ns + 100_000_000))


def test_programs_and_agents_hear_each_other_and_nothing_twice() -> None:
    agents = Agents({"a": {"x": 1.5}, "b": b"said"})
    program_payloads, agent_payload = [b"", b"said", b"one", b"two"], encode({"x": 1.5})
    run = BridgeRun("a", "b", "c", hear=True, agents=[agents], delay={"seconds": 0.005})

    def by_agents() -> list[tuple[str, str, bytes]]:
        return [
            (vehicle, each.message.sender, each.message.body)
            for vehicle, each in receptions_in(agents.receptions)
            if each.message.sender == "a" and isinstance(each.message.body, bytes)
        ]

    with run.program(1) as b, run.program(2) as c:
        with background_run(run), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as a:
            for payload in program_payloads:
                a.sendto(payload, run.port(0, BROADCAST))
            received_b, received_c = (receive_each_of(each, [*program_payloads, agent_payload]) for each in (b, c))
            wait_for(lambda: len(by_agents()) >= 2 * 3)
        received_b += receive_available(b)
        received_c += receive_available(c)
    assert [each for each in received_b if each in program_payloads] == program_payloads
    assert {each for each in received_b if each not in program_payloads} == {agent_payload}
    assert received_c.count(b"one") == received_c.count(b"two") == received_c.count(b"") == 1
    assert sorted(by_agents()) == sorted((name, "a", each) for name in "bc" for each in program_payloads if each)


def test_datagrams_contend_for_the_air_as_frames_of_agents_do() -> None:
    run = BridgeRun("a", "b", "c", preset="wifi-g-54", mac={"kind": "dcf"})
    with run.program(2) as c, background_run(run), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as program:
        for k in range(200):
            program.sendto(b"a%d" % k, run.port(0, 3))
            program.sendto(b"b%d" % k, run.port(1, 3))
        received = receive_all(c, 400)
    assert [each for each in received if each.startswith(b"a")] == [b"a%d" % k for k in range(200)]
    assert [each for each in received if each.startswith(b"b")] == [b"b%d" % k for k in range(200)]
    assert max(report.access_ns for report in run.reports) > 0
    assert run.bridge.lateness["delivered"] == 400


@pytest.mark.parametrize("speed", [0.5, 2.0])
def test_at_another_speed_delays_are_so_much_shorter_on_the_wall_clock(speed: float) -> None:
    run = BridgeRun("a", "b", clock=WallClock(speed), delay={"seconds": 0.1})
    took_s = []
    with run.program(1) as b, background_run(run), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as a:
        for _ in range(3):
            began = time.monotonic()
            a.sendto(b"x", run.port(0, 2))
            assert b.recv(100) == b"x"
            took_s.append(time.monotonic() - began)
    assert min(took_s) >= 0.1 / speed
    assert all(row["wanted_ns"] - row["came_ns"] == 100_000_000 for row in run.bridge.table().to_pylist())


class Halting(PlainFederate):
    """Blocks the run once, at 0.5 s, until it is released."""

    name, slot, wake_slot = "halting", Slot.AGENT, Slot.AGENT

    def __init__(self) -> None:
        self.halts, self.goes_on = threading.Event(), threading.Event()

    def start(self, run: RunInfo) -> int:
        return 500_000_000

    def step(self, now_ns: int, inbox: Any) -> Step:
        self.halts.set()
        assert self.goes_on.wait(PATIENCE_S)
        return Step([], None)


def test_datagrams_during_a_pause_get_the_time_of_the_pause() -> None:
    halting = Halting()
    run = BridgeRun("a", "b", agents=[halting], delay={"seconds": 0.1})
    run.kernel._tolerance_ns = 100 * MS
    with background_run(run), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as a:

        def say(often: int) -> None:
            for _ in range(often):
                a.sendto(b"x", run.port(0, 2))
                time.sleep(0.01)

        assert halting.halts.wait(PATIENCE_S)
        say(60)
        halting.goes_on.set()
        wait_for(lambda: sum(len(value.number) for _, value in run.sent) == 60)
        say(10)
        wait_for(lambda: sum(len(value.number) for _, value in run.sent) == 70)
    assert run.kernel._clock.slipped_ns > 400 * MS
    sent_ns = np.concatenate([value.sent_ns for _, value in run.sent])
    assert sent_ns[0] >= 500 * MS  # and not long before
    assert sent_ns[59] <= 700 * MS  # nor when it resumed: its next instant is at 0.6 s
    assert (np.diff(sent_ns) >= 0).all()
    assert all(row["late_s"] is None or row["late_s"] >= 0.0 for row in run.bridge.table().to_pylist())
