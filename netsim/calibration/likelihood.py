"""How likely measured levels are, and the parameters that make them most likely.

Rows are not taken as independent. All of them have one joint likelihood: of the received ones a normal density, of the lost
ones, given those, the probability of being below the sensitivity (J. Tobin, Econometrica 26, 1958; correlated: `below`).
Pairwise composite likelihood would save the n^3 operations, but it wastes information, and its standard errors need
independent replicates of the whole field, which no survey has.

The covariance is fitted by restricted likelihood (H. Patterson, R. Thompson, Biometrika 58, 1971), where the coefficients beta
of the mean are integrated out: otherwise sigma would be too small by what the mean has taken up.
"""

import math
from typing import NamedTuple

import msgspec
import numpy as np

from vcmvsp.netsim.calibration.covariance import WITH_FADING, Survey, covariance
from vcmvsp.netsim.interfaces.layers import Floats

# The fading's share of the variance is weakly expected at 0.12, within 0.003 and 0.87: its logit is normal with these. Without,
# the likelihood of short surveys often has its top at no fading at all, where nothing says how little is known of it.
_LOGIT, _LOGIT_SIGMA = -2.0, 2.0
_STEP = 1e-3  # of finite differences in the parameters, which are logarithms
_TOLD = 1e-2  # least curvature by which a parameter counts as told: a standard error of a factor e^10

_TOLERANCE = 1e-7  # of the log probability of lost rows, between two sweeps
_SWEEPS = 300
_FAINT = 1e-10  # least precision of a site, in units of the prior's


class LikelihoodPoint(NamedTuple):
    """The restricted likelihood at given parameters, and what follows for the mean."""

    log_likelihood: float
    gradient: Floats  # (k,) by the parameters
    coefficients: Floats  # beta, (p,)
    spread: Floats  # covariance of beta at these parameters, (p, p)


class FittedModel(NamedTuple):
    """The most likely parameters. What the rows do not tell has an infinite variance."""

    parameters: Floats  # (k,)
    parameters_spread: Floats  # covariance, (k, k): inverse of the observed information
    coefficients: Floats  # beta, (p,)
    coefficients_spread: Floats  # covariance, (p, p): with what is not known of the parameters
    freedom: Floats  # degrees of freedom of each coefficient's standard error, (p,)
    log_likelihood: float  # not restricted, at this point: comparable between means

    @property
    def aic(self) -> float:
        """Akaike's information criterion."""
        return aic_of(len(self.parameters) + len(self.coefficients), self.log_likelihood)


def aic_of(numbers: int, log_likelihood: float) -> float:
    """Akaike's information criterion of a model with so many fitted numbers (H. Akaike, 1974): less is better."""
    return 2.0 * (numbers - log_likelihood)


def maximise(survey: Survey, start: Floats) -> FittedModel:
    """The most likely parameters, sought from ``start``, (k,); their number says which model."""
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
    told = inside & (np.diagonal(information) > _TOLD)
    spread = np.diag(np.full(len(best), math.inf))
    curvature, axes = np.linalg.eigh(0.5 * (information + information.T)[np.ix_(told, told)])
    spread[np.ix_(told, told)] = axes / np.maximum(curvature, _TOLD) @ axes.T

    point = restricted(survey, best)
    # R. Kackar, D. Harville, JASA 79, 1984: beta is fitted with parameters that are themselves fitted.
    carried = drift[told].T @ spread[np.ix_(told, told)] @ drift[told]
    unsure = np.einsum("kp,kl,lp->p", swing[told], spread[np.ix_(told, told)], swing[told])  # variance of the variance
    freedom = 2.0 / np.maximum(unsure / np.diagonal(point.spread) ** 2, 2e-9)
    likelihood = log_likelihood(survey, best, point.coefficients)
    return FittedModel(best, spread, point.coefficients, point.spread + carried, freedom, likelihood)


def climb(survey: Survey, start: Floats) -> Floats:
    """The most likely parameters, (k,), alone."""
    from scipy.optimize import minimize

    def descent(parameters: Floats) -> tuple[float, Floats]:
        point = restricted(survey, parameters)
        return -point.log_likelihood, -point.gradient

    limits = survey.limits[: len(start)]
    found = minimize(descent, start, jac=True, method="L-BFGS-B", bounds=limits, options={"maxiter": 100})
    best: Floats = found.x
    return best


def restricted(survey: Survey, parameters: Floats) -> LikelihoodPoint:
    """The restricted likelihood at parameters (k,), with beta integrated out over all values."""
    from scipy.linalg.lapack import dpotri

    total, derivatives = covariance(survey, parameters)
    X, lost = survey.design, survey.lost
    received = _Received(survey, total)
    likelihood = received.log_density - 0.5 * np.linalg.slogdet(received.precision)[1]
    likelihood += 0.5 * X.shape[1] * math.log(2.0 * math.pi)
    level, extra = survey.level_dbm.copy(), np.zeros(len(lost))
    if lost.any():  # given the received rows; then they count as the measurements that say the same
        unknown = X[lost] - received.across.T @ received.design
        spread = received.left + unknown @ np.linalg.solve(received.precision, unknown.T)
        sites = below(received.expected, spread, survey.sensitivity_dbm)
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
    """The likelihood of the rows at parameters (k,), with these coefficients of the mean, (p,)."""
    received = _Received(survey, covariance(survey, parameters)[0], coefficients)
    likelihood = received.log_density
    if survey.lost.any():
        likelihood += below(received.expected, received.left, survey.sensitivity_dbm).log_probability
    return likelihood


class _Received:
    """The received rows, as independent ones of variance 1, and what they say of the lost ones."""

    def __init__(self, survey: Survey, total: Floats, coefficients: Floats | None = None) -> None:
        from scipy.linalg import solve_triangular

        seen, lost, X = ~survey.lost, survey.lost, survey.design
        factor = np.linalg.cholesky(total[np.ix_(seen, seen)])
        self.design: Floats = solve_triangular(factor, X[seen], lower=True)
        self.precision: Floats = self.design.T @ self.design  # of beta
        level: Floats = solve_triangular(factor, survey.level_dbm[seen], lower=True)
        fitted = np.linalg.solve(self.precision, self.design.T @ level)  # generalised least squares
        beta = fitted if coefficients is None else coefficients
        residual = level - self.design @ beta
        self.log_density = float(
            -np.log(np.diagonal(factor)).sum() - 0.5 * residual @ residual - 0.5 * len(level) * math.log(2.0 * math.pi)
        )
        self.across: Floats = solve_triangular(factor, total[np.ix_(seen, lost)], lower=True)
        self.expected: Floats = X[lost] @ beta + self.across.T @ residual  # of the lost rows
        self.left: Floats = total[np.ix_(lost, lost)] - self.across.T @ self.across  # their covariance


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
