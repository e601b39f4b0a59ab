"""Stages behind the receiver, over batches of frames: weak signals, jammers, losses, delays, delivery; and reports."""

from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.rng import link_uniform
from vcmvsp.cosim.tables.radio_frames import UNDER_WAY
from vcmvsp.cosim.types import RECEPTIONS, FrameReport, Message, Reception, Receptions, Traffic, frozen
from vcmvsp.netsim.channel.frames import FrameBatch, SentFrame, Transmitter
from vcmvsp.netsim.channel.link_budget import MeanBudget, ReceiverModel
from vcmvsp.netsim.impairments.delivery import Delivery
from vcmvsp.netsim.impairments.script import Script
from vcmvsp.netsim.impairments.trace import Trace
from vcmvsp.netsim.interfaces.layers import (
    DELAY_SLOT,
    DELIVERY_SLOT,
    ERROR_SLOT,
    JAMMER_SLOT,
    LOSS_SLOT,
    SCRIPT_SLOT,
    TRACE_SLOT,
    Bools,
    Delay,
    Draw,
    Floats,
    Frame,
    Ints,
    Keys,
    Loss,
    Make,
    T,
    sealed,
)
from vcmvsp.netsim.interfaces.medium import Codes, Fate

RECEIVED = "received"
JAMMED = "jammed"
_FATES = {
    Fate.RECEIVED: RECEIVED,
    Fate.UNDETECTED: "",  # see _WEAKNESSES
    Fate.TRANSMITTING: "receiver transmitting",
    Fate.COLLISION: "collision",
    Fate.ERROR: "packet error",
    Fate.QUEUE_FULL: "queue full",
    Fate.EXPIRED: "lifetime expired",
    Fate.BUSY_CHANNEL: "channel busy",
}
_WEAKNESSES = ("below sensitivity", "walls", "shadowing", "fading")  # in the order of `netsim.channel.link_budget`
TOO_WEAK = np.uint8(len(_FATES))  # code of the first of them
_UNDETECTED = int(Fate.UNDETECTED)  # an enumeration's members are slow to look up
_JAMMED = len(_FATES) + len(_WEAKNESSES)
WORDS = (*_FATES.values(), *_WEAKNESSES, JAMMED)
"""Outcomes by code: `Fate`, then causes of weak signals."""
_OWN = np.uint8(255)  # code at the sender itself


class Outcomes:
    """The stages behind the receiver."""

    def __init__(
        self,
        hearing: ReceiverModel,
        loss: Loss | None,
        delay: Delay | None,
        script: Script | None,
        trace: Trace | None,
        delivery: Delivery | None,
        *,
        fades: bool,
        propagation: bool = False,
        outages: Loss | None = None,
    ) -> None:
        self._hearing, self._delay, self._script, self._trace, self._delivery = hearing, delay, script, trace, delivery
        losses: list[tuple[Loss | None, int]] = [(outages, SCRIPT_SLOT)]  # first: an outage has priority
        losses += [(loss, LOSS_SLOT), (script, SCRIPT_SLOT), (trace, TRACE_SLOT)]
        self._losses = [(layer, _by_draws(layer, "lost"), slot) for layer, slot in losses if layer is not None]
        self._propagation = propagation  # whether arrivals count the travel time of the wave
        self._delay_ns_by: Make | None = _by_draws(delay, "delay_ns")
        asks = any(lost_by is None for _, lost_by, _ in self._losses) or (delay is not None and self._delay_ns_by is None)
        self._needs_frames = asks or script is not None or trace is not None  # as arguments of layers
        causes = [layer.cause for layer, _, _ in self._losses]
        causes += [] if delivery is None else [delivery.cause]
        words = [*WORDS, *causes]
        if not fades:  # without fading, only these lower the level of a single frame
            words[words.index("fading")] = "trace" if script is None else "script"
        self._words = np.array(words, object)  # taken from by array, not in a loop

    @property
    def plain(self) -> bool:
        """Whether every received frame arrives when it ends."""
        delays = self._delay is not None or self._propagation
        return not self._losses and not delays and self._trace is None and self._delivery is None

    def reports(self, batch: FrameBatch) -> list[FrameReport]:
        """Apply all stages behind the receiver to a batch.

        Each stage changes "received" into one cause of loss, never the reverse: the first cause is reported. Only a trace
        replaces the losses of the models before it.
        """
        layer_frames: list[Frame] = []
        if self._needs_frames:
            times = zip(batch.frames, batch.start_ns, batch.end_ns, strict=True)
            layer_frames = [sent.frame_at(start_ns, end_ns, sent.level_dbm) for sent, start_ns, end_ns in times]
        code, sinr_db = self._jam(batch, self._name_weak_signals(batch))
        code = self._lose(batch, layer_frames, code)
        arrival_ns = sealed(np.where(code, -1, self._arrival_ns(batch, layer_frames)))  # code 0: received
        outcomes = self._words[code].tolist() if np.count_nonzero(code) else [[RECEIVED] * code.shape[1]] * len(code)
        rows = zip(code, outcomes, arrival_ns, sealed(batch.snr_db), sealed(sinr_db), strict=True)
        return [self._report(batch, k, *row) for k, row in enumerate(rows)]

    def unfinished(self, sent: SentFrame) -> FrameReport:
        """Report of a frame that was not decided at the end of the run."""
        snr_db = self._hearing.over_noise(sent.level_dbm)[None]
        expired = np.full(snr_db.shape, Fate.EXPIRED, np.uint8)
        (report,) = self.reports(FrameBatch([sent], expired, [-1], [sent.sent_ns], snr_db, snr_db))
        return msgspec.structs.replace(report, outcome=(UNDER_WAY,) * len(report.outcome))

    def _name_weak_signals(self, batch: FrameBatch) -> Codes:
        """Replace "undetected" by the cause of the weak signal, (k, n)."""
        if not np.count_nonzero(batch.fate):
            return batch.fate
        too_weak = batch.fate == _UNDETECTED
        if not np.count_nonzero(too_weak):
            return batch.fate
        return np.where(too_weak, TOO_WEAK + self._hearing.weaknesses([sent.mean for sent in batch.frames]), batch.fate)

    def _jam(self, batch: FrameBatch, code: Codes) -> tuple[Codes, Floats]:
        """Apply jammers: codes and SINR, (k, n) each.

        The hazard that they add to that of noise alone is compared with the remaining patience of the receiver, which is again
        an exponential variate, as these have no memory.
        """
        if batch.interference_mw is None:
            return code, batch.sinr_db
        level_dbm = np.stack([sent.level_dbm for sent in batch.frames])
        sinr_db = level_dbm - 10.0 * np.log10(self._hearing.noise_mw + batch.interference_mw)
        jammed = ~self._hearing.noticed(sinr_db)
        if (errors := self._hearing.errors) is not None:
            for k, sent in enumerate(batch.frames):
                size = sent.message.size_bytes
                added = errors.frame_hazard(sinr_db[k], size) - errors.frame_hazard(batch.snr_db[k], size)
                jammed[k] |= sent.sender.draws.patience(sent.number, JAMMER_SLOT) <= added
        jammed &= (batch.interference_mw > 0.0) & (code == 0)
        ratio = batch.interference_mw / np.maximum(10.0 ** (level_dbm / 10.0), 1e-300)
        total_db = -10.0 * np.log10(10.0 ** (-batch.sinr_db / 10.0) + ratio)
        on_air = np.array(batch.start_ns)[:, None] >= 0
        return np.where(jammed & on_air, np.uint8(_JAMMED), code), np.where(on_air, total_db, batch.sinr_db)

    def _lose(self, batch: FrameBatch, layer_frames: Sequence[Frame], code: Codes) -> Codes:
        traced = self._traced(layer_frames, "loss")
        if traced is not None:
            traced &= np.array(batch.start_ns)[:, None] >= 0
            code = np.where(traced, np.uint8(Fate.RECEIVED), code)
        for index, (layer, lost_by, slot) in enumerate(self._losses):
            lost = _answers(batch, layer_frames, layer.lost, lost_by, slot)
            if traced is not None and slot == LOSS_SLOT:
                lost = lost & ~traced
            if np.count_nonzero(lost):
                code = np.where(code, code, lost * np.uint8(_JAMMED + 1 + index))
        return code

    def _arrival_ns(self, batch: FrameBatch, layer_frames: Sequence[Frame]) -> Ints | int:
        """Time of arrival if a frame is not lost, ns: (k, n), (k, 1), or of a single frame without delays its end."""
        end_ns = heard_ns = _rows(batch.end_ns)
        if self._propagation:
            heard_ns = end_ns + np.stack([sent.mean.propagation_ns for sent in batch.frames])
        if self._delay is None and self._trace is None and self._script is None:
            return heard_ns
        sent_ns = _rows([sent.sent_ns for sent in batch.frames])
        delay_ns: Ints | int = 0
        if self._delay is not None:
            delay_ns = _answers(batch, layer_frames, self._delay.delay_ns, self._delay_ns_by, DELAY_SLOT)
        traced = self._traced(layer_frames, "delay_s")
        if traced is not None and self._trace is not None:
            delay_ns = np.where(traced, _answers(batch, layer_frames, self._trace.delay_ns, None, DELAY_SLOT), delay_ns)
        arrival_ns: Ints = np.maximum(sent_ns + delay_ns, heard_ns)
        if self._script is None:
            return arrival_ns
        return arrival_ns + _answers(batch, layer_frames, self._script.delay_ns, None, DELAY_SLOT) - (end_ns - sent_ns)

    def _traced(self, layer_frames: Sequence[Frame], quantity: str) -> Bools | None:
        """Links for which a trace has this quantity, (k, n); None: no trace has it."""
        if self._trace is None or quantity not in self._trace.columns:
            return None
        return np.stack([self._trace.traced(frame) for frame in layer_frames])

    def _report(
        self,
        batch: FrameBatch,
        k: int,
        code: Codes,
        outcomes: list[str],
        arrival_ns: Ints,
        snr_db: Floats,
        sinr_db: Floats,
    ) -> FrameReport:
        """Report of frame k at its receivers, after delivery; rows (n,) of the batch, read-only."""
        sent, start_ns, end_ns = batch.frames[k], batch.start_ns[k], batch.end_ns[k]
        sender, to = sent.sender, sent.destination
        columns = sent.mean.report_columns(to)
        if sent.level_dbm is not sent.mean.level_dbm:
            columns = {**columns, "rssi_dbm": frozen(sent.level_dbm[to])}
        if sent.fading_db is not None:
            columns = {**columns, "fading_db": frozen(sent.fading_db[to])}
        if to.start is not None:
            code, outcomes = code[to], outcomes[to]
            arrival_ns, snr_db, sinr_db = arrival_ns[to], snr_db[to], sinr_db[to]
        if self._delivery is not None:
            draw, rows, size = sent.draw(DELIVERY_SLOT), sender.others[to], sent.message.size_bytes
            arrival_ns, copy_ns = self._delivery.deliver(sender.row, rows, arrival_ns, size, lambda: draw()[to])
            outcomes = self._words[np.where((code == 0) & (arrival_ns < 0), len(self._words) - 1, code)].tolist()
            arrival_ns, columns = frozen(arrival_ns), {**columns, "copy_ns": frozen(copy_ns)}
        air_time_ns, queue_ns, access_ns = 0, max(0, end_ns - sent.sent_ns), 0
        if start_ns >= 0:  # it was sent
            head_ns = max(sent.sent_ns, sender.free_ns)  # time at which it became the first of its sender's queue
            air_time_ns, queue_ns, access_ns = sent.air_ns, head_ns - sent.sent_ns, max(0, start_ns - head_ns)
            sender.free_ns = max(sender.free_ns, end_ns)
        return FrameReport(
            frame=sent.frame,
            sender=sender.links.sender,
            sent_ns=sent.sent_ns,
            size_bytes=sent.message.size_bytes,
            received_ns=arrival_ns,
            outcome=tuple(outcomes),
            air_time_ns=air_time_ns,
            queue_ns=queue_ns,
            access_ns=access_ns,
            snr_db=snr_db,
            sinr_db=sinr_db,
            **columns,
        )


def _answers(
    batch: FrameBatch,
    layer_frames: Sequence[Frame],
    verb: Callable[[Frame, Draw], NDArray[T]],
    by_draws: Make | None,
    slot: int,
) -> NDArray[T]:
    """Answers of a layer for each frame, (k, n): from its draws alone if possible."""
    if by_draws is not None:
        rows = [sent.sender.draws.compute(sent.number, slot, by_draws) for sent in batch.frames]
    else:
        rows = [verb(frame, sent.draw(slot)) for frame, sent in zip(layer_frames, batch.frames, strict=True)]
    return rows[0][None] if len(rows) == 1 else np.stack(rows)


def _rows(times_ns: Sequence[int]) -> Ints | int:
    """Times of k frames as (k, 1), or the only one."""
    return times_ns[0] if len(times_ns) == 1 else np.array(times_ns)[:, None]


def _by_draws(layer: object, verb: str) -> Make | None:
    """Method ``VERB_by`` of a layer, for many frames at once; None if its class overrides ``VERB`` alone."""
    own = vars(type(layer))
    method: Make | None = getattr(layer, f"{verb}_by") if verb in own and f"{verb}_by" in own else None
    return method


class TrafficLog:
    """Reports, arrivals and settled datagrams since the last event."""

    def __init__(self) -> None:
        self._clear()

    def report(self, report: FrameReport, datagram: int) -> None:
        """Add the report of a frame with a datagram."""
        self._reports.append(report)
        self._carries.append(datagram)

    def arrive(self, datagram: int, receiver: int, at_ns: int, frame: int) -> None:
        """Add an arrival of a datagram at the vehicle of this row."""
        self._arrivals.append((datagram, receiver, at_ns, frame))

    def settle(self, datagram: int) -> None:
        """Add a datagram without further arrivals."""
        self._settled.append(datagram)

    def events(self, now_ns: int) -> Iterator[Event]:
        """One event with everything since the last one, if there is anything."""
        if not (self._reports or self._arrivals or self._settled):
            return
        columns = np.array(self._arrivals, np.int64).reshape(-1, 4).T
        traffic = Traffic(
            reports=tuple(self._reports),
            carries=frozen(self._carries, np.int64),
            number=frozen(columns[0]),
            receiver=frozen(columns[1], np.int32),
            arrival_ns=frozen(columns[2]),
            frame=frozen(columns[3]),
            settled=frozen(self._settled, np.int64),
        )
        self._clear()
        yield Event("radio/traffic", now_ns, traffic)

    def _clear(self) -> None:
        self._reports: list[FrameReport] = []
        self._carries: list[int] = []
        self._arrivals: list[tuple[int, int, int, int]] = []
        self._settled: list[int] = []


class ReceptionLog:
    """Receptions of messages since the last event; ``woken``: vehicles with a reader that a reception wakes."""

    def __init__(self, names: tuple[str, ...], woken: Collection[str] = ()) -> None:
        self._names, self._woken = names, sorted(names.index(name) for name in woken)
        self._parts: list[tuple[Message, int, Any, Any, Any]] = []

    def add(
        self,
        message: Message,
        sent_ns: int,
        receiver: Sequence[int] | Ints,
        rssi_dbm: Sequence[float] | Floats,
        arrival_ns: Sequence[int] | Ints,
    ) -> None:
        """Add receptions of a message: rows of the receivers, levels (dBm) and times (ns; -1: lost), (n,) each."""
        self._parts.append((message, sent_ns, receiver, rssi_dbm, arrival_ns))

    def events(self, now_ns: int) -> list[Event]:
        """One event with all receptions since the last one; one more for each reception that wakes a reader."""
        if not self._parts:
            return []
        messages, sent_ns, *parts = zip(*self._parts, strict=True)
        self._parts.clear()
        number, receiver, rssi_dbm, arrival_ns = map(sealed, _arrivals(parts))
        batch = Receptions(
            names=self._names,
            messages=messages,
            sent_ns=sealed(np.array(sent_ns)),
            message=number,
            receiver=receiver,
            arrival_ns=arrival_ns,
            rssi_dbm=rssi_dbm,
        )
        if not len(receiver):
            return []
        woken = [at for row in self._woken for at in np.flatnonzero(receiver == row).tolist()]
        return [Event(RECEPTIONS, now_ns, batch), *(self._waking(batch, at, now_ns) for at in woken)]

    def _waking(self, batch: Receptions, at: int, now_ns: int) -> Event:
        number, arrival_ns = batch.message[at], int(batch.arrival_ns[at])
        reception = Reception(
            message=batch.messages[number],
            rssi_dbm=float(batch.rssi_dbm[at]),
            sent_ns=int(batch.sent_ns[number]),
            received_ns=arrival_ns,
        )
        due_ns = arrival_ns if arrival_ns >= now_ns else now_ns + 1  # a datagram may be decided after its time
        return Event(f"{self._names[batch.receiver[at]]}/heard", due_ns, reception)


def _arrivals(columns: Sequence[Sequence[Any]]) -> list[NDArray[Any]]:
    """Number of the message, receiver, level and time of each reception, of the columns of each message."""
    if len(columns[0]) == 1:
        receiver, rssi_dbm, arrival_ns = (np.asarray(part) for (part,) in columns)
        number = np.zeros(len(receiver), np.int64)
    else:
        receiver, rssi_dbm, arrival_ns = map(np.concatenate, columns)
        number = np.arange(len(columns[0])).repeat([len(each) for each in columns[0]])
    every, arrives = [number, receiver, rssi_dbm, arrival_ns], arrival_ns >= 0
    if np.count_nonzero(arrives) == len(arrives):
        return every
    return [each[arrives] for each in every]


def received(report: FrameReport) -> Iterator[tuple[str, float, int]]:
    """Receiver, level (dBm) and time (ns) of each reception of a frame, copies included."""
    for arrival_ns in (report.received_ns,) if report.copy_ns is None else (report.received_ns, report.copy_ns):
        for arrived in zip(report.receivers, report.rssi_dbm.tolist(), arrival_ns.tolist(), strict=True):
            if arrived[2] >= 0:
                yield arrived


def without_distant(report: FrameReport, least_dbm: float) -> FrameReport:
    """The report of a frame without receivers at lower levels that lost it; the one with the highest level stays."""
    is_near = (report.rssi_dbm >= least_dbm) | (report.received_ns >= 0)
    if is_near.all():
        return report
    is_near[report.rssi_dbm.argmax()] = True  # every frame has a row in the table
    return only(report, is_near)


def only(report: FrameReport, mask: Bools) -> FrameReport:
    """The report of a frame at some of its receivers, (n,)."""
    places = np.flatnonzero(mask)
    listed, rest = places.tolist(), dict[str, Any]()
    for name in report.__struct_fields__:
        value = getattr(report, name)
        if isinstance(value, np.ndarray):
            rest[name] = frozen(value[places])
        elif isinstance(value, tuple):
            rest[name] = tuple([value[place] for place in listed])
    return msgspec.structs.replace(report, **rest)


class BroadcastCounts(NamedTuple):
    """Outcomes of m broadcasts."""

    number: Ints  # (m,)
    end_ns: Ints  # (m,)
    receptions: Ints  # (m,) number of receivers
    losses: dict[str, int]  # in total, by cause


class Bulk:
    """Broadcasts of n radios at rest, by their transmitters and mean budgets, (n,)."""

    def __init__(
        self, medium: Any, senders: Sequence[Transmitter], means: Sequence[MeanBudget], hearing: ReceiverModel
    ) -> None:
        count = len(senders)
        others = ~np.eye(count, dtype=np.bool_)
        self._medium, self._power_mw = medium, np.stack([mean.power_mw for mean in means])
        self._weakness = np.zeros((count, count), np.uint8)
        self._weakness[others] = hearing.weaknesses(means).ravel()
        self._keys = np.zeros((count, count), np.uint64)
        self._keys[others] = np.concatenate([sender.links.keys for sender in senders])
        self._sender: Ints = np.zeros(0, np.int64)  # of each frame
        self._frames = np.zeros(count, np.int64)  # of each radio so far

    def send(self, time_ns: Ints, sender: Ints, size_bytes: int) -> None:
        """Offer broadcasts of one size: times, never decreasing, and rows of the senders, (k,) each."""
        numbers = len(self._sender) + np.arange(len(sender))
        self._sender = np.concatenate([self._sender, sender])
        uniform = link_uniform(self._keys[sender], self._own_numbers(sender)[:, None], ERROR_SLOT)[..., 0]
        patience = -np.log1p(-uniform)
        patience[np.arange(len(sender)), sender] = 0.0
        self._medium.offer_many(time_ns, sender, size_bytes, self._power_mw, patience, numbers)

    def advance(self, until_ns: int) -> BroadcastCounts | None:
        """Outcomes that are decided up to a time, if there are any."""
        decided = self._medium.advance_many(until_ns)
        if not decided:
            return None
        number, _, end_ns, _, fate, _ = map(np.concatenate, zip(*decided, strict=True))
        sender = self._sender[number]
        code = np.where(fate == np.uint8(Fate.UNDETECTED), TOO_WEAK + self._weakness[sender], fate)
        code[np.arange(len(sender)), sender] = _OWN
        counts = np.bincount(code.ravel(), minlength=len(WORDS))[: len(WORDS)].tolist()
        losses = {word: count for word, count in zip(WORDS[1:], counts[1:], strict=True) if count}
        return BroadcastCounts(number, end_ns, (code == 0).sum(axis=1), losses)

    def _own_numbers(self, sender: Ints) -> Keys:
        """The number of each frame, counted by sender."""
        order = np.argsort(sender, kind="stable")
        first = np.searchsorted(sender[order], sender[order])
        numbers: Ints = np.empty_like(sender)
        numbers[order] = self._frames[sender[order]] + np.arange(len(sender)) - first
        self._frames += np.bincount(sender, minlength=len(self._frames))
        return numbers.astype(np.uint64)
