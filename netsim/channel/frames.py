"""Transmitters, frames, their levels, and contended frames from the queue until the medium has decided them."""

from collections.abc import Callable, Iterator, Sequence
from heapq import heappop, heappush
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.rng import link_uniform
from vcmvsp.cosim.types import Message
from vcmvsp.netsim.channel.link_budget import AT_ONCE, Budgets, MeanBudget, ReceivedSignal, ReceiverModel
from vcmvsp.netsim.impairments.script import Script
from vcmvsp.netsim.impairments.trace import Trace
from vcmvsp.netsim.interfaces.layers import (
    ACK_FADING_SLOT,
    ERROR_SLOT,
    FADING_SLOT,
    RETRY_FADING_SLOT,
    SCRIPT_SLOT,
    Draw,
    Fading,
    Floats,
    Frame,
    LinkDraws,
    SenderLinks,
    sealed,
)
from vcmvsp.netsim.interfaces.medium import Codes, DecidedFrames, Fate, Medium, Offered


class Transmitter:
    """State of a transmitter between frames."""

    links: SenderLinks
    draws: LinkDraws
    row: int  # among the vehicles
    others: NDArray[np.intp]  # rows of the others

    def __init__(self) -> None:
        self.names: tuple[str, ...] = ()  # all vehicles
        self.frames = 0  # sent so far: its draws depend on this number, not on frames of others
        self.free_ns = 0  # time at which its last frame was decided

    def meet(self, links: SenderLinks, names: tuple[str, ...]) -> None:
        """Set the links to all other vehicles."""
        self.links, self.names, self.row = links, names, names.index(links.sender)
        self.others = np.delete(np.arange(len(names)), self.row)
        self.draws = LinkDraws(links)

    def destination(self, to: str | None) -> slice:
        """Places of the receivers of a message to ``to`` (None: all)."""
        if to is None:
            return slice(None)
        if to not in self.links.receivers:
            raise ValueError(f"unknown receiver {to!r}; receivers: {', '.join(self.links.receivers) or 'none'}")
        place = self.links.receivers.index(to)
        return slice(place, place + 1)


class SentFrame(msgspec.Struct):
    """A frame on its way."""

    frame: int  # number in the channel
    sender: Transmitter
    number: int  # of the sender's frames
    message: Message
    destination: slice  # places of the receivers
    sent_ns: int  # handed to the radio
    air_ns: int
    mean: MeanBudget
    level_dbm: Floats  # (n,) at all receivers, of the last attempt
    fading_db: Floats | None = None
    attempts: int = 1  # so far
    tries: list[tuple[Floats, Floats | None]] = []  # level and fading of each attempt, if they differ

    def frame_at(self, start_ns: int, end_ns: int, level_dbm: Floats) -> Frame:
        """The frame as an argument of layers, with levels (n,) dBm."""
        size = self.message.size_bytes
        return Frame(self.sent_ns, start_ns, end_ns, size, self.mean.paths, level_dbm, self.sender.links)

    def draw(self, slot: int) -> Draw:
        """Draws of one layer."""
        return lambda: self.sender.draws.uniform(self.number, slot)


class FrameBatch(msgspec.Struct):
    """k frames after the medium, each at the n radios other than its sender."""

    frames: Sequence[SentFrame]  # (k,)
    fate: Codes  # (k, n) `Fate`
    start_ns: Sequence[int]  # (k,) of the last attempt; -1: never sent
    end_ns: Sequence[int]  # (k,) of that attempt, or the time at which the frame was given up
    snr_db: Floats  # (k, n)
    sinr_db: Floats  # (k, n) minimum over the frame
    interference_mw: Floats | None = None  # (k, n) of jammers


class RxPower:
    """The layers that change the level of each attempt; None: no such layer."""

    def __init__(self, fading: Fading | None, script: Script | None, trace: Trace | None) -> None:
        self._fading, self._script, self._trace = fading, script, trace
        self.vary = any(layer is not None for layer in (fading, script, trace))  # whether levels change from attempt to attempt

    def set(self, sent: SentFrame, start_ns: int) -> None:
        """Set the level of an attempt that starts at ``start_ns``."""
        if not self.vary:
            return
        frame = sent.frame_at(start_ns, start_ns + sent.air_ns, sent.mean.level_dbm)
        level_dbm = sent.mean.level_dbm
        if self._fading is not None:
            slot = RETRY_FADING_SLOT + sent.attempts if sent.attempts > 1 else FADING_SLOT
            sent.fading_db = self._fading.gain_db(frame, sent.draw(slot))
            level_dbm = level_dbm + sent.fading_db
        if self._trace is not None:
            traced_dbm = self._trace.level_dbm(frame)
            level_dbm = np.where(np.isnan(traced_dbm), level_dbm, traced_dbm)
        if self._script is not None:
            level_dbm = level_dbm + self._script.gain_db(frame, sent.draw(SCRIPT_SLOT))
        sent.level_dbm = level_dbm

    def answer(self, sent: SentFrame, place: int, start_ns: int) -> float:
        """Fading of an acknowledgement from the receiver at ``place`` over that of the frame, a ratio of powers.

        It fades as a frame of its own time: correlated with a Doppler shift, else independent. A traced level holds for both.
        """
        frame = sent.frame_at(start_ns, start_ns + sent.air_ns, sent.mean.level_dbm)
        is_traced = self._trace is not None and not np.isnan(self._trace.level_dbm(frame)[place])
        if self._fading is None or sent.fading_db is None or is_traced:
            return 1.0
        gain_db = self._fading.gain_db(frame, sent.draw(ACK_FADING_SLOT + sent.attempts))
        return float(10.0 ** ((gain_db[place] - sent.fading_db[place]) / 10.0))


def decode(frames: Sequence[SentFrame], signal: ReceivedSignal) -> Codes:
    """Fate of k frames without interference, (k, n); ``signal``: (k, n)."""
    if signal.hazard is None or not (doubtful := signal.doubtful)[0].size:
        return signal.fate
    rows, places = doubtful
    keys = np.stack([sent.sender.links.keys for sent in frames])[rows, places]
    numbers = np.array([sent.number for sent in frames], np.uint64)[rows]
    patience = -np.log1p(-link_uniform(keys, numbers, ERROR_SLOT)[:, 0])
    lost = patience <= signal.hazard[rows, places]
    fate = signal.fate.copy()
    fate[rows[lost], places[lost]] = Fate.ERROR
    return fate


class Contention:
    """The frames under way on one medium; ``levels``: of single attempts."""

    def __init__(
        self, medium: Medium, names: tuple[str, ...], budgets: Budgets, hearing: ReceiverModel, levels: RxPower
    ) -> None:
        self.medium, self._budgets, self._hearing, self._levels = medium, budgets, hearing, levels
        self.waiting: dict[int, SentFrame] = {}  # by frame
        self._coming: list[tuple[int, int, Offered]] = []  # heap by time and frame: on their way to the queue
        self._answers: dict[int, Floats] = {}  # by frame, until it is offered: levels of its acknowledgement
        optional: Any = medium
        self._advance_many: Callable[[int], Sequence[DecidedFrames]] = getattr(medium, "advance_many", self._advance_by_frame)
        self._levels_mw: Floats | None = None  # of acknowledgements, (n, n)
        if hasattr(medium, "levels") and hasattr(medium, "sensitivity_mw"):
            self._levels_mw = optional.levels
            optional.sensitivity_mw[:] = 10.0 ** (budgets.sensitivity_dbm(names) / 10.0)
        if hasattr(medium, "power_mw"):
            optional.power_mw[:] = 10.0 ** (budgets.tx_power_dbm(names) / 10.0)

    def offer(self, sent: SentFrame, arrival_ns: int, answerer: Transmitter | None) -> None:
        """Hand over a frame that reaches its queue at ``arrival_ns``; ``answerer``: sender of the acknowledgement."""
        row = sent.sender.row

        def renew(attempt: int, start_ns: int) -> tuple[Floats, Floats]:
            sent.attempts = attempt + 1
            patience = at_all(sent.sender.draws.patience(sent.number, ERROR_SLOT + attempt), row)
            if not self._levels.vary:
                return sent.mean.power_mw, patience
            self._levels.set(sent, start_ns)
            sent.tries.append((sent.level_dbm, sent.fading_db))
            return at_all(10.0 ** (sent.level_dbm / 10.0), row), patience

        def answer(start_ns: int) -> float:
            return self._levels.answer(sent, sent.destination.start, start_ns)

        power_mw, patience = (None, None) if self._levels.vary else renew(0, 0)
        if answerer is not None and self._levels_mw is not None:
            self._answers[sent.frame] = self._budgets.at_last_positions(answerer.links).power_mw
        to, size, priority = -1 if answerer is None else answerer.row, sent.message.size_bytes, sent.message.priority
        self.waiting[sent.frame] = sent
        faded = answer if to >= 0 and self._levels.vary else None
        offered = Offered(sent.frame, arrival_ns, row, to, size, priority, power_mw, patience, renew, faded)
        heappush(self._coming, (arrival_ns, sent.frame, offered))

    def advance(self, until_ns: int) -> list[FrameBatch]:
        """Frames that the medium decides up to ``until_ns``, in order of time."""
        if not self.waiting:
            return []
        decided: list[DecidedFrames] = []
        while self._coming and self._coming[0][0] <= until_ns:
            offered = heappop(self._coming)[2]
            if offered.to >= 0 and self._levels_mw is not None:  # not earlier: an earlier acknowledgement may be on the air
                decided += self._decided(offered.time_ns)
                self._levels_mw[offered.to] = self._answers.pop(offered.number)
            self.medium.offer(offered)
        decided += self._decided(until_ns)
        return [self._settled(each) for each in decided]

    def _decided(self, until_ns: int) -> Iterator[DecidedFrames]:
        """Decisions of the medium up to ``until_ns``, in parts of at most `AT_ONCE` links."""
        for decided in self._advance_many(until_ns):
            at_once = max(1, AT_ONCE // decided.fate.shape[1])
            for start in range(0, len(decided.number), at_once):
                yield DecidedFrames._make(column[start : start + at_once] for column in decided)

    def _advance_by_frame(self, until_ns: int) -> list[DecidedFrames]:
        decided = self.medium.advance(until_ns)
        return [DecidedFrames.of(decided)] if decided else []

    def next_ns(self) -> int | None:
        """Earliest time of the next decision if no other frame is sent; None: no frame waits."""
        if not self.waiting:
            return None
        times = [arrival_ns for arrival_ns, _, _ in self._coming[:1]]  # at which the queue may be full
        due = self.medium.next_ns()
        return min(times if due is None else [*times, due])

    def _settled(self, decided: DecidedFrames) -> FrameBatch:
        frames = [self.waiting.pop(number) for number in decided.number.tolist()]
        for k, (sent, attempts) in enumerate(zip(frames, decided.attempts.tolist(), strict=True)):
            if attempts and sent.tries:  # later attempts are possible, and go on, if the acknowledgement was lost
                level_dbm, fading_db = sent.tries[attempts - 1]
                frames[k] = msgspec.structs.replace(sent, level_dbm=level_dbm, fading_db=fading_db)
        shape = len(frames), decided.fate.shape[1] - 1
        others = np.arange(shape[1] + 1) != np.array([sent.sender.row for sent in frames])[:, None]
        snr_db = self._hearing.over_noise(np.stack([sent.level_dbm for sent in frames]))
        least_sinr = decided.least_sinr[others].reshape(shape)
        least_sinr[least_sinr <= 0.0] = np.nan  # no ratio at a radio that was sending itself
        sinr_db = 10.0 * np.log10(least_sinr)
        if np.count_nonzero(decided.attempts) < len(frames):  # some were never sent
            sinr_db = np.where(decided.attempts[:, None] > 0, sinr_db, snr_db)
        fate = decided.fate[others].reshape(shape)
        return FrameBatch(frames, fate, decided.start_ns.tolist(), decided.end_ns.tolist(), snr_db, sealed(sinr_db))


def at_all(values: Floats, row: int) -> Floats:
    """Insert a zero at a row."""
    everywhere = np.zeros(len(values) + 1)  # np.insert and np.delete take ten times as long
    everywhere[:row] = values[:row]
    everywhere[row + 1 :] = values[row:]
    return everywhere
