"""Clearance of vehicles in the air, all at once: a clear vehicle cannot touch anything before the next look.

Solids are looked up in a map of square cells, each with the pieces near to it. A piece is an upright convex prism; boxes stand
for triangles of meshes, one box for several small ones. Distances are never overestimated.
"""

import math

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.physics.world.polygons import outward
from vcmvsp.physics.world.solids import Shapes

REACH_M = 1.5  # the map knows pieces this far around a cell: more than a vehicle and its way to the next look take together
_CELLS = 250_000
_FINEST_M = 0.5
_SMALL_M = 1.0  # triangles up to this size are taken together, by cubes of this size


class SolidsMap:
    """The pieces of solids near every place."""

    def __init__(self, shapes: Shapes) -> None:
        pieces = [piece for group in shapes.groups for piece in zip(*group[:3], strict=True)]
        pieces += _boxes(shapes.triangles)
        self._empty = not pieces
        if self._empty:
            return
        every = np.concatenate([corners for corners, _, _ in pieces])
        low, high = every.min(axis=0) - REACH_M, every.max(axis=0) + REACH_M
        self._size = max(_FINEST_M, math.sqrt(float(np.prod(high - low)) / _CELLS))
        self._origin, self._shape = low, np.ceil((high - low) / self._size).astype(int) + 1
        edges = max(len(corners) for corners, _, _ in pieces)
        # Outward normals and offsets of all sides; a missing side has an infinite offset.
        self._normals, self._offsets = np.zeros((len(pieces), edges, 2)), np.full((len(pieces), edges), np.inf)
        self._bottom, self._top = (np.array([piece[k] for piece in pieces], float) for k in (1, 2))
        cells = [self._enter(number, corners) for number, (corners, _, _) in enumerate(pieces)]
        of = np.repeat(np.arange(len(pieces)), [len(each) for each in cells])
        where = np.concatenate(cells)
        self._pieces = of[np.argsort(where, kind="stable")]
        self._count = np.bincount(where, minlength=int(np.prod(self._shape)))
        self._first = np.cumsum(self._count) - self._count

    def _enter(self, number: int, corners: Array) -> Array:
        """Store the sides of a piece; returns the cells within reach of it."""
        normals = outward(corners)
        offsets = (normals * corners).sum(axis=1)
        self._normals[number, : len(corners)], self._offsets[number, : len(corners)] = normals, offsets
        reach = REACH_M + self._size * math.sqrt(0.5)  # from the middle of a cell
        first = np.maximum(((corners.min(axis=0) - reach - self._origin) / self._size).astype(int), 0)
        last = np.minimum(((corners.max(axis=0) + reach - self._origin) / self._size).astype(int) + 1, self._shape)
        i, j = np.arange(first[0], last[0]), np.arange(first[1], last[1])
        x, y = self._origin[0] + (i + 0.5) * self._size, self._origin[1] + (j + 0.5) * self._size
        beyond = (normals[:, 0, None, None] * x[:, None] + normals[:, 1, None, None] * y - offsets[:, None, None]).max(axis=0)
        cells: Array = (i[:, None] * self._shape[1] + j)[beyond <= reach]
        return cells

    def near(self, position: Array, margin: Array) -> Array:
        """Whether a solid may lie within ``margin`` (n,) m of places (n, 3) m; margins beyond `REACH_M` always say so."""
        if self._empty:
            return np.zeros(len(position), bool)
        cell = np.floor((position[:, :2] - self._origin) / self._size).astype(int)
        inside = ((cell >= 0) & (cell < self._shape)).all(axis=1)
        place = np.where(inside, cell[:, 0] * self._shape[1] + cell[:, 1], 0)
        count = np.where(inside, self._count[place], 0)
        result = margin > REACH_M
        rows = np.repeat(np.arange(len(position)), count)  # one for each piece to be looked at
        if len(rows):
            nth = np.arange(len(rows)) - np.repeat(np.cumsum(count) - count, count)
            piece = self._pieces[self._first[place[rows]] + nth]
            at = position[rows]
            beyond = ((self._normals[piece] * at[:, None, :2]).sum(axis=2) - self._offsets[piece]).max(axis=1)
            beyond = np.maximum(beyond, np.maximum(self._bottom[piece] - at[:, 2], at[:, 2] - self._top[piece]))
            result[rows[beyond < margin[rows]]] = True
        return result


def _boxes(triangles: Array) -> list[tuple[Array, float, float]]:
    low, high = triangles.min(axis=1), triangles.max(axis=1)
    small = (high - low).max(axis=1) <= _SMALL_M
    cubes, of = np.unique(np.floor(low[small] / _SMALL_M).astype(int), axis=0, return_inverse=True)
    lows, highs = np.full((len(cubes), 3), np.inf), np.full((len(cubes), 3), -np.inf)
    np.minimum.at(lows, of.ravel(), low[small])
    np.maximum.at(highs, of.ravel(), high[small])
    lows, highs = np.concatenate([lows, low[~small]]) - 1e-3, np.concatenate([highs, high[~small]]) + 1e-3  # no flat box
    ends = np.stack([lows, highs], axis=1)  # (boxes, 2, 3)
    corners = np.stack([ends[:, [0, 1, 1, 0], 0], ends[:, [0, 0, 1, 1], 1]], axis=2)
    return list(zip(corners, lows[:, 2].tolist(), highs[:, 2].tolist(), strict=True))


def near_each_other(position: Array, velocity: Array, radius: Array, span_s: float, slack_m: float) -> Array:
    """Whether another of n spheres may touch each within ``span_s``; ``slack_m`` allows for accelerations."""
    x, y, z = position.T
    square = np.square(x[:, None] - x) + np.square(y[:, None] - y) + np.square(z[:, None] - z)
    apart = radius[:, None] + radius + slack_m
    fastest = 2.0 * span_s * float(np.sqrt((velocity * velocity).sum(axis=1).max(initial=0.0)))
    candidates = square < np.square(apart + fastest)
    np.fill_diagonal(candidates, val=False)
    result = np.zeros(len(position), bool)
    if candidates.any():
        a, b = np.nonzero(candidates)
        closing = np.sqrt(np.square(velocity[a] - velocity[b]).sum(axis=1)) * span_s
        result[a[square[a, b] < np.square(apart[a, b] + closing)]] = True
    return result


def near_others(position: Array, margin: Array, others: Array, other_margin: Array) -> Array:
    """Whether any of m other spheres may touch each of n; margins are radius plus way, m."""
    if not len(others):
        return np.zeros(len(position), bool)
    square = np.square(position[:, None] - others).sum(axis=2)
    return np.asarray((square < np.square(margin[:, None] + other_margin)).any(axis=1))
