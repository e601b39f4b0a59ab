"""The radio in the simulation: positions and sent messages in, receptions and frame reports out."""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.federate import Event, RunInfo, Slot, Step
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Array, Changed, Datagrams, FrameReport, Message, Outage, Reception, Seconds, States
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.channel.datagrams import TrafficLog, received
from vcmvsp.netsim.channel.replayed import RecordedChannel
from vcmvsp.netsim.routing.network import RoutingNetwork
from vcmvsp.netsim.routing.router import Routing

MANY = 1_000_000  # frames
TELLING = 20  # the same: how many are to come goes by how soon the first ones came
Post = tuple[int, Message, int, int | None]  # see `RadioFederate._sent`
_ORDERS = (Outage, Changed)  # of an operator


class RadioFederate:
    """One federate for all links.

    ====================  =========  ===============================================================================
    key                   direction  value
    ====================  =========  ===============================================================================
    ``world/states``      in         `States`: where everybody is; the newest counts
    ``<vehicle>/send``    in         `Message`: enters the channel at the event's time
    ``bridge/sent``       in         `Datagrams` of programs outside, each at its own time, which may have passed by a little
    ``operator/outage``   in         `Outage`: frames whose fate is open at the event's time are lost, as far as it concerns
                                     them
    ``operator/changed``  in         `Changed`: a number of a layer, for all frames whose fate is open then
    ``radio/frame``       out        `FrameReport`: what became of a frame, as soon as that is known: at its sending where
                                     nobody contends for the air, or a recording tells it (`netsim.channel.replayed`), else when
                                     it ends; at the end of the run for the rest
    ``radio/traffic``     out        `Traffic`: the same of datagrams, all that is known at an instant together
    ``radio/routed``      out        `Routed`: how a message came to whom, once it is under way no more; with routing alone
    ``<vehicle>/heard``   out        `Reception`, at the time at which it arrives
    ====================  =========  ===============================================================================

    Agents that act at the same instant hand their messages over at the same nanosecond, which no two computers do: radios that
    contend for the air would then all find it free, and collide. So, where several vehicles send at one instant, a message
    takes up to ``handover_s`` to reach the queue of its radio, uniformly distributed, in the order of its sender.

    With routing a message may need several frames, each handed over by the vehicle that had the one before (`netsim.routing`).

    It is stepped with the senders, and once more for every frame that ends on a contended air, or that is passed on: nothing is
    polled.
    """

    name = "radio"
    slot = Slot.RADIO
    wake_slot = Slot.SEND
    reads: tuple[str, ...] = ("*/send", "bridge/sent", "operator/outage", "operator/changed")
    latest: tuple[str, ...] = ("world/states",)
    wakes: tuple[str, ...] = ("*/send", "bridge/sent")

    def __init__(
        self,
        channel: Channel | RecordedChannel,
        handover_s: Seconds = 0.002,
        router: Routing | None = None,
        programs: bool = False,  # outside, that may send any number of frames
    ) -> None:
        self._channel, self._routing, self._programs = channel, router, programs
        self._handover_ns = seconds_to_ns(handover_s) if channel.contends else 0

    def start(self, run: RunInfo) -> int | None:
        """Begin with an idle channel; nothing to do until a message is sent."""
        self._channel.start(run.seed)
        if run.paced:  # nothing that takes a second may come in between
            self._channel.expect(MANY if self._programs else 0)
        self._end_ns, self._vehicles = run.duration_ns, run.vehicles
        self._row = {name: row for row, name in enumerate(run.vehicles)}
        self._heard = {name: f"{name}/heard" for name in run.vehicles}  # keys of events
        self._states: States | None = None
        self._open: dict[int, tuple[Message, int | None]] = {}  # by frame, until it is decided; of a datagram its number
        self._frames = 0  # so far
        self._seed = run.seed
        self._handover: dict[str, np.random.Generator] = {}
        self._handed_ns: dict[str, int] = {}
        self._network: RoutingNetwork | None = None
        if self._routing is not None:
            router, kind = self._routing.open(run.vehicles, run.seed), type(self._routing).__name__
            self._network = RoutingNetwork(router, kind, run.vehicles, run.seed, self._put)
            return self._network.next_ns()
        return None

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """Report what is decided by now, and hand over what was sent, in that order."""
        reports = self._obey(inbox)
        reports += self._channel.advance(now_ns)  # what happens by itself comes before what is sent at the same time
        for event in inbox:
            if isinstance(event.value, States):
                self._states = event.value
        if self._network is not None:
            return self._step_routed(self._network, now_ns, inbox, reports)
        sent = list(self._sent(inbox, now_ns))
        together = self._put_all(now_ns, sent) if len(sent) > 1 else None
        reports += together or ()
        for sent_ns, message, handover_ns, datagram in sent if together is None else ():
            frame, decided = self._put(sent_ns, message, handover_ns)
            self._open[frame] = message, datagram
            reports += decided
        if sent or now_ns == self._end_ns:
            reports += self._decided(now_ns)
        due = self._channel.next_ns()
        return Step(self._events(reports, now_ns), None if due is None or now_ns == self._end_ns else min(due, self._end_ns))

    def _step_routed(self, network: RoutingNetwork, now_ns: int, inbox: Sequence[Event], reports: list[FrameReport]) -> Step:
        """The same where messages become packets that go from vehicle to vehicle."""
        sent = list(self._sent(inbox, now_ns))
        network.note(reports, now_ns + bool(sent))  # what arrives when others send, is too late for the agents of this instant
        reports = network.go_on(now_ns)
        for sent_ns, message, handover_ns, datagram in sent:
            reports += network.send(sent_ns, message, handover_ns=handover_ns, datagram=datagram)
        reports += self._decided(now_ns)
        network.note(reports, now_ns + 1)
        if now_ns == self._end_ns:
            network.finish()
        due = [each for each in (self._channel.next_ns(), network.next_ns()) if each is not None]
        return Step(network.events(now_ns), None if not due or now_ns == self._end_ns else min(*due, self._end_ns))

    def _put_all(self, now_ns: int, sent: Sequence[Post]) -> list[FrameReport] | None:
        """Hand over all messages of this instant, and hear what becomes of them; None: it has to be one by one."""
        if self._states is None or any(post[0] != now_ns or post[2] for post in sent):
            return None
        names, position = self._states.names, self._states.position
        reports = self._channel.send_all(now_ns, [post[1] for post in sent], names, position)
        for number, (_, message, _, datagram) in enumerate(sent if reports else (), self._frames):
            self._open[number] = message, datagram
        self._frames += len(reports or ())
        return reports

    def _put(self, sent_ns: int, frame: Message, handover_ns: int) -> tuple[int, list[FrameReport]]:
        """Hand a frame to the channel: its number, and what is decided of it."""
        if self._states is None:
            raise ValueError(f"{frame.sender} sends before any position is known (world/states)")
        self._frames += 1
        if self._frames == TELLING and sent_ns > 0:
            self._channel.foresee(TELLING * (self._end_ns - sent_ns) // sent_ns)
        names, position = self._states.names, self._states.position
        return self._frames - 1, self._channel.send(sent_ns, frame, names, position, handover_ns=handover_ns)

    def _decided(self, now_ns: int) -> list[FrameReport]:
        """What is decided of frames by now; at the end of the run, all that are left."""
        reports = self._channel.advance(now_ns)
        return reports + self._channel.finish() if now_ns == self._end_ns else reports

    def levels_dbm(self, states: States) -> Array:
        """The mean level of each vehicle's radio, by row, at each other's, by column, (n, n) dBm; NaN at itself."""
        return self._channel.levels_dbm(states.names, states.position)

    def close(self) -> None:
        """Release the channel."""
        self._channel.close()

    def adjustable(self) -> dict[str, float]:
        """The keys that an operator may change while the run goes on, and what they are now: ``radio.loss.probability``."""
        return self._channel.operated.numbers()

    def check_change(self, key: str, value: float, earlier: Sequence[tuple[str, float]] = ()) -> None:
        """Refuse a change that cannot be made; changes nothing.

        Args:
            key: as in `adjustable`.
            value: what it is to be.
            earlier: changes that are made before it.

        Raises:
            ValueError: there is no such key, or it cannot be this.
        """
        self._channel.operated.check(key, value, earlier)

    def _obey(self, inbox: Sequence[Event]) -> list[FrameReport]:
        """Do what the operator wants, each at its own time: the reports of frames that were decided before."""
        reports: list[FrameReport] = []
        for event in inbox:
            value = event.value
            if isinstance(value, _ORDERS):
                reports += self._channel.advance(event.time_ns - 1)
            if isinstance(value, Outage):
                self._channel.cut_off(value.vehicles, event.time_ns, value.until_ns)
            elif isinstance(value, Changed):
                self._channel.change(value.key, value.value)
        return reports

    def _sent(self, inbox: Sequence[Event], now_ns: int) -> Iterator[Post]:
        """What is sent: time (ns), message, how much later it reaches the queue of its radio (ns); of a datagram its number."""
        alone = len({event.value.sender for event in inbox if isinstance(event.value, Message)}) == 1
        for event in inbox:
            if isinstance(event.value, Message):
                at_ns = self._handed_over(event.value.sender, event.time_ns, alone=alone)
                yield event.time_ns, event.value, at_ns - event.time_ns, None
            elif isinstance(event.value, Datagrams):
                for number, sent_ns, message in self._from_programs(event.value):
                    late_ns = max(0, now_ns - sent_ns) if self._channel.contends else 0  # the air of the past is taken
                    yield sent_ns, message, late_ns, number

    def _from_programs(self, datagrams: Datagrams) -> Iterator[tuple[int, int, Message]]:
        """Number, time (ns) and message of each datagram."""
        vehicles, payloads = self._vehicles, datagrams.payloads or itertools.repeat(b"")
        columns = (datagrams.number, datagrams.sender, datagrams.to, datagrams.size_bytes, datagrams.sent_ns)
        for number, sender, to, size, sent_ns, payload in zip(*(each.tolist() for each in columns), payloads, strict=False):
            message = Message(sender=vehicles[sender], body=payload, size_bytes=size, to=None if to < 0 else vehicles[to])
            yield number, sent_ns, message

    def _handed_over(self, sender: str, sent_ns: int, *, alone: bool) -> int:
        """When a message reaches the queue of its radio."""
        if not self._handover_ns:
            return sent_ns
        if sender not in self._handover:
            self._handover[sender] = stream(self._seed, f"radio/{sender}/handover")
        wait_ns = int(self._handover[sender].random() * self._handover_ns)
        at_ns = sent_ns if alone else sent_ns + wait_ns
        self._handed_ns[sender] = max(at_ns, self._handed_ns.get(sender, 0))
        return self._handed_ns[sender]

    def _events(self, reports: Sequence[FrameReport], now_ns: int) -> list[Event]:
        """What became of frames, and what agents hear; first of datagrams, all in one event."""
        if not reports:
            return []
        carried, heard, events = TrafficLog(), list[Event](), list[Event]()
        for report in reports:
            message, datagram = self._open.pop(report.frame)
            if datagram is None:
                events.append(Event("radio/frame", now_ns, report))
                events += self._receptions(message, report, 0)
                continue
            carried.report(report, datagram)
            carried.settle(datagram)
            for receiver, _, at_ns in received(report):
                carried.arrive(datagram, self._row[receiver], at_ns, report.frame)
            if message.body:
                heard += self._receptions(message, report, now_ns + 1)
        return [*carried.events(now_ns), *heard, *events]

    def _receptions(self, message: Message, report: FrameReport, least_ns: int) -> list[Event]:
        """What agents hear of a frame, not before ``least_ns``."""
        keys, sent_ns = self._heard, report.sent_ns
        return [
            Event(
                keys[receiver],
                at_ns if at_ns > least_ns else least_ns,  # noqa: FURB136  a call less than max()
                Reception(message=message, rssi_dbm=rssi_dbm, sent_ns=sent_ns, received_ns=at_ns),
            )
            for receiver, rssi_dbm, at_ns in received(report)
        ]
