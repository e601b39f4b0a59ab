"""Minimal runs with a bridge: vehicles at rest, their radios, and the test's agents."""

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from tests.support.netsim.channels import at_rest, make_channel
from tests.support.netsim.gateway_context import PATIENCE_S, free_ports
from vcmvsp.cosim.clock import SECOND_NS, Clock, WallClock
from vcmvsp.cosim.federate import Event, Federate, RunInfo, Slot, Step
from vcmvsp.cosim.kernel.kernel import Kernel
from vcmvsp.cosim.types import Array, Datagrams, FrameReport, States, Traffic
from vcmvsp.netsim.bridge.federate import Bridge
from vcmvsp.netsim.bridge.messages import GatewaySpec
from vcmvsp.netsim.federate import RadioFederate

BROADCAST, RECEIVE = 0, 99  # per vehicle


class PlainFederate:
    """A federate that reads nothing and holds nothing."""

    reads: tuple[str, ...] = ()
    latest: tuple[str, ...] = ()
    wakes: tuple[str, ...] = ()

    def close(self) -> None:
        pass


class VehiclesAtRest(PlainFederate):
    """Publishes at time 0 positions 10 m apart, and steps ten times a second."""

    name, slot, wake_slot = "world", Slot.WORLD, Slot.APPLY

    def start(self, run: RunInfo) -> int | None:
        self._names, self._end_ns = run.vehicles, run.duration_ns
        return 0

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        states = at_rest(self._names, [(10.0 * row, 0.0, 0.0) for row in range(len(self._names))])
        events = [Event("world/states", 0, states)] if now_ns == 0 else []
        return Step(events, now_ns + SECOND_NS // 10 if now_ns < self._end_ns else None)


class Air(RadioFederate):
    """A radio whose levels are given by rows."""

    def levels_dbm(self, states: States) -> Array:
        n = len(self._vehicles)
        return -10.0 * np.arange(n)[:, None] - np.arange(n)[None, :]


class BridgeRun:
    """A run in a thread of its own (`go`, `stop`); afterwards, `sent` and `reports` hold its published values.

    During the run, `left` counts its deliveries; the bridge's own reports are complete after the end.
    """

    def __init__(
        self,
        *vehicles: str,
        gateways: Sequence[GatewaySpec] | None = None,
        seconds: float = 60.0,
        agents: Sequence[Federate] = (),
        hear: bool = False,
        clock: Clock | None = None,
        connect: bool = True,
        folder: str = ".",
        udp: dict[str, Any] | None = None,
        preset: str = "ideal",
        **channel: Any,
    ) -> None:
        self.first_port = free_ports(100 * len(vehicles)) if gateways is None else 0
        params = {"first_port": self.first_port, **(udp or {})}
        gateways = [GatewaySpec(name="udp", kind="udp", params=params)] if gateways is None else gateways
        self.lines: list[str] = []
        self.logged: list[tuple[str, int, Any]] = []
        self.sent: list[tuple[int, Datagrams]] = []
        self.reports: list[FrameReport] = []
        self.carries: list[int] = []
        self.events: list[Event] = []
        self.left = 0  # deliveries that have left the bridge
        self.error: BaseException | None = None
        air = Air(make_channel(preset, vehicles=vehicles, **channel))
        clock = clock or WallClock()
        self.bridge = Bridge(
            gateways,
            run="test",
            folder=folder,
            vehicles=vehicles,
            agents=hear,
            levels_dbm=air.levels_dbm,
            clock=clock,  # type: ignore[arg-type]  # one that has these times
            tell=self.lines.append,
            log=self.log,
            connect=connect,
        )
        self._delivered = self.bridge._late.delivered
        self.bridge._late.delivered = self._on_delivered  # type: ignore[method-assign]
        info = RunInfo(scenario="test", seed=1, duration_ns=round(seconds * SECOND_NS), vehicles=vehicles, paced=True)
        self.kernel = Kernel(info, [VehiclesAtRest(), air, self.bridge, *agents], clock=clock)

    def log(self, key: str, time_ns: int, value: Any) -> None:
        """Store the inputs that a replay needs."""
        self.logged.append((key, time_ns, value))

    def go(self, before: Callable[[], object] = lambda: None) -> None:
        """Open all gateways, run ``before`` ahead of time 0, and begin."""
        try:
            self.kernel.start()
            before()
        except BaseException:
            self.kernel.close()
            raise
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def stop(self) -> None:
        """End the run, as by Ctrl-C."""
        self.kernel.stop = True
        self._thread.join()

    def join(self) -> None:
        """Wait for the end of the run."""
        self._thread.join()

    def _run(self) -> None:
        try:
            self.kernel.run(self._observe)
        except KeyboardInterrupt:
            pass
        except BaseException as error:
            self.error = error
        finally:
            self.kernel.close()

    def _observe(self, event: Event) -> None:
        if isinstance(event.value, Datagrams):
            self.sent.append((event.time_ns, event.value))
        elif isinstance(event.value, Traffic):
            self.reports += event.value.reports
            self.carries += event.value.carries.tolist()
        else:
            self.events.append(event)

    def _on_delivered(self, row: Array, at_ns: Array) -> None:
        self._delivered(row, at_ns)
        self.left += len(row)

    def port(self, vehicle: int, offset: int) -> tuple[str, int]:
        """Port in a vehicle's block: 0 broadcast, 1 + j to vehicle j, 99 for receptions."""
        return "127.0.0.1", self.first_port + 100 * vehicle + offset

    def program(self, vehicle: int) -> socket.socket:
        """A socket that receives what this vehicle's radio receives."""
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 * 2**20)
        opened.bind(self.port(vehicle, RECEIVE))
        opened.settimeout(PATIENCE_S)
        return opened


@contextlib.contextmanager
def background_run(run: BridgeRun) -> Iterator[BridgeRun]:
    """The running run; stopped at the end, if it has not failed."""
    run.go()
    try:
        yield run
    finally:
        run.stop()
    if run.error is not None:
        raise run.error


@contextlib.contextmanager
def sent_repeatedly(datagrams: Mapping[int, bytes], rounds: int, period_s: float = 0.004) -> Iterator[None]:
    """A program that sends these datagrams to ports of this machine in every period, for so many rounds at the most."""
    stop = threading.Event()

    def send() -> None:
        done = 0
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as program:
            while done < rounds and not stop.wait(period_s):
                with contextlib.suppress(ConnectionError):  # the run has not started, or has ended
                    for port, payload in datagrams.items():
                        program.sendto(payload, ("127.0.0.1", port))
                    done += 1

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def receive_all(receiver: socket.socket, count: int) -> list[bytes]:
    """Receive a number of datagrams."""
    return [receiver.recv(65536) for _ in range(count)]


def receive_each_of(receiver: socket.socket, expected: Iterable[bytes]) -> list[bytes]:
    """Receive datagrams until each expected one is among them."""
    missing, found = set(expected), list[bytes]()
    while missing:
        found.append(receiver.recv(65536))
        missing.discard(found[-1])
    return found


def receive_available(receiver: socket.socket) -> list[bytes]:
    """Datagrams that have arrived."""
    receiver.setblocking(False)
    found = []
    with contextlib.suppress(BlockingIOError):
        while True:
            found.append(receiver.recv(65536))
    return found


def wait_for(holds: Callable[[], bool], seconds: float = PATIENCE_S) -> None:
    """Wait for a condition; fails after a timeout."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "not in time"
        time.sleep(0.005)
