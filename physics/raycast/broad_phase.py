"""Which beams may meet which pieces: quick tests that let through a little too much; and what is left of all that they meet."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from vcmvsp.cosim.types import Array

_AT_ONCE = 8192  # pairs: arrays that stay in the processor's cache
_LAST = np.iinfo(np.int64).max


class Reached(NamedTuple):
    """What each beam met first."""

    distance: Array  # (r,) m; inf: nothing
    which: Array  # (r,) int64, the number of the thing; -1: nothing


class Nearest:
    """Keeps the nearest of what beams meet; of two at the same distance the one with the smaller number."""

    def __init__(self, beams: int) -> None:
        self._distance, self._which = np.full(beams, np.inf), np.full(beams, _LAST)

    def meet(self, beam: Array, distance: Array, which: Array) -> None:
        """Some beams (q,) meet things of these numbers (q,) at these distances (q,); inf: they do not."""
        found = np.full(len(self._distance), np.inf)
        np.minimum.at(found, beam, distance)
        nearer = found < self._distance
        self._distance[nearer], self._which[nearer] = found[nearer], _LAST
        (won,) = (np.isfinite(distance) & (distance == self._distance[beam])).nonzero()
        np.minimum.at(self._which, beam[won], which[won])

    def within(self, reach_m: float) -> Reached:
        """All that was met within reach."""
        met = np.isfinite(self._distance) & (self._distance <= reach_m)
        return Reached(np.where(met, self._distance, np.inf), np.where(met, self._which, -1))


def pairs(
    origins: Array, directions: Array, reach_m: float, centre: Array, radius: Array, around: Array
) -> Iterator[tuple[Array, Array]]:
    """Pairs (beam, piece) that may meet, some at a time; no other beam meets a piece.

    Args:
        origins: (r, 3) m.
        directions: (r, 3), unit vectors.
        reach_m: no further than this.
        centre: (m, 3) m, of spheres around the pieces.
        radius: (m,) m, of these spheres.
        around: (m,) m, of circles around the pieces seen from above.
    """
    if (origins == origins[:1]).all():
        yield from by_bearing(origins[0], directions, centre, around)
        return
    rows = max(1, _AT_ONCE // max(1, len(centre)))
    for first in range(0, len(origins), rows):
        some = slice(first, first + rows)
        beam, piece = touching_spheres(origins[some], directions[some], reach_m, centre, radius)
        yield beam + first, piece


def touching_spheres(origins: Array, directions: Array, reach_m: float, centre: Array, radius: Array) -> tuple[Array, Array]:
    """Pairs (beam, sphere) that meet: all with all."""
    base = origins[:1]
    start, middle = origins - base, centre - base
    along = directions @ middle.T - (start * directions).sum(axis=1)[:, None]
    square = (middle * middle).sum(axis=1) + (start * start).sum(axis=1)[:, None] - 2.0 * (start @ middle.T)
    aside = square - along * along
    crossed = aside <= radius * radius + 1e-6 + 1e-12 * square
    beam, sphere = np.nonzero(crossed & (along >= -radius - 1e-3) & (along <= reach_m + radius + 1e-3))
    return beam, sphere


def by_bearing(origin: Array, directions: Array, centre: Array, around: Array) -> Iterator[tuple[Array, Array]]:
    """Pairs of beams from one place and pieces: those between the bearings of a circle's two sides, however far away it is.

    Args:
        origin: (3,) m.
        directions: (r, 3), of any length.
        centre: (m, 3) m, of the circles; heights do not matter.
        around: (m,) m, their radii.
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
