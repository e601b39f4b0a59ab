"""Lengths of straight lines inside upright solids of any outline: cylinders, prisms with courtyards."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.types import Array
from vcmvsp.physics.world.polygons import area_m2, is_convex, outward, width_m
from vcmvsp.physics.world.solids import Prism, Solid

Floats = NDArray[np.float64]

_NEVER_ZERO = 1e-300  # added to what is divided by: changes nothing but a zero
_SKIN_M = 1e-9  # solids are smaller by this all round, so that a line along a face does not count
_SHORT_M = 1e-9  # what is left of a touch after rounding
_BLOCK = 1 << 15  # lines x solids, and pairs x edges, at a time


class PrismObstacles:
    """Upright solids by their rings, counter-clockwise, and clockwise round holes.

    A line is inside from each edge where it enters to the one where it leaves, and between bottom and top. Prisms are not cut
    into convex pieces: a line along a cut is inside both, or none.

    Attributes:
        columns: numbers of the solids among the world's, (c,).
        thickness_m: (c,). Of a convex outline its least width, e.g. a cylinder's diameter; of another twice its area per length
            of all rings, as for a long wall; at most the height.
    """

    def __init__(self, solids: Mapping[int, Solid]) -> None:
        self.columns = np.array(list(solids), np.int64)
        parts = [_pieces(solid) for solid in solids.values()]
        pieces = [(column, *piece) for column, own in enumerate(parts) for piece in own]
        self._column = np.array([column for column, *_ in pieces], np.int64)
        self.thickness_m: Floats = np.full(len(solids), np.inf)
        for column, rings, bottom, top in pieces:
            self.thickness_m[column] = min(self.thickness_m[column], top - bottom, _thickness(rings))
        self._bottom = np.array([bottom for *_, bottom, _ in pieces], np.float64) + _SKIN_M
        self._top = np.array([top for *_, top in pieces], np.float64) - _SKIN_M
        shrunk = [[_shrunk(ring) for ring in rings] for _, rings, *_ in pieces]
        starts = [np.concatenate(each) for each in shrunk]
        self._count = np.array([len(each) for each in starts], np.int64)
        self._first = np.cumsum(self._count) - self._count
        self._start = np.concatenate([np.empty((0, 2)), *starts])
        rings = [ring for each in shrunk for ring in each]
        self._end = np.concatenate([np.empty((0, 2)), *(np.roll(ring, -1, axis=0) for ring in rings)])
        boxes = np.array([(each.min(axis=0), each.max(axis=0)) for each in starts]).reshape(-1, 2, 2)
        self._middle, self._half = 0.5 * (boxes[:, 0] + boxes[:, 1]), 0.5 * (boxes[:, 1] - boxes[:, 0])

    def inside(self, tx: Floats, rx: Floats) -> Floats:
        """Lengths inside each solid, (n, c) m, of the lines from ``tx`` (3,) to each of ``rx`` (n, 3)."""
        result = np.zeros((len(rx), len(self.columns)))
        rows = max(1, _BLOCK // len(self._column))
        for first in range(0, len(rx), rows):
            middle, run = 0.5 * (tx + rx[first : first + rows]), rx[first : first + rows] - tx
            back = (run[:, 0] < 0.0) | ((run[:, 0] == 0.0) & (run[:, 1] < 0.0))
            run = np.where(back[:, None], -run, run)  # one direction for both ways: corners count alike
            run[np.abs(run) < _SKIN_M**4] = 0.0
            run[(run[:, :2] * run[:, :2]).sum(axis=1) < _SKIN_M**2, :2] = 0.0  # upright: nothing to divide by
            line, piece = self._near(middle, run)
            pairs = max(1, _BLOCK // int(self._count.max()))
            for start in range(0, len(line), pairs):
                some, of = line[start : start + pairs], piece[start : start + pairs]
                share = self._shares(middle[some], run[some], of)
                length = share * np.sqrt((run[some] * run[some]).sum(axis=1))
                length[length < _SHORT_M] = 0.0
                np.add.at(result, (first + some, self._column[of]), length)
        return result

    def _near(self, middle: Floats, run: Floats) -> tuple[Array, Array]:
        """Pairs of lines and pieces with a common part of bounding box and heights."""
        low, high = np.full((len(run), len(self._column)), -0.5), np.full((len(run), len(self._column)), 0.5)
        floor, ceiling = 0.5 * (self._top + self._bottom), 0.5 * (self._top - self._bottom)
        slabs = (*zip(self._middle.T, self._half.T, strict=True), (floor, ceiling))
        for k, (centre, half) in enumerate(slabs):
            per_metre = 1.0 / (run[:, k : k + 1] + _NEVER_ZERO)
            offset, reach = (middle[:, k : k + 1] - centre) * per_metre, half * np.abs(per_metre)
            np.maximum(low, -offset - reach, out=low)
            np.minimum(high, reach - offset, out=high)
        line, piece = np.nonzero(high > low)
        return line, piece

    def _shares(self, middle: Floats, run: Floats, of: Array) -> Floats:
        """Share of each line inside the piece of its pair, (p,).

        Crossed edges count from the middle of the line: plus at exits, minus at entries, each clipped to the line's part
        between bottom and top. A line exactly through a corner counts as passing it on the left: it crosses one edge there, or
        two, or none, like a line beside it.
        """
        count = self._count[of]
        pair = np.repeat(np.arange(len(of)), count)
        edge = np.repeat(self._first[of] - np.cumsum(count) + count, count) + np.arange(len(pair))
        a, b = self._start[edge] - middle[pair, :2], self._end[edge] - middle[pair, :2]
        dx, dy = run[pair, 0], run[pair, 1]
        side_a, side_b = dx * a[:, 1] - dy * a[:, 0], dx * b[:, 1] - dy * b[:, 0]
        out = (side_a < 0.0) & (side_b >= 0.0)  # from the right of the line to its left: it goes out
        into = (side_a >= 0.0) & (side_b < 0.0)
        crossed = np.flatnonzero(out | into)
        along_a, along_b = (dx * p[:, 0] + dy * p[:, 1] for p in (a, b))
        weight = side_a[crossed] / (side_a[crossed] - side_b[crossed])
        place = along_a[crossed] + weight * (along_b[crossed] - along_a[crossed])
        place /= (dx * dx + dy * dy)[crossed]
        at = pair[crossed]
        low, high = self._between(middle[:, 2], run[:, 2], of)
        signed = np.where(out[crossed], 1.0, -1.0) * np.clip(place, low[at], high[at])
        share: Floats = np.maximum(np.bincount(at, signed, len(of)), 0.0)
        upright = np.flatnonzero((run[:, 0] == 0.0) & (run[:, 1] == 0.0))
        if len(upright):  # nothing is crossed: the whole line has one place in the outline
            share[upright] = np.where(self._holds(a, b, pair, len(of))[upright], (high - low)[upright], 0.0)
        return share

    def _between(self, z: Floats, rise: Floats, of: Array) -> tuple[Floats, Floats]:
        """Limits of the line's part between bottom and top, in shares of the line from its middle."""
        per_metre = 1.0 / (rise + _NEVER_ZERO)
        centre, reach = (0.5 * (self._top + self._bottom)[of] - z) * per_metre, 0.5 * (self._top - self._bottom)[of]
        low, high = np.maximum(centre - reach * np.abs(per_metre), -0.5), np.minimum(centre + reach * np.abs(per_metre), 0.5)
        return low, np.maximum(high, low)

    @staticmethod
    def _holds(a: Floats, b: Floats, pair: Array, count: int) -> Array:
        """Whether the origin is inside, by pair: an odd number of edges lies east of it."""
        above = (a[:, 1] > 0.0) != (b[:, 1] > 0.0)
        slope = (b[:, 0] - a[:, 0]) / np.where(above, b[:, 1] - a[:, 1], 1.0)
        east = above & (a[:, 0] - a[:, 1] * slope > 0.0)
        odd: Array = np.bincount(pair, east, count) % 2.0 == 1.0
        return odd


def _pieces(solid: Solid) -> list[tuple[list[Array], float, float]]:
    """Rings, bottom and top of the parts of a solid; a prism is one part."""
    if isinstance(solid, Prism):
        rings = [np.array(ring, float) for ring in (solid.outline, *solid.holes)]
        turned = [ring if (area_m2(ring) > 0.0) == (k == 0) else ring[::-1] for k, ring in enumerate(rings)]
        return [(turned, solid.bottom, solid.bottom + solid.height)]
    return [([corners], bottom, top) for corners, bottom, top in solid.uprights()]


def _thickness(rings: Sequence[Array]) -> float:
    if len(rings) == 1 and is_convex(rings[0].tolist()):
        return width_m(rings[0])
    around = sum(float(np.hypot(*(ring - np.roll(ring, 1, axis=0)).T).sum()) for ring in rings)
    return 2.0 * sum(area_m2(ring) for ring in rings) / around


def _shrunk(ring: Array) -> Array:
    """A ring with its edges moved inwards by the skin; at sharp corners by at most ten skins."""
    inwards = -outward(ring)
    before = np.roll(inwards, 1, axis=0)
    total = before + inwards
    scale = np.maximum((total * total).sum(axis=1), 0.04)  # 2 (1 + cos of the turn)
    result: Array = ring + 2.0 * _SKIN_M * total / scale[:, None]
    return result
