import math

import numpy as np
import pytest

from tests.support.netsim.channels import make_frame
from tests.support.netsim.links import even_uniforms
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.testing import check_channel
from vcmvsp.netsim.impairments.random_delay import EmpiricalDelay, GammaDelay, NormalDelay, UniformDelay
from vcmvsp.netsim.interfaces.layers import Delay, Floats

EVEN = even_uniforms(200_000)
MEASURED = EmpiricalDelay(((0.0, 0.002), (0.5, 0.004), (0.99, 0.03), (1.0, 0.2)))


def seconds(layer: Delay) -> Floats:
    delay = layer.delay_ns(make_frame(len(EVEN)), lambda: EVEN)
    assert delay.dtype == np.int64
    return np.asarray(delay * 1e-9, np.float64)


def test_uniform() -> None:
    delay = seconds(UniformDelay(0.01, 0.05))
    assert np.percentile(delay, [0, 25, 50, 100]) == pytest.approx([0.01, 0.02, 0.03, 0.05], abs=1e-6)
    assert delay.std() == pytest.approx(0.04 / math.sqrt(12), rel=1e-4)


def test_normal() -> None:
    delay = seconds(NormalDelay(0.1, 0.01))
    assert np.percentile(delay, [2.275, 15.866, 50, 84.134, 97.725]) == pytest.approx([0.08, 0.09, 0.1, 0.11, 0.12], abs=2e-4)
    assert (delay.mean(), delay.std()) == pytest.approx((0.1, 0.01), rel=5e-3)
    assert seconds(NormalDelay(0.0, 0.01)).min() == 0.0


@pytest.mark.parametrize(("mean_s", "sigma_s"), [(0.02, 0.02), (0.02, 0.005), (0.02, 0.04), (0.02, 0.001)])
def test_gamma(mean_s: float, sigma_s: float) -> None:
    delay = seconds(GammaDelay(mean_s, sigma_s, fixed_s=0.003)) - 0.003
    assert delay.min() >= 0.0
    assert (delay.mean(), delay.std()) == pytest.approx((mean_s, sigma_s), rel=2e-3)
    if mean_s == sigma_s:  # exponential
        assert np.percentile(delay, [10, 50, 99]) == pytest.approx(-mean_s * np.log([0.9, 0.5, 0.01]), rel=1e-3)


def test_as_measured() -> None:
    delay = seconds(MEASURED)
    assert np.percentile(delay, [25, 50, 74.5, 99, 99.5]) == pytest.approx([0.003, 0.004, 0.017, 0.03, 0.115], rel=1e-3)
    assert delay.min() >= 0.002
    assert delay.max() <= 0.2


@pytest.mark.parametrize("layer", [UniformDelay(0.0, 0.1), NormalDelay(0.01, 0.01), GammaDelay(0.01, 0.01), MEASURED])
def test_the_laws_of_every_delay(layer: Delay) -> None:
    check_channel(layer)
    edges = np.array([(0.0, 0.0), (1.0 - 2.0**-53, 0.0), (0.0, 1.0 - 2.0**-53)])
    assert (layer.delay_ns(make_frame(3), lambda: edges) >= 0).all()


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(ScenarioError, match=r"to_s.*not be less than from_s"):
        UniformDelay(0.2, 0.1)
    for mean_s, sigma_s in ((0.1, 0.0), (0.0, 0.0), (0.0, 0.1), (0.1, 10.0)):
        with pytest.raises(ScenarioError, match=r"sigma_s.*between"):
            GammaDelay(mean_s, sigma_s)
    falling = ((0.0, 0.2), (1.0, 0.1))
    for quantiles in ((), ((0.0, 0.1),), ((0.1, 0.1), (1.0, 0.2)), falling, ((0.0, 0.1), (0.0, 0.2), (1.0, 0.3))):
        with pytest.raises(ScenarioError, match=r"quantiles.*rise from probability 0"):
            EmpiricalDelay(quantiles)
