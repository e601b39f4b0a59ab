"""Fading: distributions of the gain against closed forms and ns-3, and correlation in time."""

import math
from typing import Any

import numpy as np
import pytest

from tests.support.netsim.channels import even_uniforms, linked_frame, many_frame, many_keys
from vcmvsp.netsim.interfaces.layers import Fading, Floats
from vcmvsp.netsim.propagation.fading import Nakagami, Rayleigh, Rician, gamma_quantile, scattering

pytestmark = pytest.mark.slow

PERCENT = (1, 5, 10, 25, 50, 75, 90, 95, 99)

# ns-3.44, NakagamiPropagationLossModel with m0 = m: quantiles in dB at PERCENT of 4e6 values of CalcRxPower(0 dBm), 10 m
# apart. Their own standard error at 1 % is 0.022 / m dB, and less elsewhere.
NS3_NAKAGAMI_DB = {
    0.5: (-38.0687, -24.0382, -17.9964, -9.9331, -3.4222, 1.2142, 4.3241, 5.8433, 8.2139),
    0.75: (-25.9303, -16.5336, -12.4658, -6.8958, -2.1799, 1.3905, 3.9266, 5.2100, 7.2690),
    1.0: (-19.9894, -12.9111, -9.7832, -5.4153, -1.5904, 1.4194, 3.6226, 4.7625, 6.6300),
    1.5: (-14.1451, -9.2989, -7.1060, -3.9335, -1.0308, 1.3653, 3.1886, 4.1602, 5.7793),
    3.0: (-8.3829, -5.6459, -4.3492, -2.3945, -0.4982, 1.1634, 2.4920, 3.2194, 4.4762),
    10.0: (-3.8399, -2.6551, -2.0597, -1.1198, -0.1459, 0.7602, 1.5240, 1.9603, 2.7403),
}

# Quantiles of g = X / (2 (K + 1)) in dB, X noncentral chi squared, 2 degrees of freedom, noncentrality 2 K (SciPy's ncx2)
RICIAN_DB = {
    1.0: (-18.6671, -11.6712, -8.6426, -4.5437, -1.1159, 1.4891, 3.3623, 4.3289, 5.9087),
    4.0: (-11.5108, -6.8365, -5.0077, -2.5679, -0.4474, 1.2706, 2.5781, 3.2779, 4.4582),
    10.0: (-6.1836, -3.9823, -2.9978, -1.5625, -0.2003, 0.9797, 1.9215, 2.4404, 3.3381),
}

EVEN = even_uniforms(400_000)


def gains_db(layer: Fading, uniforms: Floats = EVEN) -> Floats:
    return layer.gain_db(many_frame(len(uniforms)), lambda: uniforms)


def ratio(decibels: Floats) -> Floats:
    return 10.0 ** (decibels / 10.0)


def bessel_j0(x: float) -> float:
    """Bessel's integral: the mean of cos(x sin theta), of a periodic function, by the rectangle rule."""
    theta = (np.arange(400) + 0.5) * math.pi / 400
    return float(np.cos(x * np.sin(theta)).mean())


@pytest.mark.parametrize("m", NS3_NAKAGAMI_DB)
def test_nakagami_quantiles_equal_ns3(m: float) -> None:
    assert np.percentile(gains_db(Nakagami(m)), PERCENT) == pytest.approx(NS3_NAKAGAMI_DB[m], abs=0.1 if m < 1 else 0.05)


@pytest.mark.parametrize("m", [0.3, 0.5, 0.75, 1.0, 1.5, 3.0, 10.0, 100.0])
def test_nakagami_mean_and_variance(m: float) -> None:
    gain = ratio(gains_db(Nakagami(m)))
    assert gain.mean() == pytest.approx(1.0, abs=1e-4)
    assert gain.var() == pytest.approx(1.0 / m, rel=2e-3)


def test_gamma_quantiles_in_closed_form() -> None:
    """Shape 1 is exponential, shape 1/2 a squared normal number, shape 2 has P = 1 - (1 + 2x) exp(-2x)."""
    p = np.array([1e-16, 1e-9, 0.001, 0.05, 0.5, 0.95, 0.999])
    logit = np.log(p) - np.log1p(-p)
    assert gamma_quantile(1.0, logit) == pytest.approx(-np.log1p(-p), rel=1e-5)
    x = gamma_quantile(2.0, logit)
    series = 2.0 * x**2 * (1.0 - 4.0 * x / 3.0)  # where the closed form loses its digits
    assert np.where(x < 1e-4, series, 1.0 - (1.0 + 2.0 * x) * np.exp(-2.0 * x)) == pytest.approx(p, rel=1e-4)
    assert [math.erf(math.sqrt(g / 2.0)) for g in gamma_quantile(0.5, logit)] == pytest.approx(p, rel=1e-4)
    assert gamma_quantile(1.0, -logit)[:2] == pytest.approx(-np.log(p[:2]), rel=4e-4)


def test_rayleigh_is_exponential_and_a_special_case_of_both_others() -> None:
    exact = 10.0 * np.log10(-np.log1p(-np.array(PERCENT) / 100.0))
    for layer in (Rayleigh(), Nakagami(1.0), Rician(0.0)):
        assert np.percentile(gains_db(layer), PERCENT) == pytest.approx(exact, abs=1e-3)


@pytest.mark.parametrize("k_factor", RICIAN_DB)
def test_rician_quantiles_mean_and_variance(k_factor: float) -> None:
    decibels = gains_db(Rician(k_factor))
    assert np.percentile(decibels, PERCENT) == pytest.approx(RICIAN_DB[k_factor], abs=0.06)
    gain = ratio(decibels)
    assert gain.mean() == pytest.approx(1.0, abs=2e-3)
    assert gain.var() == pytest.approx((2.0 * k_factor + 1.0) / (k_factor + 1.0) ** 2, rel=0.02)  # 1 / m


@pytest.mark.parametrize("layer", [Rayleigh(), Nakagami(0.1), Nakagami(1000.0), Rician(0.0), Rician(1000.0)])
def test_finite_for_the_least_and_the_greatest_draw(layer: Fading) -> None:
    most = 1.0 - 2.0**-53
    edges = np.array([(0.0, 0.0), (0.0, most), (most, 0.0), (most, most), (most, 0.5)])
    assert np.isfinite(gains_db(layer, edges)).all()


# --- in time ----------------------------------------------------------------------------------------------------------------

DOPPLER_HZ = 8.0
LAGS_S = (0.005, 0.01, 0.02, 0.03, 0.048, 0.08, 0.12)  # J0^2 is 0.97, 0.88, 0.57, 0.23, 0.00, 0.16, 0.00


def process(layer: Fading, times_s: Any, links: int) -> Floats:
    """Gains of many links at many times, (times, links)."""

    def never() -> Floats:
        raise AssertionError

    return ratio(np.array([layer.gain_db(many_frame(links, round(t * 1e9)), never) for t in times_s]))


@pytest.mark.parametrize(
    ("layer", "direct"),
    [
        (Rayleigh(DOPPLER_HZ), 0.0),
        (Nakagami(1.0, DOPPLER_HZ), 0.0),
        (Nakagami(3.0, DOPPLER_HZ), 0.0),
        (Rician(4.0, DOPPLER_HZ), 4.0),
    ],
)
def test_autocorrelation_of_the_power(layer: Fading, direct: float) -> None:
    """J0(2 pi fd tau)^2; with a constant direct path K (2 K J0 + J0^2) / (2 K + 1)."""
    times = np.random.default_rng(2).uniform(0.0, 3600.0, 60)
    now = process(layer, times, 500)
    for lag in LAGS_S:
        later = process(layer, times + lag, 500)
        covariance = ((now - now.mean()) * (later - later.mean())).mean() / (now.std() * later.std())
        j0 = bessel_j0(2.0 * math.pi * DOPPLER_HZ * lag)
        assert covariance == pytest.approx((2.0 * direct * j0 + j0**2) / (2.0 * direct + 1.0), abs=0.05)


@pytest.mark.parametrize("m", [0.5, 1.0, 3.0])
def test_the_process_has_the_distribution_of_the_draws(m: float) -> None:
    gain = process(Nakagami(m, DOPPLER_HZ), np.random.default_rng(4).uniform(0.0, 3600.0, 300), 1000)
    assert gain.mean() == pytest.approx(1.0, abs=0.01)
    assert gain.var() == pytest.approx(1.0 / m, rel=0.025)
    exact = np.array(NS3_NAKAGAMI_DB[m])
    assert np.percentile(10.0 * np.log10(gain), PERCENT) == pytest.approx(exact, abs=0.3 if m < 1 else 0.15)


def test_the_amplitude_has_the_autocorrelation_j0_and_links_are_independent() -> None:
    keys, times = many_keys(4000), np.arange(0.0, 30.0, 3.0)
    now = np.array([scattering(keys, round(t * 1e9), DOPPLER_HZ) for t in times])
    for lag in LAGS_S:
        later = np.array([scattering(keys, round((t + lag) * 1e9), DOPPLER_HZ) for t in times])
        mean = (now.conj() * later).mean()
        assert abs(mean - bessel_j0(2.0 * math.pi * DOPPLER_HZ * lag)) < 0.03
    assert abs((now[:, 1:].conj() * now[:, :-1]).mean()) < 0.03
    assert abs(now.mean()) < 0.03


@pytest.mark.parametrize("layer", [Rayleigh(DOPPLER_HZ), Nakagami(1.5, DOPPLER_HZ), Rician(4.0, DOPPLER_HZ)])
def test_the_process_is_a_function_of_pair_and_time(layer: Fading) -> None:
    def at(sender: str, *receivers: str, seed: int = 1) -> Floats:
        return layer.gain_db(linked_frame(sender, *receivers, at_s=12.345, seed=seed), lambda: np.zeros((1, 2)))

    together = at("car1", "car2", "car3", "car4")
    assert together.tolist() == [at("car1", name).item() for name in ("car2", "car3", "car4")]
    assert together[::-1].tolist() == at("car1", "car4", "car3", "car2").tolist()
    assert at("car2", "car1").item() == together[0]
    assert len({*together.tolist(), *at("car1", "car2", seed=2).tolist()}) == 4
