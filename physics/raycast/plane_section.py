"""Sections of the world by the planes of range scanners: line segments from prisms and triangles.

The plane of a level scanner cuts everything at one height: whole sides, and neither roofs nor undersides.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.physics.raycast.spatial_index import PieceIndex

_THIN = 1e-9  # m2: twice the area between scanner and segment; less is a view from the edge, without effect
_COORDINATES = [0, 0, 1, 1, 2, 2]  # of the rows of `PieceIndex.edges`


class Fan(NamedTuple):
    """The beams of s scanners: beam i points at ``cos(a) ahead + sin(a) left`` with ``a = first + i step``."""

    origin: Array  # (3, s) m, world
    frame: Array  # (3, 3, s) unit vectors: ahead, left, and the normal of the plane of beams; x, y, z; scanner
    beams: Array  # (s,) how many
    cos: Array  # (all beams,) of a
    sin: Array
    spread: Array  # (5, s), in beams: a full turn, middle of the beams from ahead, last beam; 1 / step, 1/rad; first among all
    reach: Array  # (s,) m, finite
    own: Array  # (s,) row of the body that it does not see
    level: bool  # whether all planes are

    @property
    def single(self) -> bool:
        """Whether there is one scanner, with parameters that need no repetition."""
        return len(self.reach) == 1

    def of(self, values: Array, scanner: Array) -> Array:
        """A parameter of each scanner, (..., s), repeated for things of these scanners."""
        return values if len(self.reach) == 1 else values.take(scanner, axis=-1)


def spread_of(first: float, step: float, beams: int) -> tuple[float, float, float, float]:
    """One scanner's column of `Fan.spread`, without the last row. The beams make at most a full turn, and step > 0."""
    last = beams - 1.0
    return math.tau / step, first / step + 0.5 * last, last, 1.0 / step


class Segments(NamedTuple):
    """Line segments in the planes of scanners, clockwise for the scanner, none from its edge."""

    scanner: Array  # (k,)
    x: Array  # (2, k) m, ahead: of both ends
    y: Array  # (2, k) m, left


def cut(pieces: PieceIndex, fan: Fan, scanners: Sequence[int]) -> Iterator[Segments]:
    """Sections of the solids within reach by the planes of some scanners."""
    if not scanners:
        return
    (xs, ys, _), reach = fan.origin.tolist(), fan.reach.tolist()
    near = [pieces.near(xs[each], ys[each], reach[each]) for each in scanners]
    prisms, edges, triangles = (_of_each(parts, scanners) for parts in zip(*near, strict=True))
    if edges[0].size:
        yield _sides(pieces, fan, *edges)
    if prisms[0].size and not fan.level:
        yield from _ends(pieces, fan, *prisms)
    if triangles[0].size:
        yield _facets(pieces, fan, *triangles)


def _of_each(parts: Sequence[Array], scanners: Sequence[int]) -> tuple[Array, Array]:
    """Pieces near each of some scanners in one array, and their scanners."""
    if len(parts) == 1:
        return parts[0], np.full(len(parts[0]), scanners[0])
    return np.concatenate(parts), np.repeat(scanners, [len(part) for part in parts])


def _sides(pieces: PieceIndex, fan: Fan, edges: Array, scanner: Array) -> Segments:
    """Upright faces, between the plane's entry and exit at the bottom and top."""
    sides = pieces.edges.take(edges, axis=1)
    sides -= fan.of(fan.origin[_COORDINATES], scanner)
    x, y, (bottom, top) = sides[:2], sides[2:4], sides[4:]
    facing = x[0] * y[1] - x[1] * y[0] < -_THIN
    if fan.level:
        facing &= (bottom <= 0.0) & (top >= 0.0)
    (some,) = facing.nonzero()
    scanner, (x, y, (bottom, top)) = scanner[some], sides.take(some, axis=1).reshape(3, 2, -1)
    x, y = _in_plane(fan, scanner, x, y)
    clipped = False
    if not fan.level:
        z = _height(fan, scanner, x, y)
        low, high = np.minimum(z[0], z[1]), np.maximum(z[0], z[1])
        whole = (low >= bottom) & (high <= top)
        (some,) = (whole | (low < top) & (high > bottom)).nonzero()
        (part,) = (~whole[some]).nonzero()
        scanner, x, y = scanner[some], x.take(some, axis=1), y.take(some, axis=1)
        if part.size:
            x[:, part], y[:, part] = _clipped(x[:, part], y[:, part], z[:, some[part]], bottom[some[part]], top[some[part]])
            clipped = True
    return _clockwise(scanner, x, y) if clipped or (fan.frame[2, 2] < 0.0).any() else Segments(scanner, x, y)


def _clipped(x: Array, y: Array, z: Array, bottom: Array, top: Array) -> tuple[Array, Array]:
    """Parts of segments, (2, k) each, between two heights, (k,) each."""
    rise = z[1] - z[0]
    one, two = (bottom - z[0]) / rise, (top - z[0]) / rise
    share = np.array([np.maximum(np.minimum(one, two), 0.0), np.minimum(np.maximum(one, two), 1.0)])
    return x[0] + share * (x[1] - x[0]), y[0] + share * (y[1] - y[0])


def _ends(pieces: PieceIndex, fan: Fan, prisms: Array, scanner: Array) -> Iterator[Segments]:
    """Roofs from above, and undersides from below: a plane crosses two edges of each."""
    oz = fan.of(fan.origin[2], scanner)
    top, bottom = pieces.top[prisms] - oz, pieces.bottom[prisms] - oz
    gap = np.maximum(-top, bottom)
    (some,) = ((gap > 0.0) & (gap <= fan.of(fan.reach * np.hypot(*fan.frame[:2, 2]), scanner))).nonzero()
    if not some.size:
        return
    count = pieces.corners[prisms[some]]
    height, scanner = np.repeat(np.where(top < 0.0, top, bottom)[some], count), np.repeat(scanner[some], count)
    edges = pieces.edges[:4].take(pieces.edges_of(prisms[some]), axis=1) - fan.of(fan.origin[_COORDINATES[:4]], scanner)
    x, y = _in_plane(fan, scanner, edges[:2], edges[2:])
    z = _height(fan, scanner, x, y)
    over = z >= height
    (across,) = (over[0] != over[1]).nonzero()
    x, y, z = (each.take(across, axis=1) for each in (x, y, z))
    share = (height[across] - z[0]) / (z[1] - z[0])
    points = np.array([x[0] + share * (x[1] - x[0]), y[0] + share * (y[1] - y[0])])
    yield _clockwise(scanner[across[0::2]], *points.reshape(2, -1, 2).swapaxes(1, 2))


def _facets(pieces: PieceIndex, fan: Fan, triangles: Array, scanner: Array) -> Segments:
    """Triangles with one corner on one side of the plane and two on the other."""
    corners = np.moveaxis(pieces.triangles[triangles], 0, -1) - fan.of(fan.origin, scanner)  # (3 corners, xyz, k)
    side = _along(fan.of(fan.frame[2], scanner), corners)
    over = side >= 0.0
    count = over.sum(axis=0)
    (some,) = ((count == 1) | (count == 2)).nonzero()
    lone = np.argmax(over[:, some] == (count[some] == 1), axis=0)
    others = np.array([(lone + 1) % 3, (lone + 2) % 3])
    corner, its = corners[lone, :, some], side[lone, some]  # (k, 3), (k,)
    far, share = corners[others, :, some], its / (its - side[others, some])  # (2, k, 3), (2, k)
    points = np.moveaxis(corner + (far - corner) * share[:, :, None], -1, 1)
    scanner = scanner[some]
    ahead, left, _ = fan.of(fan.frame, scanner)
    return _clockwise(scanner, _along(ahead, points), _along(left, points))


def _in_plane(fan: Fan, scanner: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Coordinates ahead and left of the scanner, in its plane, of points above or below (x, y) from it, world."""
    (ax, ay, _), (bx, by, _) = fan.frame[:2]
    a, b, c, d = fan.of(np.array([by, bx, ax, ay]) / fan.frame[2, 2], scanner)
    return x * a - y * b, y * c - x * d


def _height(fan: Fan, scanner: Array, x: Array, y: Array) -> Array:
    """Heights of points of the plane above the scanner, m."""
    ahead, left = fan.of(fan.frame[:2, 2], scanner)
    height: Array = ahead * x + left * y
    return height


def _along(axis: Array, points: Array) -> Array:
    """Components of points (n, 3, k) along unit vectors (3, k) or (3, 1): (n, k)."""
    components: Array = axis[0] * points[:, 0] + axis[1] * points[:, 1] + axis[2] * points[:, 2]
    return components


def _clockwise(scanner: Array, x: Array, y: Array) -> Segments:
    """Segments with ends in the right order, without segments seen from their edge."""
    area = x[0] * y[1] - x[1] * y[0]
    swap = area > 0.0
    (some,) = (np.abs(area) > _THIN).nonzero()
    x, y = (np.where(swap, each[::-1], each).take(some, axis=1) for each in (x, y))
    return Segments(scanner[some], x, y)
