"""Rows of figures and checks: measured and expected value, and tolerance."""

import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vcmvsp.cosim.util.files import replacing

COLUMNS = ("case", "expected", "measured", "tolerance", "ok")


@dataclass(frozen=True)
class Row:
    """An expected and a measured value. Tolerances are absolute; the case names the share of a relative one."""

    case: str
    expected: float
    measured: float
    tolerance: float

    @property
    def ok(self) -> bool:
        """Whether the values agree within the tolerance; NaN never does."""
        return bool(abs(self.measured - self.expected) <= self.tolerance)

    @property
    def tolerance_used(self) -> float:
        """``|measured - expected|`` over the tolerance, at most 1 if the row is ok; infinite or NaN where undefined."""
        difference = abs(self.measured - self.expected)
        if self.tolerance:
            return difference / self.tolerance
        return math.inf if difference else 0.0

    @property
    def plain(self) -> dict[str, Any]:
        """The row for JSON, with ``ok``; ``measured`` is None if it is not finite."""
        measured = self.measured if math.isfinite(self.measured) else None
        return {"case": self.case, "expected": self.expected, "measured": measured, "tolerance": self.tolerance, "ok": self.ok}

    @property
    def csv(self) -> tuple[str, float, float, float, str]:
        """The row for a CSV file with the columns `COLUMNS`."""
        return self.case, self.expected, self.measured, self.tolerance, str(self.ok).lower()

    @property
    def cells(self) -> tuple[str, str, str, str]:
        """Case, expected, measured and tolerance as text."""
        return self.case, f"{self.expected:.6g}", f"{self.measured:.6g}", f"{self.tolerance:.6g}"


def relative(case: str, expected: float, measured: float, share: float) -> Row:
    """A row with a tolerance relative to the expected value; the case names the share."""
    return Row(f"{case} (within {100 * share:g} %)", float(expected), float(measured), float(abs(expected) * share))


def absolute(case: str, expected: float, measured: float, tolerance: float) -> Row:
    """A row with an absolute tolerance."""
    return Row(case, float(expected), float(measured), float(tolerance))


def at_most(case: str, limit: float, measured: float) -> Row:
    """A row for an upper limit: the excess is compared with zero."""
    return Row(f"{case}, at most {limit:g}: excess", 0.0, float(np.maximum(measured - limit, 0.0)), 0.0)


def at_least(case: str, limit: float, measured: float) -> Row:
    """A row for a lower limit: the shortfall is compared with zero."""
    return Row(f"{case}, at least {limit:g}: shortfall", 0.0, float(np.maximum(limit - measured, 0.0)), 0.0)


def write_csv(path: Path, header: Sequence[str], lines: Iterable[Sequence[object]]) -> None:
    """Write a CSV file atomically."""
    with replacing(path) as place, place.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([header, *lines])
