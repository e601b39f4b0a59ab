"""The gaps between what a range scanner sees: runs of beams that meet nothing as far as one looks ahead.

Toh 2012, 4.1, with half-open crossings, so that each edge of a gap is met once: beams ``P`` to ``N - 1`` are a gap where
``D(P-1) <= L < D(P)`` and ``D(N-1) > L >= D(N)``. (The printed (4-2) also marks beams between which nothing changes, and both
of its cases count D = L.) The width is the distance between the returns on both sides (law of cosines; (4-3) loses the root)::

    width = sqrt(a^2 + b^2 - 2 a b cos(delta)),   a = D(P-1),  b = D(N),  delta = (N - P + 1) step

As those beams have passed the edges, it is never less than the true one, and too large by less than a beam's spacing on
either side. With both sides taken at the look-ahead distance instead, doors look wider by 0.7 m on average. A gap at the border
of the field of view is closed there, at the look-ahead distance.
"""

import math
from typing import NamedTuple

import numpy as np

from vcmvsp.agents.avoidance.view import View, wrapped
from vcmvsp.cosim.types import Array

QUARTER = 0.5 * math.pi + 1e-9  # rad: the beams at its ends belong to it


class Gaps(NamedTuple):
    """Gaps, the widest first; arrays of one length."""

    begin: Array  # (k,) P: the first beam that is free
    end: Array  # (k,) N: the beam after the last one; beyond the number of beams for a gap that reaches over the first one
    width: Array  # (k,) m
    bearing: Array  # (k,) rad, of its middle; in a full turn from -pi to pi


def gaps(ranges: Array, lookahead_m: float, first: float, step: float, cyclic: bool = False) -> Gaps:
    """The gaps in a scan.

    All free: one gap of the whole field of view. Seen under half a turn or more, a gap is as wide as both sides are away.

    Args:
        ranges: (n,) m, from 0 to inf; inf: no return.
        lookahead_m: L; a beam is free that gets further.
        first: bearing of the first beam, rad.
        step: angle between beams, rad.
        cyclic: they go all the way round: the last is beside the first.
    """
    count, free = len(ranges), ranges > lookahead_m
    # In a full turn one begins at a beam that is not free: no gap reaches over that.
    start = int(free.argmin()) if cyclic else 0
    fenced = np.zeros(count + 2, bool)
    fenced[1 : count + 1 - start], fenced[count + 1 - start : count + 1] = free[start:], free[:start]
    edges = np.flatnonzero(fenced[1:] != fenced[:-1]) + start
    begin, end = edges[::2], edges[1::2]
    if cyclic and not free[start]:
        turns = count * (begin >= count)
        begin, end = begin - turns, end - turns
        a, b, beams = ranges[begin - 1], ranges[end % count], end - begin + 1
    else:
        a = np.where(begin > 0, ranges[begin - 1], lookahead_m)
        b = np.where(end < count, ranges[end % count], lookahead_m)
        beams = np.minimum(end, count - 1) - np.maximum(begin - 1, 0)
    delta = beams * step
    # The law of cosines, written so that rounding makes nothing negative.
    width = np.where(delta >= math.pi, a + b, np.sqrt((a - b) ** 2 + 4.0 * a * b * np.sin(0.5 * delta) ** 2))
    bearing = first + step * 0.5 * (begin + end - 1)
    if cyclic:
        bearing = wrapped(bearing)
    order = np.argsort(-width, kind="stable")
    return Gaps(begin[order], end[order], width[order], bearing[order])


def gaps_ahead(view: View, bearing: float, lookahead_m: float) -> tuple[Gaps, Array]:
    """The gaps within a quarter turn of a bearing that is in view, rad, and where they are to be thought to be.

    That is their middles, (k,) rad; but what lies beyond the border of the field of view counts as free. Otherwise a gap
    there grows while one turns towards it, its middle moves away, and the gap on the other side comes nearer. A gap that
    reaches beyond the quarter turn is as wide as it is in all of the view.
    """
    first, bearing = float(view.bearings[0]), view.near_middle(bearing)
    begin = math.ceil((bearing - first - QUARTER) / view.step)
    end = math.floor((bearing - first + QUARTER) / view.step) + 1
    if view.cyclic:
        unseen, ranges = 0, view.ranges.take(np.arange(begin, end), mode="wrap")
    else:
        unseen, ranges = max(-begin, 0), view.ranges[max(begin, 0) : end]
    candidates = gaps(ranges, lookahead_m, first + (begin + unseen) * view.step, view.step)
    width = _whole_widths(view, candidates, begin + unseen, len(ranges), lookahead_m)
    order = np.argsort(-width, kind="stable")
    candidates = Gaps(candidates.begin[order], candidates.end[order], width[order], candidates.bearing[order])
    more = (candidates.end == len(ranges)) * (end - begin - unseen - len(ranges)) - (candidates.begin == 0) * unseen
    return candidates, candidates.bearing + 0.5 * view.step * more


def _whole_widths(view: View, candidates: Gaps, begin: int, count: int, lookahead_m: float) -> Array:
    """Widths, m, of gaps among ``count`` beams from beam ``begin`` on; cut gaps are measured whole.

    A gap of half a turn or more is no door, so its width is not used.
    """
    cut = np.flatnonzero((candidates.begin == 0) | (candidates.end == count))
    if not len(cut):
        return candidates.width
    width, every = candidates.width.copy(), len(view.ranges)
    whole = gaps(view.ranges, lookahead_m, 0.0, view.step, view.cyclic)
    for each in cut.tolist():
        inside = (begin + int(candidates.begin[each]) - whole.begin) % every < whole.end - whole.begin
        one = inside.argmax()
        if (whole.end[one] - whole.begin[one] + 1) * view.step < math.pi:
            width[each] = min(width[each], float(whole.width[one]))
    return width
