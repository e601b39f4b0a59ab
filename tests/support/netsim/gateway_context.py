"""Gateways without a run: a context that delivers datagrams after a set delay."""

import asyncio
import contextlib
import dataclasses
import os
import socket
import threading
import time
from collections.abc import AsyncIterator, Callable, Mapping, Sequence

from vcmvsp.netsim.bridge.gateways.base import BROADCAST, LARGEST, Gateway

PATIENCE_S = 60.0  # timeout on a machine that may be held up


@dataclasses.dataclass(frozen=True)
class OfferedPacket:
    """A packet that a gateway offered."""

    sender: int
    to: int
    payload: bytes
    came_ns: int
    size_bytes: int
    radio: str = ""


class RunlessContext:
    """A `netsim.bridge.gateways.base.GatewayContext` without a run; create it on the running loop.

    Args:
        vehicles: names of the run's vehicles.
        delay_s: from the offer to the delivery.
        radios: rows of the vehicles with each of several radios.
        hears: whether ``receiver`` gets a datagram of ``sender``, by rows and by its index in `offered`.

    Attributes:
        offered: all accepted packets, in order.
        room: False makes `offer` refuse.
        counts: vehicle -> words -> count.
        levels: (sender, receiver) -> dBm.
        lines: the gateway's lines for the user, if it was `open_gateway`.
    """

    __test__ = False

    def __init__(
        self,
        vehicles: Sequence[str],
        *,
        run: str = "test",
        delay_s: float = 0.0,
        hears: Callable[[int, int, int], bool] = lambda sender, receiver, place: True,
        radios: Mapping[str, tuple[int, ...]] | None = None,
    ) -> None:
        self.vehicles, self.run, self.loop = tuple(vehicles), run, asyncio.get_running_loop()
        self.radios: Mapping[str, tuple[int, ...]] = radios or {}
        self.offered: list[OfferedPacket] = []
        self.room = True
        self.counts: dict[str, dict[str, int]] = {}
        self.levels: dict[tuple[int, int], float] = {}
        self.lines: list[str] = []
        self._delay_s, self._hears = delay_s, hears
        self._thread = threading.get_ident()
        self.is_closed = False  # then the run makes no further deliveries

    def offer(
        self,
        gateway: Gateway,
        sender: int,
        to: int,
        payload: bytes,
        *,
        came_ns: int | None = None,
        size_bytes: int | None = None,
        radio: str = "",
    ) -> bool:
        self._on_the_loop()
        rows = range(len(self.vehicles))
        assert type(payload) is bytes
        assert len(payload) <= LARGEST
        assert sender in rows
        assert to == BROADCAST or (to in rows and to != sender)
        if not self.room:
            return False
        place = len(self.offered)
        at_ns = time.monotonic_ns() if came_ns is None else came_ns
        self.offered.append(
            OfferedPacket(sender, to, payload, at_ns, len(payload) if size_bytes is None else size_bytes, radio)
        )
        members = self.radios.get(radio, rows)
        for receiver in [row for row in members if row != sender] if to == BROADCAST else [to]:
            if self._hears(sender, receiver, place):
                self._later(gateway.deliver, sender, receiver, payload)
            elif to != BROADCAST and (lost := getattr(gateway, "lost", None)):
                self._later(lost, sender, receiver, payload)
        return True

    def count(self, vehicle: int, what: str, by: int = 1) -> None:
        self._on_the_loop()
        counts = self.counts.setdefault(self.vehicles[vehicle], {})
        counts[what] = counts.get(what, 0) + by

    def level_dbm(self, sender: int, receiver: int) -> float:
        return self.levels.get((sender, receiver), float("nan"))

    def _later(self, call: Callable[[int, int, bytes], None], sender: int, receiver: int, payload: bytes) -> None:
        def unless_closed() -> None:
            if not self.is_closed:
                call(sender, receiver, payload)

        self.loop.call_later(self._delay_s, unless_closed)

    def _on_the_loop(self) -> None:
        assert threading.get_ident() == self._thread, "for the loop's own thread"


@contextlib.asynccontextmanager
async def open_gateway(gateway: Gateway, context: RunlessContext) -> AsyncIterator[RunlessContext]:
    """Context of an open gateway, which is always closed at the end; no error may occur on the loop."""
    trouble: list[object] = []
    context.loop.set_exception_handler(lambda _, what: trouble.append(what))  # would end the bridge
    gateway.check(context.vehicles)
    try:
        context.lines = list(await gateway.open(context))
        yield context
    finally:
        context.is_closed = True
        await gateway.close()
        await asyncio.sleep(0)  # sockets are closed in the next iteration
    assert not trouble


async def until(holds: Callable[[], bool], seconds: float = PATIENCE_S) -> None:
    """Run the loop until a condition holds; fails after a timeout."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "not in time"
        await asyncio.sleep(0.005)


def free_ports(count: int, kind: int = socket.SOCK_DGRAM) -> int:
    """First of a number of consecutive free ports of 127.0.0.1, outside of the ranges of other test workers.

    Each call continues behind the previous one, so that requested ports that are still free are not given twice.
    """
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    stretch = 12_000 // workers  # below the kernel's ephemeral ports
    begin = 20_000 + stretch * int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    assert count <= stretch, f"{workers} workers leave {stretch} ports to each"
    for _ in range(stretch // count):
        if _next_port[0] + count > stretch:
            _next_port[0] = 0
        first = begin + _next_port[0]
        _next_port[0] += count
        if all(_is_free(port, kind) for port in range(first, first + count)):
            return first
    raise AssertionError("no free ports")


_next_port = [os.getpid() * 100 % 4_000]  # in this process's range; other runs of the tests begin elsewhere


def _is_free(port: int, kind: int) -> bool:
    with socket.socket(socket.AF_INET, kind) as tried:
        try:
            tried.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True
