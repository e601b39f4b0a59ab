"""Lost frames as evidence: the chance that correlated normal levels all lie below the sensitivity."""

import math

import msgspec
import numpy as np

from vcmvsp.netsim.interfaces.layers import Floats

_TOLERANCE = 1e-7  # of the log probability, between two sweeps
_SWEEPS = 300
_FAINT = 1e-10  # least precision of a site, in units of the prior's


class Censored(msgspec.Struct, frozen=True):
    """What being below the bound says of m values.

    ``level`` and ``variance`` are the sites: the m measurements with noise that say the same about the values as being below
    the bound does. Whoever takes them for measurements has the gradient of ``log_probability`` (Seeger 2005).
    """

    log_probability: float
    level: Floats  # (m,)
    variance: Floats  # (m,)


def below(mean: Floats, covariance: Floats, bound: float) -> Censored:
    """Log probability that all values of a normal vector are less than ``bound``.

    Expectation propagation (T. Minka, UAI 2001; for the form in cavities C. Rasmussen and C. Williams, Gaussian Processes for
    Machine Learning, 2006, section 3.6; for boxes J. Cunningham, P. Hennig, S. Lacoste-Julien, arXiv:1111.6832): each
    one-sided bound is replaced by the normal factor that leaves mean and variance of its value right, given the other
    factors. Exact for independent values. All factors are renewed at once; a step that would leave a factor without a proper
    remainder is halved, and steps that go to and fro are shortened.

    Args:
        mean: (m,).
        covariance: (m, m), positive definite.
        bound: the same for all.
    """
    from scipy.linalg import solve_triangular

    mean = mean - bound  # counted from there, no digits are lost
    count, prior = len(mean), np.diagonal(covariance)
    precision, shift = np.zeros(count), np.zeros(count)  # of the sites; shift = precision x level
    toward_precision, toward_shift, step, last = np.zeros(count), np.zeros(count), 1.0, -math.inf
    most, change = 1.0, 0.0
    for _ in range(_SWEEPS):
        new_precision, new_shift = precision + step * toward_precision, shift + step * toward_shift
        root = np.sqrt(new_precision)
        factor = np.linalg.cholesky(np.eye(count) + root[:, None] * covariance * root)
        half = solve_triangular(factor, root[:, None] * covariance, lower=True)
        variance = prior - (half * half).sum(axis=0)
        if (variance <= 0.0).any() or (variance * new_precision >= 1.0 - 1e-9).any():
            step *= 0.5
            continue
        precision, shift, step = new_precision, new_shift, min(most, 1.5 * step)

        unscaled = mean + covariance @ shift
        posterior = unscaled - half.T @ solve_triangular(factor, root * unscaled, lower=True)
        cavity_variance = 1.0 / (1.0 / variance - precision)
        cavity = cavity_variance * (posterior / variance - shift)
        log_mass, tilted, tilted_variance = _truncated(cavity, cavity_variance)

        local = log_mass + _log_partition(cavity, cavity_variance) - _log_partition(posterior, variance)
        joint = 0.5 * ((shift - precision * posterior) @ mean + posterior @ shift) - np.log(np.diagonal(factor)).sum()
        total = float(local.sum() + joint)
        if total - last < 0.0 < change:  # to and fro
            most *= 0.7
        change, last = total - last, total
        if abs(change) < _TOLERANCE:
            break
        toward_precision = np.maximum(1.0 / tilted_variance - 1.0 / cavity_variance, _FAINT / prior) - precision
        toward_shift = tilted / tilted_variance - cavity / cavity_variance - shift
    precision = np.maximum(precision, _FAINT / prior)
    return Censored(last, bound + shift / precision, 1.0 / precision)


def _log_partition(mean: Floats, variance: Floats) -> Floats:
    """Of a normal density in natural parameters, without constants."""
    partition: Floats = 0.5 * mean * mean / variance + 0.5 * np.log(variance)
    return partition


def _truncated(mean: Floats, variance: Floats) -> tuple[Floats, Floats, Floats]:
    """Log mass below 0, mean and variance of normal values there, each (m,)."""
    from scipy.special import erfcx, log_ndtr

    sigma = np.sqrt(variance)
    h = -mean / sigma
    ratio = math.sqrt(2.0 / math.pi) / erfcx(-h / math.sqrt(2.0))  # density / mass at h (inverse Mills ratio)
    far = h < -50.0  # where the difference would lose its digits
    left = np.where(far, 1.0 / np.where(far, h, 1.0) ** 2, 1.0 - ratio * (ratio + h))
    log_mass: Floats = log_ndtr(h)
    return log_mass, mean - sigma * ratio, np.maximum(variance * left, 1e-12 * variance)
