"""Candidate pairs of beams and pieces, by conservative tests, and the nearest hit of each beam."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from vcmvsp.cosim.types import Array

_AT_ONCE = 8192  # pairs: arrays that stay in the processor's cache
_LAST = np.iinfo(np.int64).max


class Reached(NamedTuple):
    """First hit of each beam."""

    distance: Array  # (r,) m; inf: nothing
    which: Array  # (r,) int64, the number of the thing; -1: nothing


class Nearest:
    """The nearest hit of each beam; at equal distances the one with the smaller number."""

    def __init__(self, beams: int) -> None:
        self._distance, self._which = np.full(beams, np.inf), np.full(beams, _LAST)

    def meet(self, beam: Array, distance: Array, which: Array) -> None:
        """Add hits: beams (q,), distances (q,) m, inf: none, and numbers of the things hit (q,)."""
        nearest = np.full(len(self._distance), np.inf)
        np.minimum.at(nearest, beam, distance)
        nearer = nearest < self._distance
        self._distance[nearer], self._which[nearer] = nearest[nearer], _LAST
        (won,) = (np.isfinite(distance) & (distance == self._distance[beam])).nonzero()
        np.minimum.at(self._which, beam[won], which[won])

    def within(self, reach_m: float) -> Reached:
        """All hits within reach."""
        met = np.isfinite(self._distance) & (self._distance <= reach_m)
        return Reached(np.where(met, self._distance, np.inf), np.where(met, self._which, -1))


def pairs(
    origins: Array, directions: Array, reach_m: float, centre: Array, radius: Array, around: Array
) -> Iterator[tuple[Array, Array]]:
    """Candidate pairs (beam, piece), in portions; no other beam hits a piece.

    Args:
        origins: (r, 3) m.
        directions: (r, 3), unit vectors.
        reach_m: of the beams.
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
    """Pairs (beam, sphere) that meet, of all beams and spheres."""
    base = origins[:1]
    start, middle = origins - base, centre - base
    along = directions @ middle.T - (start * directions).sum(axis=1)[:, None]
    square = (middle * middle).sum(axis=1) + (start * start).sum(axis=1)[:, None] - 2.0 * (start @ middle.T)
    aside = square - along * along
    crossed = aside <= radius * radius + 1e-6 + 1e-12 * square
    beam, sphere = np.nonzero(crossed & (along >= -radius - 1e-3) & (along <= reach_m + radius + 1e-3))
    return beam, sphere


def by_bearing(origin: Array, directions: Array, centre: Array, around: Array) -> Iterator[tuple[Array, Array]]:
    """Pairs of beams from one place and circles, by bearing alone, at any distance.

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
