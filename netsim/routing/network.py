"""The network layer of a run: messages become frames; received frames become receptions and further frames.

A message of an agent or a program becomes a packet. Its origin sends the first frame. A vehicle that receives the first copy
delivers it, if it is a destination, and forwards it by the router: at once to the next hop, a broadcast after a random delay.
Later copies are dropped. The state of a packet is deleted with its last open frame and delay.

Each hop is a frame like any other, recorded under the name of the vehicle that sends it.
"""

import heapq
from collections.abc import Callable, Collection, Sequence
from numbers import Integral

import msgspec

from vcmvsp.cosim.errors import FederateError
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.tables.radio_frames import UNDER_WAY
from vcmvsp.cosim.types import FrameReport, Message, Routed
from vcmvsp.netsim.channel.reception import ReceptionLog, TrafficLog, received
from vcmvsp.netsim.routing.router import BROADCAST, HEADER_BYTES, AdvertisingRouter, Router

Put = Callable[[int, Message, int], tuple[int, list[FrameReport]]]
"""Hands a frame to the channel: time (ns), frame, handover delay (ns) -> number of the frame, reports of decided frames."""


class PacketArrival(msgspec.Struct, frozen=True):
    """The first arrival of a packet at a vehicle."""

    hops: int
    via: int
    received_ns: int


class Packet(msgspec.Struct):
    """A message under way."""

    origin: int
    number: int  # of the origin's packets
    to: int  # `BROADCAST`: all
    message: Message
    sent_ns: int
    datagram: int | None = None  # number of a program's datagram
    update: object = None  # content of a route update
    open: int = 0  # frames, arrivals and delays
    arrival_reported: bool = False  # of a unicast datagram
    under_way: bool = False  # at the end of the run
    frames: list[int] = msgspec.field(default_factory=list)
    reached: dict[int, PacketArrival] = msgspec.field(default_factory=dict)


class _Copy(msgspec.Struct, frozen=True):
    packet: Packet
    by: int
    via: int  # destination of the frame, or `BROADCAST`
    hops: int  # with this frame


class _Arrival(msgspec.Struct, frozen=True):
    copy: _Copy
    frame: int
    at: int
    rssi_dbm: float
    received_ns: int


class _Wait(msgspec.Struct, frozen=True):
    packet: Packet
    by: int
    hops: int  # so far


class RoutingNetwork:
    """The network layer of all vehicles that take part.

    Args:
        kind: name of the router in error messages.
        put: see `Put`.
        every: all vehicles of the run, if more than ``vehicles``; receptions and traffic have rows of these.
    """

    def __init__(
        self,
        router: Router,
        kind: str,
        vehicles: Sequence[str],
        seed: int,
        put: Put,
        woken: Collection[str] = (),
        every: Sequence[str] = (),
    ) -> None:
        self._router, self._blame, self._names, self._put = router, f"routing {kind}", tuple(vehicles), put
        self._telling = router if isinstance(router, AdvertisingRouter) else None
        self._row = {name: row for row, name in enumerate(vehicles)}
        run = {name: row for row, name in enumerate(every or vehicles)}
        self._run_row = [run[name] for name in self._names]
        self._draws = [stream(seed, f"radio/{name}/relay") for name in vehicles]
        self._numbers = [0] * len(self._names)
        self._copies: dict[int, _Copy] = {}  # by frame: not decided yet
        self._packets: dict[tuple[int, int], Packet] = {}  # under way, in the order of sending
        # Heap of: time of processing, due time, order, and an arrival, a delay, or the row of an update.
        self._agenda: list[tuple[int, int, int, _Arrival | _Wait | int]] = []
        self._order = 0
        self._traffic = TrafficLog()
        self._reports: list[FrameReport] = []  # these three wait for `events`
        self._receptions = ReceptionLog(tuple(run), woken)
        self._routed: list[Routed] = []
        for row, first_ns in enumerate(() if self._telling is None else self._telling.first_ns()):
            self._plan(first_ns, row)

    def next_ns(self) -> int | None:
        """Time of the next arrival, delay or update."""
        return self._agenda[0][0] if self._agenda else None

    def send(self, sent_ns: int, message: Message, *, handover_ns: int = 0, datagram: int | None = None) -> list[FrameReport]:
        """Send a message; returns the report of its first frame if that is decided already."""
        to = BROADCAST if message.to is None else self._row[message.to]
        return self._originate(self._row[message.sender], to, message, sent_ns, handover_ns, datagram=datagram)

    def note(self, reports: Sequence[FrameReport], earliest_ns: int) -> None:
        """Take reports of frames; past arrivals are processed at ``earliest_ns``."""
        for report in reports:
            copy = self._copies.pop(report.frame)
            packet = copy.packet
            packet.under_way |= UNDER_WAY in report.outcome
            if packet.datagram is None:
                self._reports.append(report)
            else:
                self._traffic.report(report, packet.datagram)
            for receiver, rssi_dbm, at_ns in received(report):
                packet.open += 1
                row = self._row[receiver]
                self._plan(at_ns, _Arrival(copy, report.frame, row, rssi_dbm, at_ns), earliest_ns)
                if copy.via == row == packet.to:  # unicast has one route: no earlier arrival is possible
                    self._report_arrival(packet, row, at_ns, report.frame)
            self._close_one(packet)

    def go_on(self, now_ns: int) -> list[FrameReport]:
        """Process everything that is due; returns the reports of sent frames that are decided."""
        reports: list[FrameReport] = []
        while self._agenda and self._agenda[0][0] <= now_ns:
            *_, item = heapq.heappop(self._agenda)
            if isinstance(item, _Arrival):
                reports += self._arrive(item, now_ns)
                self._close_one(item.copy.packet)
            elif isinstance(item, _Wait):
                reports += self._transmit(item.packet, item.by, BROADCAST, item.hops, now_ns)
                self._close_one(item.packet)
            elif self._telling is not None:
                reports += self._update(self._telling, item, now_ns)
        return reports

    def finish(self) -> None:
        """End the run: report the packets under way."""
        for packet in self._packets.values():
            packet.under_way = True
            self._report_packet(packet)

    def events(self, now_ns: int) -> list[Event]:
        """Events since the last call."""
        events = [Event("radio/frame", now_ns, report) for report in self._reports]
        events += self._receptions.events(now_ns)
        events += [Event("radio/routed", now_ns, routed) for routed in self._routed]
        self._reports, self._routed = [], []
        return [*events, *self._traffic.events(now_ns)]

    def _plan(self, at_ns: int, item: _Arrival | _Wait | int, earliest_ns: int = 0) -> None:
        heapq.heappush(self._agenda, (max(at_ns, earliest_ns), at_ns, self._order, item))
        self._order += 1

    # --- packets --------------------------------------------------------------------------------------------------------------

    def _originate(
        self,
        origin: int,
        to: int,
        message: Message,
        sent_ns: int,
        handover_ns: int = 0,
        *,
        datagram: int | None = None,
        update: object = None,
    ) -> list[FrameReport]:
        packet = Packet(origin, self._numbers[origin], to, message, sent_ns, datagram, update)
        self._numbers[origin] += 1
        self._packets[origin, packet.number] = packet
        packet.open += 1
        reports: list[FrameReport] = []
        via = BROADCAST if to == BROADCAST else self._router.next_hop(origin, to, sent_ns)
        if via is not None:
            reports = self._transmit(packet, origin, via, 0, sent_ns, handover_ns)
        self._close_one(packet)
        return reports

    def _update(self, telling: AdvertisingRouter, row: int, now_ns: int) -> list[FrameReport]:
        update = telling.update(row, now_ns)
        if update.next_ns <= now_ns or update.size_bytes < 0:
            problem = f"returned an update of {update.size_bytes} bytes at {now_ns} ns, the next at {update.next_ns} ns"
            raise FederateError(self._blame, problem)
        self._plan(update.next_ns, row)
        message = Message(sender=self._names[row], body=b"", size_bytes=update.size_bytes)
        return self._originate(row, BROADCAST, message, now_ns, update=update.content)

    def _transmit(self, packet: Packet, by: int, via: int, hops: int, now_ns: int, handover_ns: int = 0) -> list[FrameReport]:
        if not isinstance(via, Integral) or via not in range(BROADCAST, len(self._names)) or via == by:
            allowed = f"the row of another vehicle (of {len(self._names)}), {BROADCAST} (a broadcast) or None"
            problem = f"returned {via!r} as the next hop of {self._names[by]}; allowed: {allowed}"
            raise FederateError(self._blame, problem)
        message = packet.message
        frame = Message(
            sender=self._names[by],
            body=b"",  # frames carry no body, `Packet` does
            size_bytes=message.size_bytes + HEADER_BYTES,
            to=None if via == BROADCAST else self._names[via],
            priority=message.priority,
        )
        number, reports = self._put(now_ns, frame, handover_ns)
        self._copies[number] = _Copy(packet, by, via, hops + 1)
        packet.open += 1
        packet.frames.append(number)
        return reports

    def _arrive(self, arrival: _Arrival, now_ns: int) -> list[FrameReport]:
        copy, row = arrival.copy, arrival.at
        packet = copy.packet
        if row == packet.origin or row in packet.reached:
            return []
        packet.reached[row] = PacketArrival(copy.hops, copy.by, arrival.received_ns)
        if packet.update is not None:
            if self._telling is not None:
                self._telling.take(row, packet.origin, packet.update, now_ns)
            return []
        if packet.to in (BROADCAST, row):
            self._deliver(packet, arrival)
        return [] if row == packet.to or copy.hops >= self._router.hop_limit else self._pass_on(copy, row, now_ns)

    def _pass_on(self, copy: _Copy, row: int, now_ns: int) -> list[FrameReport]:
        packet = copy.packet
        via = BROADCAST if packet.to == BROADCAST else self._router.next_hop(row, packet.to, now_ns)
        if via is None:
            return []
        if via != BROADCAST:
            return self._transmit(packet, row, via, copy.hops, now_ns)
        if self._router.relays(row, copy.by):
            packet.open += 1
            wait_ns = int(self._draws[row].random() * self._router.jitter_ns)
            self._plan(now_ns + wait_ns, _Wait(packet, row, copy.hops))
        return []

    def _deliver(self, packet: Packet, arrival: _Arrival) -> None:
        message = packet.message
        if packet.datagram is not None:
            self._report_arrival(packet, arrival.at, arrival.received_ns, arrival.frame)
            if not message.body:
                return
        at = self._run_row[arrival.at]
        self._receptions.add(message, packet.sent_ns, [at], [arrival.rssi_dbm], [arrival.received_ns])

    def _report_arrival(self, packet: Packet, receiver: int, at_ns: int, frame: int) -> None:
        if packet.datagram is not None and not packet.arrival_reported:
            self._traffic.arrive(packet.datagram, self._run_row[receiver], at_ns, frame)
            packet.arrival_reported = packet.to != BROADCAST

    def _close_one(self, packet: Packet) -> None:
        packet.open -= 1
        if not packet.open:
            del self._packets[packet.origin, packet.number]
            self._report_packet(packet)

    def _report_packet(self, packet: Packet) -> None:
        if packet.datagram is not None:
            self._traffic.settle(packet.datagram)
        names, arrivals = self._names, packet.reached.values()
        receivers = [names[row] for row in packet.reached]
        hops = [each.hops for each in arrivals]
        via = [names[each.via] for each in arrivals]
        received_ns = [each.received_ns for each in arrivals]
        self._routed.append(
            Routed(
                origin=names[packet.origin],
                number=packet.number,
                to=packet.message.to,
                sent_ns=packet.sent_ns,
                size_bytes=packet.message.size_bytes,
                frame_bytes=packet.message.size_bytes + HEADER_BYTES,
                frames=tuple(packet.frames),
                receivers=tuple(receivers),
                hops=tuple(hops),
                via=tuple(via),
                received_ns=tuple(received_ns),
                update=packet.update is not None,
                under_way=packet.under_way,
            )
        )
