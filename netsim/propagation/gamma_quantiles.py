"""Quantiles of the gamma distribution, by a table: there is none in NumPy, and draws must be functions of uniforms."""

import math
from functools import lru_cache

import numpy as np

from vcmvsp.netsim.interfaces.layers import Floats

_NODES = 8192
_TAIL = -math.log(1e-18)  # the table ends where either tail holds less than this: uniforms end at 2**-53


def gamma_quantile(shape: float, logit: Floats) -> Floats:
    """Quantiles of the gamma distribution with mean 1 and variance 1 / shape, of any array of probabilities.

    The probabilities p are given as ``log(p / (1 - p))``, which is exact in both tails. For shapes from 0.1 to 1000 the
    relative error is below 4e-4 (0.002 dB) down to tails of 1e-16, and below 2e-5 between 5 and 95 % for shapes from 0.5.
    """
    nodes, logarithms = _table(shape)
    quantiles: Floats = np.exp(np.interp(logit, nodes, logarithms))
    return quantiles


@lru_cache(maxsize=32)
def _table(shape: float) -> tuple[Floats, Floats]:
    """Logits of the probabilities, increasing, and logarithms of their quantiles.

    The density of t = log(x), ``exp(shape (t - e^t)) shape^shape / Gamma(shape)``, is integrated by Gauss's rule with three
    points in each interval: from below for the probability, from above for its complement.
    """
    # Below: P(t) <= (shape e^t)^shape / Gamma(shape + 1). Above (Chernoff): 1 - P(t) <= exp(shape (1 + t - e^t)).
    lowest = (math.lgamma(shape + 1.0) - _TAIL) / shape - math.log(shape)
    bound = 2.0 * _TAIL / shape
    highest = min(math.sqrt(bound), math.log(2.0 + bound))
    t = np.linspace(lowest, highest, _NODES)
    step = t[1] - t[0]
    middle, offset = 0.5 * (t[1:] + t[:-1]), 0.5 * math.sqrt(0.6) * step
    areas = step / 18.0 * (5.0 * _density(shape, middle - offset) + 8.0 * _density(shape, middle))
    areas += step / 18.0 * 5.0 * _density(shape, middle + offset)
    # What lies below the table: the density is exponential there, P = density / shape.
    below = np.cumsum(np.concatenate([_density(shape, t[:1]) / shape, areas]))
    above = np.cumsum(np.concatenate([[math.exp(-_TAIL)], areas[::-1]]))[::-1]
    inside = (below > 0.0) & (above > 0.0)
    return np.log(below[inside]) - np.log(above[inside]), t[inside]


def _density(shape: float, t: Floats) -> Floats:
    density: Floats = np.exp(shape * (t - np.exp(t) + math.log(shape)) - math.lgamma(shape))
    return density
