"""Multiple knife edges over the roofs: what is left where no other path arrives."""

import math
from typing import NamedTuple

import numpy as np

from vcmvsp.netsim.interfaces.layers import Bools, Floats, Ints
from vcmvsp.netsim.propagation.rays.arrays import Complex
from vcmvsp.netsim.propagation.rays.world import RayWorld

_PAIRS_AT_ONCE = 1 << 14  # pairs x bodies: what fits into a cache
_NEGLIGIBLE = -0.78  # nu below which an edge loses nothing (ITU-R P.526-15, 4.1)


class RoofPaths(NamedTuple):
    """The way over the roofs of n pairs: a string over one to three edges."""

    gain: Complex  # (n,) of free space over the straight line, and of the edges; with the phase of the string
    length_m: Floats  # (n,) of the string
    edge_of: Ints  # (m,) pair of each edge, never decreasing
    edge: Floats  # (m, 3) m, in order from a to b


def over_roofs(world: RayWorld, a: Floats, b: Floats, wavelength_m: float) -> RoofPaths:
    """Paths over up to three knife edges in the upright plane through a (n, 3) m and b (n, 3) m.

    J. Deygout, Multiple knife-edge diffraction of microwaves, IEEE Transactions on Antennas and Propagation 14, 1966: the edge
    with the greatest nu counts as if it were alone; then, likewise, that of each side between it and the end. nu and the loss J
    of one edge are those of ITU-R P.526-15, equations 26 and 31::

        nu = h sqrt(2 / lambda (1 / d1 + 1 / d2)),   J = 6.9 + 20 log10(sqrt((nu - 0.1)^2 + 1) + nu - 0.1)

    Each body in the plane has two edges, at the ends of its roof; a thin one has one, in its middle.
    """
    pair, share, height = _profile(world, a, b)
    level = a[pair, 2] + share * (b[pair, 2] - a[pair, 2])
    across = np.sqrt(((b - a)[:, :2] ** 2).sum(axis=1))
    nothing, everything = np.zeros(len(a)), np.ones(len(a))
    main = _highest(pair, share, height, level, across, (nothing, everything), wavelength_m)
    loss_db = main.loss_db
    chosen = [main]
    for before in (True, False):
        inside = share < main.share[pair] if before else share > main.share[pair]
        ends = (nothing, main.share) if before else (main.share, everything)
        low = np.where(before, a[:, 2], main.height)
        high = np.where(before, main.height, b[:, 2])
        part = np.maximum(ends[1] - ends[0], 1e-12)
        line = low[pair] + (share - ends[0][pair]) / part[pair] * (high - low)[pair]
        side = _highest(pair[inside], share[inside], height[inside], line[inside], across, ends, wavelength_m)
        loss_db = loss_db + np.where(main.loss_db > 0.0, side.loss_db, 0.0)
        chosen.insert(0 if before else 2, side)
    counts = np.stack([edge.loss_db > 0.0 for edge in chosen], axis=1) & (main.loss_db > 0.0)[:, None]
    edge_of, _ = np.nonzero(counts)
    points, length_m = _strings(a, b, chosen, counts)
    distance_m = np.sqrt(((b - a) ** 2).sum(axis=1))
    size = wavelength_m / (4.0 * math.pi * np.maximum(distance_m, wavelength_m)) * 10.0 ** (-loss_db / 20.0)
    turns = length_m / wavelength_m
    return RoofPaths(size * np.exp(-2j * math.pi * (turns - np.floor(turns))), length_m, edge_of, points[counts])


class _Edge(NamedTuple):
    """The chosen edge of each pair; where there is none its loss is 0."""

    share: Floats  # (n,) of the way from a to b
    height: Floats  # (n,) m
    loss_db: Floats  # (n,)


def _profile(world: RayWorld, a: Floats, b: Floats) -> tuple[Ints, Floats, Floats]:
    """Edges of roofs in the planes: pair, share of the way, height."""
    found = world.roofs
    pairs: list[Ints] = [np.zeros(0, np.int64)]
    shares, heights = [np.zeros(0)], [np.zeros(0)]
    step = max(1, _PAIRS_AT_ONCE // max(1, len(found.top)))
    for first in range(0, len(a), step):
        here, run = a[first : first + step], (b - a)[first : first + step]
        begin, finish = np.zeros((len(here), len(found.top))), np.ones((len(here), len(found.top)))
        body = np.repeat(np.arange(len(found.top)), np.diff(found.side_first))
        before = here[:, :2] @ found.side[:, :2].T - found.side[:, 2]
        slope = run[:, :2] @ found.side[:, :2].T
        with np.errstate(divide="ignore", invalid="ignore"):
            at = -before / slope
        enter = np.where(slope < 0.0, at, np.where((slope == 0.0) & (before > 0.0), 2.0, -1.0))
        leave = np.where(slope > 0.0, at, 2.0)
        starts = found.side_first[:-1]
        if len(body):
            begin = np.maximum(begin, np.maximum.reduceat(enter, starts, axis=1))
            finish = np.minimum(finish, np.minimum.reduceat(leave, starts, axis=1))
        row, column = np.nonzero(finish > begin)
        enters, leaves = begin[row, column], finish[row, column]
        is_thin = found.thin[column]
        enters = np.where(is_thin, 0.5 * (enters + leaves), enters)
        for share, counts in ((enters, enters > 0.0), (leaves, ~is_thin)):
            within = counts & (share < 1.0)
            pairs.append(first + row[within])
            shares.append(share[within])
            heights.append(found.top[column[within]])
    pair = np.concatenate(pairs)
    order = np.lexsort((np.concatenate(heights), np.concatenate(shares), pair))
    return pair[order], np.concatenate(shares)[order], np.concatenate(heights)[order]


def _highest(
    pair: Ints, share: Floats, height: Floats, line: Floats, across: Floats, ends: tuple[Floats, Floats], wavelength_m: float
) -> _Edge:
    """Of each pair the edge with the greatest nu between two ends, the first of equals."""
    n = len(across)
    first, second = (share - ends[0][pair]) * across[pair], (ends[1][pair] - share) * across[pair]
    inside = (first > 0.0) & (second > 0.0)
    nearer = np.where(inside, first, 1.0), np.where(inside, second, 1.0)
    nu = np.where(inside, (height - line) * np.sqrt(2.0 / wavelength_m * (1.0 / nearer[0] + 1.0 / nearer[1])), -np.inf)
    greatest = np.full(n, -np.inf)
    np.maximum.at(greatest, pair, nu)
    (best,) = np.nonzero((nu == greatest[pair]) & (nu > _NEGLIGIBLE))
    best = best[np.unique(pair[best], return_index=True)[1]]
    chosen = _Edge(np.full(n, 0.5), np.zeros(n), np.zeros(n))
    chosen.share[pair[best]], chosen.height[pair[best]] = share[best], height[best]
    less = nu[best] - 0.1
    chosen.loss_db[pair[best]] = 6.9 + 20.0 * np.log10(np.sqrt(less * less + 1.0) + less)
    return chosen


def _strings(a: Floats, b: Floats, chosen: list[_Edge], counts: Bools) -> tuple[Floats, Floats]:
    """Points of the three chosen edges, (n, 3, 3) m, and lengths of the strings over those that count, (n,) m."""
    points = np.stack([np.column_stack([a[:, :2] + e.share[:, None] * (b - a)[:, :2], e.height]) for e in chosen], axis=1)
    at, length = a, np.zeros(len(a))
    for k in range(3):
        to = np.where(counts[:, k, None], points[:, k], at)
        length = length + np.sqrt(((to - at) ** 2).sum(axis=1))
        at = to
    return points, length + np.sqrt(((b - at) ** 2).sum(axis=1))
