"""Many radios, against closed forms and against ns-3.44 with the same positions and the same traffic."""

import numpy as np
import pytest

from tests.support.netsim.dcf_runs import MS, US, frame, open_air, run, square
from vcmvsp.cosim.reproduction.validation.medium_access import EDGES_M, NS3, sending_chance
from vcmvsp.netsim.interfaces.layers import Floats
from vcmvsp.netsim.interfaces.medium import Fate
from vcmvsp.netsim.mac.dcf.parameters import Dcf
from vcmvsp.netsim.phy.dsss import Dsss
from vcmvsp.netsim.phy.ofdm import Ofdm


@pytest.mark.parametrize("count", [3, 10])
def test_saturated_unicast_is_bianchis(count: int) -> None:
    """Equal levels: nothing is received in a collision, whose end is followed by DIFS."""
    medium = open_air(count, Dsss(11e6), Dcf(lifetime_s=1e6, queue_frames=10**6))
    level = np.full(count, 1e-6)
    frames = [frame(k, 0, k % count, level, to=(k + 1) % count, size=1000, patience=1.0) for k in range(9000)]
    until_ns = 8000 * MS
    decided = run(medium, frames, until_ns)
    assert len(decided) < 0.8 * len(frames)  # saturated to the end
    received = sum(bool((each.fate == Fate.RECEIVED).any()) for each in decided)
    attempts = sum(each.attempts for each in decided)
    tau = sending_chance(count)
    p = 1 - (1 - tau) ** (count - 1)
    assert 1 - received / attempts == pytest.approx(p, abs=0.02)
    air_ns, idle, success = Dsss(11e6).air_time_ns(1000), (1 - tau) ** count, count * tau * (1 - tau) ** (count - 1)
    acknowledged_ns = air_ns + 10 * US + 203 * US + 50 * US
    slot_ns = idle * 20 * US + success * acknowledged_ns + (1 - idle - success) * (air_ns + 50 * US)
    assert received / until_ns == pytest.approx(success / slot_ns, rel=0.03)


@pytest.mark.parametrize("count", [3, 20])
def test_saturated_broadcast_sends_in_a_slot_with_2_over_w_plus_1(count: int) -> None:
    """Bianchi without retries: the share of collisions is 1 - (1 - 2 / 33)^(n - 1)."""
    medium = open_air(count, Dsss(11e6), Dcf(lifetime_s=1e6, queue_frames=10**6))
    level = np.full(count, 1e-6)
    frames = [frame(k, 0, k % count, level, patience=1.0) for k in range(5000)]
    decided = [each for each in run(medium, frames, 10_000 * MS) if each.start_ns > 20 * MS][:4000]
    alone = np.mean([(each.fate == Fate.RECEIVED).sum() == count - 1 for each in decided])
    assert 1 - alone == pytest.approx(1 - (1 - 2 / 33) ** (count - 1), abs=0.02)


PHYS: dict[str, Dsss | Ofdm] = {"wifi-b-1": Dsss(1e6), "wifi-g-6": Ofdm(6e6)}


def traffic(count: int, hz: float, seconds: int, seed: int) -> tuple[list[int], list[int]]:
    """Independent times and senders, from 1 s on."""
    rng, frames = np.random.default_rng(seed), int(count * hz * seconds)
    times = np.sort(rng.integers(10**9, 10**9 * (1 + seconds), frames))
    return times.tolist(), rng.integers(0, count, frames).tolist()


@pytest.mark.parametrize("name", NS3)
def test_as_ns_3(name: str) -> None:
    judged = NS3[name]
    n, levels = judged.radios, square(judged.radios, judged.side_m, judged.exponent, 1)
    place = np.random.default_rng(1).uniform(0.0, judged.side_m, (n, 2))
    bins = np.digitize(np.linalg.norm(place[:, None] - place, axis=-1), EDGES_M[1:])
    delay_ms: list[Floats] = []
    sent, got = np.zeros(len(EDGES_M)), np.zeros(len(EDGES_M))
    for seed in range(judged.runs):
        times, senders = traffic(n, judged.hz, judged.seconds, seed)
        rng = np.random.default_rng(seed)
        frames = [
            frame(k, time, i, levels[i], patience=rng.exponential(size=n))
            for k, (time, i) in enumerate(zip(times, senders, strict=True))
        ]
        for each in run(open_air(n, PHYS[judged.preset], seed=seed), frames, 60_000 * MS):
            i, ok = frames[each.number].sender, each.fate == Fate.RECEIVED
            sent += np.bincount(np.delete(bins[i], i), minlength=len(EDGES_M))
            got += np.bincount(bins[i][ok], minlength=len(EDGES_M))
            delay_ms.append(np.full(ok.sum(), (each.end_ns - frames[each.number].time_ns) / 1e6))
    delays = np.concatenate(delay_ms)
    assert got.sum() / sent.sum() == pytest.approx(judged.delivery, abs=0.01)
    assert delays.mean() == pytest.approx(judged.mean_ms, rel=0.05)
    shares = [np.mean(delays <= quantile_ms + 1e-3) for quantile_ms in judged.quantiles_ms]
    for share, expected, within in zip(shares, judged.shares, (0.03, 0.015, 0.015), strict=True):
        assert share == pytest.approx(expected, abs=within)
    np.testing.assert_allclose(got / sent, judged.by_distance, atol=0.02)
