"""Timing two things in turn, so that a drift of the machine affects both."""

import math
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

Timed = Callable[[], float]
"""Does its work once; the answer is what it cost, in s (its own clock: set-up does not count)."""


class Row(NamedTuple):
    """One line of the table."""

    name: str
    ours: str
    other: str
    ratio: float
    demand: str  # a ratio to the peer of the row; "goal: ...": a speed, which depends on the machine
    holds: bool

    @property
    def is_goal(self) -> bool:
        """Whether the demand is a goal, which fails no benchmark."""
        return self.demand.startswith("goal: ")

    @property
    def verdict(self) -> str:
        """The last column."""
        if self.is_goal:
            return "reached" if self.holds else "not reached"
        return "holds" if self.holds else "FAILS"


def missing(name: str, demand: str, why: object) -> Row:
    """The line of a missing peer: no number, no failure."""
    return Row(name, "", f"not measured: {why}", math.nan, demand, True)


def cpu(work: Callable[[], object]) -> float:
    """CPU seconds of this process for one call."""
    begin = time.process_time()
    work()
    return time.process_time() - begin


def peak_mib() -> float:
    """Peak memory of this process: `resource` starts with that of its parent."""
    (line,) = (each for each in Path("/proc/self/status").read_text("ascii").splitlines() if each.startswith("VmHWM"))
    return int(line.split()[1]) / 1024.0


def in_turn(ours: Timed, other: Timed, rounds: int) -> tuple[float, float, float]:
    """Median costs of both and the median of the ratios ours / other, pair by pair, after an uncounted round."""
    return medians([(ours(), other()) for _ in range(rounds + 1)][1:])


def medians(pairs: Sequence[tuple[float, float]]) -> tuple[float, float, float]:
    """Medians of ours, of the other, and of the ratio of each pair."""
    ours, other = zip(*pairs, strict=True)
    return statistics.median(ours), statistics.median(other), statistics.median(a / b for a, b in pairs)


def measured(measures: Sequence[Callable[[], Row]]) -> list[Row]:
    """Rows of these measurements, in order, with progress."""
    found = []
    for measure in measures:
        print(f"measuring: {measure.__module__.rpartition('.')[2]}, {measure.__name__} ...", file=sys.stderr, flush=True)
        found.append(measure())
    return found


def table(rows: list[Row]) -> str:
    """The rows as a Markdown table."""
    lines = ["| what | ours | peer | ratio | demand | |", "|---|---|---|---|---|---|"]
    lines += [f"| {row.name} | {row.ours} | {row.other} | {row.ratio:.2f} | {row.demand} | {row.verdict} |" for row in rows]
    return "\n".join(lines)
