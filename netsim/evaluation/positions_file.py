"""Positions from a CSV file: three columns, x, y and z in metres; a first line with these names is allowed."""

import math
from pathlib import Path

import numpy as np

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.util.files import read_cells
from vcmvsp.netsim.interfaces.layers import Floats

COLUMNS = ("x", "y", "z")
FARTHEST_M = 1e9


def read_positions(path: Path) -> Floats:
    """The points of a file, (n, 3) m; empty lines do not count.

    Raises:
        UsageError: naming file, line and column.
    """
    points: list[tuple[float, ...]] = []
    for place, (number, cells) in enumerate(read_cells(path)):
        where = f"{path} line {number}"
        if place or not _is_header(cells, where):
            points.append(_point(cells, where))
    if not points:
        raise UsageError(f"{path}: has no positions; write a line x,y,z (metres) for each vehicle")
    return np.array(points)


def _is_header(cells: list[str], where: str) -> bool:
    """Whether a line holds names; then they have to be the right ones."""
    if any(_number(cell) is not None for cell in cells):
        return False
    if tuple(cell.lower().removesuffix("_m") for cell in cells) != COLUMNS:
        raise UsageError(f"{where}: the columns must be x,y,z, not {','.join(cells)}")
    return True


def _point(cells: list[str], where: str) -> tuple[float, ...]:
    if len(cells) != len(COLUMNS):
        raise UsageError(f"{where}: must have 3 columns, x,y,z, not {len(cells)}: {','.join(cells)[:60]}")
    return tuple(_coordinate(cell, f"{where}, column {name}") for cell, name in zip(cells, COLUMNS, strict=True))


def _coordinate(cell: str, where: str) -> float:
    value = _number(cell)
    if value is None:
        raise UsageError(f"{where}: must be a number, not {cell[:60]!r}")
    if not math.isfinite(value):
        raise UsageError(f"{where}: must be finite, not {cell}")
    if abs(value) > FARTHEST_M:
        raise UsageError(f"{where}: must be from -{FARTHEST_M:g} to {FARTHEST_M:g} m, not {cell}")
    return value


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None
