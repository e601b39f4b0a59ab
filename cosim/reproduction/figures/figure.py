"""What a figure is made of: runs of the platform, what is drawn of them, and rows that compare them with what must come out.

A figure is a function ``make(runner: Runner) -> Figure`` in a module of its own, which `cosim.reproduction.figures.NAMES`
names. It builds scenarios as mappings, hands them to the runner as jobs, and says what to draw; it never draws, and knows no
part but ``cosim``.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, Literal

import numpy as np

from vcmvsp.cosim.errors import VcmvspError
from vcmvsp.cosim.processes.worker_pool import Pool
from vcmvsp.cosim.runs.api import Result, run
from vcmvsp.cosim.types import Array

Read = Callable[[Result], Any]
# "dots": many small markers; "pose": a track with its two ends
Style = Literal["line", "dashed", "dotted", "thin", "markers", "dots", "hollow", "pose", "both"]


@dataclass(frozen=True)
class Row:
    """A number that must come out, and what did. Tolerances are absolute; where one means a share, the case says so."""

    case: str
    expected: float
    measured: float
    tolerance: float

    @property
    def ok(self) -> bool:
        """Whether it came out; never if it is no number."""
        return bool(abs(self.measured - self.expected) <= self.tolerance)

    @property
    def plain(self) -> dict[str, Any]:
        """The row for JSON, with ``ok``; what was measured is None where it is no finite number."""
        measured = self.measured if math.isfinite(self.measured) else None
        return {"case": self.case, "expected": self.expected, "measured": measured, "tolerance": self.tolerance, "ok": self.ok}

    @property
    def cells(self) -> tuple[str, str, str, str]:
        """The row for a reader: case, expected, measured and tolerance."""
        return self.case, f"{self.expected:.6g}", f"{self.measured:.6g}", f"{self.tolerance:.6g}"


@dataclass(frozen=True)
class Curve:
    """Points (n,) that belong together; of curves of equal ``label`` in a panel the legend shows one."""

    x: Array
    y: Array
    label: str = ""
    color: int = 0  # of the palette: 0 black, 1 blue, 2 vermilion, 3 green, 4 purple, 5 orange, 6 sky blue
    style: Style = "line"


@dataclass(frozen=True)
class Heat:
    """Values over a grid: ``values[i, j]`` belongs to ``y[i]``, ``x[j]``; every cell is drawn with its number, but in a map."""

    x: Array
    y: Array
    values: Array  # (len(y), len(x))
    label: str = ""
    # "about one": which side of 1 is shown by colour; "map": equal steps, values from 0 to 1, curves of the panel above it
    style: Literal["growing", "about one", "map"] = "growing"


@dataclass(frozen=True)
class Photo:
    """A picture, (h, w, 3) uint8, under the curves; the middle of its first pixel, at the top left, is (0, 0)."""

    pixels: Array


@dataclass(frozen=True)
class Panel:
    """A pair of axes; it shows curves, or a `Heat`, or curves on a `Photo`."""

    title: str
    x_label: str
    y_label: str
    curves: Sequence[Curve] = ()
    _: KW_ONLY
    heat: Heat | None = None
    photo: Photo | None = None
    levels: Mapping[str, float | tuple[float, float]] = field(default_factory=dict)  # horizontal lines, by their labels
    log_x: bool = False
    log_y: bool = False
    equal: bool = False  # the same scale on both axes: a map
    x_limits: tuple[float, float] | None = None
    y_limits: tuple[float, float] | None = None


@dataclass(frozen=True)
class Figure:
    """What a figure consists of; ``columns`` of panels stand side by side."""

    title: str
    panels: Sequence[Panel]
    rows: Sequence[Row]
    columns: int = 2

    @property
    def ok(self) -> bool:
        """Whether every row came out."""
        return all(row.ok for row in self.rows)


@dataclass(frozen=True)
class Job:
    """A run, and what is wanted of it: ``read`` is a function of a module, since it may be called in another process."""

    scenario: Mapping[str, Any]
    read: Read
    set: Mapping[str, Any] = field(default_factory=dict)
    seed: int | None = None

    def __call__(self) -> Any:
        """What is wanted of it."""
        return self.read(run(self.scenario, seed=self.seed, set=self.set, mcap=False))


class Runner:
    """Runs jobs, several at a time where there are several: those of the platform, or a `functools.partial` of other work.

    Args:
        jobs: how many processes; 1: this one.
        progress: told after every run how many are done, and of how many.
    """

    def __init__(self, jobs: int = 1, progress: Callable[[int, int], None] | None = None) -> None:
        self._jobs, self._progress = jobs, progress or (lambda *_: None)

    def __call__(self, jobs: Sequence[Callable[[], Any]]) -> list[Any]:
        """What each job gave, in the order of the jobs."""
        workers = min(self._jobs, len(jobs))
        if workers <= 1:
            return [self._tell(done, len(jobs), _do(job)) for done, job in enumerate(jobs, 1)]
        died = VcmvspError("a process that ran a part of the figure died twice; --jobs 1 runs all in this one")
        with Pool(_do, workers, died=died) as pool:
            given = pool.answers(enumerate(jobs), len(jobs))
            answers = dict(self._tell(done, len(jobs), answer) for done, answer in enumerate(given, 1))
        return [answers[place] for place in range(len(jobs))]

    def _tell(self, done: int, of: int, answer: Any) -> Any:
        self._progress(done, of)
        return answer


def _do(job: Callable[[], Any]) -> Any:
    return job()


def relative(case: str, expected: float, measured: float, share: float) -> Row:
    """A row whose tolerance is a share of what is expected; the case says so."""
    return Row(f"{case} (within {100 * share:g} %)", float(expected), float(measured), float(abs(expected) * share))


def absolute(case: str, expected: float, measured: float, tolerance: float) -> Row:
    """A row with a tolerance of its own."""
    return Row(case, float(expected), float(measured), float(tolerance))


def at_most(case: str, limit: float, measured: float) -> Row:
    """A row for what may not exceed a limit: what is compared with zero is by how much it does."""
    return Row(f"{case}, at most {limit:g}: excess", 0.0, float(np.maximum(measured - limit, 0.0)), 0.0)


def at_least(case: str, limit: float, measured: float) -> Row:
    """A row for what must reach a limit: what is compared with zero is by how much it does not."""
    return Row(f"{case}, at least {limit:g}: shortfall", 0.0, float(np.maximum(limit - measured, 0.0)), 0.0)
