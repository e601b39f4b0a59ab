"""Delays: exact where they are fixed, and distributed as they say."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.netsim.channels import make_channel, make_frame, send
from tests.support.netsim.links import even_uniforms
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.testing import check_channel
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.impairments.delay import EmpiricalDelay, FixedDelay, GammaDelay, NoDelay, NormalDelay, UniformDelay
from vcmvsp.netsim.impairments.loss import NoLoss
from vcmvsp.netsim.interfaces.layers import Delay, Floats
from vcmvsp.netsim.phy.dsss import Dsss
from vcmvsp.netsim.propagation.path_loss import NoPathLoss


def test_a_frame_without_delay_arrives_when_it_ends() -> None:
    report = send(make_channel("wifi-b-1", delay={"kind": "none"}), 10.0, 20.0, sent_ns=5, size_bytes=100)
    assert report.received_ns.tolist() == [5 + 1_280_000] * 2


@pytest.mark.parametrize("seconds", [0.1, 0.25, 0.3, 1.0, 2.0, 0.0013])
def test_fixed_delay_is_exact_and_contains_the_air_time(seconds: float) -> None:
    channel = make_channel("wifi-b-1", delay={"seconds": seconds})
    for k in range(5):
        sent_ns = k * 3_000_000_000
        expected = sent_ns + round(seconds * 1e9)
        assert send(channel, 10.0, sent_ns=sent_ns).received_ns.tolist() == [expected]


def test_no_frame_arrives_before_its_end() -> None:
    report = send(make_channel("wifi-b-1", delay={"seconds": 0.001}), 10.0, size_bytes=100)
    assert report.received_ns.tolist() == [1_280_000]


def test_jitter_is_uniform() -> None:
    """Mean, spread (width / sqrt 12) and Kolmogorov-Smirnov distance (1.95 / sqrt n: 1 in 1000) of 1e5 delays."""
    uniforms = np.random.default_rng(11).random((100_000, 1, 2))
    delay = FixedDelay(0.1, 0.02).delay_ns(make_frame(100_000, 1), lambda: uniforms)[:, 0]
    assert delay.dtype == np.int64
    assert 80_000_000 <= delay.min() < 80_002_000
    assert 119_998_000 < delay.max() <= 120_000_000
    sigma = 0.04e9 / np.sqrt(12)
    assert abs(delay.mean() - 0.1e9) < 4.5 * sigma / np.sqrt(delay.size)
    assert delay.std() == pytest.approx(sigma, rel=0.01)
    cumulative = (np.sort(delay) - 0.08e9) / 0.04e9
    assert np.abs(cumulative - np.arange(delay.size) / delay.size).max() < 1.95 / np.sqrt(delay.size)


def test_jitter_differs_between_receivers_and_frames() -> None:
    channel = make_channel("wifi-b-1", delay={"seconds": 0.1, "jitter_s": 0.02})
    delays = [send(channel, 1.0, 2.0, 3.0, sent_ns=k * 10**8).received_ns - k * 10**8 for k in range(50)]
    assert len(np.unique(delays)) == 150
    assert (np.array(delays) >= 80_000_000).all()
    assert (np.array(delays) <= 120_000_000).all()


@given(
    seconds=st.floats(0.0, 3.0),
    jitter_s=st.floats(0.0, 3.0),
    sends=st.lists(st.tuples(st.integers(0, 10**9), st.integers(0, 1500)), min_size=1, max_size=20),
)
def test_reception_is_later_than_sending_by_the_air_time_at_least(
    seconds: float, jitter_s: float, sends: list[tuple[int, int]]
) -> None:
    channel = Channel(path_loss=NoPathLoss(), phy=Dsss(), loss=NoLoss(), delay=FixedDelay(seconds, jitter_s))
    now, free, latest = 0, 0, round((seconds + jitter_s) * 1e9) + 1
    for gap, size in sends:
        now += gap
        free = max(now, free) + Dsss().air_time_ns(size)
        for received in send(channel, 1.0, 1.0, sent_ns=now, size_bytes=size).received_ns.tolist():
            assert now < free <= received <= max(free, now + latest)


def test_null_delay_asks_for_nothing() -> None:
    def never() -> np.ndarray:
        raise AssertionError

    assert NoDelay().delay_ns(make_frame(3), never).tolist() == [0, 0, 0]
    assert FixedDelay(0.1).delay_ns(make_frame(3), never).tolist() == [100_000_000] * 3


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
