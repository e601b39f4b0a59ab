"""Ray casting among the solids of a world."""

import math
from collections.abc import Iterator

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.physics.raycast.broad_phase import Nearest, Reached, pairs
from vcmvsp.physics.raycast.spatial_index import NearbyPieces, PieceIndex
from vcmvsp.physics.world.shapes import Shapes
from vcmvsp.physics.world.world import World, made_once

FLOOR = -2  # in `Reached.which`
_FEW = 16  # beams in a cell: with fewer, all beams are tested with all pieces


class Caster:
    """Casts beams among the solids of a world.

    Beams hit a prism from outside; a beam that begins inside a prism has a length of 0 m. Triangles have two sides.

    Args:
        shapes: the solids in pieces.
        cell_m: of the index of pieces; no effect on results.
    """

    def __init__(self, shapes: Shapes, cell_m: float | None = None) -> None:
        self.pieces = PieceIndex(shapes, cell_m)

    def cast(self, origins: Array, directions: Array, reach_m: float = math.inf, *, floor: bool = True) -> Array:
        """Lengths of beams, (r,) m; inf: no hit within reach.

        Args:
            origins: (r, 3) m, world.
            directions: (r, 3), unit vectors.
            reach_m: of the beams.
            floor: whether beams end at z = 0 from above.
        """
        return self.meet(origins, directions, reach_m, floor=floor).distance

    def meet(self, origins: Array, directions: Array, reach_m: float = math.inf, *, floor: bool = True) -> Reached:
        """Lengths of beams, and the number of the solid that each hits: -1 for none, `FLOOR` for the floor."""
        origins, directions = np.broadcast_arrays(np.asarray(origins, float), np.asarray(directions, float))
        distance, which = np.full(len(origins), np.inf), np.full(len(origins), -1)
        for rows, near in self._by_place(origins, reach_m):
            hits = self._among(near, origins[rows], directions[rows], reach_m)
            distance[rows], which[rows] = hits
        if floor:
            down = _to_floor(origins, directions)
            lower = (down < distance) & (down <= reach_m)
            distance, which = np.where(lower, down, distance), np.where(lower, FLOOR, which)
        return Reached(distance, which)

    def inside(self, point: tuple[float, float, float]) -> bool:
        """Whether a point is inside a prism, faces included."""
        x, y, z = point
        prisms = self.pieces.near(x, y, 0.0).prisms
        if not prisms.size:
            return False
        prisms = prisms[(self.pieces.bottom[prisms] <= z) & (z <= self.pieces.top[prisms])]
        if not prisms.size:
            return False
        x0, x1, y0, y1 = self.pieces.edges[:4, self.pieces.edges_of(prisms)]
        left = (x0 - x) * (y1 - y) - (x1 - x) * (y0 - y) >= 0.0
        count = self.pieces.corners[prisms]
        return bool(np.logical_and.reduceat(left, np.cumsum(count) - count).any())

    def _by_place(self, origins: Array, reach_m: float) -> Iterator[tuple[Array | slice, NearbyPieces]]:
        """Beams with origins in the same cell, and the pieces near it."""
        pieces = self.pieces
        if not len(origins):
            return
        if reach_m == math.inf or (origins == origins[0]).all():
            yield slice(None), pieces.near(origins[0, 0], origins[0, 1], reach_m)
            return
        cells = np.floor(origins[:, :2] / pieces.cell_m(reach_m))
        _, first, cell = np.unique(cells, axis=0, return_index=True, return_inverse=True)
        if len(first) * _FEW > len(origins):
            yield slice(None), pieces.near(0.0, 0.0, math.inf)
            return
        for number, (x, y) in enumerate(origins[first, :2].tolist()):
            yield np.nonzero(cell.ravel() == number)[0], pieces.near(x, y, reach_m)

    def _among(self, near: NearbyPieces, origins: Array, directions: Array, reach_m: float) -> Reached:
        pieces, nearest = self.pieces, Nearest(len(origins))
        for some, before, lengths, solid in (
            (near.prisms, 0, self._to_prisms, pieces.solid),
            (near.triangles, len(pieces.first), self._to_triangles, pieces.triangle_solid),
        ):
            numbers = some + before
            spheres = pieces.centre[numbers], pieces.radius[numbers], pieces.around[numbers]
            for beam, place in pairs(origins, directions, reach_m, *spheres):
                piece = some[place]
                nearest.meet(beam, lengths(piece, origins[beam], directions[beam]), solid[piece])
        return nearest.within(reach_m)

    def _to_prisms(self, prism: Array, origins: Array, directions: Array) -> Array:
        """Lengths of q beams up to one prism each, m; inf: no hit.

        A line is inside a convex body from the last plane that it enters by to the first that it leaves by (M. Cyrus, J. Beck,
        Generalized two- and three-dimensional clipping, 1978).
        """
        distance = np.full(len(prism), np.inf)
        corners = self.pieces.corners[prism]
        for count in np.unique(corners).tolist():
            (some,) = np.nonzero(corners == count)
            (x, y, z), (dx, dy, dz) = origins[some].T[..., None], directions[some].T[..., None]
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

    def _to_triangles(self, triangle: Array, origins: Array, directions: Array) -> Array:
        """Lengths of q beams up to one triangle each, m; inf: no hit.

        T. Moeller, B. Trumbore, Fast, minimum storage ray/triangle intersection, 1997.
        """
        corner, *others = self.pieces.triangles[triangle].swapaxes(0, 1)
        one, two = (each - corner for each in others)
        p, t = np.cross(directions, two), origins - corner
        q = np.cross(t, one)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            scale = 1.0 / (one * p).sum(axis=1)
            u, v = (t * p).sum(axis=1) * scale, (directions * q).sum(axis=1) * scale
            along = (two * q).sum(axis=1) * scale
            hit = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (along >= 0.0) & np.isfinite(scale)
        return np.where(hit, along, np.inf)


def caster_of(world: World) -> Caster:
    """The caster of a world, made once."""
    return made_once(world, _caster)


def _caster(world: World) -> Caster:
    return Caster(world.shapes)


def _to_floor(origins: Array, directions: Array) -> Array:
    height, fall = origins[:, 2], -directions[:, 2]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.where((fall > 0.0) & (height > 0.0), height / fall, np.inf)
