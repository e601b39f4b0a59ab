"""A check: a measurement, and rows that compare it with expected numbers."""

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from vcmvsp.cosim.reproduction import figures
from vcmvsp.cosim.reproduction.row import Row
from vcmvsp.cosim.reproduction.runner import Runner


@dataclass(frozen=True)
class Check:
    """A measurement and the source of its expected numbers."""

    name: str
    area: str
    title: str
    source: str  # of what is expected
    measure: str  # "module:function" of this package, which gives a sequence of `Row`
    seconds: float = 2.0  # about, on one core: the longest begin first
    settings: Mapping[str, Any] = field(default_factory=dict)  # what the function is given
    reduced: str = ""  # in which way it is less than it could be


@dataclass(frozen=True)
class Outcome:
    """Rows of a check; without rows, its problem."""

    check: Check
    rows: Sequence[Row] = ()
    problem: str = ""

    @property
    def missed(self) -> Sequence[Row]:
        """Rows outside their tolerance."""
        return [row for row in self.rows if not row.ok]

    @property
    def ok(self) -> bool:
        """Whether there are rows, and all hold."""
        return bool(self.rows) and not self.missed


def run_all(checks: Sequence[Check], jobs: int, progress: Callable[[int, int], None]) -> list[Outcome]:
    """Run checks, longest first; the outcomes are in the order of ``checks``.

    Args:
        checks: to run.
        jobs: number of processes; 1: this one.
        progress: called after every check with the finished and the total number.
    """
    order = sorted(range(len(checks)), key=lambda place: -checks[place].seconds)
    done = Runner(jobs, progress)([partial(measured, checks[place]) for place in order])
    outcomes = dict(zip(order, done, strict=True))
    return [outcomes[place] for place in range(len(checks))]


def measured(check: Check) -> Outcome:
    """Run one check. An exception becomes its problem."""
    module, _, function = check.measure.partition(":")
    try:
        rows = getattr(importlib.import_module(f"vcmvsp.cosim.reproduction.validation.{module}"), function)(**check.settings)
    except Exception as error:
        return Outcome(check, problem=f"{type(error).__name__}: {error}")
    return Outcome(check, rows, "" if rows else "gave no rows")


def figure_rows(name: str, **settings: object) -> Sequence[Row]:
    """The rows of one figure; settings are arguments of its function."""
    return figures.find(name)(Runner(), **settings).rows
