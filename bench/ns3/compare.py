"""``python -m bench.ns3.compare [WORD ...]``: ns-3 and ours in the same scenarios, and the difference beside what is allowed.

Words choose scenarios: all whose name contains one (``b-1-N50``).

--list   the names
--judge  runs ns-3 alone, and keeps the results
--core   feeds the contention core with the frames of ns-3 instead of running ``vcmvsp channel``: the same phases, therefore far
         less scatter; and only so unicast and saturated scenarios

Exit code 1 if a demand is missed. A difference has a standard error, from run to run: a demand is missed when the difference
exceeds it by more than two of them, and in doubt when it exceeds it by less.
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from bench.ns3.cases import CASES, Case
from bench.ns3.program import Floats
from bench.ns3.sample import BIN_M, Sample, command, ns3

SATURATED_MS = 20.0  # a mean delay above which looser demands hold
ATOM_NS = 2_000  # most frames do not wait: their delays differ by the time of flight, 0.3 us a 100 m


class Row(NamedTuple):
    """One figure."""

    quantity: str
    expected: float
    ours: float
    error: float  # standard error of the difference
    tolerance: float  # absolute

    @property
    def verdict(self) -> str:
        """Of the difference."""
        excess = abs(self.ours - self.expected) - self.tolerance
        if excess <= 0.0:
            return "holds"
        return "in doubt" if excess <= 2.0 * self.error else "MISSED"


def compare(case: Case, judge: Sequence[Sample], ours: Sequence[Sample], *, paired: bool) -> Iterator[Row]:
    """All figures of a scenario; paired: runs of the same seed have the same phases."""

    def row(quantity: str, figure: Callable[[Sample], float], tolerance: float, *, relative: bool = False) -> Row:
        a = np.array([figure(sample) for sample in judge])
        b = np.array([figure(sample) for sample in ours])
        allowed = tolerance * abs(a.mean()) if relative else tolerance
        error = _error(b - a) if paired else float(np.hypot(_error(a), _error(b)))
        return Row(quantity, a.mean(), b.mean(), error, allowed)

    yield row("delivery ratio", lambda sample: sample.received.sum() / sample.intended.sum(), 0.01)
    if case.saturated:
        yield row(
            "throughput, kbit/s", lambda sample: 8e-3 * case.size * sample.received.sum() / case.duration_s, 0.03, relative=True
        )
        return
    delays = np.concatenate([sample.delay_ns for sample in judge])
    saturated = delays.mean() > SATURATED_MS * 1e6
    yield row("mean delay, ms", lambda sample: sample.delay_ns.mean() / 1e6, 0.10 if saturated else 0.05, relative=True)
    for percent in (50, 95, 99):
        at = float(np.percentile(delays, percent))
        if not saturated:
            yield row(f"delay CDF at {at / 1e6:.3f} ms", partial(_share_within, at + ATOM_NS), 0.015)
        elif percent == 99:
            yield row("p99 delay, ms", lambda sample: float(np.percentile(sample.delay_ns, 99)) / 1e6, 0.02, relative=True)
    if case.hidden:
        yield _by_distance(judge, ours)


def _share_within(ns: float, sample: Sample) -> float:
    return float((sample.delay_ns <= ns).mean())


def _by_distance(judge: Sequence[Sample], ours: Sequence[Sample]) -> Row:
    """Number of distance bins with deliveries that agree within 0.02 (and twice the statistical error)."""
    (a, a_error), (b, b_error) = _ratios(judge), _ratios(ours)
    filled = np.isfinite(a) & (np.maximum(a, b) > 0.0)
    agree = np.abs(a - b)[filled] <= 0.02 + 2.0 * np.hypot(a_error, b_error)[filled]
    return Row(f"share of {agree.size} bins of {BIN_M:g} m whose delivery ratios agree", 1.0, float(agree.mean()), 0.0, 0.05)


def _ratios(samples: Sequence[Sample]) -> tuple[Floats, Floats]:
    """Delivery ratio in each bin, (BINS,), and its standard error."""
    intended = np.array([sample.intended for sample in samples], np.float64)
    received = np.array([sample.received for sample in samples], np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = received.sum(axis=0) / intended.sum(axis=0)
        return ratio, np.std(received / intended, axis=0, ddof=1) / np.sqrt(len(samples))


def _error(values: Floats) -> float:
    return float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else 0.0


def main(words: Sequence[str]) -> int:
    """Print a table for each scenario; the exit code."""
    names = [word for word in words if not word.startswith("--")]
    chosen = list(CASES)
    if names:
        chosen = [case for case in CASES if any(name in case.name for name in names)]
    if "--list" in words:
        print(*(case.name for case in chosen), sep="\n")
        return 0
    simulate, paired = command, "--core" in words
    if paired:
        from bench.ns3.core import core as simulate
    missed = 0
    for case in chosen:
        judge = [ns3(case, seed) for seed in range(1, case.seeds + 1)]
        receivers = 1 if case.unicast else case.nodes - 1
        frames = sum(int(sample.intended.sum()) for sample in judge) / receivers
        cpu_s = sum(sample.cpu_s for sample in judge)
        print(f"\n{case.name}: {case.seeds} runs, {frames:.0f} frames, ns-3 {cpu_s:.1f} s of CPU", flush=True)
        if "--judge" in words:
            continue
        try:
            ours = [simulate(case, seed) for seed in range(1, case.seeds + 1)]
        except NotImplementedError as problem:
            print(f"  left out: {problem}")
            continue
        for row in compare(case, judge, ours, paired=paired):
            missed += row.verdict == "MISSED"
            figures = f"{row.expected:12.5f} {row.ours:12.5f} {row.ours - row.expected:+10.5f} ± {row.error:.5f}"
            print(f"  {row.quantity:56} {figures} allowed {row.tolerance:.5f} {row.verdict}")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
