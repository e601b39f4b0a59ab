import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.netsim.channels import make_channel, make_frame, send
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.impairments.delay import FixedDelay, NoDelay
from vcmvsp.netsim.impairments.loss import NoLoss
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
