"""From what a radio receives to what arrives: jammers, losses, delays, and the report of it all."""

import msgspec
import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.tables.radio_frames import UNDER_WAY
from vcmvsp.cosim.types import FrameReport, frozen
from vcmvsp.netsim.channel.frames import FrameBatch, SentFrame
from vcmvsp.netsim.channel.link_budget import ReceiverModel
from vcmvsp.netsim.impairments.delivery import Delivery
from vcmvsp.netsim.impairments.script import Script
from vcmvsp.netsim.impairments.trace import Trace
from vcmvsp.netsim.interfaces.layers import Bools, Delay, Floats, Frame, Ints, Loss, T, sealed
from vcmvsp.netsim.interfaces.link_draws import DELAY_SLOT, DELIVERY_SLOT, JAMMER_SLOT, LOSS_SLOT, SCRIPT_SLOT, TRACE_SLOT, Make
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
"""What codes mean: `Fate`, then why a frame was too weak."""


class OnAir(msgspec.Struct, frozen=True):
    """What became of a frame on the air."""

    fate: Codes  # (n,) `Fate` at all receivers
    start_ns: int  # of the last attempt; -1: it was never sent
    end_ns: int  # of that attempt, or when it was given up
    snr_db: Floats  # (n,) there
    sinr_db: Floats  # (n,) the least while it was on the air


class Outcomes:
    """Everything behind the receiver."""

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
        outages: Script | None = None,
    ) -> None:
        self._hearing, self._delay, self._script, self._trace, self._delivery = hearing, delay, script, trace, delivery
        losses: list[tuple[Loss | None, int]] = [(outages, SCRIPT_SLOT)]  # first: they decide before all others
        losses += [(loss, LOSS_SLOT), (script, SCRIPT_SLOT), (trace, TRACE_SLOT)]
        self._losses = [(layer, _by_draws(layer, "lost"), slot) for layer, slot in losses if layer is not None]
        self._delay_ns_by: Make | None = _by_draws(delay, "delay_ns")
        causes = [layer.cause for layer, _, _ in self._losses]
        causes += [] if delivery is None else [delivery.cause]
        words = [*WORDS, *causes]
        if not fades:  # what is weaker than its mean level is so by one of these
            words[words.index("fading")] = "trace" if script is None else "script"
        self._words = np.array(words, object)  # taken from by array, not in a loop

    @property
    def plain(self) -> bool:
        """Whether everything arrives that a radio receives, when the frame ends."""
        return not self._losses and self._delay is None and self._trace is None and self._delivery is None

    @property
    def by_draws(self) -> bool:
        """Whether what becomes of a frame behind the receiver goes by its draws alone."""
        layers_do = all(lost_by is not None for _, lost_by, _ in self._losses)
        own = self._delay is not None and self._delay_ns_by is None
        return layers_do and not own and self._script is None and self._trace is None and self._delivery is None

    def reports(self, chorus: FrameBatch, code: Codes) -> list[FrameReport]:
        """What becomes of several broadcasts whose fate on the air is ``code``, (k, n); where it goes on `by_draws`."""
        senders, every, snr_db = chorus.senders, chorus.every, sealed(chorus.heard.snr_db)
        if np.count_nonzero(too_weak := code == _UNDETECTED):
            code = np.where(too_weak, TOO_WEAK + self._hearing.weakness_together(every), code)
        for index, (_, lost_by, slot) in enumerate(self._losses):
            assert lost_by is not None  # noqa: S101  see by_draws
            code = np.where((code == 0) & chorus.made(slot, lost_by), np.uint8(_JAMMED + 1 + index), code)
        arrival: Ints = np.array(chorus.end_ns)[:, None]
        if self._delay_ns_by is not None:
            arrival = np.maximum(chorus.sent_ns + chorus.made(DELAY_SLOT, self._delay_ns_by), arrival)
        arrival = sealed(np.where(code == 0, arrival, -1))
        words = self._words[code].tolist()
        reports: list[FrameReport] = []
        rows = zip(every.distance_m, every.level_dbm, arrival, words, snr_db, every.path_loss_db, strict=True)
        for k, (distance_m, level_dbm, received_ns, outcome, over_noise_db, path_loss_db) in enumerate(rows):
            sender, message, air_ns = senders[k], chorus.messages[k], chorus.air_ns[k]
            report = FrameReport(
                frame=chorus.first + k,
                sender=message.sender,
                sent_ns=chorus.sent_ns,
                size_bytes=message.size_bytes,
                receivers=sender.links.receivers,
                distance_m=distance_m,
                rssi_dbm=level_dbm,
                received_ns=received_ns,
                outcome=tuple(outcome),
                air_time_ns=air_ns,
                queue_ns=chorus.end_ns[k] - air_ns - chorus.sent_ns,
                snr_db=over_noise_db,
                sinr_db=over_noise_db,
                path_loss_db=path_loss_db,
            )
            reports.append(report)
        return reports

    def report(self, sent: SentFrame, air: OnAir, interference_mw: Floats | None = None) -> FrameReport:
        """What becomes of a frame at every receiver that it is meant for.

        Args:
            sent: the frame.
            air: what became of it at all receivers.
            interference_mw: of jammers, (n,); None: there are none, or it was never sent.
        """
        sender, mean, to, on_air = sent.sender, sent.mean, sent.meant, air.start_ns >= 0
        frame = sent.frame_at(air.start_ns, air.end_ns, sent.level_dbm)
        code, sinr_db = air.fate, air.sinr_db
        if np.count_nonzero(code) and np.count_nonzero(too_weak := code == _UNDETECTED):
            code = np.where(too_weak, TOO_WEAK + self._hearing.weakness(mean), code)
        if interference_mw is not None:
            sinr_db, code = self._jam(sent, air, code, interference_mw)
        if self._losses:
            code = self._lose(sent, frame, code)
        code = code[to]
        arrival = sealed(self._arrivals(code, self._arrival(sent, frame, air, to)))
        copy_ns = None
        if self._delivery is not None:
            draw, rows = sent.draw(DELIVERY_SLOT), sender.others[to]
            arrival, copy_ns = self._delivery.deliver(sender.row, rows, arrival, sent.message.size_bytes, lambda: draw()[to])
            code = np.where((code == 0) & (arrival < 0), np.uint8(len(self._words) - 1), code)
        of_mean, snr_db = mean.told(sender.links.receivers, to), frozen(air.snr_db[to])
        head_ns = max(sent.sent_ns, sender.free_ns)  # when it became the sender's first
        if on_air:
            sender.free_ns = max(sender.free_ns, air.end_ns)
        return FrameReport(
            frame=sent.frame,
            sender=sender.links.sender,
            sent_ns=sent.sent_ns,
            size_bytes=sent.message.size_bytes,
            receivers=of_mean.receivers,
            distance_m=of_mean.distance_m,
            rssi_dbm=of_mean.level_dbm if sent.level_dbm is mean.level_dbm else frozen(sent.level_dbm[to]),
            received_ns=frozen(arrival),
            copy_ns=None if copy_ns is None else frozen(copy_ns),
            outcome=tuple(self._words[code].tolist()) if np.count_nonzero(code) else (RECEIVED,) * len(code),
            air_time_ns=sent.air_ns if on_air else 0,
            queue_ns=max(0, (head_ns if on_air else air.end_ns) - sent.sent_ns),
            access_ns=max(0, air.start_ns - head_ns) if on_air else 0,
            snr_db=snr_db,
            sinr_db=snr_db if sinr_db is air.snr_db else frozen(sinr_db[to]),
            path_loss_db=of_mean.path_loss_db,
            walls=of_mean.walls,
            wall_materials=of_mean.materials,
            wall_loss_db=of_mean.wall_loss_db,
            shadowing_db=of_mean.shadowing_db,
            fading_db=_part(sent.fading_db, to),
        )

    def unfinished(self, sent: SentFrame) -> FrameReport:
        """The report of a frame that was not decided when the run ended."""
        snr_db = self._hearing.over_noise(sent.level_dbm)
        never = OnAir(np.full(len(snr_db), Fate.EXPIRED, np.uint8), -1, sent.sent_ns, snr_db, snr_db)
        report = self.report(sent, never)
        return msgspec.structs.replace(report, outcome=(UNDER_WAY,) * len(report.outcome))

    def _jam(self, sent: SentFrame, air: OnAir, code: Codes, interference_mw: Floats) -> tuple[Floats, Codes]:
        """What jammers leave of the SINR, and spoil of a frame that would have been received.

        What they add to the hazard of noise alone meets what is left of the receiver's patience: an exponential variate has
        no memory, so that this is another one.
        """
        sinr_db = sent.level_dbm - 10.0 * np.log10(self._hearing.noise_mw + interference_mw)
        spoilt = ~self._hearing.noticed(sinr_db)
        if self._hearing.errors is not None:
            size = sent.message.size_bytes
            more = self._hearing.errors.frame_hazard(sinr_db, size) - self._hearing.errors.frame_hazard(air.snr_db, size)
            spoilt |= sent.sender.draws.patience(sent.number, JAMMER_SLOT) <= more
        spoilt &= (interference_mw > 0.0) & (code == 0)
        share = interference_mw / np.maximum(10.0 ** (sent.level_dbm / 10.0), 1e-300)
        both_db = -10.0 * np.log10(10.0 ** (-air.sinr_db / 10.0) + share)
        return both_db, np.where(spoilt, np.uint8(_JAMMED), code)

    def _lose(self, sent: SentFrame, frame: Frame, code: Codes) -> Codes:
        decided = self._told(frame, "loss") if frame.start_ns >= 0 else None  # by a trace, whatever the models say
        if decided is not None:
            code = np.where(decided, np.uint8(Fate.RECEIVED), code)
        for index, (layer, lost_by, slot) in enumerate(self._losses):
            lost = layer.lost(frame, sent.draw(slot)) if lost_by is None else sent.sender.draws.made(sent.number, slot, lost_by)
            if decided is not None and slot == LOSS_SLOT:
                lost = lost & ~decided
            if np.count_nonzero(lost):
                lost, code = (code == 0) & lost, code.copy()
                code[lost] = _JAMMED + 1 + index
        return code

    def _arrivals(self, code: Codes, arrival: Ints | int) -> Ints:
        """The same at all for whom it is meant; -1 where it is lost."""
        every = arrival if isinstance(arrival, np.ndarray) else np.full(len(code), arrival)
        np.putmask(every, code != 0, -1)
        return every

    def _arrival(self, sent: SentFrame, frame: Frame, air: OnAir, to: slice) -> Ints | int:
        """When the frame arrives where it is not lost, ns: at each of those for whom it is meant, or the same at all."""
        if self._delay is None and self._trace is None and self._script is None:
            return air.end_ns
        draw = sent.draw(DELAY_SLOT)
        delay_ns: Ints | int
        if self._delay_ns_by is not None:
            delay_ns = sent.sender.draws.made(sent.number, DELAY_SLOT, self._delay_ns_by)
        else:
            delay_ns = 0 if self._delay is None else self._delay.delay_ns(frame, draw)
        told = self._told(frame, "delay_s")
        if told is not None and self._trace is not None:
            delay_ns = np.where(told, self._trace.delay_ns(frame, draw), delay_ns)
        arrival: Ints = np.maximum(sent.sent_ns + delay_ns, air.end_ns)
        if self._script is not None:
            arrival = arrival + self._script.delay_ns(frame, draw) - (frame.end_ns - frame.sent_ns)
        return arrival if arrival.ndim == 0 else arrival[to]

    def _told(self, frame: Frame, quantity: str) -> Bools | None:
        """For which receivers a trace has this quantity."""
        if self._trace is None or quantity not in self._trace.columns:
            return None
        return self._trace.traced(frame)


def _by_draws(layer: object, verb: str) -> Make | None:
    """What a layer answers for many frames at once; None: nothing, or a class derived from the one that does has the verb."""
    own = vars(type(layer))
    made: Make | None = getattr(layer, f"{verb}_by") if verb in own and f"{verb}_by" in own else None
    return made


def _part(values: NDArray[T] | None, to: slice) -> NDArray[T] | None:
    return None if values is None else frozen(values[to])
