"""Rows of figures and checks: a measured number beside the expected one, and its tolerance."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np


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
