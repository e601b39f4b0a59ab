"""Ray casting among the solids of a world, and the spatial index of their pieces."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.physics.world.solids import Shapes
from vcmvsp.physics.world.world import World, cached_on_world

_CELLS_PER_REACH = 4.0
_MOST = 4_000_000  # limit of piece numbers in the index; then it is cleared


class NearbyPieces(NamedTuple):
    """Pieces within reach of a cell."""

    prisms: Array  # (p,) intp, rising
    edges: Array  # (e,) intp: all edges of these prisms, in order
    triangles: Array  # (t,) intp, rising


class PieceIndex:
    """Upright convex prisms with their edges, and triangles.

    ``triangles`` (t, 3, 3) m belong to the world; results do not depend on the size of the cells ``cell_m`` (None: a quarter of
    the reach).

    Attributes:
        edges: (6, e) m: x where an edge begins and ends (counter-clockwise), y where it does, bottom and top of its prism.
        first, corners: (p,) number of each prism's first edge, which the others follow, and how many it has.
        bottom, top: (p,) m, of each prism.
        centre, around: (p + t, 3) and (p + t,) m, middle of each prism and each triangle, and radius around it from above.
    """

    def __init__(self, shapes: Shapes, cell_m: float | None = None) -> None:
        groups, triangles = shapes.groups, shapes.triangles
        self.triangles = triangles
        self.corners = _joined([np.full(len(group.corners), group.corners.shape[1]) for group in groups], np.intp)
        self.first = np.cumsum(self.corners) - self.corners
        self.bottom = _joined([group.bottom for group in groups])
        self.top = _joined([group.top for group in groups])
        self.edges = np.concatenate([np.empty((6, 0)), *(_edges(*group[:3]) for group in groups)], axis=1)

        boxes = [
            np.empty((0, 6)),
            *(np.column_stack([g.corners.min(axis=1), g.bottom, g.corners.max(axis=1), g.top]) for g in groups),
        ]
        bounds = np.concatenate([*boxes, np.concatenate([triangles.min(axis=1), triangles.max(axis=1)], axis=1)])
        lower, upper = bounds[:, :3], bounds[:, 3:]
        self._low, self._high = lower[:, :2].T, upper[:, :2].T
        self.around: Array = 0.5 * np.hypot(*(self._high - self._low))
        self.centre: Array = 0.5 * (lower + upper)
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


_AT_ONCE = 8192  # pairs: arrays that stay in the processor's cache


def by_bearing(origin: Array, directions: Array, centre: Array, around: Array) -> Iterator[tuple[Array, Array]]:
    """Pairs of beams from one place and circles, by bearing alone, at any distance.

    Beams from ``origin`` (3,) m along vectors (r, 3) of any length; circles around ``centre`` (m, 3) m, of any height, with
    radii ``around`` (m,) m.
    """
    beams = len(directions)
    bearing = np.arctan2(directions[:, 1], directions[:, 0])
    order = np.argsort(bearing, kind="stable")
    rising = bearing[order]
    rising = np.concatenate([rising - math.tau, rising, rising + math.tau])
    x, y, _ = (centre - origin).T
    away = np.hypot(x, y)
    side = np.where(away > around, np.arcsin(np.minimum(around / np.maximum(away, 1e-9), 1.0)), math.pi) + 1e-9
    middle = np.arctan2(y, x)
    first = np.searchsorted(rising, middle - side)
    count = np.minimum(np.searchsorted(rising, middle + side, "right") - first, beams)
    after = np.cumsum(count)
    total = int(after[-1]) if len(after) else 0
    cuts = np.searchsorted(after, np.arange(_AT_ONCE, total, _AT_ONCE))
    for piece in np.split(np.arange(len(centre)), cuts):
        number = count[piece]
        before = np.cumsum(number) - number
        place = np.repeat(first[piece] - before, number) + np.arange(number.sum())
        yield order[place % beams], np.repeat(piece, number)


class Caster:
    """Casts beams among the solids of a world.

    Beams hit a prism from outside; a beam that begins inside a prism has a length of 0 m. Triangles have two sides.
    """

    def __init__(self, shapes: Shapes, cell_m: float | None = None) -> None:
        self.pieces = PieceIndex(shapes, cell_m)

    def cast(self, origin: Array, directions: Array, reach_m: float = math.inf) -> Array:
        """Lengths, (r,) m, of beams from a place (3,) m along unit vectors (r, 3), world; inf: no hit within reach."""
        pieces, distance = self.pieces, np.full(len(directions), np.inf)
        near = pieces.near(origin[0], origin[1], reach_m)
        prisms, triangles = (near.prisms, 0, self._to_prisms), (near.triangles, len(pieces.first), self._to_triangles)
        for some, before, lengths in (prisms, triangles):
            numbers = some + before
            for beam, place in by_bearing(origin, directions, pieces.centre[numbers], pieces.around[numbers]):
                np.minimum.at(distance, beam, lengths(some[place], origin, directions[beam]))
        distance[distance > reach_m] = np.inf
        return distance

    def inside(self, point: tuple[float, float, float]) -> bool:
        """Whether a point is inside a prism, faces included."""
        x, y, z = point
        prisms = self.pieces.near(x, y, 0.0).prisms
        prisms = prisms[(self.pieces.bottom[prisms] <= z) & (z <= self.pieces.top[prisms])]
        if not prisms.size:
            return False
        x0, x1, y0, y1 = self.pieces.edges[:4, self.pieces.edges_of(prisms)]
        left = (x0 - x) * (y1 - y) - (x1 - x) * (y0 - y) >= 0.0
        count = self.pieces.corners[prisms]
        return bool(np.logical_and.reduceat(left, np.cumsum(count) - count).any())

    def _to_prisms(self, prism: Array, origin: Array, directions: Array) -> Array:
        """Lengths of q beams up to one prism each, m; inf: no hit.

        A line is inside a convex body from the last plane that it enters by to the first that it leaves by (M. Cyrus, J. Beck,
        Generalized two- and three-dimensional clipping, 1978).
        """
        distance = np.full(len(prism), np.inf)
        corners = self.pieces.corners[prism]
        for count in np.unique(corners).tolist():
            (some,) = np.nonzero(corners == count)
            (x, y, z), (dx, dy, dz) = origin, directions[some].T[..., None]
            x0, x1, y0, y1, bottom, top = self.pieces.edges[:, self.pieces.first[prism[some], None] + np.arange(count)]
            across, ahead = y1 - y0, x0 - x1  # the normal to the outside, as long as the edge
            depth = np.concatenate([across * (x0 - x) + ahead * (y0 - y), z - bottom[:, :1], top[:, :1] - z], axis=1)
            speed = np.concatenate([across * dx + ahead * dy, -dz, dz], axis=1)
            with np.errstate(divide="ignore", invalid="ignore"):
                when = depth / speed  # metres; depth < 0: outside of that plane
            enter = np.where(speed < 0.0, when, -np.inf).max(axis=1)
            leave = np.where(speed > 0.0, when, np.inf).min(axis=1)
            beside = ((speed == 0.0) & (depth < 0.0)).any(axis=1)
            hit = (enter <= leave) & (leave >= 0.0) & ~beside
            distance[some] = np.where(hit, np.maximum(enter, 0.0), np.inf)
        return distance

    def _to_triangles(self, triangle: Array, origin: Array, directions: Array) -> Array:
        """Lengths of q beams up to one triangle each, m; inf: no hit.

        T. Moeller, B. Trumbore, Fast, minimum storage ray/triangle intersection, 1997.
        """
        corner, *others = self.pieces.triangles[triangle].swapaxes(0, 1)
        one, two = (each - corner for each in others)
        p, t = np.cross(directions, two), origin - corner
        q = np.cross(t, one)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            scale = 1.0 / (one * p).sum(axis=1)
            u, v = (t * p).sum(axis=1) * scale, (directions * q).sum(axis=1) * scale
            along = (two * q).sum(axis=1) * scale
            hit = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (along >= 0.0) & np.isfinite(scale)
        return np.where(hit, along, np.inf)


@cached_on_world
def caster_of(world: World) -> Caster:
    """The caster of a world."""
    return Caster(world.shapes)
