"""A trial of the channel alone: radios that stand still and broadcast periodically.

The frames of a radio are one period apart, the first one at a random instant of the first period. Frames are sent at
``0 <= t < duration``; the channel then goes on until the fate of all of them is known. What happens is a pure function of
channel, places, period, size and seed; the first instant of a radio goes by the seed and its name alone.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from itertools import count, islice
from typing import Any, Protocol

import msgspec
import numpy as np
from threadpoolctl import threadpool_limits

from vcmvsp.cosim.clock import SECOND_NS, Ticks, seconds_to_ns
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import FrameReport, Message
from vcmvsp.netsim.channel.bulk import Bulk
from vcmvsp.netsim.evaluation.tally import FrameTally
from vcmvsp.netsim.interfaces.layers import Floats, Ints

Sink = Callable[[FrameReport], None]
Progress = Callable[[int, int], None]

_BULK = 512  # frames that are handed over together where no reports are wanted
_LONG_AFTER_NS = 10**15  # behind the last sending, when all is decided
_ADVANCE_EVERY = 64  # frames: what is decided meanwhile is worked off together


class TrialChannel(Protocol):
    """What a trial asks of a `netsim.channel.channel.Channel`."""

    def start(self, seed: int) -> None:
        """Forget all frames."""

    def send(self, sent_ns: int, message: Message, names: tuple[str, ...], position: Floats) -> list[FrameReport]:
        """Hand over one message of one of the n vehicles at ``position``, (n, 3) m; what is decided by that."""

    def advance(self, until_ns: int) -> list[FrameReport]:
        """What is decided up to a time."""

    def next_ns(self) -> int | None:
        """When something will be decided next."""

    def expect(self, frames: int) -> None:
        """About so many frames will be sent."""

    def bulk(self, names: tuple[str, ...], position: Floats) -> Bulk | None:
        """For many frames at once of vehicles at ``position``, (n, 3) m; None if that is not possible."""


class Broadcasts(msgspec.Struct, frozen=True, kw_only=True):
    """Who broadcasts, where, and how often. The radios are called v0, v1, ..."""

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
        """When each radio sends its first frame: uniform in the period."""
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


def run(
    channel: TrialChannel, plan: Broadcasts, *, sink: Sink | None = None, progress: Progress | None = None
) -> dict[str, Any]:
    """Send everything and count what becomes of it.

    Args:
        channel: it is started with the plan's seed.
        plan: what is sent.
        sink: is given every report, in the order in which frames are decided.
        progress: called with (now, end) in ns now and then.

    Returns:
        `FrameTally.summary`, and ``cpu_s``: CPU time of the trial, without ``sink`` and without compilation.
    """
    with threadpool_limits(1):  # as in a run: sums come out the same on any number of cores
        return _run(channel, plan, sink, progress)


def _run(channel: TrialChannel, plan: Broadcasts, sink: Sink | None, progress: Progress | None) -> dict[str, Any]:
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
    """The same, many frames at once."""
    sent_ns: Ints = np.zeros(0, np.int64)
    others = len(plan.position) - 1

    def note(until_ns: int) -> None:
        done = bulk.advance(until_ns)
        tally.add_many(done.end_ns - sent_ns[done.number], done.received, others * len(done.number), done.losses)
        if progress is not None:
            progress(min(until_ns, plan.end_ns), plan.end_ns)

    sendings = plan.sendings()
    while block := list(islice(sendings, _BULK)):
        time_ns, sender = (np.array(column, np.int64) for column in zip(*block, strict=True))
        sent_ns = np.concatenate([sent_ns, time_ns])
        bulk.send(time_ns, sender, plan.size_bytes)
        note(int(time_ns[-1]))
    note(plan.end_ns + _LONG_AFTER_NS)


def _warm_up(channel: TrialChannel, plan: Broadcasts, message: Message) -> None:
    """Send one frame, of which nothing is left."""
    channel.start(plan.seed)
    channel.expect(plan.frames)
    channel.send(0, message, plan.names, plan.position)
    channel.advance(SECOND_NS)
