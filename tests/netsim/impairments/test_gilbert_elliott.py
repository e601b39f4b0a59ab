"""Gilbert and Elliott's channel against its closed forms, and that asking changes nothing."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.netsim.links import linked_frame, many_frame, many_keys
from vcmvsp.netsim.impairments.loss import Bursts, GilbertElliott
from vcmvsp.netsim.interfaces.layers import Bools, Floats

RATES = [(0.1, 1.0), (2.0, 3.0), (5.0, 0.5)]


def history(layer: GilbertElliott, times_s: Any, links: int) -> Bools:
    keys = many_keys(links)
    return np.array([layer.bad(keys, round(t * 1e9)) for t in times_s])


@pytest.mark.parametrize(("p", "r"), RATES)
def test_stationary_loss(p: float, r: float) -> None:
    """2000 links at 50 times far apart: 1e5 independent states, and losses in each."""
    layer = GilbertElliott(p, r, bad_loss=0.8, good_loss=0.05)
    times = np.arange(50) * 37.0 / (p + r)
    share = p / (p + r)
    assert history(layer, times, 2000).mean() == pytest.approx(share, abs=4.5 * math.sqrt(share * (1 - share) / 1e5))
    rng = np.random.default_rng(1)
    lost = np.mean([layer.lost(many_frame(2000, round(t * 1e9)), lambda: rng.random((2000, 2))) for t in times])
    loss = share * 0.8 + (1 - share) * 0.05
    assert lost == pytest.approx(loss, abs=4.5 * math.sqrt(loss * (1 - loss) / 1e5))


@pytest.mark.parametrize(("p", "r"), RATES)
def test_bursts_last_as_long_as_they_should(p: float, r: float) -> None:
    """Mean and spread of the exponential sojourns: 1/r bad, 1/p good; sampled 50 times as quickly as anything changes."""
    step = 0.02 / (p + r)
    states = history(GilbertElliott(p, r), np.arange(60_000) * step, 20)
    for wanted, rate in ((True, r), (False, p)):
        lengths = []
        for link in (states == wanted).T:
            changes = np.flatnonzero(np.diff(link.astype(int))) + 1
            runs, first = np.diff(changes), link[changes[0]]
            lengths += (runs[0 if first else 1 :: 2] * step).tolist()
        # what is shorter than a step is missed: those that are seen last about one step longer
        mean, error = np.mean(lengths), 1.0 / rate / math.sqrt(len(lengths))
        assert mean == pytest.approx(1.0 / rate, rel=0.03 + 4.5 * error * rate)
        assert np.std(lengths) == pytest.approx(1.0 / rate, rel=0.08)


@pytest.mark.parametrize(("p", "r"), [RATES[0], RATES[-1]])
def test_autocorrelation(p: float, r: float) -> None:
    """exp(-(p + r) tau), whatever the time between the frames; across the ends of cells too (16 / (p + r) s)."""
    layer, rate = GilbertElliott(p, r), p + r
    times = np.random.default_rng(3).uniform(0.0, 3600.0, 60)
    now = history(layer, times, 2000).astype(float)
    spread = now.std()
    for lag in (0.05 / rate, 0.3 / rate, 1.0 / rate, 3.0 / rate, 16.0 / rate):
        later = history(layer, times + lag, 2000).astype(float)
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
        return np.array([layer.bad(linked_frame(sender, receiver, seed=seed).keys, t * 10**10)[0] for t in range(1000)], float)

    here = states("car1", "car2")
    for other in (states("car2", "car1"), states("car1", "car3"), states("car1", "car2", seed=2)):
        assert abs(np.corrcoef(here, other)[0, 1]) < 4.5 / math.sqrt(1000)


def test_extremes_are_exact() -> None:
    uniforms = np.random.default_rng(0).random((300, 2))
    frame = many_frame(300, 5 * 10**9)
    assert GilbertElliott(1.0, 1.0, bad_loss=1.0, good_loss=1.0).lost(frame, lambda: uniforms).all()
    assert not GilbertElliott(1.0, 1.0, bad_loss=0.0, good_loss=0.0).lost(frame, lambda: uniforms).any()
    layer = GilbertElliott(1.0, 1.0)
    assert layer.lost(frame, lambda: uniforms).tolist() == layer.bad(frame.keys, frame.start_ns).tolist()


LINKS = 2000


def losses(layer: Bursts, period_s: float, frames: int) -> Bools:
    """Which of a train of frames each of many links loses, (frames, links)."""
    uniforms = np.random.default_rng(2)
    return np.array(
        [layer.lost(many_frame(LINKS, round(k * period_s * 1e9)), lambda: uniforms.random((LINKS, 2))) for k in range(frames)]
    )


@pytest.mark.parametrize(
    ("probability", "mean_burst_s", "period_s"), [(0.5, 1.0, 0.1), (0.5, 0.05, 0.1), (0.2, 0.3, 0.1), (0.9, 0.5, 0.02)]
)
def test_share_and_mean_row_of_losses_are_the_closed_forms(probability: float, mean_burst_s: float, period_s: float) -> None:
    lost = losses(Bursts(probability, mean_burst_s), period_s, 400)
    rate = 1.0 / mean_burst_s / (1.0 - probability)  # p + r
    row = 1.0 / ((1.0 - probability) * -math.expm1(-rate * period_s))
    chains = LINKS * 400 * min(1.0, rate * period_s / 2.0)  # independent states, roughly
    assert lost.mean() == pytest.approx(probability, abs=5.0 * math.sqrt(probability * (1.0 - probability) / chains))
    ends = (lost[:-1] & ~lost[1:]).sum()
    assert lost[:-1].sum() / ends == pytest.approx(row, rel=0.03)


def test_it_is_the_channel_of_gilbert_and_elliott_with_these_rates() -> None:
    mine, theirs = Bursts(0.2, 0.5), GilbertElliott(to_bad_per_s=0.5, to_good_per_s=2.0)
    uniforms = np.zeros((LINKS, 2))
    for time_ns in range(0, 10**10, 10**9):
        frame = many_frame(LINKS, time_ns)
        assert mine.lost(frame, lambda: uniforms).tolist() == theirs.lost(frame, lambda: uniforms).tolist()
