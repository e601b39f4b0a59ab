"""Running counts and delays of frames, in bounded memory."""

from collections import Counter
from typing import Any

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import FrameReport
from vcmvsp.netsim.channel.reception import RECEIVED
from vcmvsp.netsim.interfaces.layers import Floats, Ints

KEPT = 20_000_000  # delays, equal ones in part together
_HELD = 1 << 20  # delays that wait to be sorted

# Beyond that: bins whose edges are the floats with 12 bits behind the leading one, a relative width of at most 2^-12.
_SHIFT = 52 - 12
_ZERO = (1023 << 12) - 1  # bin of 0 ns, below that of 1 ns
_BINS = 64 << 12  # up to 2^64 ns


class FrameTally:
    """Receptions, losses by cause, and delays of frames."""

    def __init__(self) -> None:
        self.frames = self.receivers = self.receptions = 0
        self.losses: dict[str, int] = {}
        self.delays = Delays()

    def add(self, report: FrameReport) -> None:
        """Count one frame at all its receivers."""
        received_ns, total = report.received_ns, len(report.outcome)
        received = int(np.count_nonzero(received_ns >= 0))
        self.frames += 1
        self.receivers += total
        self.receptions += received
        if received:
            latest_ns = int(received_ns.max())
            if np.count_nonzero(received_ns == latest_ns) == received:
                self.delays.add(latest_ns - report.sent_ns, received)
            else:
                self.delays.add_each(received_ns[received_ns >= 0] - report.sent_ns)
        if received < total:
            for cause, lost in self._causes(report.outcome, total - received).items():
                self.losses[cause] = self.losses.get(cause, 0) + lost

    def add_many(self, delay_ns: Ints, received: Ints, receivers: int, losses: dict[str, int]) -> None:
        """Count frames: delays and how many received them, (m,) each; of all together the receivers, and losses by cause."""
        self.frames += len(delay_ns)
        self.receivers += receivers
        self.receptions += int(received.sum())
        self.delays.add_counts(delay_ns[received > 0], received[received > 0])
        for cause, lost in losses.items():
            self.losses[cause] = self.losses.get(cause, 0) + lost

    def summary(self) -> dict[str, Any]:
        """``frames, receptions, delivery_ratio, delay_s`` (mean, p50, p95, p99), ``losses``; None where there is nothing."""
        mean_s, (p50, p95, p99) = self.delays.mean_s(), self.delays.percentiles_s(50, 95, 99)
        return {
            "frames": self.frames,
            "receptions": self.receptions,
            "delivery_ratio": self.receptions / self.receivers if self.receivers else None,
            "delay_s": {"mean": mean_s, "p50": p50, "p95": p95, "p99": p99},
            "losses": {cause: self.losses[cause] for cause in sorted(self.losses)},
        }

    def _causes(self, outcome: tuple[str, ...], lost: int) -> dict[str, int]:
        known = {cause: found for cause in self.losses if (found := outcome.count(cause))}  # quicker than to hash every word
        if sum(known.values()) == lost:
            return known
        return {cause: found for cause, found in Counter(outcome).items() if cause != RECEIVED}


class Delays:
    """Mean and percentiles of delays (whole ns) that need not be kept.

    Percentiles are exact, linear between ranks, as long as no more than half of ``kept`` values are distinct; beyond that every
    delay counts as the middle of its bin, right within 2^-13 of itself.
    """

    def __init__(self, kept: int = KEPT) -> None:
        self._most = kept
        self._count, self._sum_ns = 0, 0.0
        self._same: dict[int, int] = {}  # delay: how many
        self._each: list[Ints] = []
        self._held = 0
        self._chunks: list[tuple[Ints, Ints]] = []  # distinct delays in order, how many of each
        self._kept = 0
        self._bins: Ints = np.zeros(0, np.int64)  # empty as long as delays are kept one by one

    def add(self, delay_ns: int, count: int) -> None:
        """So many of the same delay."""
        self._same[delay_ns] = self._same.get(delay_ns, 0) + count
        if len(self._same) >= _HELD:
            self._sort_same()

    def add_counts(self, delays_ns: Ints, counts: Ints) -> None:
        """So many of each, (n,)."""
        if len(delays_ns):
            self._keep(delays_ns, counts)

    def add_each(self, delays_ns: Ints) -> None:
        """Delays one by one, (n,)."""
        self._each.append(delays_ns)
        self._held += len(delays_ns)
        if self._held >= _HELD:
            self._sort_each()

    def mean_s(self) -> float | None:
        """Their mean; None: there are none."""
        self._sort()
        return self._sum_ns / self._count / SECOND_NS if self._count else None

    def percentiles_s(self, *percent: float) -> list[float | None]:
        """Percentiles."""
        self._sort()
        if not self._count:
            return [None] * len(percent)
        values, counts = self._table()
        upto = np.cumsum(counts)

        def at(rank: int) -> float:
            return float(values[np.searchsorted(upto, rank, side="right")]) / SECOND_NS

        found: list[float | None] = []
        for each in percent:
            whole, part = divmod(each / 100.0 * (self._count - 1), 1.0)
            low, high = at(int(whole)), at(min(int(whole) + 1, self._count - 1))
            found.append(low + (high - low) * part)
        return found

    def _table(self) -> tuple[Ints | Floats, Ints]:
        """Distinct delays in order, and how many of each."""
        if self._bins.size:
            used = np.flatnonzero(self._bins)
            middle = (((used + _ZERO) << _SHIFT) + (1 << (_SHIFT - 1))).view(np.float64)
            return np.where(used == 0, 0.0, middle), self._bins[used]
        self._merge()
        return self._chunks[0]

    def _sort(self) -> None:
        self._sort_same()
        self._sort_each()

    def _sort_same(self) -> None:
        if self._same:
            self._keep(np.array(list(self._same), np.int64), np.array(list(self._same.values()), np.int64))
            self._same = {}

    def _sort_each(self) -> None:
        if self._each:
            values, counts = np.unique(np.concatenate(self._each), return_counts=True)
            self._keep(values, counts)
            self._each, self._held = [], 0

    def _keep(self, values: Ints, counts: Ints) -> None:
        self._count += int(counts.sum())
        self._sum_ns += float(np.sum(values * counts.astype(np.float64)))
        if self._bins.size:
            self._put(values, counts)
            return
        self._chunks.append((values, counts))
        self._kept += len(values)
        if self._kept > self._most:
            self._merge()
            if self._kept > self._most // 2:
                self._bins = np.zeros(_BINS, np.int64)
                self._put(*self._chunks.pop())

    def _merge(self) -> None:
        """Put equal delays of all chunks together."""
        values = np.concatenate([chunk[0] for chunk in self._chunks])
        counts = np.concatenate([chunk[1] for chunk in self._chunks])
        self._chunks = []  # and one after another: this is where a trial needs most memory
        order = np.argsort(values, kind="stable")
        values = values[order]
        counts = counts[order]
        del order
        first = np.concatenate([[0], np.flatnonzero(values[1:] != values[:-1]) + 1])
        self._chunks = [(values[first], np.add.reduceat(counts, first))]
        self._kept = len(first)

    def _put(self, values: Ints, counts: Ints) -> None:
        places = np.maximum((values.astype(np.float64).view(np.int64) >> _SHIFT) - _ZERO, 0)
        np.add.at(self._bins, places, counts)
