"""Spatial index of the pieces of a world, as flat tables, for beams."""

import math
from typing import NamedTuple

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.physics.world.solids import Shapes

_CELLS_PER_REACH = 4.0
_MOST = 4_000_000  # numbers of pieces in the index; then it is begun anew


class NearbyPieces(NamedTuple):
    """Pieces within reach of a cell."""

    prisms: Array  # (p,) intp, rising
    edges: Array  # (e,) intp: all edges of these prisms, in order
    triangles: Array  # (t,) intp, rising


class PieceIndex:
    """Upright convex prisms with their edges, and triangles.

    Attributes:
        edges: (6, e) m: x where an edge begins and ends (counter-clockwise), y where it does, bottom and top of its prism.
        first: (p,) number of each prism's first edge; the others follow.
        corners: (p,) number of edges of each prism.
        solid: (p,) solid of each prism.
        bottom, top: (p,) m.
        triangles: (t, 3, 3) m.
        triangle_solid: (t,).
        centre: (p + t, 3) m, of a sphere around each prism and each triangle.
        radius: (p + t,) m, of these spheres.
        around: (p + t,) m, radius of a circle around each seen from above.

    Args:
        shapes: the world's.
        cell_m: size of the cells; None: a quarter of the reach. No effect on results.
    """

    def __init__(self, shapes: Shapes, cell_m: float | None = None) -> None:
        groups, triangles = shapes.groups, shapes.triangles
        self.triangles, self.triangle_solid = triangles, shapes.triangle_solid
        self.corners = _joined([np.full(len(group.corners), group.corners.shape[1]) for group in groups], np.intp)
        self.first = np.cumsum(self.corners) - self.corners
        self.solid = _joined([group.solid for group in groups], np.int64)
        self.bottom = _joined([group.bottom for group in groups])
        self.top = _joined([group.top for group in groups])
        self.edges = np.concatenate([np.empty((6, 0)), *(_edges(*group[:3]) for group in groups)], axis=1)

        boxes = [np.empty((0, 6)), *(_bounds(*group[:3]) for group in groups)]
        bounds = np.concatenate([*boxes, np.concatenate([triangles.min(axis=1), triangles.max(axis=1)], axis=1)])
        lower, upper = bounds[:, :3], bounds[:, 3:]
        self._low, self._high = lower[:, :2].T, upper[:, :2].T
        self.around: Array = 0.5 * np.hypot(*(self._high - self._low))
        self.centre: Array = 0.5 * (lower + upper)
        self.radius: Array = 0.5 * np.sqrt(((upper - lower) ** 2).sum(axis=1))
        self._cell_m = cell_m
        self._cells: dict[tuple[float, int, int], NearbyPieces] = {}
        self._size = 0

    def cell_m(self, reach_m: float) -> float:
        """Edge of the cells for this reach, m."""
        return self._cell_m or max(reach_m / _CELLS_PER_REACH, 1.0)

    def near(self, x: float, y: float, reach_m: float) -> NearbyPieces:
        """Pieces within ``reach_m``, seen from above, of the cell around (x, y)."""
        cell = self.cell_m(reach_m)
        place = (reach_m, math.floor(x / cell), math.floor(y / cell)) if reach_m < math.inf else (reach_m, 0, 0)
        pieces = self._cells.get(place)
        if pieces is None:
            pieces = self._search(*place, cell)
            if self._size > _MOST:
                self._cells.clear()
                self._size = 0
            self._size += 1 + sum(map(len, pieces))
            self._cells[place] = pieces
        return pieces

    def edges_of(self, prisms: Array) -> Array:
        """Numbers of all edges of some prisms, in order."""
        count = self.corners[prisms]
        return np.repeat(self.first[prisms] - np.cumsum(count) + count, count) + np.arange(count.sum())

    def _search(self, reach_m: float, i: int, j: int, cell: float) -> NearbyPieces:
        if reach_m == math.inf:
            within = np.arange(len(self.centre))
        else:
            corner = np.array([[i * cell], [j * cell]])
            gap = np.maximum(self._low - (corner + cell), corner - self._high).clip(0.0)
            margin = 1e-9 * cell
            (within,) = np.nonzero((gap * gap).sum(axis=0) <= (reach_m + margin) ** 2)
        count = len(self.first)
        prisms = within[within < count]
        return NearbyPieces(prisms, self.edges_of(prisms), within[within >= count] - count)


def _joined(parts: list[Array], dtype: type = np.float64) -> Array:
    return np.concatenate([np.empty(0, dtype), *parts]).astype(dtype)


def _edges(corners: Array, bottom: Array, top: Array) -> Array:
    m, k, _ = corners.shape
    ends = np.stack([corners, np.roll(corners, -1, axis=1)], axis=-1).reshape(m * k, 4).T
    return np.concatenate([ends, np.repeat(bottom, k)[None], np.repeat(top, k)[None]])


def _bounds(corners: Array, bottom: Array, top: Array) -> Array:
    return np.column_stack([corners.min(axis=1), bottom, corners.max(axis=1), top])
