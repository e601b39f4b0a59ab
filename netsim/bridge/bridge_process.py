"""The bridge process: opens all gateways, passes their datagrams to the run, and delivers datagrams at the run's times.

It ends on a `Leave` message or when the link to the run ends. The run confirms each batch of datagrams; later ones wait in
`netsim.bridge.datagram_store`, bounded for each vehicle.
"""

import asyncio
import contextlib
import signal
import sys
import time
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.errors import ScenarioError, place_of, words_of
from vcmvsp.cosim.processes.child_process import LocalLink
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util.codec import encode
from vcmvsp.netsim.bridge import messages
from vcmvsp.netsim.bridge.datagram_store import DatagramStore, Pacer, TimedDelivery
from vcmvsp.netsim.bridge.gateways.base import BROADCAST, LARGEST, Gateway, GatewayError

OPENING_S = 60.0  # timeout from the start to the `Opening` message
CLOSE_S = 3.0  # timeout for a gateway to close and for the last messages,
VEHICLE_S = 0.02  # longer by this for each vehicle
RETRY_S = 0.001  # between two attempts to send to a run that does not read
REPORT_S = 0.05  # period of reports of deliveries and counts
MOST_DELIVERED = 4000  # deliveries in a report; more are reported at once
MOST_COUNTED = 100  # vehicles in a message
NO_RADIO = "not on the radio {}, which sender or destination lack"


class BridgeProcess:
    """Main object of the process, from the first message to the last; the `GatewayContext` of its gateways."""

    run: str
    vehicles: tuple[str, ...]
    radios: Mapping[str, tuple[int, ...]] = {}

    def __init__(self, link: LocalLink, loop: asyncio.AbstractEventLoop, *, wary: bool = False) -> None:
        self._link, self.loop, self._wary = link, loop, wary
        self._counts: dict[str, Counter[str]] = {}
        self._changed_counts: dict[str, None] = {}  # vehicles with counts that were not reported yet
        self._levels: dict[str, Array] = {}  # by radio
        self._over: asyncio.Future[str] = loop.create_future()  # reason for the end; empty: requested
        self._gateways: list[tuple[str, Gateway]] = []
        self._opened: list[tuple[str, Gateway]] = []  # open, or `open` has failed
        self._outbox: deque[bytes] = deque()
        self._forwarded = 0  # datagrams sent to the run
        self._awaits_confirmation = False  # of the last batch
        self._flushing = False
        self._deliveries = 0  # announced by the run
        self._delivered: list[tuple[int, int]] = []  # number of the delivery, time (ns)
        self._levels_requested = set[str]()  # of radios

    async def serve(self) -> int:
        """Run to the end; returns the exit code."""
        try:
            problem = await self._go_through(self._opening())
        except (GatewayError, ScenarioError) as error:
            problem = str(error)
        except Exception as error:
            problem = _words(error)
        if problem:
            self._send(messages.BridgeFailed(problem=problem))
        self._drain()
        return 3 if problem else 0

    async def _go_through(self, opening: messages.Opening) -> str:
        self.loop.set_exception_handler(self._on_exception)
        self.loop.add_signal_handler(signal.SIGTERM, self._end, "it received SIGTERM")
        self.loop.add_reader(self._link.fileno(), self._receive)
        try:
            await self._open(opening)
            return await self._over
        finally:
            await self._close(CLOSE_S + VEHICLE_S * len(opening.vehicles))
            self._report_deliveries()
            self._report_counts()

    # Opening

    def _opening(self) -> messages.Opening:
        self._link.wait(OPENING_S)
        received = self._link.receive()
        if not received or not isinstance(opening := messages.downs.decode(received[0]), messages.Opening):
            raise GatewayError("no gateways to open: this process is started by a run, not by hand")
        if self._wary:
            _check(opening)
        self._store = DatagramStore(len(opening.vehicles), payloads=opening.payloads)
        self.run, self.vehicles, self.radios = opening.run, opening.vehicles, opening.radios
        self._radio_number = {name: number for number, name in enumerate(opening.radios)}
        self._radio_of = {each.name: each.radio for each in opening.gateways}
        self._pacer = Pacer(self.loop, self._deliver)
        self._payloads = opening.payloads
        for message in received[1:]:
            self._handle(messages.downs.decode(message))
        return opening

    async def _open(self, opening: messages.Opening) -> None:
        folder = Path(opening.folder)
        with registry.looking_in(folder):
            for spec in opening.gateways:
                self._gateways.append((spec.name, _build_gateway(spec, folder)))
        lines: list[str] = []
        for name, gateway in self._gateways:
            self._opened.append((name, gateway))
            radio = self._radio_of[name]
            task = asyncio.ensure_future(gateway.open(RadioContext(self, radio) if radio else self))
            either: list[asyncio.Future[Any]] = [task, self._over]
            await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
            if self._over.done():
                task.cancel()
                with contextlib.suppress(asyncio.CancelledError, Exception):
                    await task
                return
            try:
                lines += [f"bridge.{name}: {line}" for line in task.result()]
            except GatewayError as error:
                raise GatewayError(f"bridge.{name}: {error}") from error
            except Exception as error:
                raise GatewayError(f"bridge.{name}: {_words(error)}") from error
        self._send(messages.Ready(lines=tuple(lines)))
        self._report()

    # From programs to the run

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
        """Store a datagram for the run, if there is room; returns whether there was."""
        rows = range(len(self.vehicles))
        if len(payload) > LARGEST or sender not in rows or to == sender or (to not in rows and to != BROADCAST):
            raise ValueError(f"{type(gateway).__name__} offers {len(payload)} bytes from row {sender} to {to}")
        if self.radios and not {sender, *([] if to == BROADCAST else [to])} <= {*self.radios[radio]}:
            self.count(sender, NO_RADIO.format(radio))
            return True
        now_ns = time.monotonic_ns()
        at_ns = now_ns if came_ns is None else min(came_ns, now_ns)
        if not self._store.put(gateway, sender, to, payload, at_ns, size_bytes, self._radio_number.get(radio, 0)):
            return False
        if not self._awaits_confirmation and not self._flushing:
            self._flushing = True
            self.loop.call_soon(self._flush)  # after all other datagrams of this turn
        return True

    def count(self, vehicle: int, what: str, by: int = 1) -> None:
        """Count datagrams of a vehicle under a reason."""
        name = self.vehicles[vehicle]
        self._counts.setdefault(name, Counter())[what] += by
        self._changed_counts[name] = None

    def level_dbm(self, sender: int, receiver: int, radio: str = "") -> float:
        """The newest level from the run, which sends levels from the first request on."""
        levels_dbm = self._levels.get(radio)
        if levels_dbm is None and radio not in self._levels_requested:
            self._levels_requested.add(radio)
            self._send(messages.LevelsRequest(radio=radio))
        return float("nan") if levels_dbm is None else float(levels_dbm[sender, receiver])

    def _flush(self) -> None:
        """Send new datagrams to the run, unless it has not confirmed the last batch yet."""
        self._flushing = False
        if self._awaits_confirmation or not (numbers := self._store.batch()):
            return
        self._awaits_confirmation = True
        self._forwarded += len(numbers)
        datagrams = [self._store[each] for each in numbers]
        rows = {id(gateway): row for row, (_, gateway) in enumerate(self._gateways)}
        ends = [(rows[id(each.gateway)], each.sender, each.to, each.radio) for each in datagrams]
        gateway, sender, to, radio = np.array(ends, np.int32).T
        size_bytes, came_ns = np.array([(each.size_bytes, each.came_ns) for each in datagrams], np.int64).T
        batch = {"number": np.array(numbers, np.int64), "gateway": gateway, "sender": sender, "to": to}
        payloads: tuple[bytes, ...] = ()
        if self._payloads:
            payloads = tuple([each.payload for each in datagrams])
        radios = radio if self.radios else None
        self._send(messages.NewDatagrams(**batch, size_bytes=size_bytes, came_ns=came_ns, payloads=payloads, radio=radios))

    def _send(self, message: messages.Up) -> None:
        self._outbox.append(encode(message))
        if len(self._outbox) == 1:
            self._send_outbox()

    def _send_outbox(self) -> None:
        while self._outbox:
            try:
                accepted = self._link.send(self._outbox[0])
            except ValueError:
                self._outbox.popleft()  # else it would block all later messages, also the one about this error
                raise
            if not accepted:
                if not self._over.done():
                    self.loop.call_later(RETRY_S, self._send_outbox)
                return
            self._outbox.popleft()

    # From the run to programs

    def _receive(self) -> None:
        for message in self._link.receive():
            self._handle(messages.downs.decode(message))
        if self._link.ended:
            self._end("")

    def _handle(self, message: messages.Down) -> None:
        if isinstance(message, messages.Deliveries):
            self._on_due(message)
        elif isinstance(message, messages.AgentDatagram):
            radio = self._radio_number.get(message.radio, 0)
            number = self._store.speak(message.sender, message.payload, radio)
            self._pacer.put(TimedDelivery(message.at_ns, number, -1, message.receiver))
            self._pacer.arm()
        elif isinstance(message, messages.LevelRows):
            shape = len(self.vehicles), len(self.vehicles)
            levels_dbm = self._levels.setdefault(message.radio, np.full(shape, np.nan))
            levels_dbm[message.first : message.first + len(message.dbm)] = message.dbm
        elif isinstance(message, messages.Leave):
            self._end("")

    def _on_due(self, due: messages.Deliveries) -> None:
        store, put, row = self._store, self._pacer.put, self._deliveries
        for number, receiver, at_ns in zip(due.number.tolist(), due.receiver.tolist(), due.at_ns.tolist(), strict=True):
            store.due(number)
            put(TimedDelivery(at_ns, number, row, receiver))
            row += 1
        self._deliveries = row
        for number in due.settled.tolist():
            datagram = store.settle(number)
            gateway = None if datagram is None else datagram.gateway
            if datagram and gateway and (lost := getattr(gateway, "lost", None)):
                with self._errors_of(gateway):
                    lost(datagram.sender, datagram.to, datagram.payload)
        if self._awaits_confirmation and due.taken >= self._forwarded:
            self._awaits_confirmation = False
            self._flush()
        self._pacer.arm()

    def _deliver(self, delivery: TimedDelivery) -> None:
        datagram = self._store[delivery.number]
        all_on = [gateway for name, gateway in self._gateways if self._is_on(name, datagram.radio)]
        gateways = all_on if datagram.gateway is None else [datagram.gateway]
        try:
            for gateway in gateways:
                with self._errors_of(gateway):
                    gateway.deliver(datagram.sender, delivery.receiver, datagram.payload)
        finally:
            self._store.mark_delivered(delivery.number)
        if delivery.row >= 0:
            self._delivered.append((delivery.row, time.monotonic_ns()))
            if len(self._delivered) >= MOST_DELIVERED:
                self._report_deliveries()

    def _is_on(self, gateway: str, radio: int) -> bool:
        """Whether a gateway has the radio of this number."""
        own = self._radio_of[gateway]
        return not own or self._radio_number[own] == radio

    @contextlib.contextmanager
    def _errors_of(self, gateway: Gateway) -> Iterator[None]:
        """End the bridge with an error that names the gateway if the block raises."""
        try:
            yield
        except Exception as error:
            name = next(name for name, each in self._gateways if each is gateway)
            self._end(f"bridge.{name}: {_words(error)}")

    def _report_deliveries(self) -> None:
        if self._delivered:
            due, at_ns = np.array(self._delivered, np.int64).T
            self._delivered.clear()
            self._send(messages.Delivered(due=due, at_ns=at_ns))

    def _report(self) -> None:
        if not self._outbox:
            self._report_deliveries()
            self._report_counts()
        self.loop.call_later(REPORT_S, self._report)

    def _report_counts(self) -> None:
        counts, changed = self._counts, list(self._changed_counts)
        self._changed_counts.clear()
        for first in range(0, len(changed), MOST_COUNTED):
            self._send(messages.Counts(counts={name: dict(counts[name]) for name in changed[first : first + MOST_COUNTED]}))

    # The end

    def _end(self, why: str) -> None:
        if not self._over.done():
            self._over.set_result(why)

    def _on_exception(self, _: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Handle an exception of a gateway: an `OSError` of a connection is printed, any other ends the bridge."""
        error = context.get("exception")
        if isinstance(error, OSError) or error is None:
            sys.stderr.write(f"bridge: {context.get('message', 'trouble')}: {error}\n")
        else:
            self._end(_words(error))

    async def _close(self, seconds: float) -> None:
        for name, gateway in self._opened:
            try:
                await asyncio.wait_for(gateway.close(), seconds)
            except Exception as error:  # the other gateways are closed, too
                sys.stderr.write(f"bridge: closing bridge.{name}: {_words(error)}\n")

    def _drain(self) -> None:
        until = time.monotonic() + CLOSE_S
        while self._outbox and time.monotonic() < until and not self._link.ended:
            self._send_outbox()
            if self._outbox:
                self._link.receive()
                time.sleep(RETRY_S)
        self._link.close()


class RadioContext:
    """The `GatewayContext` of a gateway that has one of several radios."""

    def __init__(self, process: BridgeProcess, radio: str) -> None:
        self.vehicles, self.run, self.loop = process.vehicles, process.run, process.loop
        self.radios: Mapping[str, tuple[int, ...]] = {radio: process.radios[radio]}
        self.offer, self.count = partial(process.offer, radio=radio), process.count
        self.level_dbm = partial(process.level_dbm, radio=radio)


def _check(opening: messages.Opening) -> None:
    """Reject user code and names with a path in them: this process has root's rights."""
    for spec in opening.gateways:
        if ":" in spec.kind:
            raise GatewayError(
                f"bridge.{spec.name}: {spec.kind} is user code and would run as root; with sudo, only built-in gateways open"
            )
    for name in (opening.run, *opening.vehicles):
        if "/" in name or name in (".", ".."):
            raise GatewayError(f"'{name}' is not a valid network name")


def _build_gateway(spec: messages.GatewaySpec, folder: Path) -> Gateway:
    kind = registry.find("door", spec.kind, folder=folder, key=f"bridge.{spec.name}.kind")
    return binding.call(kind, spec.params, key=f"bridge.{spec.name}")


def _words(error: BaseException) -> str:
    return f"{words_of(error)}{place_of(error)}"
