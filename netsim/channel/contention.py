"""Frames on a contended medium, from the sender's queue until the medium has decided them."""

from collections.abc import Sequence
from heapq import heappop, heappush
from typing import Any, NamedTuple

import numpy as np

from vcmvsp.cosim.rng import link_uniform
from vcmvsp.netsim.channel.frames import FrameBatch, RxPower, SentFrame, Transmitter
from vcmvsp.netsim.channel.link_budget import Budgets, MeanBudget, ReceiverModel
from vcmvsp.netsim.channel.reception import TOO_WEAK, WORDS
from vcmvsp.netsim.interfaces.layers import ERROR_SLOT, Floats, Ints, Keys, sealed
from vcmvsp.netsim.interfaces.medium import Decided, Fate, Medium, Offered


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
            self._answers[sent.frame] = self._budgets.here(answerer.links).power_mw
        to, size, priority = -1 if answerer is None else answerer.row, sent.message.size_bytes, sent.message.priority
        self.waiting[sent.frame] = sent
        faded = answer if to >= 0 and self._levels.vary else None
        offered = Offered(sent.frame, arrival_ns, row, to, size, priority, power_mw, patience, renew, faded)
        heappush(self._coming, (arrival_ns, sent.frame, offered))

    def advance(self, until_ns: int) -> list[FrameBatch]:
        """Frames that the medium decides up to ``until_ns``, one by one."""
        if not self.waiting:
            return []
        decided: list[Decided] = []
        while self._coming and self._coming[0][0] <= until_ns:
            offered = heappop(self._coming)[2]
            if offered.to >= 0 and self._levels_mw is not None:  # not earlier: an earlier acknowledgement may be on the air
                decided += self.medium.advance(offered.time_ns)
                self._levels_mw[offered.to] = self._answers.pop(offered.number)
            self.medium.offer(offered)
        decided += self.medium.advance(until_ns)
        return [self._settled(each) for each in decided]

    def next_ns(self) -> int | None:
        """Earliest time of the next decision if no other frame is sent; None: no frame waits."""
        if not self.waiting:
            return None
        times = [arrival_ns for arrival_ns, _, _ in self._coming[:1]]  # at which the queue may be full
        due = self.medium.next_ns()
        return min(times if due is None else [*times, due])

    def _settled(self, decided: Decided) -> FrameBatch:
        sent = self.waiting.pop(decided.number)
        if decided.attempts and sent.tries:  # a later attempt is possible if the acknowledgement was lost
            sent.level_dbm, sent.fading_db = sent.tries[decided.attempts - 1]
        others = sent.sender.others
        snr_db = sinr_db = self._hearing.over_noise(sent.level_dbm)
        if decided.attempts:
            least_sinr = decided.least_sinr[others]
            least_sinr[least_sinr <= 0.0] = np.nan  # no ratio at a radio that was sending itself
            sinr_db = sealed(10.0 * np.log10(least_sinr))
        snr_row = snr_db[None]
        sinr_row = snr_row if sinr_db is snr_db else sinr_db[None]
        return FrameBatch([sent], decided.fate[others][None], [decided.start_ns], [decided.end_ns], snr_row, sinr_row)


def at_all(values: Floats, row: int) -> Floats:
    """Insert a zero at a row."""
    everywhere = np.zeros(len(values) + 1)  # np.insert and np.delete take ten times as long
    everywhere[:row] = values[:row]
    everywhere[row + 1 :] = values[row:]
    return everywhere


OWN = np.uint8(255)  # code at the sender itself


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
        number, end_ns, fate = (np.concatenate([batch[column] for batch in decided]) for column in (0, 2, 4))
        sender = self._sender[number]
        code = np.where(fate == np.uint8(Fate.UNDETECTED), TOO_WEAK + self._weakness[sender], fate)
        code[np.arange(len(sender)), sender] = OWN
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
