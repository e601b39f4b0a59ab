"""Networks of many 802.11 radios: laws of every run, closed forms, and ns-3 with the same positions and traffic."""

from bisect import bisect
from collections.abc import Sequence

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.netsim.dcf_runs import (
    MS,
    PHYS,
    UNTIL,
    US,
    all_equal,
    bytes_of,
    frame,
    mixed_traffic,
    open_air,
    periodic,
    run,
    square_levels,
)
from vcmvsp.cosim.reproduction.validation.medium_access import EDGES_M, NS3, sending_chance
from vcmvsp.netsim.interfaces.layers import Floats
from vcmvsp.netsim.interfaces.medium import Decided, Fate, Offered
from vcmvsp.netsim.mac.dcf import access
from vcmvsp.netsim.mac.dcf.medium import DcfMedium
from vcmvsp.netsim.mac.dcf.parameters import Dcf
from vcmvsp.netsim.mac.dcf.state import DcfRules, DcfState
from vcmvsp.netsim.phy.dsss import Dsss
from vcmvsp.netsim.phy.ofdm import Ofdm

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("seed", range(3))
def test_receptions_take_their_air_time_and_a_radio_sends_one_frame_at_a_time(seed: int) -> None:
    phy, frames = Dsss(11e6), mixed_traffic(seed, frames=200)
    decided = run(open_air(6, phy, seed=seed), frames, UNTIL)
    busy: dict[int, int] = {}
    for each in sorted(decided, key=lambda one: one.start_ns):
        offered = frames[each.number]
        if each.start_ns < 0:
            continue
        end_ns = each.start_ns + phy.air_time_ns(offered.size_bytes)
        assert each.start_ns >= offered.time_ns
        assert each.end_ns >= end_ns
        assert each.start_ns >= busy.get(offered.sender, 0)
        busy[offered.sender] = end_ns
        if offered.to < 0:
            assert each.end_ns == end_ns
            assert each.fate[offered.sender] == Fate.TRANSMITTING
    received = [each for each in decided if (each.fate == Fate.RECEIVED).any()]
    assert len(received) > 20


@pytest.mark.parametrize("seed", [142, 149, 160])  # a late access ends exactly with a frame that the radio cannot hear
def test_time_never_goes_back(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    times: list[int] = []
    upcoming = access.upcoming

    def watched(s: DcfState, rules: DcfRules) -> tuple[int, int, int]:
        kind, row, now = upcoming(s, rules)
        times.append(now)
        return kind, row, now

    monkeypatch.setattr(access, "upcoming", watched)
    frames = [
        msgspec.structs.replace(each, time_ns=each.time_ns // (20 * US) * (20 * US)) for each in mixed_traffic(seed, frames=100)
    ]
    run(open_air(6, Ofdm(54e6), Dcf(cw_min=7, cca_threshold_dbm=-70.0), seed=seed), frames, UNTIL)
    assert len(times) > 300
    assert times == sorted(times)


@settings(max_examples=12)
@given(
    phy=st.sampled_from(PHYS), cuts=st.lists(st.integers(0, 80 * MS), max_size=40), seed=st.integers(0, 9), peek=st.booleans()
)
def test_every_frame_is_decided_once_in_its_step_however_time_is_cut(
    phy: Dsss | Ofdm, cuts: list[int], seed: int, peek: bool
) -> None:
    frames = mixed_traffic(seed, frames=40)
    whole = run(open_air(6, phy, seed=seed), frames, UNTIL)
    assert sorted(each.number for each in whole) == list(range(40))
    assert [each.end_ns for each in whole] == sorted(each.end_ns for each in whole)
    medium, last = open_air(6, phy, seed=seed), -1
    decided: list[Decided] = []
    offered = 0
    for cut in [*sorted(cuts), UNTIL]:
        upto = bisect(frames, cut, key=lambda one: one.time_ns)
        for each in frames[offered:upto]:
            medium.offer(each)
            if peek:
                medium.next_ns()
        offered = max(offered, upto)
        now = list(medium.advance(cut))
        assert all(last < each.end_ns <= cut for each in now)
        decided, last = decided + now, cut
    assert bytes_of(decided) == bytes_of(whole)
    assert medium.next_ns() is None


def predicted(medium: DcfMedium, frames: Sequence[Offered]) -> tuple[list[Decided], int]:
    """All decisions, advanced to predicted times and to offers alone, and the number of predicted times without a decision."""
    decided, idle = list[Decided](), 0
    for offered in (*frames, None):
        until_ns = UNTIL if offered is None else offered.time_ns
        while (now := medium.next_ns()) is not None and now < until_ns:
            more = medium.advance(now)
            assert all(one.end_ns == now for one in more)
            decided += more
            idle += not more
        if offered is not None:
            decided += medium.advance(until_ns)
            medium.offer(offered)
    return decided, idle


@pytest.mark.parametrize(("phy", "mac"), [(Dsss(), Dcf()), (Ofdm(54e6), Dcf(rts_threshold_bytes=0))], ids=["plain", "rts"])
@pytest.mark.parametrize("seed", range(4))
def test_the_predicted_time_is_never_late_and_progress_never_stalls(phy: Dsss | Ofdm, mac: Dcf, seed: int) -> None:
    frames = mixed_traffic(seed)
    whole = run(open_air(6, phy, mac, seed=seed), frames, UNTIL)
    decided, idle = predicted(open_air(6, phy, mac, seed=seed), frames)
    assert bytes_of(decided) == bytes_of(whole)
    assert idle < 6 * sum(each.attempts for each in whole)


def test_for_broadcasts_in_one_domain_the_predicted_time_is_exact() -> None:
    decided, idle = predicted(open_air(5), periodic(np.full((5, 5), 1e-6), 100.0, 200 * MS))
    assert idle == 0
    assert len(decided) > 90


@settings(max_examples=8)
@given(cuts=st.lists(st.integers(0, 300 * MS), max_size=6), seed=st.integers(0, 9))
def test_frames_offered_as_arrays_fare_as_one_by_one(cuts: list[int], seed: int) -> None:
    """With levels that change after every cut, and queues that overflow."""
    mac, n = Dcf(queue_frames=3, lifetime_s=0.02), 6
    levels = square_levels(n, 200.0, 3.0, seed)
    frames = periodic(levels, 60.0, 300 * MS, size=1000, seed=seed)
    singly, together = open_air(n, mac=mac, seed=seed), open_air(n, mac=mac, seed=seed)
    decided, arrays, offered = list[Decided](), list[Decided](), 0
    for k, cut in enumerate([*sorted(cuts), UNTIL]):
        now = frames[offered : max(bisect(frames, cut, key=lambda one: one.time_ns), offered)]
        moved = levels * (1.0 + k)
        time_ns, sender, number = (np.array([getattr(each, it) for each in now], int) for it in ("time_ns", "sender", "number"))
        patience = np.array([each.patience for each in now])
        together.offer_many(time_ns, sender, 1000, moved, patience, number)
        rows = [msgspec.structs.replace(one, power_mw=moved[one.sender]) for one in now]
        decided += run(singly, rows, cut)
        arrays += together.advance(cut)
        offered += len(now)
    assert bytes_of(arrays) == bytes_of(decided)
    assert len(arrays) == len(frames)
    assert together.next_ns() is None


def saturated(count: int, phy: Dsss | Ofdm, until_ns: int, *, unicast: bool, size: int = 100) -> list[Decided]:
    """Decisions of frames that all wait from the start, at equal levels: none survives a collision."""
    medium = open_air(count, phy, Dcf(lifetime_s=1e6, queue_frames=10**6), compiled=True)
    to = [(k + 1) % count if unicast else -1 for k in range(count)]
    frames = [frame(k, 0, k % count, all_equal(count), to=to[k % count], size=size, patience=1.0) for k in range(9000)]
    decided = run(medium, frames, until_ns)
    assert len(decided) < 0.9 * len(frames)  # saturated to the end
    return decided


def receptions(decided: list[Decided]) -> int:
    return sum(bool((each.fate == Fate.RECEIVED).any()) for each in decided)


@pytest.mark.parametrize("count", [3, 10])
def test_saturated_unicast_is_bianchis(count: int) -> None:
    """The end of a collision is followed by DIFS."""
    until_ns = 8000 * MS
    decided = saturated(count, Dsss(11e6), until_ns, unicast=True, size=1000)
    received = receptions(decided)
    attempts = sum(each.attempts for each in decided)
    tau = sending_chance(count)
    p = 1 - (1 - tau) ** (count - 1)
    assert 1 - received / attempts == pytest.approx(p, abs=0.02)
    air_ns, idle, success = Dsss(11e6).air_time_ns(1000), (1 - tau) ** count, count * tau * (1 - tau) ** (count - 1)
    acknowledged_ns = air_ns + 10 * US + 203 * US + 50 * US
    slot_ns = idle * 20 * US + success * acknowledged_ns + (1 - idle - success) * (air_ns + 50 * US)
    assert received / until_ns == pytest.approx(success / slot_ns, rel=0.03)


@pytest.mark.parametrize(("rate_bps", "frames_hz"), [(6.5e6, 2190.0), (26e6, 3349.4), (65e6, 3662.4)])
def test_two_saturated_radios_of_802_11n_send_as_many_frames_as_in_ns_3(rate_bps: float, frames_hz: float) -> None:
    """Acknowledged frames of 100 bytes, ns-3.44, 5 runs of 1 s (``bench.ns3.compare``)."""
    received = receptions(saturated(2, Ofdm(rate_bps), 2000 * MS, unicast=True))
    assert received / 2.0 == pytest.approx(frames_hz, rel=0.02)


@pytest.mark.parametrize("count", [3, 20])
def test_saturated_broadcast_sends_in_a_slot_with_2_over_w_plus_1(count: int) -> None:
    """Bianchi without retries: the share of collisions is 1 - (1 - 2 / 33)^(n - 1)."""
    decided = saturated(count, Dsss(11e6), 1500 * MS, unicast=False)
    decided = [each for each in decided if each.start_ns > 20 * MS][:4000]
    alone = np.mean([(each.fate == Fate.RECEIVED).sum() == count - 1 for each in decided])
    assert 1 - alone == pytest.approx(1 - (1 - 2 / 33) ** (count - 1), abs=0.02)


BY_PRESET: dict[str, Dsss | Ofdm] = {"wifi-b-1": Dsss(1e6), "wifi-g-6": Ofdm(6e6)}


def traffic(count: int, hz: float, seconds: int, levels: Floats, seed: int) -> list[Offered]:
    """Broadcasts at independent times and of independent senders, from 1 s on."""
    rng, patience, total = np.random.default_rng(seed), np.random.default_rng(seed), int(count * hz * seconds)
    times = np.sort(rng.integers(10**9, 10**9 * (1 + seconds), total)).tolist()
    sent = enumerate(zip(times, rng.integers(0, count, total).tolist(), strict=True))
    return [frame(k, time, i, levels[i], patience=patience.exponential(size=count)) for k, (time, i) in sent]


@pytest.mark.parametrize("name", [name for name in NS3 if name != "802.11b, 50 in one domain"])  # demanded by `vcmvsp validate`
def test_delivery_and_delays_agree_with_ns_3(name: str) -> None:
    judged = NS3[name]
    n, levels = judged.radios, square_levels(judged.radios, judged.side_m, judged.exponent, 1)
    place = np.random.default_rng(1).uniform(0.0, judged.side_m, (n, 2))
    bins = np.digitize(np.linalg.norm(place[:, None] - place, axis=-1), EDGES_M[1:])
    delay_ms: list[Floats] = []
    sent, got = np.zeros(len(EDGES_M)), np.zeros(len(EDGES_M))
    for seed in range(judged.runs):
        frames = traffic(n, judged.hz, judged.seconds, levels, seed)
        for each in run(open_air(n, BY_PRESET[judged.preset], seed=seed, compiled=True), frames, 60_000 * MS):
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
