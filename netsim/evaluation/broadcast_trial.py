"""A trial of the channel alone: radios at rest or on given paths send by a rule.

Frames are sent at ``0 <= t < duration``, each from and to the positions of the instant at which it is handed to its radio; the
trial ends when all are decided. The result is a pure function of channel, traffic and seed.
"""

import time
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from heapq import heappop, heappush, merge
from itertools import count, islice
from typing import Any, Literal

import msgspec
import numpy as np
from threadpoolctl import threadpool_limits

from vcmvsp.cosim.clock import SECOND_NS, Ticks, seconds_to_ns
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import FrameReport, Message
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.channel.reception import RECEIVED, Bulk
from vcmvsp.netsim.interfaces.layers import Floats, Ints

Kind = Literal["periodic", "jitter", "poisson", "saturated"]
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
            self._add_losses(self._causes(report.outcome, total - received))

    def add_many(self, delay_ns: Ints, received: Ints, receivers: int, losses: dict[str, int]) -> None:
        """Count frames: delays and numbers of receptions, (m,) each; in total: receivers, and losses by cause."""
        self.frames += len(delay_ns)
        self.receivers += receivers
        self.receptions += int(received.sum())
        self.delays.add(delay_ns[received > 0], received[received > 0])
        self._add_losses(losses)

    def summary(self) -> dict[str, Any]:
        """``frames, receptions, delivery_ratio, delay_s`` (mean, p50, p95, p99), ``losses``; None: no value."""
        mean_s, (p50, p95, p99) = self.delays.mean_s(), self.delays.percentiles_s(50, 95, 99)
        return {
            "frames": self.frames,
            "receptions": self.receptions,
            "delivery_ratio": self.receptions / self.receivers if self.receivers else None,
            "delay_s": {"mean": mean_s, "p50": p50, "p95": p95, "p99": p99},
            "losses": dict(sorted(self.losses.items())),
        }

    def _causes(self, outcome: tuple[str, ...], lost: int) -> dict[str, int]:
        causes = {cause: outcome.count(cause) for cause in self.losses}  # quicker than to hash every word
        if sum(causes.values()) != lost:
            causes = Counter(outcome)
            del causes[RECEIVED]
        return causes

    def _add_losses(self, losses: dict[str, int]) -> None:
        for cause, lost in losses.items():
            self.losses[cause] = self.losses.get(cause, 0) + lost


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

        percentiles: list[float | None] = []
        for each in percent:
            whole, part = divmod(each / 100.0 * (self._count - 1), 1.0)
            low, high = at(int(whole)), at(min(int(whole) + 1, self._count - 1))
            percentiles.append(low + (high - low) * part)
        return percentiles

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


class Waypoints(msgspec.Struct, frozen=True, kw_only=True):
    """Positions of radios over time: linear between a radio's times, at rest before the first and after the last."""

    names: tuple[str, ...]  # n radios
    times_ns: tuple[tuple[int, ...], ...]  # of each radio, increasing
    points: tuple[Floats, ...]  # of each radio, (times, 3) m, world: of the antenna

    @classmethod
    def fixed(cls, position: Floats) -> "Waypoints":
        """Radios v0, v1, ... at rest at ``position``, (n, 3) m."""
        names = tuple(f"v{i}" for i in range(len(position)))
        return cls(names=names, times_ns=((0,),) * len(names), points=tuple(position[:, None]))

    @property
    def moving(self) -> bool:
        """Whether a radio has more than one position."""
        return any(len(times_ns) > 1 for times_ns in self.times_ns)

    def at(self, time_ns: int) -> Floats:
        """Positions at a time, (n, 3) m."""
        return np.array([self._point(row, time_ns) for row in range(len(self.names))])

    def _point(self, row: int, time_ns: int) -> Floats:
        times_ns, points = self.times_ns[row], self.points[row]
        following = bisect_right(times_ns, time_ns)
        if following == 0:
            return points[0]
        if following == len(times_ns):
            return points[-1]
        before_ns, after_ns = times_ns[following - 1], times_ns[following]
        share = (time_ns - before_ns) / (after_ns - before_ns)
        return points[following - 1] + share * (points[following] - points[following - 1])


class TrialTraffic(msgspec.Struct, frozen=True, kw_only=True):
    """Radios, and the frames that each of them sends.

    Kinds, with the period ``1 / rate_hz``:

    - periodic: the first frame is uniform in the first period.
    - jitter: the first frame as with periodic; then ``period * (1 + U(-jitter, jitter))`` from frame to frame.
    - poisson: a Poisson process of this rate.
    - saturated: a frame at time 0, and the next one when the former is decided. ``rate_hz`` has no effect.
    """

    waypoints: Waypoints
    size_bytes: int  # payload
    duration_s: float
    rate_hz: float = 1.0
    kind: Kind = "periodic"
    jitter: float = 0.1  # from 0 to 1
    to: str | None = None  # destination of the frames of all other radios; None: broadcasts
    seed: int = 0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the radios."""
        return self.waypoints.names

    @property
    def senders(self) -> tuple[int, ...]:
        """Rows of the radios that send: all but the destination."""
        return tuple(row for row, name in enumerate(self.names) if name != self.to)

    @property
    def receivers(self) -> int:
        """Receivers of a frame."""
        return len(self.names) - 1 if self.to is None else 1

    @property
    def end_ns(self) -> int:
        """End of sending: every frame is sent before this time."""
        return seconds_to_ns(self.duration_s)

    @property
    def frames(self) -> int:
        """Approximate number of frames; 0: unknown."""
        return 0 if self.kind == "saturated" else int(len(self.senders) * self.rate_hz * self.duration_s)

    def messages(self) -> list[Message]:
        """The message of each radio."""
        return [Message(sender=name, to=self.to, body={}, size_bytes=self.size_bytes) for name in self.names]

    def phases_ns(self) -> list[int]:
        """Time of the first frame of each radio, uniform in the period."""
        period_ns = float(Ticks.rate(self.rate_hz).period)
        return [int(period_ns * stream(self.seed, f"radio/{name}/phase").random()) for name in self.names]

    def sendings(self) -> Iterator[tuple[int, int]]:
        """Time (ns) and sender's row of each frame, in order of time; not for saturated traffic."""
        if self.kind == "periodic":
            return self._periodic()
        phases_ns = self.phases_ns()
        return merge(*(self._random(row, phases_ns[row]) for row in self.senders))

    def _periodic(self) -> Iterator[tuple[int, int]]:
        ticks, phases, end_ns = Ticks.rate(self.rate_hz), self.phases_ns(), self.end_ns
        order = sorted(self.senders, key=phases.__getitem__)  # no phase exceeds a period: the same in all periods
        for k in count():
            begin_ns = ticks.at(k)
            if begin_ns >= end_ns:
                return
            for row in order:
                if begin_ns + phases[row] < end_ns:
                    yield begin_ns + phases[row], row

    def _random(self, row: int, phase_ns: int) -> Iterator[tuple[int, int]]:
        """Frames of one radio, jittered or of a Poisson process."""
        draws, period_ns, end_ns = stream(self.seed, f"radio/{self.names[row]}/traffic"), SECOND_NS / self.rate_hz, self.end_ns

        def gap_ns() -> int:
            ratio = draws.exponential() if self.kind == "poisson" else 1.0 + self.jitter * draws.uniform(-1.0, 1.0)
            return round(period_ns * ratio)

        time_ns = gap_ns() if self.kind == "poisson" else phase_ns
        while time_ns < end_ns:
            yield time_ns, row
            time_ns += gap_ns()


def run(channel: Channel, plan: TrialTraffic, *, sink: Sink | None = None, progress: Progress | None = None) -> dict[str, Any]:
    """Run a trial and count the outcomes.

    Args:
        channel: started with the plan's seed.
        plan: the traffic.
        sink: takes every report, in the order of decisions.
        progress: called with (now, end) in ns.

    Returns:
        `FrameTally.summary`, and ``cpu_s``: CPU time of the trial, without ``sink`` and without compilation.
    """
    with threadpool_limits(1):  # as in a run: sums come out the same on any number of cores
        _warm_up(channel, plan)
        begun_s = time.process_time()
        channel.start(plan.seed)
        channel.expect(plan.frames)
        trial = _Trial(channel, plan, sink, progress)
        alike = sink is None and plan.kind != "saturated" and plan.to is None and not plan.waypoints.moving
        bulk = channel.bulk(plan.names, plan.waypoints.at(0)) if alike else None
        if bulk is not None:
            _run_bulk(bulk, plan, trial.tally, progress)
        elif plan.kind == "saturated":
            trial.send_saturated()
        else:
            trial.send_planned()
        summary = trial.tally.summary()
        return {**summary, "cpu_s": time.process_time() - begun_s - trial.elsewhere_s}


class _Trial:
    def __init__(self, channel: Channel, plan: TrialTraffic, sink: Sink | None, progress: Progress | None) -> None:
        self._channel, self._plan, self._sink, self._progress = channel, plan, sink, progress
        self._messages = plan.messages()
        self._position = plan.waypoints.at(0)  # one array object as long as no radio moves
        self.tally = FrameTally()
        self.elsewhere_s = 0.0  # CPU time of the sink

    def send_planned(self) -> None:
        """Send all frames at the times of the plan, and wait until they are decided."""
        for number, (sent_ns, row) in enumerate(self._plan.sendings()):
            self._note(self._send(sent_ns, row))
            if number % _ADVANCE_EVERY == 0:
                self._note(self._channel.advance(sent_ns))
                self._tell(sent_ns)
        while (due_ns := self._channel.next_ns()) is not None:
            self._note(self._channel.advance(due_ns + SECOND_NS))

    def send_saturated(self) -> None:
        """Hand each radio its next frame at the time at which its former one is decided, until the end of sending."""
        rows = {name: row for row, name in enumerate(self._plan.names)}
        ready = [(0, row) for row in self._plan.senders]  # time (ns) and row of each radio without a frame: a heap
        for number in count():
            due_ns = self._channel.next_ns()
            if ready and (due_ns is None or ready[0][0] <= due_ns):
                now_ns, row = heappop(ready)
                reports = self._send(now_ns, row) if now_ns < self._plan.end_ns else []
                ended_ns = [now_ns + report.queue_ns + report.access_ns + report.air_time_ns for report in reports]
            elif due_ns is not None:
                now_ns, reports = due_ns, self._channel.advance(due_ns)
                ended_ns = [due_ns] * len(reports)  # none is decided earlier
            else:
                return
            self._note(reports)
            for report, end_ns in zip(reports, ended_ns, strict=True):
                heappush(ready, (end_ns, rows[report.sender]))
            if number % _ADVANCE_EVERY == 0 and now_ns < self._plan.end_ns:
                self._tell(now_ns)

    def _send(self, sent_ns: int, row: int) -> list[FrameReport]:
        waypoints = self._plan.waypoints
        position = waypoints.at(sent_ns) if waypoints.moving else self._position
        return self._channel.send(sent_ns, self._messages[row], waypoints.names, position)

    def _note(self, reports: Sequence[FrameReport]) -> None:
        for report in reports:
            self.tally.add(report)
        if self._sink is not None and reports:
            before_s = time.process_time()
            for report in reports:
                self._sink(report)
            self.elsewhere_s += time.process_time() - before_s

    def _tell(self, now_ns: int) -> None:
        if self._progress is not None:
            self._progress(now_ns, self._plan.end_ns)


def _run_bulk(bulk: Bulk, plan: TrialTraffic, tally: FrameTally, progress: Progress | None) -> None:
    sent_ns: Ints = np.zeros(0, np.int64)

    def note(until_ns: int) -> None:
        if (frames := bulk.advance(until_ns)) is not None:
            tally.add_many(
                frames.end_ns - sent_ns[frames.number], frames.receptions, plan.receivers * len(frames.number), frames.losses
            )
        if progress is not None:
            progress(min(until_ns, plan.end_ns), plan.end_ns)

    sendings = plan.sendings()
    while block := list(islice(sendings, _BULK)):
        time_ns, sender = (np.array(column, np.int64) for column in zip(*block, strict=True))
        sent_ns = np.concatenate([sent_ns, time_ns])
        bulk.send(time_ns, sender, plan.size_bytes)
        note(int(time_ns[-1]))
    note(plan.end_ns + _LONG_AFTER_NS)


def _warm_up(channel: Channel, plan: TrialTraffic) -> None:
    """Send one frame, so that compilation and tables are not part of ``cpu_s``."""
    channel.start(plan.seed)
    channel.expect(plan.frames)
    channel.send(0, plan.messages()[plan.senders[0]], plan.names, plan.waypoints.at(0))
    channel.advance(SECOND_NS)
