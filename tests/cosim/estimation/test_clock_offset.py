"""Foreign clocks: promised error bounds, order, jumps; delays are random, the drift is constant."""

import math

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from vcmvsp.cosim.estimation.clock_offset import AGREE, EchoClock, ForeignClock

pytestmark = pytest.mark.slow

MS = 10**6
SECOND = 10**9
delays = st.floats(0.0, 0.9)  # s, beyond the least delay
gaps = st.floats(1e-3, 3.0)  # s between messages


def stamp(now_ns: int, offset_ns: int, ppm: float) -> int:
    """Reading, ns, of a clock that is ``offset_ns`` behind ours at 0 and gains ``ppm`` microseconds a second."""
    return now_ns - offset_ns + round(ppm * 1e-6 * now_ns)  # integers: floats of 1e18 are 128 apart


def traffic(messages: list[tuple[float, float]], least: float) -> list[tuple[int, int, int]]:
    """Rows (true time, arrival, extra delay), ns; the link keeps the order."""
    now, arrived, rows = 10 * SECOND, 0, []
    for gap, extra in messages:
        now += round(gap * SECOND)
        arrived = max(arrived, now + round((least + extra) * SECOND))
        rows.append((now, arrived, arrived - now - round(least * SECOND)))
    return rows


@settings(max_examples=300)
@given(
    messages=st.lists(st.tuples(gaps, delays), min_size=1, max_size=40),
    least=st.sampled_from([0.0, 0.1]),
    offset=st.integers(-(10**18), 2 * 10**18),
    ppm=st.floats(-100.0, 100.0),
)
def test_the_error_is_at_most_the_least_extra_delay_and_drift(
    messages: list[tuple[float, float]], least: float, offset: int, ppm: float
) -> None:
    clock = ForeignClock(least_s=least, drift_ppm=100.0)
    before: list[tuple[int, int]] = []
    last = -math.inf
    for now, arrived, extra in traffic(messages, least):
        local = clock.local_time_ns(stamp(now, offset, ppm), arrived)
        before.append((arrived, extra))
        bounds = [extra + 2e-4 * (arrived - at) for at, extra in before if at >= arrived - 30 * SECOND]
        # plus the drift of the offset while the message was under way
        slack = 1e-4 * (arrived - now) + 2
        assert -slack <= local - now <= min(bounds) + slack
        assert local <= arrived - round(least * SECOND)
        assert local >= last
        last = local
    assert clock.jumps == 0


@settings(max_examples=200)
@given(
    before=st.lists(st.tuples(st.floats(0.05, 0.2), st.floats(0.0, 0.2)), min_size=1, max_size=20),
    after=st.lists(st.tuples(st.floats(0.05, 0.2), st.floats(0.0, 0.2)), min_size=AGREE, max_size=20),
    jump=st.floats(1.5, 1e6) | st.floats(-1e6, -1.5),
)
@example(before=[(0.125, 0.0)], after=[(0.125, 0.0), (0.1875, 0.0), (0.1875, 0.0)], jump=-1.5)  # soon makes up for the jump
def test_a_jump_is_counted_once_and_corrected(
    before: list[tuple[float, float]], after: list[tuple[float, float]], jump: float
) -> None:
    clock = ForeignClock(drift_ppm=0.0)
    rows = traffic(before + after, 0.0)
    for number, (now, arrived, _) in enumerate(rows):
        jumped = number >= len(before)
        local = clock.local_time_ns(now + (round(jump * SECOND) if jumped else 0), arrived)
        assert local <= arrived  # also before the jump is accepted
        if number >= len(before) + AGREE - 1:
            assert clock.jumps == 1
            assert 0 <= local - now <= 0.2 * SECOND
    assert clock.jumped_ns == pytest.approx(jump * SECOND, abs=0.5 * SECOND)


def test_one_wild_stamp_changes_nothing() -> None:
    clock = ForeignClock(drift_ppm=0.0)
    for tick in range(50):
        now = tick * 100 * MS
        wild = {20: 0, 30: 10**18, 31: -(10**18)}.get(tick)
        local = clock.local_time_ns(now + 7 * SECOND if wild is None else wild, now + 5 * MS)
        if wild is None:
            assert local - now == 5 * MS
    assert clock.jumps == 0


def test_an_emptied_queue_is_no_jump() -> None:
    """Two seconds of messages arrive at once; their times remain exact."""
    clock = ForeignClock(drift_ppm=0.0)
    for tick in range(10):
        clock.local_time_ns(tick * 100 * MS, tick * 100 * MS)
    for tick in range(10, 30):
        assert clock.local_time_ns(tick * 100 * MS, 3 * SECOND) == tick * 100 * MS
    assert clock.jumps == 0


def test_the_window_drops_old_data() -> None:
    clock = ForeignClock(window_s=2.0, drift_ppm=0.0)
    clock.local_time_ns(0, 0)
    assert clock.local_time_ns(SECOND, SECOND + 300 * MS) == SECOND  # slower from now on
    assert clock.local_time_ns(3 * SECOND, 3 * SECOND + 300 * MS) == 3 * SECOND + 300 * MS
    assert clock.offset_ns(3 * SECOND) == 300 * MS
    assert ForeignClock().offset_ns(0) is None


@settings(max_examples=300)
@given(
    trips=st.lists(st.tuples(st.floats(0.01, 5.0), *3 * (st.floats(0.0, 1.0),)), min_size=1, max_size=20),
    offset=st.integers(-(10**18), 2 * 10**18),
    ppm=st.floats(-100.0, 100.0),
    later=st.floats(0.0, 100.0),
)
def test_the_error_of_an_exchange_is_within_its_bound(
    trips: list[tuple[float, ...]], offset: int, ppm: float, later: float
) -> None:
    exchange, now_ns = EchoClock(drift_ppm=100.0), 0
    for gap, there, stay, back in trips:
        sent_ns = now_ns + round(gap * SECOND)
        received_ns = sent_ns + round(there * SECOND)
        answered_ns = received_ns + round(stay * SECOND)
        now_ns = answered_ns + round(back * SECOND)
        exchange.add(sent_ns, stamp(received_ns, offset, ppm), stamp(answered_ns, offset, ppm), now_ns)
    at = now_ns + round(later * SECOND)
    best = exchange.best(at)
    assert best is not None
    assert abs(best.offset_ns - (at - stamp(at, offset, ppm))) <= best.error_ns + 2
    assert exchange.jumps == exchange.refused == 0
    shortest = min(there + back for _, there, _, back in trips[-8:])
    assert best.error_ns <= 0.5 * shortest * SECOND + 1e-4 * (at + 3 * SECOND) + MS


def test_equal_delays_give_the_exact_offset() -> None:
    exchange = EchoClock()
    assert exchange.best(0) is None
    exchange.add(100, 5100, 5200, 300)  # 50 each way, 100 at the other end
    best = exchange.best(300)
    assert best is not None
    assert best.offset_ns == 100 + 50 - 5100
    assert best.error_ns <= 53


def test_a_contradiction_restarts_an_exchange() -> None:
    exchange = EchoClock(drift_ppm=0.0)
    exchange.add(0, SECOND, SECOND, 10 * MS)
    exchange.add(SECOND, 2 * SECOND, 2 * SECOND, SECOND + 100 * MS)  # longer, but consistent
    best = exchange.best(2 * SECOND)
    assert exchange.jumps == 0
    assert best is not None
    assert best.at_ns == 10 * MS
    exchange.add(2 * SECOND, 13 * SECOND, 13 * SECOND, 2 * SECOND + 200 * MS)
    best = exchange.best(3 * SECOND)
    assert exchange.jumps == 1
    assert best is not None
    assert best.offset_ns == -11 * SECOND + 100 * MS


def test_answers_before_their_requests_are_refused() -> None:
    exchange = EchoClock()
    exchange.add(10, 5, 4, 20)
    exchange.add(10, 5, 50, 20)
    exchange.add(10, 5, 5, 9)
    assert (exchange.refused, exchange.best(20)) == (3, None)
