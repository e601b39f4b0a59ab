"""All beams of many range scanners at once.

The beams of a scanner lie in a plane, which cuts the world into line segments (`cut`). In polar coordinates (r, a) of
the scanner, a segment on the line ``u x + v y = 1`` is ``1/r = u cos a + v sin a`` for the beams between its ends, and the
largest ``1/r`` of each beam is its measurement: two products and a sum for each beam of each segment that faces the scanner.
Hulls of bodies are tested with single beams, but only beams towards a sphere around them.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.physics.raycast.caster import Caster, PieceIndex
from vcmvsp.physics.world.world import Hulls


class Fan(NamedTuple):
    """The beams of s scanners: beam i points at ``cos(a) ahead + sin(a) left`` with ``a = first + i step``."""

    origin: Array  # (3, s) m, world
    frame: Array  # (3, 3, s) unit vectors: ahead, left, and the normal of the plane of beams; x, y, z; scanner
    beams: Array  # (s,) how many
    cos: Array  # (all beams,) of a
    sin: Array
    spread: Array  # (5, s), in beams: a full turn, middle of the beams from ahead, last beam; 1 / step, 1/rad; first among all
    reach: Array  # (s,) m, finite
    own: Array  # (s,) row of its own body, which it does not see
    level: bool  # whether all planes are

    @property
    def single(self) -> bool:
        """Whether there is one scanner, with parameters that need no repetition."""
        return len(self.reach) == 1

    def of(self, values: Array, scanner: Array) -> Array:
        """A parameter of each scanner, (..., s), repeated for elements of these scanners."""
        return values if len(self.reach) == 1 else values.take(scanner, axis=-1)


class Segments(NamedTuple):
    """Line segments in the planes of scanners, clockwise for the scanner, none from its edge."""

    scanner: Array  # (k,)
    x: Array  # (2, k) m, ahead: of both ends
    y: Array  # (2, k) m, left


_NEVER_ZERO = 1e-300  # added to divisors: changes only zeros
_STEEP = 0.02  # of the normal's z component: planes nearly upright are not cut; their beams are cast one by one
_SEAM = 1e-9  # beams: segments reach this far beyond their ends, so that nothing passes between two that touch


def sweep(caster: Caster, fan: Fan, hulls: Hulls | None = None) -> list[Array]:
    """Ranges without errors, an array (beams,) for each scanner, m; inf: nothing within reach.

    Beams end at the floor. A scanner inside a prism measures 0 with all beams.
    """
    inverse = _floor(fan)  # 1/m, of all beams
    upright = np.abs(fan.frame[2, 2]).tolist()
    for segments in cut(caster.pieces, fan, [each for each, z in enumerate(upright) if z >= _STEEP]):
        _draw(fan, segments, inverse)
    with np.errstate(divide="ignore"):
        distance = 1.0 / inverse
    for number, z in enumerate(upright):
        if z < _STEEP:
            _cast(caster, fan, number, distance)
    if hulls is not None and len(hulls.centre):
        _bodies(hulls, fan, distance)
    distance[distance > (fan.reach if fan.single else np.repeat(fan.reach, fan.beams))] = np.inf
    ranges = [distance] if fan.single else np.split(distance, np.cumsum(fan.beams)[:-1])
    for each, point in zip(ranges, fan.origin.T.tolist(), strict=True):
        if caster.inside(point):
            each[:] = 0.0
    return ranges


def _floor(fan: Fan) -> Array:
    """1 / distance to the floor of all beams, 1/m; 0: no hit."""
    if fan.level:
        return np.zeros(len(fan.cos))
    height = fan.origin[2]
    fall = fan.frame[:2, 2] / -np.where(height > 0.0, height, np.inf)
    ahead, left = fall if fan.single else np.repeat(fall, fan.beams, axis=1)
    return np.asarray(np.maximum(ahead * fan.cos + left * fan.sin, 0.0) + 0.0)  # the sum turns -0 into 0


def _draw(fan: Fan, segments: Segments, inverse: Array) -> None:
    scanner, x, y = segments
    angle = np.arctan2(y, x)
    width = angle[0] - angle[1]
    width += math.tau * (width < 0.0)
    lines = np.array([y[1] - y[0], x[0] - x[1]]) / (x[0] * y[1] - x[1] * y[0])
    segment, beam = _between(fan, scanner, angle[1], width)
    u, v = lines.take(segment, axis=1)
    np.maximum.at(inverse, beam, u * fan.cos[beam] + v * fan.sin[beam])


def _between(fan: Fan, scanner: Array, low: Array, width: Array) -> tuple[Array, Array]:
    """Beams within angles from ``low`` to ``low + width``, rad, (k,) each: pairs (which of the k, beam among all)."""
    turn, middle, last, per_rad, start = fan.of(fan.spread, scanner)
    begin = low * per_rad - middle  # from here on in beams
    begin += 0.5 * last - turn * np.rint(begin / turn)
    end = begin + (width * per_rad + _SEAM)
    first = np.ceil(np.maximum(begin - _SEAM, 0.0))
    count = np.minimum(np.floor(end), last) - first + 1.0
    which, first = np.arange(len(low)), first + start
    (again,) = (end >= turn).nonzero()  # behind the scanner, and round to its first beam
    if again.size:
        turn, last, start = (np.broadcast_to(each, low.shape)[again] for each in (turn, last, start))
        count = np.concatenate([count, np.minimum(np.floor(end[again] - turn), last) + 1.0])
        which, first = np.concatenate([which, again]), np.concatenate([first, start])
    number = np.maximum(count, 0.0).astype(np.intp)
    after = number.cumsum()
    beam = np.repeat(first.astype(np.intp) - after + number, number)
    beam += np.arange(len(beam))
    return np.repeat(which, number), beam


def _cast(caster: Caster, fan: Fan, each: int, distance: Array) -> None:
    before = int(fan.beams[:each].sum())
    beams = slice(before, before + fan.beams[each])
    toward = np.outer(fan.cos[beams], fan.frame[0, :, each]) + np.outer(fan.sin[beams], fan.frame[1, :, each])
    met = caster.cast(fan.origin[:, each], toward, float(fan.reach[each]))
    distance[beams] = np.minimum(distance[beams], met)


def _bodies(hulls: Hulls, fan: Fan, distance: Array) -> None:
    offset = hulls.centre.T[:, None] - fan.origin[:, :, None]  # (3, scanners, bodies)
    near = (offset * offset).sum(axis=0) <= (fan.reach[:, None] + hulls.radius) ** 2
    near[np.arange(len(near)), fan.own] = False
    scanner, body = near.nonzero()
    if not body.size:
        return
    offset, frame = offset[:, scanner, body], fan.frame[:, :, scanner]
    x, y, aside = (frame * offset).sum(axis=1)
    square, circle = x * x + y * y, hulls.radius[body] ** 2 - aside * aside  # the sphere, cut by the plane
    (some,) = (circle > 0.0).nonzero()
    if not some.size:
        return
    scanner, body, x, y, square, circle = (each[some] for each in (scanner, body, x, y, square, circle))
    half = np.where(square > circle, np.arcsin(np.sqrt(circle / np.maximum(square, circle))), math.pi)
    pair, beam = _between(fan, scanner, np.arctan2(y, x) - half, 2.0 * half)
    vectors = np.concatenate([-offset[None], frame[:2]]).take(some, axis=2)
    start, ahead, left = in_frames(hulls, body, vectors.swapaxes(0, 1))
    toward = ahead.take(pair, axis=1) * fan.cos[beam] + left.take(pair, axis=1) * fan.sin[beam]
    np.minimum.at(distance, beam, meet(hulls, body[pair], start.take(pair, axis=1), toward))


_THIN = 1e-9  # m2: twice the area between scanner and segment; a smaller area is an edge-on view, without effect
_COORDINATES = [0, 0, 1, 1, 2, 2]  # of the rows of `PieceIndex.edges`


def cut(pieces: PieceIndex, fan: Fan, scanners: Sequence[int]) -> Iterator[Segments]:
    """Sections of the solids within reach by the planes of some scanners: line segments from prisms and triangles.

    The plane of a level scanner cuts all solids at one height: whole sides, and neither roofs nor undersides.
    """
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
    """Coordinates (ahead, left) in the scanner's plane of the points above or below (x, y) from it, world."""
    (ax, ay, _), (bx, by, _) = fan.frame[:2]
    a, b, c, d = fan.of(np.array([by, bx, ax, ay]) / fan.frame[2, 2], scanner)
    return x * a - y * b, y * c - x * d


def _height(fan: Fan, scanner: Array, x: Array, y: Array) -> Array:
    """Heights of points of the plane above the scanner, m."""
    ahead, left = fan.of(fan.frame[:2, 2], scanner)
    return np.asarray(ahead * x + left * y)


def _along(axis: Array, points: Array) -> Array:
    """Components of points (n, 3, k) along unit vectors (3, k) or (3, 1): (n, k)."""
    return np.asarray(axis[0] * points[:, 0] + axis[1] * points[:, 1] + axis[2] * points[:, 2])


def _clockwise(scanner: Array, x: Array, y: Array) -> Segments:
    """Segments with ends in the right order, without segments seen from their edge."""
    area = x[0] * y[1] - x[1] * y[0]
    swap = area > 0.0
    (some,) = (np.abs(area) > _THIN).nonzero()
    x, y = (np.where(swap, each[::-1], each).take(some, axis=1) for each in (x, y))
    return Segments(scanner[some], x, y)


def in_frames(hulls: Hulls, body: Array, vectors: Array) -> tuple[Array, ...]:
    """World vectors (3, v, q), v for each of q bodies, in the frames of these bodies: v arrays of (3, q)."""
    turned = (hulls.rotation[:, :, None, body] * vectors[:, None]).sum(axis=0)
    return tuple(turned[:, k] for k in range(vectors.shape[1]))


def meet(hulls: Hulls, body: Array, start: Array, toward: Array) -> Array:
    """Lengths of q beams up to one body (q,) each, m; 0: from inside; inf: no hit.

    Beams ``start`` (3, q) m from the centres of the hulls, ``toward`` (3, q) unit vectors, both in the bodies' frames.
    """
    half = hulls.half[:, body]
    with np.errstate(over="ignore"):
        per_metre = 1.0 / (toward + _NEVER_ZERO)
        centre, reach = start * per_metre, half * np.abs(per_metre)
        enter, leave = -centre - reach, reach - centre
        (rounds,) = np.nonzero(hulls.round[body])
        if rounds.size:
            enter[:2, rounds], leave[:2, rounds] = _barrel(start[:, rounds], toward[:, rounds], half[0, rounds])
    first, last = enter.max(axis=0), leave.min(axis=0)
    return np.where((first <= last) & (last >= 0.0), np.maximum(first, 0.0), np.inf)


def _barrel(start: Array, toward: Array, radius: Array) -> tuple[Array, Array]:
    """Entry and exit (q,) of lines in endless cylinders around z; without a hit, the exit is before the entry."""
    (x, y, _), (dx, dy, _) = start, toward
    square, cross = dx * dx + dy * dy + _NEVER_ZERO, x * dy - y * dx
    beside = (square == _NEVER_ZERO) & (x * x + y * y > radius * radius)  # along the axis
    root = np.where(beside, -1.0, square * radius * radius - cross * cross)
    middle, half = -(x * dx + y * dy) / square, np.sqrt(np.maximum(root, 0.0)) / square
    return np.where(root < 0.0, np.inf, middle - half), np.where(root < 0.0, -np.inf, middle + half)
