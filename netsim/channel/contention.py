"""Frames on a contended medium, from the sender's queue until the medium has decided them."""

from heapq import heappop, heappush

import numpy as np

from vcmvsp.netsim.channel.frames import FrameBatch, SentFrame, Transmitter
from vcmvsp.netsim.channel.link_budget import Budgets, ReceiverModel
from vcmvsp.netsim.channel.mean_budget import at_all
from vcmvsp.netsim.channel.rx_power import RxPower
from vcmvsp.netsim.interfaces.layers import Floats, sealed
from vcmvsp.netsim.interfaces.link_draws import ERROR_SLOT
from vcmvsp.netsim.interfaces.medium import Decided, Levelled, Medium, Offered, Powered


class Contention:
    """The frames under way on one medium; ``levels``: of single attempts."""

    def __init__(
        self, medium: Medium, names: tuple[str, ...], budgets: Budgets, hearing: ReceiverModel, levels: RxPower
    ) -> None:
        self.medium, self._budgets, self._hearing, self._levels = medium, budgets, hearing, levels
        self.waiting: dict[int, SentFrame] = {}  # by frame
        self._coming: list[tuple[int, int, Offered]] = []  # heap by time and frame: on their way to the queue
        self._answers: dict[int, Floats] = {}  # by frame, until it is offered: levels of its acknowledgement
        self._levelled = medium if isinstance(medium, Levelled) else None
        if self._levelled is not None:
            self._levelled.sensitivity_mw[:] = 10.0 ** (budgets.sensitivity_dbm(names) / 10.0)
        if isinstance(medium, Powered):
            medium.power_mw[:] = 10.0 ** (budgets.tx_power_dbm(names) / 10.0)

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
        if answerer is not None and self._levelled is not None:
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
            if offered.to >= 0 and self._levelled is not None:  # not earlier: an earlier acknowledgement may be on the air
                decided += self.medium.advance(offered.time_ns)
                self._levelled.levels[offered.to] = self._answers.pop(offered.number)
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
