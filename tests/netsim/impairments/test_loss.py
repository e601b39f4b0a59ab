"""Independent losses and bursts: closed forms, and results that do not depend on the order of calls."""

import math
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.netsim.channels import linked_frame, make_frame, many_frame, many_keys, plain_channel, send
from vcmvsp.cosim.rng import key64, link_uniform
from vcmvsp.netsim.impairments.delay import FixedDelay
from vcmvsp.netsim.impairments.loss import Bernoulli, Bursts, GilbertElliott, NoLoss
from vcmvsp.netsim.interfaces.layers import DELAY_SLOT, LOSS_SLOT, Bools, Draw, Floats, Frame, LinkDraws, SenderLinks

pytestmark = pytest.mark.slow

FRAMES = np.arange(100_000, dtype=np.uint64)[:, None]
LINKS = np.array([key64(7, f"radio/car1/car{i}") for i in range(2, 10)], np.uint64)


@pytest.fixture(scope="module")
def uniforms() -> np.ndarray:
    """Uniform draws of 1e5 frames on 8 links."""
    return link_uniform(LINKS, FRAMES, LOSS_SLOT)


@pytest.mark.parametrize("p", [0.01, 0.1, 0.5, 0.9, 0.999])
def test_loss_rate_of_every_link(p: float, uniforms: np.ndarray) -> None:
    """Binomial: within 4.5 standard deviations (once in 18 000 repetitions for the 8 links of one p)."""
    lost = Bernoulli(p).lost(make_frame(*uniforms.shape[:2]), lambda: uniforms)
    assert np.abs(lost.mean(axis=0) - p).max() < 4.5 * np.sqrt(p * (1 - p) / len(FRAMES))


def test_probabilities_0_and_1_are_exact(uniforms: np.ndarray) -> None:
    frame = make_frame(*uniforms.shape[:2])
    assert not Bernoulli(0.0).lost(frame, lambda: uniforms).any()
    assert Bernoulli(1.0).lost(frame, lambda: uniforms).all()
    for never in (Bernoulli(0.0), NoLoss()):
        assert not never.lost(make_frame(4), lambda: np.zeros((4, 2))).any()  # the smallest possible draw


def test_links_frames_and_layers_are_independent(uniforms: np.ndarray) -> None:
    """Correlations of independent series of n values have standard deviation 1 / sqrt(n)."""
    bound = 4.5 / np.sqrt(len(FRAMES))
    lost = Bernoulli(0.3).lost(make_frame(*uniforms.shape[:2]), lambda: uniforms).astype(float)
    between_links = np.corrcoef(lost, rowvar=False) - np.eye(len(LINKS))
    assert np.abs(between_links).max() < bound
    for lag in (1, 2, 3):
        assert abs(np.corrcoef(lost[lag:, 0], lost[:-lag, 0])[0, 1]) < bound
    for_delay = link_uniform(LINKS, FRAMES, DELAY_SLOT)
    assert abs(np.corrcoef(uniforms[:, 0, 0], for_delay[:, 0, 0])[0, 1]) < bound
    assert abs(np.corrcoef(uniforms[:, 0, 0], uniforms[:, 0, 1])[0, 1]) < bound


@pytest.mark.parametrize("receivers", [1, 9, 300, 5000])
def test_blocks_change_no_draw(receivers: int) -> None:
    """Any order of frames and slots gives the draws that the generator gives for each frame alone."""
    names = tuple(f"car{i}" for i in range(receivers))
    draws = LinkDraws(SenderLinks(3, "leader", names))
    keys = np.array([key64(3, f"radio/leader/{name}") for name in names], np.uint64)
    for frame in (0, 1, 63, 64, 65, 2, 1_000_003, 64, 0):
        for slot in (DELAY_SLOT, LOSS_SLOT):
            alone = link_uniform(keys, np.array(frame, np.uint64), slot)
            assert np.array_equal(draws.uniform(frame, slot), alone)
            assert alone.shape == (receivers, 2)


def test_losses_by_draws_alone_are_equal_for_many_frames_at_once() -> None:
    """Equal to frame by frame, in any order, for whichever layer has the slot by now."""
    draws = LinkDraws(SenderLinks(3, "leader", ("a", "b", "c")))
    frame = make_frame(3)
    for number in (0, 1, 255, 256, 2):
        for loss in (Bernoulli(0.3), Bernoulli(0.9)):
            alone = loss.lost(frame, partial(draws.uniform, number, LOSS_SLOT))
            assert np.array_equal(draws.compute(number, LOSS_SLOT, loss.lost_by), alone)
        for delay in (FixedDelay(0.05, 0.02), FixedDelay(0.05)):
            late_ns = delay.delay_ns(frame, partial(draws.uniform, number, DELAY_SLOT))
            assert np.array_equal(draws.compute(number, DELAY_SLOT, delay.delay_ns_by), late_ns)


def test_a_derived_loss_overrides_losses_by_draws_alone() -> None:
    class Never(Bernoulli):
        def lost(self, frame: Frame, draw: Draw) -> Bools:
            return np.zeros(frame.rssi_dbm.shape, np.bool_)

    assert send(plain_channel(loss=Bernoulli(1.0)), 1.0).outcome == ("random loss",)
    assert send(plain_channel(loss=Never(1.0)), 1.0).outcome == ("received",)


RATES = [(0.1, 1.0), (2.0, 3.0), (5.0, 0.5)]


def history(layer: GilbertElliott, times_s: Any, links: int) -> Bools:
    keys = many_keys(links)
    return np.array([layer.bad(keys, round(t * 1e9)) for t in times_s])


@pytest.mark.parametrize(("p", "r"), RATES)
def test_stationary_loss(p: float, r: float) -> None:
    """400 links at 50 times far apart: 20000 independent states, and losses in each."""
    layer = GilbertElliott(p, r, bad_loss=0.8, good_loss=0.05)
    times = np.arange(50) * 37.0 / (p + r)
    share = p / (p + r)
    assert history(layer, times, 400).mean() == pytest.approx(share, abs=4.5 * math.sqrt(share * (1 - share) / 2e4))
    rng = np.random.default_rng(1)
    lost = np.mean([layer.lost(many_frame(400, round(t * 1e9)), lambda: rng.random((400, 2))) for t in times])
    loss = share * 0.8 + (1 - share) * 0.05
    assert lost == pytest.approx(loss, abs=4.5 * math.sqrt(loss * (1 - loss) / 2e4))


@pytest.mark.parametrize(("p", "r"), RATES)
def test_bursts_last_as_long_as_they_should(p: float, r: float) -> None:
    """Mean and spread of the exponential sojourns: 1/r bad, 1/p good; sampled at 50 times the fastest rate."""
    step = 0.02 / (p + r)
    states = history(GilbertElliott(p, r), np.arange(60_000) * step, 20)
    for state, rate in ((True, r), (False, p)):
        lengths = []
        for link in (states == state).T:
            changes = np.flatnonzero(np.diff(link.astype(int))) + 1
            runs, first = np.diff(changes), link[changes[0]]
            lengths += (runs[0 if first else 1 :: 2] * step).tolist()
        # Sojourns shorter than a step are missed: visible ones last about one step longer.
        mean, error = np.mean(lengths), 1.0 / rate / math.sqrt(len(lengths))
        assert mean == pytest.approx(1.0 / rate, rel=0.03 + 4.5 * error * rate)
        assert np.std(lengths) == pytest.approx(1.0 / rate, rel=0.08)


@pytest.mark.parametrize(("p", "r"), [RATES[0], RATES[-1]])
def test_autocorrelation(p: float, r: float) -> None:
    """exp(-(p + r) tau), whatever the time between the frames; across the ends of cells too (16 / (p + r) s)."""
    layer, rate = GilbertElliott(p, r), p + r
    times = np.random.default_rng(3).uniform(0.0, 3600.0, 60)
    now = history(layer, times, 800).astype(float)
    spread = now.std()
    for lag in (0.05 / rate, 0.3 / rate, 1.0 / rate, 3.0 / rate, 16.0 / rate):
        later = history(layer, times + lag, 800).astype(float)
        covariance = ((now - now.mean()) * (later - later.mean())).mean() / spread**2
        assert covariance == pytest.approx(math.exp(-rate * lag), abs=0.02)


@given(
    times=st.lists(st.integers(0, 10**13), min_size=1, max_size=10),
    more=st.lists(st.integers(0, 10**13), max_size=10),
    rates=st.sampled_from([*RATES, (1e-6, 1e-6), (1e6, 1e6)]),
)
def test_the_state_does_not_depend_on_when_or_how_often_one_asks(
    times: list[int], more: list[int], rates: tuple[float, float]
) -> None:
    layer, keys = GilbertElliott(*rates), many_keys(5)
    alone = {t: [layer.bad(keys[k : k + 1], t).item() for k in range(5)] for t in times}
    for t in more:
        layer.bad(keys, t)
    assert all(layer.bad(keys, t).tolist() == alone[t] for t in reversed(times))


def test_directions_and_links_have_their_own_histories() -> None:
    layer = GilbertElliott(1.0, 1.0)

    def states(sender: str, receiver: str, seed: int = 1) -> Floats:
        return np.array([layer.bad(linked_frame(sender, receiver, seed=seed).keys, t * 10**10)[0] for t in range(200)], float)

    here = states("car1", "car2")
    for other in (states("car2", "car1"), states("car1", "car3"), states("car1", "car2", seed=2)):
        assert abs(np.corrcoef(here, other)[0, 1]) < 4.5 / math.sqrt(200)


def test_extremes_are_exact() -> None:
    uniforms = np.random.default_rng(0).random((300, 2))
    frame = many_frame(300, 5 * 10**9)
    assert GilbertElliott(1.0, 1.0, bad_loss=1.0, good_loss=1.0).lost(frame, lambda: uniforms).all()
    assert not GilbertElliott(1.0, 1.0, bad_loss=0.0, good_loss=0.0).lost(frame, lambda: uniforms).any()
    layer = GilbertElliott(1.0, 1.0)
    assert layer.lost(frame, lambda: uniforms).tolist() == layer.bad(frame.keys, frame.start_ns).tolist()


@pytest.mark.parametrize(("probability", "mean_burst_s"), [(0.2, 0.5), (0.5, 1.0), (0.9, 0.05)])
def test_bursts_are_the_channel_of_gilbert_and_elliott_with_these_rates(probability: float, mean_burst_s: float) -> None:
    """1 / mean bursts end in a second; as many begin as keep the share of losses: share / (1 - share) / mean."""
    to_good = 1.0 / mean_burst_s
    bursts = Bursts(probability, mean_burst_s)
    reference = GilbertElliott(to_bad_per_s=to_good * probability / (1.0 - probability), to_good_per_s=to_good)
    uniforms = np.zeros((2000, 2))
    for time_ns in range(0, 10**10, 10**9):
        frame = many_frame(2000, time_ns)
        assert bursts.lost(frame, lambda: uniforms).tolist() == reference.lost(frame, lambda: uniforms).tolist()
