"""Age of information: the time since the newest message in hand was sent (Kaul, Yates and Gruteser 2012).

Messages every T, each lost with probability p, received d after their sending: the mean age is d + T (1 + p) / (2 (1 - p)),
its mean at receptions just before they count, the peak, d + T / (1 - p), and its mean at the ticks kT + d is d + T p / (1 - p).
"""

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.support.netsim.channels import make_channel, make_frame, send
from vcmvsp.cosim.rng import key64, link_uniform
from vcmvsp.netsim.impairments.delay import FixedDelay
from vcmvsp.netsim.impairments.loss import Bernoulli
from vcmvsp.netsim.interfaces.layers import LOSS_SLOT

T = 100_000_000  # ns


def ages(sent: NDArray[np.int64], received: NDArray[np.int64]) -> tuple[float, float]:
    """Mean and mean peak age, s, of messages that arrive in the order of sending, from the first to the last arrival."""
    start, end = (received[:-1] - sent[:-1]) / 1e9, (received[1:] - sent[:-1]) / 1e9  # of each ramp of the saw-tooth
    mean = ((start + end) / 2 * (end - start)).sum() / (end - start).sum()
    return float(mean), float(end.mean())


@pytest.mark.parametrize(("p", "d"), [(0.0, 0.0), (0.1, 0.1), (0.5, 0.0), (0.5, 0.25), (0.9, 0.0), (0.9, 1.0)])
def test_mean_and_peak_age_follow_from_loss_and_delay(p: float, d: float) -> None:
    n = 1_000_000
    uniforms = link_uniform(np.array([key64(1, "radio/a/b")], np.uint64), np.arange(n, dtype=np.uint64)[:, None], LOSS_SLOT)
    frame = make_frame(n, 1)
    sent = np.arange(n, dtype=np.int64) * T
    kept = ~Bernoulli(p).lost(frame, lambda: uniforms)[:, 0]
    received = sent + FixedDelay(d).delay_ns(frame, lambda: uniforms)[:, 0]
    mean, peak = ages(sent[kept], received[kept])
    assert mean == pytest.approx(d + 0.1 * (1 + p) / (2 * (1 - p)), rel=0.01)
    assert peak == pytest.approx(d + 0.1 / (1 - p), rel=0.01)


def test_age_in_the_recorded_rows() -> None:
    """The same through the whole channel; 5 standard deviations of the mean age of 30 000 frames at p = 0.5 are 2 %."""
    channel = make_channel("wifi-b-1", loss={"probability": 0.5}, delay={"seconds": 0.1})
    rows = [(k * T, send(channel, 20.0, sent_ns=k * T).received_ns.item()) for k in range(30_000)]
    sent, received = np.array([row for row in rows if row[1] >= 0]).T
    mean, peak = ages(sent, received)
    assert mean == pytest.approx(0.1 + 0.15, rel=0.02)
    assert peak == pytest.approx(0.1 + 0.2, rel=0.02)
