"""Likelihood of a survey: closed forms, the gradient, the covariance of the field."""

import math
from collections.abc import Sequence

import numpy as np
import pytest

from tests.support.netsim.measured_links import mean_of, points, shadows
from vcmvsp.netsim.calibration.likelihood import Survey, below, covariance, log_likelihood, restricted
from vcmvsp.netsim.propagation.shadowing import Shadowing


@pytest.mark.parametrize(("correlation", "error"), [(0.0, 1e-12), (0.5, 0.002), (0.9, 0.031), (0.99, 0.085), (-0.4, 0.0005)])
def test_two_values_below_their_mean_are_as_likely_as_the_closed_form_says(correlation: float, error: float) -> None:
    """``1/4 + asin(rho) / (2 pi)`` (W. Sheppard, 1899)."""
    matrix = 9.0 * np.array([[1.0, correlation], [correlation, 1.0]])
    exact = math.log(0.25 + math.asin(correlation) / (2.0 * math.pi))
    assert below(np.full(2, -90.0), matrix, -90.0).log_probability == pytest.approx(exact, abs=error)


def test_independent_values_below_a_bound_are_exact() -> None:
    mean, sigma = np.array([-200.0, -95.0, -90.0, -85.0, 60.0]), np.array([1.0, 3.0, 4.0, 2.0, 1.0])
    z = [(-90.0 - m) / s for m, s in zip(mean, sigma, strict=True)]
    exact = sum(math.log(0.5 * math.erfc(-each / math.sqrt(2.0))) for each in z[:4])
    exact += -0.5 * 150.0**2 - math.log(150.0 * math.sqrt(2.0 * math.pi)) - 1.0 / 150.0**2  # asymptotic, 150 sigma away
    assert below(mean, np.diag(sigma**2), -90.0).log_probability == pytest.approx(exact, rel=1e-8)


@pytest.mark.parametrize("parameters", [(3.0,), (3.0, 2.0), (3.0, 2.5, -1.0)])
def test_gradient_is_that_of_the_likelihood(parameters: Sequence[float]) -> None:
    rng = np.random.default_rng(6)
    a, b = points(rng, 60, 30.0), points(rng, 60, 30.0)
    level = mean_of(a, b) + rng.normal(0.0, 4.0, 60)
    at = np.array(parameters)
    X = np.column_stack([np.ones(60), mean_of(a, b, 0.0, 1.0)])
    survey = Survey.between(a, b, level_dbm=level, lost=level < -78.0, sensitivity_dbm=-78.0, design=X)
    for k, slope in enumerate(restricted(survey, at).gradient.tolist()):
        step = 1e-4 * np.eye(len(at))[k]
        difference = restricted(survey, at + step).log_likelihood - restricted(survey, at - step).log_likelihood
        assert slope == pytest.approx(difference / 2e-4, rel=1e-3, abs=1e-3)


def test_without_losses_the_likelihood_is_the_normal_density() -> None:
    rng = np.random.default_rng(8)
    a, b = points(rng, 30, 30.0), points(rng, 30, 30.0)
    at, X = np.array([3.0, 2.0, -1.0]), np.ones((30, 1))
    survey = Survey.between(a, b, level_dbm=mean_of(a, b), lost=np.zeros(30, bool), sensitivity_dbm=0.0, design=X)
    matrix, deviation = covariance(survey, at)[0], mean_of(a, b) + 80.0
    squares = deviation @ np.linalg.inv(matrix) @ deviation
    exact = -0.5 * (np.linalg.slogdet(matrix)[1] + squares + 30 * math.log(2.0 * math.pi))
    assert log_likelihood(survey, at, np.array([-80.0])) == pytest.approx(exact, rel=1e-9)


def test_covariance_is_that_of_the_shadowing_layer() -> None:
    """Over 1500 worlds, 4 links that share ends or are one link both ways."""
    a = np.array([(0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (8.0, 1.0, 0.0), (40.0, 0.0, 0.0)]) + 1000.0
    b = np.array([(8.0, 0.0, 0.0), (8.0, 0.0, 2.0), (0.0, 0.0, 0.0), (45.0, 0.0, 0.0)]) + 1000.0
    layer = Shadowing(1.0, 10.0, 32)
    worlds = np.array([shadows(a, b, seed, layer) for seed in range(1500)])
    survey = Survey.between(a, b, level_dbm=np.zeros(4), lost=np.zeros(4, bool), sensitivity_dbm=0.0, design=np.ones((4, 1)))
    expected, _ = covariance(survey, np.array([0.0, math.log(10.0)]))
    np.testing.assert_allclose(np.cov(worlds.T), expected, atol=4.0 * math.sqrt(2.0 / 1500))
