"""A trial of the channel alone: radios at rest broadcast periodically.

The first frame of a radio is at a random instant of the first period, by seed and name of the radio. Frames are sent at
``0 <= t < duration``; the trial ends when all are decided. The result is a pure function of channel, positions, period, size
and seed.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from itertools import count, islice
from typing import Any

import msgspec
import numpy as np
from threadpoolctl import threadpool_limits

from vcmvsp.cosim.clock import SECOND_NS, Ticks, seconds_to_ns
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import FrameReport, Message
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.channel.reception import RECEIVED, Bulk
from vcmvsp.netsim.interfaces.layers import Floats, Ints

Sink = Callable[[FrameReport], None]
Progress = Callable[[int, int], None]

_BULK = 512  # frames in a batch without reports
_LONG_AFTER_NS = 10**15  # after the last sending: all frames are decided
_ADVANCE_EVERY = 64  # frames between two advances of the channel

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
            self.delays.add(received_ns[received_ns >= 0] - report.sent_ns)
        if received < total:
            for cause, lost in self._causes(report.outcome, total - received).items():
                self.losses[cause] = self.losses.get(cause, 0) + lost

    def add_many(self, delay_ns: Ints, received: Ints, receivers: int, losses: dict[str, int]) -> None:
        """Count frames: delays and numbers of receptions, (m,) each; in total: receivers, and losses by cause."""
        self.frames += len(delay_ns)
        self.receivers += receivers
        self.receptions += int(received.sum())
        self.delays.add(delay_ns[received > 0], received[received > 0])
        for cause, lost in losses.items():
            self.losses[cause] = self.losses.get(cause, 0) + lost

    def summary(self) -> dict[str, Any]:
        """``frames, receptions, delivery_ratio, delay_s`` (mean, p50, p95, p99), ``losses``; None: no value."""
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
    """Mean and percentiles of delays (whole ns) in bounded memory.

    Percentiles are exact, linear between ranks, as long as no more than half of ``kept`` values are distinct; beyond that every
    delay counts as the middle of its bin, with a relative error of at most 2^-13.
    """

    def __init__(self, kept: int = KEPT) -> None:
        self._most = kept
        self._count, self._sum_ns = 0, 0.0
        self._same: Counter[int] = Counter()  # number of each since the last sort
        self._chunks: list[tuple[Ints, Ints]] = []  # distinct delays in order, number of each
        self._kept = 0
        self._bins: Ints = np.zeros(0, np.int64)  # empty as long as delays are kept one by one

    def add(self, delays_ns: Ints, counts: Ints | None = None) -> None:
        """Add delays, (n,), each ``counts`` times, (n,); None: once."""
        if counts is None:
            self._same.update(delays_ns.tolist())
        else:
            for delay_ns, count in zip(delays_ns.tolist(), counts.tolist(), strict=True):
                self._same[delay_ns] += count
        if len(self._same) >= _HELD:
            self._sort()

    def mean_s(self) -> float | None:
        """Mean delay; None: no delays."""
        self._sort()
        return self._sum_ns / self._count / SECOND_NS if self._count else None

    def percentiles_s(self, *percent: float) -> list[float | None]:
        """Percentiles of the delays; None: no delays."""
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
        """Distinct delays in order, and the number of each."""
        if self._bins.size:
            used = np.flatnonzero(self._bins)
            middle = (((used + _ZERO) << _SHIFT) + (1 << (_SHIFT - 1))).view(np.float64)
            return np.where(used == 0, 0.0, middle), self._bins[used]
        self._merge()
        return self._chunks[0]

    def _sort(self) -> None:
        if self._same:
            self._keep(np.array(list(self._same), np.int64), np.array(list(self._same.values()), np.int64))
            self._same.clear()

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
        """Merge equal delays of all chunks."""
        values = np.concatenate([chunk[0] for chunk in self._chunks])
        counts = np.concatenate([chunk[1] for chunk in self._chunks])
        self._chunks = []  # released one by one: peak of a trial's memory
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


class Broadcasts(msgspec.Struct, frozen=True, kw_only=True):
    """Positions, rate and size of the broadcasts; the radios are v0, v1, ..."""

    position: Floats  # (n, 3) m, world: of the antennas
    rate_hz: float
    size_bytes: int  # payload
    duration_s: float
    seed: int = 0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the radios."""
        return tuple(f"v{i}" for i in range(len(self.position)))

    @property
    def end_ns(self) -> int:
        """End of sending: every frame is sent before this time."""
        return seconds_to_ns(self.duration_s)

    @property
    def frames(self) -> int:
        """Approximate number of frames."""
        return int(len(self.position) * self.rate_hz * self.duration_s)

    def phases_ns(self) -> list[int]:
        """Time of the first frame of each radio, uniform in the period."""
        period_ns = float(Ticks.rate(self.rate_hz).period)
        return [int(period_ns * stream(self.seed, f"radio/{name}/phase").random()) for name in self.names]

    def sendings(self) -> Iterator[tuple[int, int]]:
        """Time (ns) and sender's row of each frame, in order of time."""
        ticks, phases, end_ns = Ticks.rate(self.rate_hz), self.phases_ns(), self.end_ns
        order = sorted(range(len(phases)), key=phases.__getitem__)  # no phase exceeds a period: the same in all periods
        for k in count():
            begin_ns = ticks.at(k)
            if begin_ns >= end_ns:
                return
            for row in order:
                if begin_ns + phases[row] < end_ns:
                    yield begin_ns + phases[row], row


def run(channel: Channel, plan: Broadcasts, *, sink: Sink | None = None, progress: Progress | None = None) -> dict[str, Any]:
    """Run a trial and count the outcomes.

    Args:
        channel: started with the plan's seed.
        plan: the broadcasts.
        sink: takes every report, in the order of decisions.
        progress: called with (now, end) in ns.

    Returns:
        `FrameTally.summary`, and ``cpu_s``: CPU time of the trial, without ``sink`` and without compilation.
    """
    with threadpool_limits(1):  # as in a run: sums come out the same on any number of cores
        return _run(channel, plan, sink, progress)


def _run(channel: Channel, plan: Broadcasts, sink: Sink | None, progress: Progress | None) -> dict[str, Any]:
    names = plan.names
    messages = [Message(sender=name, body={}, size_bytes=plan.size_bytes) for name in names]
    _warm_up(channel, plan, messages[0])
    tally, elsewhere_s, begun_s = FrameTally(), 0.0, time.process_time()

    def note(reports: Sequence[FrameReport]) -> None:
        nonlocal elsewhere_s
        for report in reports:
            tally.add(report)
        if sink is not None and reports:
            before_s = time.process_time()
            for report in reports:
                sink(report)
            elsewhere_s += time.process_time() - before_s

    channel.start(plan.seed)
    channel.expect(plan.frames)
    bulk = channel.bulk(names, plan.position) if sink is None else None
    if bulk is not None:
        _run_bulk(bulk, plan, tally, progress)
        return {**tally.summary(), "cpu_s": time.process_time() - begun_s}
    for number, (sent_ns, row) in enumerate(plan.sendings()):
        note(channel.send(sent_ns, messages[row], names, plan.position))
        if number % _ADVANCE_EVERY == 0:
            note(channel.advance(sent_ns))
            if progress is not None:
                progress(sent_ns, plan.end_ns)
    while (due_ns := channel.next_ns()) is not None:
        note(channel.advance(due_ns + SECOND_NS))
    summary = tally.summary()
    return {**summary, "cpu_s": time.process_time() - begun_s - elsewhere_s}


def _run_bulk(bulk: Bulk, plan: Broadcasts, tally: FrameTally, progress: Progress | None) -> None:
    sent_ns: Ints = np.zeros(0, np.int64)
    others = len(plan.position) - 1

    def note(until_ns: int) -> None:
        if (done := bulk.advance(until_ns)) is not None:
            tally.add_many(done.end_ns - sent_ns[done.number], done.receptions, others * len(done.number), done.losses)
        if progress is not None:
            progress(min(until_ns, plan.end_ns), plan.end_ns)

    sendings = plan.sendings()
    while block := list(islice(sendings, _BULK)):
        time_ns, sender = (np.array(column, np.int64) for column in zip(*block, strict=True))
        sent_ns = np.concatenate([sent_ns, time_ns])
        bulk.send(time_ns, sender, plan.size_bytes)
        note(int(time_ns[-1]))
    note(plan.end_ns + _LONG_AFTER_NS)


def _warm_up(channel: Channel, plan: Broadcasts, message: Message) -> None:
    """Send one frame, so that compilation and tables are not part of ``cpu_s``."""
    channel.start(plan.seed)
    channel.expect(plan.frames)
    channel.send(0, message, plan.names, plan.position)
    channel.advance(SECOND_NS)
