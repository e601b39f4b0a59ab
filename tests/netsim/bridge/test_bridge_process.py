"""The bridge process alone, driven by the test, and the run's side of it."""

import asyncio
import contextlib
import itertools
import os
import select
import signal
import socket
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from tests.support.netsim.bridge_runs import wait_for
from tests.support.netsim.gateway_context import PATIENCE_S, free_ports
from vcmvsp.cosim.errors import FederateError
from vcmvsp.cosim.util.codec import encode
from vcmvsp.netsim.bridge import messages, process_client
from vcmvsp.netsim.bridge.bridge_process import BridgeProcess
from vcmvsp.netsim.bridge.datagram_store import BATCH_OF_ONE, MOST
from vcmvsp.netsim.bridge.process_client import BridgeClient

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

VEHICLES = ("a", "b", "c")
PROBE = """
from pathlib import Path


class Probe:
    def __init__(self, out: str, fails: str = "") -> None:
        self.out, self.fails = Path(out), fails

    def check(self, vehicles):
        pass

    async def open(self, context):
        self.context = context
        if self.fails == "open":
            raise RuntimeError("no luck")
        context.loop.call_soon(self.turn)
        context.offer(self, 0, 1, b"to one")
        context.offer(self, 0, -1, b"to all")
        return ["probe is open"]

    def turn(self):
        level = self.context.level_dbm(0, 2)
        if level == level:
            self.say(f"level {level}")
        else:
            self.context.loop.call_later(0.005, self.turn)

    def say(self, line):
        with self.out.open("a") as file:
            file.write(line + "\\n")

    def deliver(self, sender, receiver, payload):
        if self.fails == "deliver":
            raise RuntimeError("no luck")
        self.say(f"delivered {sender} {receiver} {payload!r}")

    def lost(self, sender, receiver, payload):
        self.say(f"lost {sender} {receiver} {payload!r}")

    async def close(self):
        self.say("closed")
"""


def opening(*gateways: messages.GatewaySpec, folder: Path | str = ".", **keys: Any) -> messages.Opening:
    known: dict[str, Any] = {"run": "test", "vehicles": VEHICLES, "payloads": False, **keys}
    return messages.Opening(folder=str(folder), gateways=gateways, **known)


def udp(first: int, **params: Any) -> messages.GatewaySpec:
    return messages.GatewaySpec(name="udp", kind="udp", params={"first_port": first, **params})


@pytest.fixture
def probe(tmp_path: Path) -> messages.GatewaySpec:
    (tmp_path / "probe.py").write_text(PROBE)
    return messages.GatewaySpec(name="probe", kind="probe.py:Probe", params={"out": str(tmp_path / "out.txt")})


Start = Callable[..., BridgeClient]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Starts bridge processes, which are closed at the end."""
    with contextlib.ExitStack() as processes:

        def started(*gateways: messages.GatewaySpec, **keys: Any) -> BridgeClient:
            process = BridgeClient.start(opening(*gateways, folder=tmp_path, **keys))
            processes.callback(process.close)
            return process

        yield started


def due(*rows: tuple[int, int, int], taken: int = 0, settled: tuple[int, ...] = ()) -> messages.Deliveries:
    number, receiver, at_ns = np.array(rows, np.int64).reshape(-1, 3).T
    return messages.Deliveries(
        taken=taken, number=number, receiver=receiver.astype(np.int32), at_ns=at_ns, settled=np.array(settled, np.int64)
    )


def hear(process: BridgeClient, kind: type, seconds: float = PATIENCE_S) -> Any:
    """Next message of this kind."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        select.select([process], [], [], end - time.monotonic())
        for message in process.read():
            if isinstance(message, kind):
                return message
    raise AssertionError(f"no {kind.__name__}")


def test_a_custom_gateway_gets_deliveries_losses_and_levels(probe: messages.GatewaySpec, tmp_path: Path, start: Start) -> None:
    def output_lines() -> list[str]:
        file = tmp_path / "out.txt"
        return file.read_text().splitlines() if file.exists() else []

    process = start(probe, payloads=True)
    assert process.wait_ready() == ("bridge.probe: probe is open",)
    received = process.read()
    while not {messages.NewDatagrams, messages.LevelsRequest} <= {type(each) for each in received}:
        select.select([process], [], [], 10.0)
        received += process.read()
    (came,) = [each for each in received if isinstance(each, messages.NewDatagrams)]
    assert (came.sender.tolist(), came.to.tolist(), came.payloads) == ([0, 0], [1, -1], (b"to one", b"to all"))
    process.send(messages.LevelRows(first=1, dbm=np.arange(3.0, 9.0).reshape(2, 3)))
    process.send(messages.LevelRows(first=0, dbm=np.arange(3.0).reshape(1, 3)))
    wait_for(lambda: output_lines() == ["level 2.0"])
    os.kill(process.pid, signal.SIGSTOP)  # they arrive together, however long sending takes
    now_ns = time.monotonic_ns()
    process.send(due((1, 2, now_ns + 20_000_000), (1, 1, now_ns + 10_000_000), taken=2, settled=(0, 1)))
    process.send(messages.AgentDatagram(sender=2, receiver=0, at_ns=now_ns + 15_000_000, payload=b"said"))
    os.kill(process.pid, signal.SIGCONT)
    wait_for(lambda: len(output_lines()) == 5)
    assert output_lines()[1:] == [
        "lost 0 1 b'to one'",
        "delivered 0 1 b'to all'",
        "delivered 2 0 b'said'",
        "delivered 0 2 b'to all'",
    ]
    process.leave()
    deliveries = [each for each in process.close() if isinstance(each, messages.Delivered)]
    first, second = np.concatenate([each.due for each in deliveries]).tolist()
    assert (first, second) == (1, 0)  # messages of agents are not counted
    assert (np.concatenate([each.at_ns for each in deliveries]) >= now_ns + np.array([10_000_000, 20_000_000])).all()
    assert output_lines()[-1] == "closed"


def test_a_gateway_that_cannot_open_ends_the_bridge_before_later_gateways(
    probe: messages.GatewaySpec, tmp_path: Path, start: Start
) -> None:
    second = messages.GatewaySpec(name="second", kind="probe.py:Probe", params={"out": str(tmp_path / "second.txt")})
    probe.params["fails"] = "open"
    process = start(probe, second)
    with pytest.raises(FederateError, match=r"bridge: bridge.probe: RuntimeError: no luck \(probe.py line \d+, in open\)"):
        process.wait_ready()
    assert (tmp_path / "out.txt").read_text() == "closed\n"
    process.close()
    assert not (tmp_path / "second.txt").exists()


class Deaf:
    """Link to a run that does not read."""

    def __init__(self, *says: messages.Down) -> None:
        self.says, self.ended = [encode(each) for each in says], False
        self.reads = False
        self.received: list[bytes] = []

    def wait(self, seconds: float) -> None:
        pass

    def receive(self) -> list[bytes]:
        pending, self.says = self.says, []
        return pending

    def send(self, message: bytes) -> bool:
        if self.reads:
            self.received.append(message)
        return self.reads


async def test_counts_are_sent_once_when_the_run_reads_again() -> None:
    link: Any = Deaf(opening())
    process = BridgeProcess(link, asyncio.get_running_loop())
    process._opening()
    for k in range(50):
        process.count(k % 2, "too long")
        process._report()
    assert len(process._outbox) == 1
    link.reads = True
    process._send_outbox()
    process._report()
    reports = [messages.ups.decode(each) for each in link.received]
    counts: dict[str, dict[str, int]] = {}
    for each in reports:
        assert isinstance(each, messages.Counts)
        counts |= each.counts
    assert counts == {"a": {"too long": 25}, "b": {"too long": 25}}
    assert len(reports) == 2


def test_a_message_too_long_for_the_link_is_an_error(probe: messages.GatewaySpec, tmp_path: Path, start: Start) -> None:
    (tmp_path / "probe.py").write_text(PROBE.replace('return ["probe is open"]', 'return ["x" * 1_000_000]'))
    process = start(probe)
    with pytest.raises(FederateError, match=r"bridge: ValueError: a message of 1000\d+ bytes is too long for the link"):
        process.wait_ready()


async def test_counts_of_many_vehicles_are_split_into_messages() -> None:
    link: Any = Deaf(opening(vehicles=tuple(f"vehicle{k}" for k in range(3000))))
    link.reads = True
    process = BridgeProcess(link, asyncio.get_running_loop())
    process._opening()
    for row in range(3000):
        for kind in range(8):
            process.count(row, f"what there is no room for, of kind {kind}")
    process._report_counts()
    assert max(map(len, link.received)) < 100_000
    reports: list[Any] = [messages.ups.decode(each) for each in link.received]
    assert sum(len(each.counts) for each in reports) == 3000


@pytest.mark.parametrize("error", ["RuntimeError", "OSError"])
def test_an_error_of_a_gateway_that_delivers_ends_the_bridge_with_its_name(
    error: str, probe: messages.GatewaySpec, tmp_path: Path, start: Start
) -> None:
    """Also an error of the operating system, which the bridge's own link may raise."""
    probe.params["fails"] = "deliver"
    (tmp_path / "probe.py").write_text(PROBE.replace('RuntimeError("no luck")', f'{error}("no luck")'))
    process = start(probe)
    process.wait_ready()
    process.send(messages.AgentDatagram(sender=0, receiver=1, at_ns=0, payload=b"said"))
    with pytest.raises(FederateError, match=rf"bridge: bridge.probe: {error}: no luck \(probe.py line \d+, in deliver\)"):
        hear(process, messages.Delivered)


def test_an_unknown_kind_of_gateway_is_refused(start: Start) -> None:
    process = start(messages.GatewaySpec(name="udp", kind="udb", params={}))
    with pytest.raises(FederateError, match=r"bridge.udp.kind: unknown door kind 'udb'; did you mean 'udp'\?"):
        process.wait_ready()


def test_batches_wait_for_the_one_before_and_the_excess_stays_in_the_socket(start: Start) -> None:
    first = free_ports(300)
    process = start(udp(first))
    process.wait_ready()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as program:
        for _ in range(MOST + 1000):
            program.sendto(b"x", ("127.0.0.1", first))
    came = hear(process, messages.NewDatagrams)
    time.sleep(0.1)
    assert process.read() == []
    numbers = came.number.tolist()
    assert len(numbers) <= BATCH_OF_ONE
    while len(numbers) < MOST:
        process.send(due(taken=len(numbers)))
        numbers += hear(process, messages.NewDatagrams).number.tolist()
    process.send(due(taken=MOST))
    time.sleep(0.1)
    assert process.read() == []  # nothing is acknowledged: there is no room for more
    process.send(due(taken=MOST, settled=tuple(range(1000))))
    while len(numbers) < MOST + 1000:
        numbers += hear(process, messages.NewDatagrams).number.tolist()
        process.send(due(taken=len(numbers)))
    assert numbers == list(range(MOST + 1000))


def test_the_process_ends_with_the_run_however_that_ended() -> None:
    first = free_ports(300)
    process = BridgeClient.start(opening(udp(first)))
    process.wait_ready()
    process._link.close()  # as the operating system does with a killed process
    assert process._process.why_ended(PATIENCE_S) == "ended with exit code 0"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as program:
        program.bind(("127.0.0.1", first))


@pytest.mark.parametrize(
    ("number", "words"), [(signal.SIGKILL, "was killed by SIGKILL"), (signal.SIGTERM, "it received SIGTERM")]
)
def test_the_end_of_the_process_is_reported_with_its_signal(number: signal.Signals, words: str, start: Start) -> None:
    process = start(udp(free_ports(300)))
    process.wait_ready()
    os.kill(process.pid, number)
    with pytest.raises(FederateError, match=f"bridge: .*{words}"):
        hear(process, messages.NewDatagrams)


def test_ctrl_c_does_not_end_the_process(start: Start) -> None:
    process = start(udp(first := free_ports(300)))
    process.wait_ready()
    os.kill(process.pid, signal.SIGINT)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as program:
        program.sendto(b"x", ("127.0.0.1", first))
    assert hear(process, messages.NewDatagrams).number.tolist() == [0]


def test_the_process_can_be_closed_before_its_gateways_are_open(monkeypatch: pytest.MonkeyPatch, start: Start) -> None:
    monkeypatch.setattr("vcmvsp.netsim.bridge.process_client.CLOSE_S", PATIENCE_S)  # a process may be slow to begin
    process = start(udp(free_ports(300)))
    process.leave()
    process.close()
    assert process._process.returncode == 0


def test_a_process_that_does_not_read_is_ended_and_never_blocks_the_run(start: Start) -> None:
    process = start(udp(free_ports(300)))
    process.wait_ready()
    os.kill(process.pid, signal.SIGSTOP)
    datagram = messages.AgentDatagram(sender=0, receiver=1, at_ns=0, payload=bytes(60_000))
    with pytest.raises(FederateError, match=rf"bridge: its process \(pid {process.pid}\) no longer reads its messages"):
        deque(map(process.send, itertools.repeat(datagram)), 0)
    assert process.has_outbox
    process._process.kill()


STEP_S = 7.0


class Silent:
    """Link without messages, which records the timeout of each wait; a negative timeout would never end."""

    ended = False

    def __init__(self) -> None:
        self.waits: list[float] = []

    def wait(self, seconds: float) -> None:
        self.waits.append(seconds)

    def receive(self) -> list[bytes]:
        return []

    def send(self, message: bytes) -> bool:
        return True

    def close(self) -> None:
        pass


@pytest.fixture
def slow_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock that advances by seconds between two readings."""
    now = itertools.count(0.0, STEP_S)
    monkeypatch.setattr(process_client, "time", SimpleNamespace(monotonic=lambda: next(now)))


def silent() -> tuple[BridgeClient, Silent]:
    link = Silent()
    process = SimpleNamespace(pid=1, link=link, close=lambda _: False)
    return BridgeClient(cast("Any", process), opening(vehicles=("a",))), link


def test_gateways_that_do_not_open_in_time_are_reported(slow_clock: None) -> None:
    waiting, link = silent()
    with pytest.raises(FederateError, match="its gateways did not open within 60 s"):
        waiting.wait_ready()
    assert len(link.waits) == pytest.approx(process_client.READY_S / STEP_S, abs=1.0)
    assert min(link.waits) > 0.0


def test_a_process_that_does_not_end_in_time_is_killed(slow_clock: None) -> None:
    waiting, link = silent()
    assert waiting.close() == []
    assert waiting.killed
    assert link.waits
    assert min(link.waits) > 0.0
