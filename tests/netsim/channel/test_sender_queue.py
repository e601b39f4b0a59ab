"""Waiting behind one's own frames: Lindley's recursion, and by it the queue M/D/1."""

import numpy as np
import pytest

from tests.support.netsim.channels import make_channel, one
from vcmvsp.cosim.types import Message
from vcmvsp.netsim.interfaces.layers import Floats

AIR_NS = 1_280_000  # 100 bytes at 1 Mbit/s


def waits_ns(arrival_ns: Floats, service_ns: float) -> Floats:
    """Lindley's recursion ``W' = max(0, W + S - A)``, unrolled: the walk of S - A above its least value so far."""
    walk = np.concatenate([[0.0], np.cumsum(service_ns - np.diff(arrival_ns))])
    waits: Floats = walk - np.minimum.accumulate(walk)
    return waits


def poisson_ns(load: float, count: int, seed: int) -> Floats:
    return np.cumsum(np.rint(np.random.default_rng(seed).exponential(AIR_NS / load, count)))


@pytest.mark.parametrize("load", [0.5, 0.95, 1.2])
def test_the_channel_queues_as_lindley_says(load: float) -> None:
    channel = make_channel("wifi-b-1")
    arrivals = poisson_ns(load, 2000, seed=1)
    places = np.array([(0.0, 0.0, 0.0), (5.0, 0.0, 0.0)])
    message, names = Message(sender="a", body={}, size_bytes=100), ("a", "b")
    queued = [one(channel.send(int(at), message, names, places)).queue_ns for at in arrivals.tolist()]
    assert queued == waits_ns(arrivals, AIR_NS).tolist()


@pytest.mark.parametrize(("load", "tolerance"), [(0.3, 0.01), (0.8, 0.01), (0.95, 0.05)])
def test_mean_wait_of_m_d_1(load: float, tolerance: float) -> None:
    """Pollaczek and Khinchine: ``rho T / (2 (1 - rho))``."""
    waits = np.concatenate([waits_ns(poisson_ns(load, 2_000_000, seed), AIR_NS) for seed in range(3)])
    assert waits.mean() == pytest.approx(load * AIR_NS / (2.0 * (1.0 - load)), rel=tolerance)
