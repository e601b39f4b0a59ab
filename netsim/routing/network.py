"""The network layer of a run: messages in, frames out; frames that arrive in, receptions and more frames out.

A message of an agent or a program becomes a packet. Its origin sends the first frame; who receives a frame of a packet for the
first time takes it, if it is meant, and sends one more frame if the router says so: at once to the next hop, a broadcast after
a random wait. Whatever comes again is dropped. What is remembered of a packet is forgotten when no frame and no wait of it is
open any more, so there is never more in memory than is under way.

Each hop is a frame like any other: it contends, collides, is lost, delayed and recorded under the name of who sends it.
"""

import heapq
from collections.abc import Callable, Sequence
from numbers import Integral

import msgspec

from vcmvsp.cosim.errors import FederateError
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.tables.radio_frames import UNDER_WAY
from vcmvsp.cosim.types import FrameReport, Message, Reception, Routed
from vcmvsp.netsim.channel.datagrams import TrafficLog, received
from vcmvsp.netsim.routing.router import BROADCAST, HEADER_BYTES, AdvertisingRouter, Router

Put = Callable[[int, Message, int], tuple[int, list[FrameReport]]]
"""Hands a frame to the channel, at a time (ns), reaching the queue so much later (ns): its number, and what is decided."""


class PacketArrival(msgspec.Struct, frozen=True):
    """How a packet came to a vehicle."""

    hops: int
    via: int
    received_ns: int


class Packet(msgspec.Struct):
    """A message under way."""

    origin: int
    number: int  # among those of its origin
    to: int  # `BROADCAST`: all
    message: Message
    sent_ns: int
    datagram: int | None = None  # its number, of one that a program has sent
    update: object = None  # of routes: its content
    open: int = 0  # frames, arrivals and waits
    told: bool = False  # when it arrives, of a datagram to one vehicle
    under_way: bool = False  # when the run ends
    frames: list[int] = msgspec.field(default_factory=list)
    reached: dict[int, PacketArrival] = msgspec.field(default_factory=dict)


class _Copy(msgspec.Struct, frozen=True):
    """A frame on the air, and how many hops its packet has gone when it arrives."""

    packet: Packet
    by: int
    via: int  # to whom; `BROADCAST`: all
    hops: int


class _Arrival(msgspec.Struct, frozen=True):
    copy: _Copy
    frame: int
    at: int
    rssi_dbm: float
    received_ns: int


class _Wait(msgspec.Struct, frozen=True):
    """A broadcast that is passed on later."""

    packet: Packet
    by: int
    hops: int  # gone so far


class RoutingNetwork:
    """All vehicles' network layers.

    Args:
        router: says whom packets are handed to.
        kind: what that is called, for errors.
        vehicles: names; rows are places in it.
        seed: of the run.
        put: hands a frame to the channel.
    """

    def __init__(self, router: Router, kind: str, vehicles: Sequence[str], seed: int, put: Put) -> None:
        self._router, self._kind, self._names, self._put = router, kind, tuple(vehicles), put
        self._telling = router if isinstance(router, AdvertisingRouter) else None
        self._row = {name: row for row, name in enumerate(vehicles)}
        self._draws = [stream(seed, f"radio/{name}/relay") for name in vehicles]
        self._numbers = [0] * len(self._names)
        self._copies: dict[int, _Copy] = {}  # by frame: those whose fate is open
        self._packets: dict[tuple[int, int], Packet] = {}  # in the order in which they were sent: those under way
        # Heap of when it is done, when it is due, order, and what: an arrival, a wait, or of a row its update.
        self._agenda: list[tuple[int, int, int, _Arrival | _Wait | int]] = []
        self._given = 0
        self._carried = TrafficLog()
        self._reports: list[FrameReport] = []  # these three are to be told
        self._heard: list[tuple[str, Reception]] = []
        self._routed: list[Routed] = []
        for row, first_ns in enumerate(() if self._telling is None else self._telling.first_ns()):
            self._plan(first_ns, row)

    def next_ns(self) -> int | None:
        """When there is something to do next."""
        return self._agenda[0][0] if self._agenda else None

    def send(self, sent_ns: int, message: Message, *, handover_ns: int = 0, datagram: int | None = None) -> list[FrameReport]:
        """A vehicle has a message: the reports of its first frame, if that is decided already."""
        to = BROADCAST if message.to is None else self._row[message.to]
        return self._originate(self._row[message.sender], to, message, sent_ns, handover_ns, datagram=datagram)

    def note(self, reports: Sequence[FrameReport], earliest_ns: int) -> None:
        """Take what became of frames; arrivals of the past are dealt with at ``earliest_ns``."""
        for report in reports:
            copy = self._copies.pop(report.frame)
            packet = copy.packet
            packet.under_way |= UNDER_WAY in report.outcome
            if packet.datagram is None:
                self._reports.append(report)
            else:
                self._carried.report(report, packet.datagram)
            for receiver, rssi_dbm, at_ns in received(report):
                packet.open += 1
                row = self._row[receiver]
                self._plan(at_ns, _Arrival(copy, report.frame, row, rssi_dbm, at_ns), earliest_ns)
                if copy.via == row == packet.to:  # there is but one way to it: nothing will come earlier
                    self._tell_program(packet, row, at_ns, report.frame)
            self._less(packet)

    def go_on(self, now_ns: int) -> list[FrameReport]:
        """Do what is due: the reports of frames that were sent, as far as they are decided."""
        reports: list[FrameReport] = []
        while self._agenda and self._agenda[0][0] <= now_ns:
            *_, what = heapq.heappop(self._agenda)
            if isinstance(what, _Arrival):
                reports += self._arrive(what, now_ns)
                self._less(what.copy.packet)
            elif isinstance(what, _Wait):
                reports += self._transmit(what.packet, what.by, BROADCAST, what.hops, now_ns)
                self._less(what.packet)
            elif self._telling is not None:
                reports += self._update(self._telling, what, now_ns)
        return reports

    def finish(self) -> None:
        """The run is over: tell of what is under way as far as it came."""
        for packet in self._packets.values():
            packet.under_way = True
            self._tell(packet)

    def events(self, now_ns: int) -> list[Event]:
        """What there is to tell since it was asked last."""
        events = [Event("radio/frame", now_ns, report) for report in self._reports]
        events += [Event(f"{name}/heard", now_ns, reception) for name, reception in self._heard]
        events += [Event("radio/routed", now_ns, routed) for routed in self._routed]
        self._reports, self._heard, self._routed = [], [], []
        return [*events, *self._carried.events(now_ns)]

    def _plan(self, at_ns: int, what: _Arrival | _Wait | int, earliest_ns: int = 0) -> None:
        heapq.heappush(self._agenda, (max(at_ns, earliest_ns), at_ns, self._given, what))
        self._given += 1

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
        self._less(packet)
        return reports

    def _update(self, telling: AdvertisingRouter, row: int, now_ns: int) -> list[FrameReport]:
        update = telling.update(row, now_ns)
        if update.next_ns <= now_ns or update.size_bytes < 0:
            raise self._nonsense(f"tells {update.size_bytes} bytes of routes at {now_ns} ns, and next at {update.next_ns} ns")
        self._plan(update.next_ns, row)
        message = Message(sender=self._names[row], body=b"", size_bytes=update.size_bytes)
        return self._originate(row, BROADCAST, message, now_ns, update=update.content)

    def _transmit(self, packet: Packet, by: int, via: int, hops: int, now_ns: int, handover_ns: int = 0) -> list[FrameReport]:
        """Send one frame of a packet that has come so far."""
        if not isinstance(via, Integral) or via not in range(BROADCAST, len(self._names)) or via == by:
            wanted = f"the row of another of {len(self._names)} vehicles, {BROADCAST} (a broadcast) or None"
            raise self._nonsense(f"has {self._names[by]} hand a message to {via!r}, which is not {wanted}")
        message = packet.message
        frame = Message(
            sender=self._names[by],
            body=b"",  # nobody looks into frames
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
        """A vehicle has received a frame: take the packet, pass it on, or drop it."""
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
            self._tell_program(packet, arrival.at, arrival.received_ns, arrival.frame)
            if not message.body:
                return
        heard = Reception(message=message, rssi_dbm=arrival.rssi_dbm, sent_ns=packet.sent_ns, received_ns=arrival.received_ns)
        self._heard.append((self._names[arrival.at], heard))

    def _tell_program(self, packet: Packet, receiver: int, at_ns: int, frame: int) -> None:
        """When a datagram arrives: of one to a single vehicle as soon as that is known of its last frame."""
        if packet.datagram is not None and not packet.told:
            self._carried.arrive(packet.datagram, receiver, at_ns, frame)
            packet.told = packet.to != BROADCAST

    def _less(self, packet: Packet) -> None:
        """Something of a packet is over; with the last of it, so is the packet."""
        packet.open -= 1
        if not packet.open:
            del self._packets[packet.origin, packet.number]
            self._tell(packet)

    def _tell(self, packet: Packet) -> None:
        names, reached = self._names, packet.reached.values()
        if packet.datagram is not None:
            self._carried.settle(packet.datagram)
        self._routed.append(
            Routed(
                origin=names[packet.origin],
                number=packet.number,
                to=packet.message.to,
                sent_ns=packet.sent_ns,
                size_bytes=packet.message.size_bytes,
                frame_bytes=packet.message.size_bytes + HEADER_BYTES,
                frames=tuple(packet.frames),
                receivers=tuple(names[row] for row in packet.reached),
                hops=tuple(each.hops for each in reached),
                via=tuple(names[each.via] for each in reached),
                received_ns=tuple(each.received_ns for each in reached),
                update=packet.update is not None,
                under_way=packet.under_way,
            )
        )

    def _nonsense(self, problem: str) -> FederateError:
        return FederateError(f"routing {self._kind}", problem)
