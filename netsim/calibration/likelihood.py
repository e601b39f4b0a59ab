"""Likelihood of measured levels, and its maximisation.

Rows are correlated and have one joint likelihood: the normal density of the received rows times the probability, given these,
that the lost rows are below the sensitivity (J. Tobin, Econometrica 26, 1958; for correlated rows: `below`). Pairwise composite
likelihood would avoid the n^3 operations, but wastes information, and its standard errors need independent replicates of the
whole field, which surveys do not have.

The covariance is fitted by restricted likelihood (H. Patterson, R. Thompson, Biometrika 58, 1971), which integrates out the
coefficients beta of the mean: plain maximum likelihood would underestimate sigma.

The level of row i, between points a and b at distance r, is::

    y_i = X_i beta + S_i + e_i,   S ~ N(0, sigma^2 R),   e_i ~ N(0, tau^2), independent

    R_ij = (exp(-(|a a'| + |b b'|) / d) + exp(-(|a b'| + |b a'|) / d)) / sqrt((1 + exp(-2 r / d)) (1 + exp(-2 r' / d)))

R is the correlation of `netsim.propagation.shadowing.Shadowing`, equal in both directions; e is fading and measurement error.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import msgspec
import numpy as np

from vcmvsp.netsim.interfaces.layers import Bools, Floats, Ints

# Weak prior of the fading's share of the variance: a normal logit, median 0.12, 95 % within 0.003 and 0.87. Without it, short
# surveys often have their maximum at zero fading, where the curvature does not show the uncertainty.
_LOGIT, _LOGIT_SIGMA = -2.0, 2.0
_STEP = 1e-3  # of finite differences in the parameters, which are logarithms
_TOLD = 1e-2  # least curvature of a determined parameter: a standard error of a factor e^10

_TOLERANCE = 1e-7  # of the log probability of lost rows, between two sweeps
_SWEEPS = 300
_FAINT = 1e-10  # least precision of a site, in units of the prior's


@dataclass(frozen=True)
class Survey:
    """Arrays of n measured rows for the likelihood."""

    level_dbm: Floats  # (n,); any value where lost
    lost: Bools  # (n,)
    sensitivity_dbm: Floats  # (n,) below which the row is lost
    design: Floats  # X, (n, p)
    distance_m: Floats  # r, (n,)
    straight_m: Floats  # |a a'| + |b b'|, (n, n)
    swapped_m: Floats  # |a b'| + |b a'|, (n, n)

    @classmethod
    def between(
        cls, a: Floats, b: Floats, *, level_dbm: Floats, lost: Bools, sensitivity_dbm: float | Floats, design: Floats
    ) -> Self:
        """Rows between the points a and b, (n, 3) m each; one sensitivity for all, or one for each."""
        sensitivity_dbm = np.broadcast_to(sensitivity_dbm, lost.shape)
        distance_m = np.sqrt(((a - b) ** 2).sum(axis=1))
        return cls(level_dbm, lost, sensitivity_dbm, design, distance_m, *_moves_m(a, b))

    def only(self, rows: Ints) -> Self:
        """The rows with these numbers, (m,)."""
        columns: Any = self.level_dbm, self.lost, self.sensitivity_dbm, self.design, self.distance_m
        level_dbm, lost, sensitivity_dbm, design, distance_m = (each[rows] for each in columns)
        pairs = self.straight_m[np.ix_(rows, rows)], self.swapped_m[np.ix_(rows, rows)]
        return type(self)(level_dbm, lost, sensitivity_dbm, design, distance_m, *pairs)

    @property
    def moved_m(self) -> Floats:
        """Sum of both ends' displacements between two rows, in the orientation that makes it shorter, (n, n) m."""
        return np.minimum(self.straight_m, self.swapped_m)

    @property
    def nearest_m(self) -> Floats:
        """`moved_m` from each row to its nearest other row, (n,) m."""
        return (self.moved_m + np.diag(np.full(len(self.lost), math.inf))).min(axis=1)

    @property
    def limits(self) -> list[tuple[float, float]]:
        """Bounds of the three parameters within which the rows are informative."""
        moved = self.moved_m
        nearest = moved[moved > 1e-9].min(initial=math.inf)
        least = nearest / 3.0 if math.isfinite(nearest) else 1.0  # rows with a correlation of 0.05 are as good as independent
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
    """Logarithms of sigma and tau (without fading: of one spread), (s,), and their derivatives, (s, k)."""
    if len(parameters) < WITH_FADING:
        return 0.5 * parameters[:1], 0.5 * np.eye(1, len(parameters))
    share = 1.0 / (1.0 + math.exp(-parameters[2]))
    logs = 0.5 * (parameters[0] + np.log([1.0 - share, share]))
    return logs, np.array([(0.5, 0.0, -0.5 * share), (0.5, 0.0, 0.5 * (1.0 - share))])


def moved_m(a: Floats, b: Floats) -> Floats:
    """Sum of both ends' displacements between two of n rows, in the orientation that makes it shorter, (n, n) m."""
    return np.minimum(*_moves_m(a, b))


def _moves_m(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Displacements in both orientations: |a a'| + |b b'| and, with one row's ends swapped, |a b'| + |b a'|, (n, n) each."""
    cross = _apart(a, b)
    return _apart(a, a) + _apart(b, b), cross + cross.T


def _apart(a: Floats, b: Floats) -> Floats:
    squared = np.zeros((len(a), len(b)))
    for axis in range(3):
        squared += (a[:, axis, None] - b[:, axis]) ** 2
    return np.sqrt(squared, out=squared)


class LikelihoodPoint(NamedTuple):
    """Restricted likelihood at given parameters, and the resulting estimate of the mean."""

    log_likelihood: float
    gradient: Floats  # (k,) by the parameters
    coefficients: Floats  # beta, (p,)
    spread: Floats  # covariance of beta at these parameters, (p, p)


class FittedModel(NamedTuple):
    """Maximum-likelihood estimate; a parameter that the rows do not determine has infinite variance."""

    parameters: Floats  # (k,)
    parameters_spread: Floats  # covariance, (k, k): inverse of the observed information
    coefficients: Floats  # beta, (p,)
    coefficients_spread: Floats  # covariance, (p, p), uncertainty of the parameters included
    freedom: Floats  # degrees of freedom of each coefficient's standard error, (p,)
    log_likelihood: float  # unrestricted, at this point: comparable between models of the mean

    @property
    def aic(self) -> float:
        """Akaike's information criterion."""
        return aic_of(len(self.parameters) + len(self.coefficients), self.log_likelihood)


def aic_of(numbers: int, log_likelihood: float) -> float:
    """Akaike's information criterion of a model with ``numbers`` fitted parameters (H. Akaike, 1974): lower is better."""
    return 2.0 * (numbers - log_likelihood)


def maximise(survey: Survey, start: Floats) -> FittedModel:
    """Maximise the restricted likelihood from ``start``, (k,); the number of parameters selects the model."""
    best = climb(survey, start)
    limits = np.array(survey.limits[: len(best)])
    inside = (best > limits[:, 0] + 1e-3) & (best < limits[:, 1] - 1e-3)
    information = np.zeros((len(best), len(best)))
    drift, swing = np.zeros((2, len(best), survey.design.shape[1]))
    for k in range(len(best)):
        step = _STEP * np.eye(len(best))[k]
        above, beneath = restricted(survey, best + step), restricted(survey, best - step)
        information[k] = (beneath.gradient - above.gradient) / (2.0 * _STEP)
        drift[k] = (above.coefficients - beneath.coefficients) / (2.0 * _STEP)
        swing[k] = np.diagonal(above.spread - beneath.spread) / (2.0 * _STEP)
    usable = inside & (np.diagonal(information) > _TOLD)
    spread = np.diag(np.full(len(best), math.inf))
    curvature, axes = np.linalg.eigh(0.5 * (information + information.T)[np.ix_(usable, usable)])
    spread[np.ix_(usable, usable)] = axes / np.maximum(curvature, _TOLD) @ axes.T

    point = restricted(survey, best)
    # R. Kackar, D. Harville, JASA 79, 1984: variance of beta due to estimated parameters.
    carried = drift[usable].T @ spread[np.ix_(usable, usable)] @ drift[usable]
    unsure = np.einsum("kp,kl,lp->p", swing[usable], spread[np.ix_(usable, usable)], swing[usable])  # variance of the variance
    freedom = 2.0 / np.maximum(unsure / np.diagonal(point.spread) ** 2, 2e-9)
    likelihood = log_likelihood(survey, best, point.coefficients)
    return FittedModel(best, spread, point.coefficients, point.spread + carried, freedom, likelihood)


def climb(survey: Survey, start: Floats) -> Floats:
    """Maximum-likelihood parameters, (k,), without standard errors."""
    from scipy.optimize import minimize

    def descent(parameters: Floats) -> tuple[float, Floats]:
        point = restricted(survey, parameters)
        return -point.log_likelihood, -point.gradient

    limits = survey.limits[: len(start)]
    optimum = minimize(descent, start, jac=True, method="L-BFGS-B", bounds=limits, options={"maxiter": 100})
    return optimum.x


def restricted(survey: Survey, parameters: Floats) -> LikelihoodPoint:
    """Restricted likelihood at parameters (k,), with beta integrated out over all values."""
    from scipy.linalg.lapack import dpotri

    total, derivatives = covariance(survey, parameters)
    X, lost = survey.design, survey.lost
    received = _Received(survey, total)
    likelihood = received.log_density - 0.5 * np.linalg.slogdet(received.precision)[1]
    likelihood += 0.5 * X.shape[1] * math.log(2.0 * math.pi)
    level, extra = survey.level_dbm.copy(), np.zeros(len(lost))
    if lost.any():  # conditional on the received rows; then replaced by equivalent measurements
        unknown = X[lost] - received.across.T @ received.design
        spread = received.covariance + unknown @ np.linalg.solve(received.precision, unknown.T)
        sites = below(received.expected, spread, survey.sensitivity_dbm[lost])
        likelihood += sites.log_probability
        level[lost], extra[lost] = sites.level, sites.variance

    lower, _ = dpotri(np.linalg.cholesky(total + np.diag(extra)), lower=1)
    inverse = np.tril(lower) + np.tril(lower, -1).T
    weighted = inverse @ X
    spread_of_beta = np.linalg.inv(X.T @ weighted)
    beta = spread_of_beta @ (weighted.T @ level)
    pull = inverse @ (level - X @ beta)
    slope = np.outer(pull, pull) - inverse + weighted @ spread_of_beta @ weighted.T
    gradient = np.array([0.5 * float(np.vdot(slope, each)) for each in derivatives])
    if len(parameters) == WITH_FADING:
        off = (parameters[2] - _LOGIT) / _LOGIT_SIGMA
        likelihood -= 0.5 * off**2
        gradient[2] -= off / _LOGIT_SIGMA
    return LikelihoodPoint(float(likelihood), gradient, beta, spread_of_beta)


def log_likelihood(survey: Survey, parameters: Floats, coefficients: Floats) -> float:
    """Log likelihood of the rows at parameters (k,) and coefficients of the mean, (p,)."""
    received = _Received(survey, covariance(survey, parameters)[0], coefficients)
    likelihood = received.log_density
    if survey.lost.any():
        likelihood += below(received.expected, received.covariance, survey.sensitivity_dbm[survey.lost]).log_probability
    return likelihood


class _Received:
    """Received rows, whitened to unit variance, and the conditional distribution of the lost rows."""

    def __init__(self, survey: Survey, total: Floats, coefficients: Floats | None = None) -> None:
        from scipy.linalg import solve_triangular

        received, lost, X = ~survey.lost, survey.lost, survey.design
        factor = np.linalg.cholesky(total[np.ix_(received, received)])
        self.design: Floats = solve_triangular(factor, X[received], lower=True)
        self.precision: Floats = self.design.T @ self.design  # of beta
        level: Floats = solve_triangular(factor, survey.level_dbm[received], lower=True)
        fitted = np.linalg.solve(self.precision, self.design.T @ level)  # generalised least squares
        beta = fitted if coefficients is None else coefficients
        residual = level - self.design @ beta
        self.log_density = float(
            -np.log(np.diagonal(factor)).sum() - 0.5 * residual @ residual - 0.5 * len(level) * math.log(2.0 * math.pi)
        )
        self.across: Floats = solve_triangular(factor, total[np.ix_(received, lost)], lower=True)
        self.expected: Floats = X[lost] @ beta + self.across.T @ residual  # of the lost rows
        self.covariance: Floats = total[np.ix_(lost, lost)] - self.across.T @ self.across  # their covariance


class Censored(msgspec.Struct, frozen=True):
    """Information in the observation that m values are below a bound.

    ``level`` and ``variance`` are the sites: m noisy measurements that are equivalent to the observation. The gradient of
    ``log_probability`` is that of these measurements (Seeger 2005).
    """

    log_probability: float
    level: Floats  # (m,)
    variance: Floats  # (m,)


def below(mean: Floats, covariance: Floats, bound: float | Floats) -> Censored:
    """Log probability that all values of a normal vector are less than ``bound``.

    Expectation propagation (T. Minka, UAI 2001; for the form in cavities C. Rasmussen and C. Williams, Gaussian Processes for
    Machine Learning, 2006, section 3.6; for boxes J. Cunningham, P. Hennig, S. Lacoste-Julien, arXiv:1111.6832): each
    one-sided bound is replaced by the normal factor that gives its value the right mean and variance, given the other
    factors. Exact for independent values. All factors are updated at once; a step that would leave an improper cavity is
    halved, and oscillating steps are shortened.

    Args:
        mean: (m,).
        covariance: (m, m), positive definite.
        bound: common to all values, or (m,).
    """
    from scipy.linalg import solve_triangular

    mean = mean - bound  # relative to the bound: no cancellation
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
        if total - last < 0.0 < change:  # oscillation
            most *= 0.7
        change, last = total - last, total
        if abs(change) < _TOLERANCE:
            break
        toward_precision = np.maximum(1.0 / tilted_variance - 1.0 / cavity_variance, _FAINT / prior) - precision
        toward_shift = tilted / tilted_variance - cavity / cavity_variance - shift
    precision = np.maximum(precision, _FAINT / prior)
    return Censored(last, bound + shift / precision, 1.0 / precision)


def _log_partition(mean: Floats, variance: Floats) -> Floats:
    """Log partition function of a normal density in natural parameters, without constants."""
    return 0.5 * mean * mean / variance + 0.5 * np.log(variance)


def _truncated(mean: Floats, variance: Floats) -> tuple[Floats, Floats, Floats]:
    """Log probability that normal values are below 0, and their mean and variance there, (m,) each."""
    from scipy.special import erfcx, log_ndtr

    sigma = np.sqrt(variance)
    h = -mean / sigma
    ratio = math.sqrt(2.0 / math.pi) / erfcx(-h / math.sqrt(2.0))  # density / mass at h (inverse Mills ratio)
    far = h < -50.0  # cancellation
    share = np.where(far, 1.0 / np.where(far, h, 1.0) ** 2, 1.0 - ratio * (ratio + h))
    log_mass: Floats = log_ndtr(h)
    return log_mass, mean - sigma * ratio, np.maximum(variance * share, 1e-12 * variance)


_NUGGET = 1e-6  # least independent share of the variance: rows at one place stay consistent
_SHARE = 7.0  # greatest |logit| of the independent share

# Models, by the number of parameters: log(sigma^2 + tau^2), then log d, then logit(tau^2 / (sigma^2 + tau^2)).
INDEPENDENT, CORRELATED, WITH_FADING = 1, 2, 3
