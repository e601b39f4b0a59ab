"""A trial of the channel alone: radios at rest broadcast periodically.

The first frame of a radio is at a random instant of the first period, by seed and name of the radio. Frames are sent at
``0 <= t < duration``; the trial ends when all are decided. The result is a pure function of channel, positions, period, size
and seed.
"""

import time
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
from vcmvsp.netsim.channel.contention import Bulk
from vcmvsp.netsim.evaluation.tally import FrameTally
from vcmvsp.netsim.interfaces.layers import Floats, Ints

Sink = Callable[[FrameReport], None]
Progress = Callable[[int, int], None]

_BULK = 512  # frames in a batch without reports
_LONG_AFTER_NS = 10**15  # after the last sending: all frames are decided
_ADVANCE_EVERY = 64  # frames between two advances of the channel


class Broadcasts(msgspec.Struct, frozen=True, kw_only=True):
    """Positions, rate and size of the broadcasts; the radios are v0, v1, ..."""

    position: Floats  # (n, 3) m, world: of the antennas
    rate_hz: float
    size_bytes: int  # payload
    duration_s: float
    seed: int = 0

    @property
    def names(self) -> tuple[str, ...]:
        """The radios."""
        return tuple(f"v{i}" for i in range(len(self.position)))

    @property
    def end_ns(self) -> int:
        """No frame is sent from here on."""
        return seconds_to_ns(self.duration_s)

    @property
    def frames(self) -> int:
        """How many, about."""
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
    """Run a trial in batches, without reports."""
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
