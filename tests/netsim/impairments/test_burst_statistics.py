"""Bursts by share and mean length against their closed forms."""

import math

import numpy as np
import pytest

from tests.support.netsim.links import many_frame
from vcmvsp.netsim.impairments.burst_statistics import Bursts
from vcmvsp.netsim.impairments.gilbert_elliott import GilbertElliott
from vcmvsp.netsim.interfaces.layers import Bools

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
