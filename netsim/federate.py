"""The federate `radio`: takes positions and messages, gives receptions and frame reports."""

import itertools
from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.federate import Event, Needed, RunInfo, Slot, Step
from vcmvsp.cosim.rng import keys64, stream
from vcmvsp.cosim.types import Array, Changed, Datagrams, FrameReport, Message, Outage, Seconds, States, Traffic, frozen
from vcmvsp.cosim.util.text import Tell
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.channel.reception import ReceptionLog, TrafficLog, only, received, without_distant
from vcmvsp.netsim.routing.network import RoutingNetwork
from vcmvsp.netsim.routing.router import Routing

MANY = 1_000_000  # frames
FORECAST_AT = 20  # frames: their rate is the forecast for the rest of the run
Post = tuple[int, Message, int, int | None]  # see `RadioFederate._posts`
_ORDERS = (Outage, Changed)  # of an operator


class Network(NamedTuple):
    """One of several radios: its name, the vehicles that have it, and whether it is the first."""

    name: str
    members: tuple[str, ...]
    is_first: bool


class RadioFederate:
    """One federate for all links.

    ====================  =========  ===============================================================================
    key                   direction  value
    ====================  =========  ===============================================================================
    ``world/states``      in         `States`: positions of the vehicles; the newest counts
    ``<vehicle>/send``    in         `Message`: enters the channel at the event's time
    ``bridge/sent``       in         `Datagrams` of external programs, each at its own time, which may be shortly past
    ``operator/outage``   in         `Outage`: its vehicles lose all frames that are not decided at the event's time
    ``operator/changed``  in         `Changed`: a number of a layer, for all frames that are not decided then
    ``radio/frame``       out        `FrameReport` of a frame when it is decided: when it is sent, without contention or in a
                                     replay (`netsim.channel.replayed`), else when it ends, or at the end of the run
    ``radio/traffic``     out        `Traffic`: the same for all datagrams that are decided at an instant
    ``radio/routed``      out        `Routed`: route of a message, at its end; with routing only
    ``radio/receptions``  out        `Receptions`: of the messages that are decided at an instant, or ahead of time up to one
    ``<vehicle>/heard``   out        `Reception`, at the time of arrival, for the vehicles in ``woken``
    ====================  =========  ===============================================================================

    Agents that act at the same instant send in the same nanosecond, unlike real computers: contending radios would all find
    the medium idle and collide. So, if several vehicles send at one instant, a message takes up to ``handover_s`` to reach the
    queue of its radio, uniformly distributed, in order for each sender.

    Of several radios (`Network`) each channel has such a federate, with the vehicles that have a radio on it. Draws are those
    of the channel's own networks: what happens on another channel changes nothing.

    With routing a message may need several frames, sent by the vehicles on its route (`netsim.routing`).

    The federate is stepped with the senders, and when a frame ends on a contended medium or is forwarded; it never polls. If
    ``looks_ahead`` is set, it decides all frames up to the run's next needed instant at once, and gives events in the future.

    Attributes:
        looks_ahead: whether agents are the only senders and no order changes the channel between the run's needed instants.
    """

    name = "radio"
    slot = Slot.RADIO
    wake_slot = Slot.SEND
    reads: tuple[str, ...] = ("*/send", "bridge/sent", "operator/outage", "operator/changed")
    latest: tuple[str, ...] = ("world/states",)
    wakes: tuple[str, ...] = ("*/send", "bridge/sent")

    def __init__(
        self,
        channel: Channel,
        handover_s: Seconds = 0.002,
        router: Routing | None = None,
        programs: bool = False,  # external programs may send any number of frames
        woken: Collection[str] = (),  # vehicles with a reader that a reception wakes
        reported_from_dbm: float | None = None,  # level of receivers in reports (`without_distant`); None: any
        networks: Sequence[Network] = (),  # on this channel, of several radios; none: the only radio
        numbers: Iterator[int] | None = None,  # of the frames of all channels
        notify: Tell = lambda _: None,
    ) -> None:
        self._networks = {network.name: frozenset(network.members) for network in networks}
        self._network_of = {member: network.name for network in networks for member in network.members}
        self._takes_others = not networks or networks[0].is_first
        self._numbers, self._numbered = numbers or itertools.count(), dict[int, int]()
        if networks:
            self.name = f"radio.{'.'.join(self._networks)}"
            channel.operated.table = f"radio.{networks[0].name}"
        self._notify = notify
        self._channel, self._routing, self._programs, self._woken = channel, router, programs, frozenset(woken)
        self._least_dbm = reported_from_dbm
        self._handover_ns = seconds_to_ns(handover_s) if channel.contends else 0
        self.looks_ahead = False

    def start(self, run: RunInfo) -> int | None:
        """Start with an idle channel."""
        self._seed = run.seed
        if self._networks:
            self._seed = int(keys64(run.seed, [f"radio/networks/{'/'.join(self._networks)}"])[0] >> np.uint64(1))
        self._channel.start(self._seed, run.clocks)
        if run.paced:  # no compilation during the run, which takes seconds
            self._channel.expect(MANY if self._programs else 0)
        self._end_ns, self._vehicles = run.duration_ns, run.vehicles
        self._needed, self._ahead_ns = Needed(run), 0  # instants, and the last until which frames were decided
        self._row = {name: row for row, name in enumerate(run.vehicles)}
        self._rows: dict[tuple[str, ...], Array] = {}  # by receivers of a frame
        self._own: dict[tuple[str, ...], tuple[list[int], tuple[str, ...]]] = {}  # vehicles with a radio here, by all names
        self._states: States | None = None
        self._open: dict[int, tuple[Message, int | None]] = {}  # by undecided frame: message, number of the datagram
        self._frames = 0  # so far
        self._handover: dict[str, np.random.Generator] = {}
        self._in_queue_ns: dict[str, int] = {}  # by sender: arrival of the last message at the queue
        self._network: RoutingNetwork | None = None
        if self._routing is not None:
            names = tuple([name for name in run.vehicles if not self._networks or name in self._network_of])
            router, kind = self._routing.open(names, self._seed), type(self._routing).__name__
            self._network = RoutingNetwork(router, kind, names, self._seed, self._put, self._woken, run.vehicles)
            return self._network.next_ns()
        return None

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """Report frames that are decided by now, then send new messages."""
        reports: list[FrameReport] = []
        if self._networks:
            inbox = [event for event in inbox if self._takes(event.value)]
        for event in inbox:
            if isinstance(event.value, States):
                self._states = self._of_members(event.value)
            elif isinstance(event.value, _ORDERS):
                reports += self._apply(event.value, event.time_ns)
        # Events of the medium precede messages of the same instant.
        reports += self._with_networks(self._channel.advance(now_ns))
        if self._network is not None:
            return self._step_routed(self._network, now_ns, inbox, reports)
        posts = list(self._posts(inbox, now_ns))
        batch = self._put_all(now_ns, posts) if len(posts) > 1 else None
        reports += batch or ()
        for sent_ns, message, handover_ns, datagram in posts if batch is None else ():
            frame, decided = self._put(sent_ns, message, handover_ns)
            self._open[frame] = message, datagram
            reports += decided
        if posts or now_ns == self._end_ns:
            reports += self._decided(now_ns)
        events = self._reported(self._events(reports, now_ns))
        if posts and now_ns < self._ahead_ns:
            raise ValueError(f"a message came at {now_ns} ns; frames up to {self._ahead_ns} ns were decided without it")
        if self.looks_ahead and (posts or not self._needed.hits(now_ns)):  # else agents may send at this instant
            events += self._ahead(now_ns)
        due = self._channel.next_ns()
        return Step(events, None if due is None or now_ns == self._end_ns else min(due, self._end_ns))

    def _ahead(self, now_ns: int) -> list[Event]:
        """Events of the frames that are decided after now, up to the next needed instant.

        Reports have their own times; receptions are one event at that instant, before which no agent looks at them.
        """
        self._ahead_ns = self._needed.after(now_ns) or now_ns
        events, receptions = list[Event](), ReceptionLog(self._vehicles)
        decisions = self._channel.decisions(self._ahead_ns)
        reports = self._with_networks([report for _, report in decisions])
        for (at_ns, _), report in zip(decisions, reports, strict=True):
            self._add_receptions(receptions, self._open.pop(report.frame)[0], report)
            events.append(Event("radio/frame", at_ns, report))
        return self._reported([*events, *receptions.events(self._ahead_ns)])

    def _step_routed(self, network: RoutingNetwork, now_ns: int, inbox: Sequence[Event], reports: list[FrameReport]) -> Step:
        posts = list(self._posts(inbox, now_ns))
        network.note(reports, now_ns + bool(posts))  # later, if agents of this instant have acted already
        reports = network.go_on(now_ns)
        for sent_ns, message, handover_ns, datagram in posts:
            reports += network.send(sent_ns, message, handover_ns=handover_ns, datagram=datagram)
        reports += self._decided(now_ns)
        network.note(reports, now_ns + 1)
        if now_ns == self._end_ns:
            network.finish()
        due = [each for each in (self._channel.next_ns(), network.next_ns()) if each is not None]
        return Step(
            self._reported(network.events(now_ns)), None if not due or now_ns == self._end_ns else min(*due, self._end_ns)
        )

    def _put_all(self, now_ns: int, posts: Sequence[Post]) -> list[FrameReport] | None:
        """Send all messages of this instant in one batch; None: no batch is possible."""
        if self._states is None or any(post[0] != now_ns or post[2] for post in posts):
            return None
        names, position = self._states.names, self._states.position
        reports = self._channel.send_all(now_ns, [post[1] for post in posts], names, position)
        if reports is None:
            return None
        for _, message, _, datagram in posts:
            self._open[self._number()] = message, datagram
        return self._with_networks(reports)

    def _put(self, sent_ns: int, frame: Message, handover_ns: int) -> tuple[int, list[FrameReport]]:
        """Hand a frame to the channel; returns its number and the reports of decided frames."""
        if self._states is None:
            raise ValueError(f"{frame.sender} sends before the first message of world/states: it has no position yet")
        number = self._number()
        if self._frames == FORECAST_AT and sent_ns > 0:
            self._channel.foresee(FORECAST_AT * (self._end_ns - sent_ns) // sent_ns)
        states = self._states
        reports = self._channel.send(
            sent_ns, frame, states.names, states.position, attitude=states.attitude, handover_ns=handover_ns
        )
        return number, self._with_networks(reports)

    def _decided(self, now_ns: int) -> list[FrameReport]:
        """Reports of frames that are decided by now; at the end of the run, of all frames."""
        reports = self._channel.advance(now_ns)
        return self._with_networks(reports + self._channel.finish() if now_ns == self._end_ns else reports)

    def levels_dbm(self, states: States) -> Array:
        """Mean levels, (n, n) dBm: sender by row, receiver by column, NaN at the sender and without a radio."""
        own = self._of_members(states)
        levels_dbm = self._channel.levels_dbm(own.names, own.position, own.attitude)
        if own is states:
            return levels_dbm
        rows = [states.names.index(name) for name in own.names]
        every = np.full((len(states.names), len(states.names)), np.nan)
        every[np.ix_(rows, rows)] = levels_dbm
        return every

    def close(self) -> None:
        """Release the channel; report antennas that were inside a solid."""
        self._channel.close()
        if enclosed := self._channel.budgets.enclosed:
            which = "; ".join(f"{name} in {solid}" for name, solid in enclosed.items())
            self._notify(f"radio.path_loss: {len(enclosed)} antennas were inside a solid, reached over the roofs only: {which}")

    @property
    def networks(self) -> tuple[str, ...]:
        """Names of the radios on this channel; none: the only radio."""
        return tuple(self._networks)

    def adjustable(self) -> dict[str, float]:
        """Keys that may change during the run, with their values: ``radio.loss.probability``.

        Of several radios the key names one, ``radio.lora.loss.probability``: of those on one channel, which is one medium, the
        first.
        """
        return self._channel.operated.numbers()

    def check_change(self, key: str, value: float, earlier: Sequence[tuple[str, float]] = ()) -> None:
        """Check a change of a key of `adjustable` after ``earlier`` changes, without making it.

        Raises:
            ValueError: unknown key, or invalid value.
        """
        own = self.adjustable()
        self._channel.operated.check(key, value, [each for each in earlier if each[0] in own])

    def _apply(self, order: Outage | Changed, at_ns: int) -> list[FrameReport]:
        """Apply an operator's order at its time; returns the reports of frames that were decided before."""
        reports = self._with_networks(self._channel.advance(at_ns - 1))
        if isinstance(order, Outage):
            self._channel.cut_off(order.vehicles, at_ns, order.until_ns)
        else:
            self._channel.change(order.key, order.value)
        return reports

    def _posts(self, inbox: Sequence[Event], now_ns: int) -> Iterator[Post]:
        """New messages: time (ns), message, delay until it reaches the queue of its radio (ns), number of the datagram."""
        alone = len({event.value.sender for event in inbox if isinstance(event.value, Message)}) == 1
        for event in inbox:
            if isinstance(event.value, Message):
                at_ns = self._queue_arrival_ns(event.value.sender, event.time_ns, alone=alone)
                yield event.time_ns, self._addressed(event.value), at_ns - event.time_ns, None
            elif isinstance(event.value, Datagrams):
                for number, sent_ns, message in self._from_programs(event.value):
                    late_ns = max(0, now_ns - sent_ns) if self._channel.contends else 0  # no sending in the past
                    yield sent_ns, self._addressed(message), late_ns, number

    def _from_programs(self, datagrams: Datagrams) -> Iterator[tuple[int, int, Message]]:
        """Number, time (ns) and message of each datagram."""
        vehicles, payloads = self._vehicles, datagrams.payloads or itertools.repeat(b"")
        columns = (datagrams.number, datagrams.sender, datagrams.to, datagrams.size_bytes, datagrams.sent_ns)
        for number, sender, to, size, sent_ns, payload in zip(*(each.tolist() for each in columns), payloads, strict=False):
            message = Message(sender=vehicles[sender], body=payload, size_bytes=size, to=None if to < 0 else vehicles[to])
            yield number, sent_ns, message

    def _queue_arrival_ns(self, sender: str, sent_ns: int, *, alone: bool) -> int:
        """Time at which a message reaches the queue of its radio."""
        if not self._handover_ns:
            return sent_ns
        if sender not in self._handover:
            self._handover[sender] = stream(self._seed, f"radio/{sender}/handover")
        wait_ns = int(self._handover[sender].random() * self._handover_ns)
        at_ns = sent_ns if alone else sent_ns + wait_ns
        self._in_queue_ns[sender] = max(at_ns, self._in_queue_ns.get(sender, 0))
        return self._in_queue_ns[sender]

    def _events(self, reports: Sequence[FrameReport], now_ns: int) -> list[Event]:
        """Events of decided frames: first one for all datagrams, then receptions, datagrams first, and reports."""
        if not reports:
            return []
        receptions, events = ReceptionLog(self._vehicles, self._woken), list[Event]()
        traffic: TrafficLog | None = None
        with_messages: list[tuple[Message, FrameReport]] = []
        for report in reports:
            message, datagram = self._open.pop(report.frame)
            if datagram is None:
                events.append(Event("radio/frame", now_ns, report))
                with_messages.append((message, report))
                continue
            traffic = traffic or TrafficLog()
            traffic.report(report, datagram)
            traffic.settle(datagram)
            for receiver, _, at_ns in received(report):
                traffic.arrive(datagram, self._row[receiver], at_ns, report.frame)
            if message.body:
                self._add_receptions(receptions, message, report)
        for message, report in with_messages:
            self._add_receptions(receptions, message, report)
        of_programs = traffic.events(now_ns) if traffic else []
        return [*of_programs, *receptions.events(now_ns), *events]

    def _takes(self, value: object) -> bool:
        """Whether a value of the inbox concerns this channel."""
        if isinstance(value, Message | Datagrams):
            return value.radio in self._networks if value.radio else self._takes_others
        return not isinstance(value, Changed) or value.key in self.adjustable()

    def _of_members(self, states: States) -> States:
        """Names and positions of the vehicles with a radio on this channel."""
        if not self._networks:
            return states
        if states.names not in self._own:
            rows = [row for row, name in enumerate(states.names) if name in self._network_of]
            self._own[states.names] = rows, tuple([states.names[row] for row in rows])
        rows, names = self._own[states.names]
        if len(rows) == len(states.names):
            return states
        position, attitude = frozen(states.position[rows]), frozen(states.attitude[rows])
        return msgspec.structs.replace(states, names=names, position=position, attitude=attitude)

    def _number(self) -> int:
        """The number in the run of the channel's next frame."""
        frame, self._frames = self._frames, self._frames + 1
        if not self._networks:
            return frame
        number = self._numbered[frame] = next(self._numbers)
        return number

    def _with_networks(self, reports: list[FrameReport]) -> list[FrameReport]:
        """The reports with the names of their networks, at the vehicles of these alone, and the numbers of the run."""
        if not self._networks:
            return reports
        return [self._with_network(report) for report in reports]

    def _with_network(self, report: FrameReport) -> FrameReport:
        name = self._network_of[report.sender]
        if len(self._networks) > 1:
            is_member = np.array([each in self._networks[name] for each in report.receivers], np.bool_)
            report = only(report, is_member) if not is_member.all() else report
        return msgspec.structs.replace(report, frame=self._numbered.pop(report.frame), radio=name)

    def _addressed(self, message: Message) -> Message:
        """The message with the name of its sender's radio on this channel, of several radios."""
        if message.radio or message.sender not in self._network_of:
            return message
        return msgspec.structs.replace(message, radio=self._network_of[message.sender])

    def _reported(self, events: list[Event]) -> list[Event]:
        """The events, in reports without receivers below the least level."""
        least_dbm = self._least_dbm
        if least_dbm is None:
            return events
        for place, event in enumerate(events):
            value = event.value
            if isinstance(value, FrameReport):
                events[place] = Event(event.key, event.time_ns, without_distant(value, least_dbm))
            elif isinstance(value, Traffic):
                reports = tuple([without_distant(each, least_dbm) for each in value.reports])
                events[place] = Event(event.key, event.time_ns, msgspec.structs.replace(value, reports=reports))
        return events

    def _add_receptions(self, log: ReceptionLog, message: Message, report: FrameReport) -> None:
        rows = self._rows.get(report.receivers)
        if rows is None:
            rows = self._rows[report.receivers] = np.array([self._row[name] for name in report.receivers])
        log.add(message, report.sent_ns, rows, report.rssi_dbm, report.received_ns)
        if report.copy_ns is not None:
            log.add(message, report.sent_ns, rows, report.rssi_dbm, report.copy_ns)
