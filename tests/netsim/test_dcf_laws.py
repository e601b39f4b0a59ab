"""What holds for any traffic: nothing is lost or invented, steps do not matter, nor does compilation, nor others' draws."""

import os
from bisect import bisect

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from netsim import compiled
from netsim.layers import Floats
from netsim.medium import Decided, Fate, Offered
from netsim.phy import Dsss
from netsim.phy_ofdm import Ofdm
from tests.netsim.dcf_runs import MS, frame, open_air, periodic, run, square

UNTIL = 10_000 * MS
PHYS: list[Dsss | Ofdm] = [Dsss(1e6), Dsss(11e6), Ofdm(6e6), Ofdm(54e6, "5GHz")]


def bytes_of(decided: list[Decided]) -> list[tuple[object, ...]]:
    return [
        (
            each.number,
            each.start_ns,
            each.end_ns,
            each.attempts,
            each.fate.tobytes(),
            each.least_sinr.tobytes(),
        )
        for each in decided
    ]


def mixed(seed: int, *, count: int = 6, frames: int = 60) -> list[Offered]:
    """Broadcast and unicast of all sizes and priorities, with hidden nodes, in bursts."""
    rng = np.random.default_rng(seed)
    levels = square(count, 200.0, 3.0, seed)
    times = np.sort(rng.integers(0, 60 * MS, frames)).tolist()
    offered = []
    for k, time in enumerate(times):
        sender = int(rng.integers(count))
        to = -1 if rng.random() < 0.5 else int((sender + rng.integers(1, count)) % count)
        size, priority = int(rng.choice([1, 100, 1000])), int(rng.integers(3))
        if rng.random() < 0.3:
            offered.append(fading(k, time, sender, to, size, priority, levels[sender]))
        else:
            patience = rng.exponential(size=count)
            offered.append(frame(k, time, sender, levels[sender], to=to, size=size, priority=priority, patience=patience))
    return offered


def fading(number: int, time: int, sender: int, to: int, size: int, priority: int, level: Floats) -> Offered:
    """Levels and patience that are another for every attempt, and not known before."""

    def renew(attempt: int, start_ns: int) -> tuple[Floats, Floats]:
        rng = np.random.default_rng((number, attempt, start_ns))
        return level * rng.exponential(size=len(level)), rng.exponential(size=len(level))

    return Offered(number, time, sender, to, size, priority, None, None, renew)


@pytest.mark.parametrize("phy", PHYS, ids=str)
@pytest.mark.parametrize("seed", range(5))
def test_every_frame_is_decided_once_or_waits(phy: Dsss | Ofdm, seed: int) -> None:
    frames = mixed(seed)
    for until in (20 * MS, 50 * MS, UNTIL):
        medium = open_air(6, phy, seed=seed)
        decided = run(medium, [each for each in frames if each.time_ns <= until], until)
        numbers = [each.number for each in decided] + list(medium.waiting())
        assert sorted(numbers) == [each.number for each in frames if each.time_ns <= until]
        assert [each.end_ns for each in decided] == sorted(each.end_ns for each in decided)
        assert all(each.end_ns <= until for each in decided)
    assert not medium.waiting()
    assert medium.next_ns() is None


@pytest.mark.parametrize("seed", range(3))
def test_what_is_received_took_its_time_and_a_radio_sends_one_frame_at_a_time(seed: int) -> None:
    phy, frames = Dsss(11e6), mixed(seed, frames=200)
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


@settings(max_examples=25, deadline=None)
@given(cuts=st.lists(st.integers(0, 80 * MS), max_size=40), seed=st.integers(0, 9), peek=st.booleans())
def test_steps_do_not_matter(cuts: list[int], seed: int, peek: bool) -> None:
    frames = mixed(seed, frames=40)
    whole = run(open_air(6, seed=seed), frames, UNTIL)
    medium = open_air(6, seed=seed)
    decided: list[Decided] = []
    offered = 0
    for cut in [*sorted(cuts), UNTIL]:
        upto = bisect(frames, cut, key=lambda one: one.time_ns)
        for each in frames[offered:upto]:
            medium.offer(each)
            if peek:
                medium.next_ns()
        offered = max(offered, upto)
        decided += medium.advance(cut)
    assert bytes_of(decided) == bytes_of(whole)


@pytest.mark.parametrize("seed", range(4))
def test_next_is_never_late_and_going_from_one_to_the_next_comes_to_an_end(seed: int) -> None:
    frames = mixed(seed)
    whole = run(open_air(6, seed=seed), frames, UNTIL)
    medium, idle = open_air(6, seed=seed), 0
    decided: list[Decided] = []
    for each in frames:
        while (now := medium.next_ns()) is not None and now < each.time_ns:
            more = list(medium.advance(now))
            assert all(one.end_ns == now for one in more)
            decided += more
            idle += not more
        decided += medium.advance(each.time_ns)
        medium.offer(each)
    while (now := medium.next_ns()) is not None:
        more = list(medium.advance(now))
        decided += more
        idle += not more
    assert bytes_of(decided) == bytes_of(whole)
    assert idle < 6 * sum(each.attempts for each in whole)


def test_for_broadcasts_in_one_domain_next_is_exact() -> None:
    levels = np.full((5, 5), 1e-6)
    frames = periodic(levels, 100.0, 200 * MS)
    medium, idle = open_air(5), 0
    decided: list[Decided] = []
    for each in frames:
        medium.offer(each)
        while (now := medium.next_ns()) is not None and now <= 200 * MS:
            following = frames[each.number + 1].time_ns if each.number + 1 < len(frames) else UNTIL
            if now >= following:
                break
            more = medium.advance(now)
            decided += more
            idle += not more
    assert idle == 0
    assert len(decided) > 90


def test_radios_that_nobody_hears_change_nothing_for_others() -> None:
    """Each radio's backoffs are its own, whatever and whenever others send."""
    levels = np.zeros((4, 4))
    levels[:2, :2] = 1e-6
    frames = [each for each in periodic(levels, 300.0, 200 * MS) if each.sender < 2]
    strangers = [each for each in periodic(levels, 300.0, 200 * MS) if each.sender >= 2]
    alone = run(open_air(4), frames, UNTIL)
    together = run(open_air(4), sorted([*frames, *strangers], key=lambda one: one.time_ns), UNTIL)
    assert bytes_of([each for each in together if each.number in {one.number for one in frames}]) == bytes_of(alone)


@pytest.mark.skipif(os.environ.get("VCMVSP_COMPILED") == "0" or not compiled.available(), reason="numba is not installed")
@pytest.mark.timeout(600)  # the first time it compiles
@pytest.mark.parametrize("seed", range(10))
def test_compiled_is_the_same_to_the_last_bit(seed: int) -> None:
    phy = PHYS[seed % 4]
    frames = mixed(seed, frames=300)
    by_numpy = run(open_air(6, phy, seed=seed, compiled=False), frames, UNTIL)
    assert bytes_of(run(open_air(6, phy, seed=seed, compiled=True), frames, UNTIL)) == bytes_of(by_numpy)


def test_compilation_can_be_turned_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VCMVSP_COMPILED", "0")
    assert not compiled.available()
