"""The covariance of measured levels: a shadowing field over both ends, and what is independent in every row.

The level of row i, between a and b at distance r, is::

    y_i = X_i beta + S_i + e_i,   S ~ N(0, sigma^2 R),   e_i ~ N(0, tau^2), independent

    R_ij = (exp(-(|a a'| + |b b'|) / d) + exp(-(|a b'| + |b a'|) / d)) / sqrt((1 + exp(-2 r / d)) (1 + exp(-2 r' / d)))

R is the correlation of `netsim.propagation.shadowing.Shadowing`, the same in both directions; e is fading and the error of
measurement.
"""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from vcmvsp.netsim.interfaces.layers import Bools, Floats

_NUGGET = 1e-6  # share of the variance that is independent at least, so that rows at one place do not contradict each other
_SHARE = 7.0  # greatest |logit| of the independent share

# Models, by the number of parameters: log(sigma^2 + tau^2), then log d, then logit(tau^2 / (sigma^2 + tau^2)).
INDEPENDENT, CORRELATED, WITH_FADING = 1, 2, 3


@dataclass(frozen=True)
class Survey:
    """n measured rows, as the likelihood needs them."""

    level_dbm: Floats  # (n,); whatever where lost
    lost: Bools  # (n,)
    sensitivity_dbm: float
    design: Floats  # X, (n, p)
    distance_m: Floats  # r, (n,)
    straight_m: Floats  # |a a'| + |b b'|, (n, n)
    swapped_m: Floats  # |a b'| + |b a'|, (n, n)

    @classmethod
    def between(cls, a: Floats, b: Floats, *, level_dbm: Floats, lost: Bools, sensitivity_dbm: float, design: Floats) -> Self:
        """Rows between the points a and b, (n, 3) m each."""
        distance_m = np.sqrt(((a - b) ** 2).sum(axis=1))
        return cls(level_dbm, lost, sensitivity_dbm, design, distance_m, *_moves_m(a, b))

    @property
    def moved_m(self) -> Floats:
        """How far both ends together moved between two rows, whichever way round, (n, n)."""
        moved: Floats = np.minimum(self.straight_m, self.swapped_m)
        return moved

    @property
    def nearest_m(self) -> Floats:
        """How far both ends together moved between each row and the one nearest to it, (n,)."""
        nearest: Floats = (self.moved_m + np.diag(np.full(len(self.lost), math.inf))).min(axis=1)
        return nearest

    @property
    def limits(self) -> list[tuple[float, float]]:
        """Least and greatest of the three parameters that such rows can tell anything of."""
        moved = self.moved_m
        nearest = moved[moved > 1e-9].min(initial=math.inf)
        least = nearest / 3.0 if math.isfinite(nearest) else 1.0  # two rows that are 0.05 alike are as good as independent
        received = self.level_dbm[~self.lost]
        spread = math.log(max(1e-6, float(received.var())))
        return [
            (spread - 7.0, spread + 5.0),
            (math.log(least), math.log(max(2.0 * moved.max(), 2.0 * least))),
            (-_SHARE, _SHARE),
        ]


def covariance(survey: Survey, parameters: Floats) -> tuple[Floats, list[Floats]]:
    """Covariance of all rows, (n, n) dB^2, and its derivatives by each parameter."""
    count, variance = len(survey.lost), math.exp(parameters[0])
    if len(parameters) == INDEPENDENT:
        total = variance * np.eye(count)
        return total, [total]
    reach = math.exp(parameters[1])
    share = _NUGGET if len(parameters) == CORRELATED else 1.0 / (1.0 + math.exp(-parameters[2]))
    straight, swapped = np.exp(-survey.straight_m / reach), np.exp(-survey.swapped_m / reach)
    alike = np.exp(-2.0 * survey.distance_m / reach)
    scale = 1.0 / np.sqrt(1.0 + alike)
    scales = scale[:, None] * scale
    field = (straight + swapped) * scales
    slope = survey.distance_m / reach * alike / (1.0 + alike)
    grown = (survey.straight_m * straight + survey.swapped_m * swapped) / reach * scales - field * (slope[:, None] + slope)

    diagonal = np.diag_indices(count)
    total = variance * (1.0 - share) * field
    total[diagonal] += variance * share
    derivatives = [total, variance * (1.0 - share) * grown]
    if len(parameters) == WITH_FADING:
        traded = -variance * field
        traded[diagonal] += variance
        derivatives.append(share * (1.0 - share) * traded)
    return total, derivatives


def spreads(parameters: Floats) -> tuple[Floats, Floats]:
    """Logarithms of sigma and tau (of one spread only, unless there is fading), (s,), and their derivatives, (s, k)."""
    if len(parameters) < WITH_FADING:
        return 0.5 * parameters[:1], 0.5 * np.eye(1, len(parameters))
    share = 1.0 / (1.0 + math.exp(-parameters[2]))
    logs = 0.5 * (parameters[0] + np.log([1.0 - share, share]))
    return logs, np.array([(0.5, 0.0, -0.5 * share), (0.5, 0.0, 0.5 * (1.0 - share))])


def moved_m(a: Floats, b: Floats) -> Floats:
    """How far both ends together moved between two of n rows, whichever way round, (n, n)."""
    moved: Floats = np.minimum(*_moves_m(a, b))
    return moved


def _moves_m(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """The same each way: |a a'| + |b b'|, and with the ends of one row swapped |a b'| + |b a'|, (n, n) each."""
    cross = _apart(a, b)
    return _apart(a, a) + _apart(b, b), cross + cross.T


def _apart(a: Floats, b: Floats) -> Floats:
    """Distances of all points a from all points b, (n, m)."""
    squared = np.zeros((len(a), len(b)))
    for axis in range(3):
        squared += (a[:, axis, None] - b[:, axis]) ** 2
    return np.sqrt(squared, out=squared)
