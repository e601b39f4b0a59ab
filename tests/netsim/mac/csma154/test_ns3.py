"""CSMA/CA of IEEE 802.15.4: delivery and delay of broadcasts are those of ns-3."""

import numpy as np
import pytest

from tests.support.netsim.csma154_runs import MS, World
from vcmvsp.netsim.interfaces.layers import Floats
from vcmvsp.netsim.interfaces.medium import Fate


def distances(places: Floats) -> Floats:
    offset = places[:, None] - places[None]
    far: Floats = np.maximum(np.sqrt((offset**2).sum(axis=2)), 1.0)
    return far


def network(kind: str, count: int, rng: np.random.Generator) -> Floats:
    """Levels: 0 dBm, 40.052 dB at 1 m; squares of 10 m with exponent 2 and of 80 m with 3, a line of 25 m steps with 3."""
    if kind == "line":
        return -40.052 - 30.0 * np.log10(distances(np.arange(count)[:, None] * np.array([25.0, 0.0])))
    side, exponent = (10.0, 2.0) if kind == "room" else (80.0, 3.0)
    return -40.052 - 10.0 * exponent * np.log10(distances(rng.uniform(0.0, side, (count, 2))))


NS3 = [  # ns-3.44, means over 12 to 24 runs: kind, nodes, Hz (Poisson), payload, seconds, runs here, PDR, mean delay ms
    ("room", 5, 10.0, 100, 20.0, 2, 0.9816, 6.335),
    ("room", 20, 5.0, 100, 10.0, 2, 0.9371, 7.572),
    ("room", 20, 10.0, 100, 10.0, 2, 0.7786, 10.310),
    ("room", 50, 1.0, 100, 20.0, 2, 0.9776, 6.251),
    ("room", 50, 10.0, 20, 4.0, 2, 0.7571, 6.031),
    ("line", 3, 20.0, 100, 30.0, 2, 0.6134, 6.293),
    ("field", 20, 5.0, 50, 1.0, 30, 0.3818, 4.242),
]


@pytest.mark.parametrize(("kind", "count", "hz", "size", "duration_s", "runs", "pdr", "delay_ms"), NS3)
def test_broadcast_is_that_of_ns_3(
    kind: str, count: int, hz: float, size: int, duration_s: float, runs: int, pdr: float, delay_ms: float
) -> None:
    arrived, delays = 0, []
    frames = round(count * hz * duration_s)
    for seed in range(runs):
        rng = np.random.default_rng((seed, 3))
        world = World(network(kind, count, rng), seed)
        times = np.sort(rng.integers(round(duration_s * 1e9), size=frames)).tolist()
        for time_ns, sender in zip(times, rng.integers(count, size=frames).tolist(), strict=True):
            world.offer(time_ns, sender, size=size)
        for number, each in world.finish().items():
            received = int(np.count_nonzero(each.fate == Fate.RECEIVED))
            arrived += received
            delays += [each.end_ns - times[number]] * received
    assert arrived / (runs * frames * (count - 1)) == pytest.approx(pdr, abs=0.02)
    assert np.mean(delays) / MS == pytest.approx(delay_ms, rel=0.05)
