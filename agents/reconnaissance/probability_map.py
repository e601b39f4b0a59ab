"""Probability of a target in each cell of an area, from looks with errors: Bayes' rule in log-odds.

A look at a cell says 1 (something is there) with probability p if there is a target and q if there is none. By Bayes' rule the
log-odds ``l = ln(P / (1 - P))`` of a cell change at every look by a constant: ``ln(p / q)`` after a 1 and
``ln((1 - p) / (1 - q))`` after a 0 (Hu, Xie, Lum and Xu, "Multiagent information fusion and cooperative control in target
search", IEEE Trans. Control Systems Technology 21(4), 2013, with Q = -l; Toh 2012, 5.2, whose label 0/1 is what a look says,
not P). So the numbers of looks with 1 and with 0, from any vehicle and in any order, are sufficient statistics of a cell.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from vcmvsp.cosim.types import Array

LIMIT = 20.0  # of |l|: beyond a probability of 1 - 2e-9 new looks would hardly change a cell
TARGET, EMPTY = 0.99, 0.01  # P above and below which a cell is decided


class Rectangle(NamedTuple):
    """An area with sides along x and y, m, world."""

    left: float
    bottom: float
    right: float
    top: float


@dataclass(frozen=True)
class Sensor:
    """Error rates of looks: 0 < q < p < 1 (with p = q a look has no information, with 0 or 1 one look would be final)."""

    p: float  # probability that a look at a target says so
    q: float  # probability that a look at none says that there is one

    def __post_init__(self) -> None:
        if not 0.0 < self.q < self.p < 1.0:
            raise ValueError(f"p = {self.p} and q = {self.q}: an informative sensor has 0 < q < p < 1")

    @property
    def hit(self) -> float:
        """Increment of the log-odds by a look that says 1."""
        return math.log(self.p / self.q)

    @property
    def miss(self) -> float:
        """Increment of the log-odds by a look that says 0 (< 0)."""
        return math.log((1.0 - self.p) / (1.0 - self.q))

    def evidence(self, hits: Array, misses: Array) -> Array:
        """Log-odds of given numbers of looks with 1 and with 0."""
        return hits * self.hit + misses * self.miss


@dataclass(frozen=True)
class Grid:
    """Square cells over a rectangle; cell number ``row * columns + column``, rows going up from the bottom left.

    The last row and column reach beyond the rectangle where its sides are no multiples of a cell's.
    """

    area: Rectangle
    cell: float  # side of a cell, m

    def __post_init__(self) -> None:
        if not (self.area.right > self.area.left and self.area.top > self.area.bottom and all(map(math.isfinite, self.area))):
            raise ValueError(f"area {self.area}: right must be greater than left, top greater than bottom, all finite")
        if not (self.cell > 0.0 and math.isfinite(self.cell)):
            raise ValueError(f"cell = {self.cell} m must be > 0")

    @cached_property
    def columns(self) -> int:
        """Number of cells along x; with a tolerance for rounding."""
        return max(1, math.ceil((self.area.right - self.area.left) / self.cell - 1e-9))

    @cached_property
    def rows(self) -> int:
        """Number of cells along y."""
        return max(1, math.ceil((self.area.top - self.area.bottom) / self.cell - 1e-9))

    @cached_property
    def xs(self) -> Array:
        """Middles of the columns, (columns,) m."""
        return self.area.left + (np.arange(self.columns) + 0.5) * self.cell

    @cached_property
    def ys(self) -> Array:
        """Middles of the rows, (rows,) m."""
        return self.area.bottom + (np.arange(self.rows) + 0.5) * self.cell

    def centres(self, cells: Array) -> Array:
        """The middles of cells, (n, 2) m, world."""
        rows, columns = np.divmod(cells, self.columns)
        return np.column_stack([self.xs[columns], self.ys[rows]])

    def at(self, x: float, y: float) -> int | None:
        """The cell that holds a point; None: outside."""
        across, up = (x - self.area.left) / self.cell, (y - self.area.bottom) / self.cell
        if not (0.0 <= across < self.columns and 0.0 <= up < self.rows):
            return None
        return int(up) * self.columns + int(across)

    def within(self, x: float, y: float, radius: float) -> Array:
        """Cells with centres at most ``radius`` from a point, ascending."""
        return self._cells_in(
            x - radius, y - radius, x + radius, y + radius, lambda u, w: (u - x) ** 2 + (w - y) ** 2 <= radius**2
        )

    def inside(self, corners: Array) -> Array:
        """Cells with centres in a polygon, such as a camera's footprint, ascending.

        ``corners`` are (n, 2) m, world, in order round it; with one that is not finite (an edge of the picture above the
        horizon) nothing is inside.
        """
        corners = np.asarray(corners, float).reshape(-1, 2)
        if len(corners) < 3 or not np.isfinite(corners).all():
            return np.empty(0, np.intp)
        (left, bottom), (right, top) = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
        return self._cells_in(left, bottom, right, top, lambda u, w: _in_polygon(corners, u, w))

    def _cells_in(self, left: float, bottom: float, right: float, top: float, test: Callable[[Array, Array], Array]) -> Array:
        """Cells in a box with centres that pass a test: x (1, n) and y (m, 1) to (m, n)."""
        if not all(map(math.isfinite, (left, bottom, right, top))):
            return np.empty(0, np.intp)
        c0, c1 = np.searchsorted(self.xs, left), np.searchsorted(self.xs, right, "right")
        r0, r1 = np.searchsorted(self.ys, bottom), np.searchsorted(self.ys, top, "right")
        rows, columns = np.nonzero(test(self.xs[None, c0:c1], self.ys[r0:r1, None]))
        return (rows + r0) * self.columns + columns + c0


def log_odds(probability: float) -> float:
    """``ln(P / (1 - P))`` of a prior, which must lie between 0 and 1: at these no look could ever change it."""
    if not 0.0 < probability < 1.0:
        raise ValueError(f"a prior probability of {probability} must be > 0 and < 1")
    return math.log(probability / (1.0 - probability))


def probability(odds: Array) -> Array:
    """Probabilities from log-odds."""
    return 1.0 / (1.0 + np.exp(-odds))


def decisions(odds: Array) -> Array:
    """By cell: 1 where P is above `TARGET`, -1 where it is below `EMPTY`, 0 where it is open (int8)."""
    return (odds > log_odds(TARGET)).astype(np.int8) - (odds < log_odds(EMPTY)).astype(np.int8)


def _in_polygon(corners: Array, x: Array, y: Array) -> Array:
    """Even-odd rule: a ray to the right from a point inside crosses the border an odd number of times."""
    inside = np.zeros(np.broadcast_shapes(x.shape, y.shape), bool)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y0 != y1:
            inside ^= ((y0 <= y) != (y1 <= y)) & (x < x0 + (y - y0) * ((x1 - x0) / (y1 - y0)))
    return inside
