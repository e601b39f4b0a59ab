"""All beams of many range scanners at once.

The beams of a scanner lie in a plane, which cuts the world into line segments (`plane_section`). In polar coordinates (r, a) of
the scanner, a segment on the line ``u x + v y = 1`` is ``1/r = u cos a + v sin a`` for the beams between its ends, and the
largest ``1/r`` of each beam is its measurement: two products and a sum for each beam of each segment that faces the scanner.
Hulls of bodies are tested with single beams, but only beams towards a sphere around them.
"""

import math

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.physics.raycast.caster import Caster
from vcmvsp.physics.raycast.moving_hulls import Hulls, in_frames, meet
from vcmvsp.physics.raycast.plane_section import Fan, Segments, cut

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
    inverse: Array = np.maximum(ahead * fan.cos + left * fan.sin, 0.0) + 0.0  # what is added makes 0 of -0
    return inverse


def _draw(fan: Fan, segments: Segments, inverse: Array) -> None:
    """Add segments to 1 / distance of all beams."""
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
    """Cast the beams of one scanner one by one among the solids."""
    before = int(fan.beams[:each].sum())
    beams = slice(before, before + fan.beams[each])
    toward = np.outer(fan.cos[beams], fan.frame[0, :, each]) + np.outer(fan.sin[beams], fan.frame[1, :, each])
    origins = np.broadcast_to(fan.origin[:, each], toward.shape)
    met = caster.cast(origins, toward, float(fan.reach[each]), floor=False)
    distance[beams] = np.minimum(distance[beams], met)


def _bodies(hulls: Hulls, fan: Fan, distance: Array) -> None:
    """Add hulls to the distances of all beams."""
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
