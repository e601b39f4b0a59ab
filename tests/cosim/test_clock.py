"""Logical time against rational arithmetic; clocks that pace it, with a simulated wall clock."""

from collections.abc import Callable
from decimal import Decimal
from fractions import Fraction
from math import floor

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from vcmvsp.cosim.clock import SECOND_NS, Clock, SimClock, Ticks, WallClock, seconds_to_ns

pytestmark = pytest.mark.slow

PERIODS_NS = st.fractions(min_value=1, max_value=10**11, max_denominator=10**6)
TICKS = PERIODS_NS.map(lambda period: Ticks(period.numerator, period.denominator))
DECIMALS = st.decimals(min_value="0.000000001", max_value=10_000, places=9)


@given(DECIMALS)
def test_a_decimal_of_nine_places_is_exact_in_nanoseconds(seconds: Decimal) -> None:
    assume(Decimal(repr(float(seconds))) == seconds)  # a float keeps 15 digits
    assert seconds_to_ns(float(seconds)) == int(seconds * SECOND_NS)


def test_seconds_are_the_decimals_as_written() -> None:
    assert (seconds_to_ns(0.1), seconds_to_ns(0.3)) == (100_000_000, 300_000_000)
    assert sum(seconds_to_ns(0.1) for _ in range(10_000)) == seconds_to_ns(1000.0)
    assert seconds_to_ns(-0.1) == -100_000_000


@pytest.mark.parametrize("hz", [3, 7, 30, 60, 120, 240, 1000])
def test_a_rate_never_drifts(hz: int) -> None:
    ticks = Ticks.rate(float(hz))
    for second in (1, 1000, 10**6):
        assert ticks.at(hz * second) == second * SECOND_NS
    assert ticks.at(1) == SECOND_NS // hz


@pytest.mark.parametrize("period_s", ["0.1", "0.2", "0.05", "0.013", "0.3", "1e-9"])
def test_a_period_never_drifts(period_s: str) -> None:
    ticks = Ticks.every(float(period_s))
    for k in (0, 1, 3, 10**6, 10**12):
        assert ticks.at(k) == floor(Fraction(period_s) * SECOND_NS * k)


@given(TICKS, st.integers(0, 10**12))
def test_a_tick_is_its_exact_time_rounded_down(ticks: Ticks, k: int) -> None:
    assert ticks.at(k) == floor(k * ticks.period)


@given(TICKS, st.integers(0, 10**18), st.integers(0, 10**9))
def test_after_is_the_first_later_tick(ticks: Ticks, now_ns: int, k: int) -> None:
    later = ticks.after(now_ns)
    near = round(later / ticks.period)
    number = next(n for n in (near - 1, near, near + 1) if ticks.at(n) == later)  # a tick
    assert ticks.at(number - 1) <= now_ns < later
    assert ticks.after(ticks.at(k)) == ticks.at(k + 1)
    assert ticks.after(-1 - now_ns) == 0


@given(TICKS, st.integers(0, 10**9), st.integers(0, 10**12))
def test_only_ticks_hit(ticks: Ticks, k: int, now_ns: int) -> None:
    assert ticks.hits(ticks.at(k))
    nearest = floor(now_ns / ticks.period)
    assert ticks.hits(now_ns) == (now_ns in (ticks.at(nearest), ticks.at(nearest + 1)))
    assert not ticks.hits(-1)


@given(PERIODS_NS, st.integers(1, 1000), st.integers(0, 10**6))
def test_ticks_of_a_multiple_are_ticks(period: Fraction, times: int, k: int) -> None:
    fine = Ticks(period.numerator, period.denominator)
    coarse = Ticks((period * times).numerator, (period * times).denominator)
    assert coarse.is_multiple_of(fine)
    assert fine.hits(coarse.at(k))
    assert fine.is_multiple_of(coarse) == (times == 1)


@pytest.mark.parametrize(
    ("period_s", "rate_hz", "fits"),
    [(0.1, 120, True), (0.05, 240, True), (1.0, 3, True), (0.013, 120, False), (0.1, 128, False)],
)
def test_which_agent_periods_are_whole_physics_steps(period_s: float, rate_hz: float, fits: bool) -> None:
    assert Ticks.every(period_s).is_multiple_of(Ticks.rate(rate_hz)) is fits


@pytest.mark.parametrize(("make", "value"), [(Ticks.every, 1e-10), (Ticks.every, 0.0), (Ticks.every, -0.1), (Ticks.rate, 2e9)])
def test_a_period_below_a_nanosecond_is_refused(make: Callable[[float], Ticks], value: float) -> None:
    with pytest.raises(ValueError, match="at least one nanosecond"):
        make(value)


class FakeWall:
    """A wall clock that moves only by sleeping; each sleep takes ``factor`` times the requested time."""

    def __init__(self, now_ns: int, factor: Fraction = Fraction(1)) -> None:
        self.now_ns, self.factor = now_ns, factor
        self.slept: list[float] = []

    def now(self) -> int:
        return self.now_ns

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now_ns += max(1, round(Fraction(seconds) * SECOND_NS * self.factor))

    def clock(self, speed: float = 1.0) -> WallClock:
        clock = WallClock(speed, now=self.now, sleep=self.sleep)
        clock.start()
        return clock


@pytest.mark.parametrize("speed", [0.25, 1.0, 2.0, 10.0])
def test_the_wall_clock_follows_the_wall_at_its_speed(speed: float) -> None:
    wall = FakeWall(now_ns=123_456_789)
    clock = wall.clock(speed)
    for due_ns in range(0, 10 * SECOND_NS, SECOND_NS // 4):
        assert clock.wait_until(due_ns) == 0
        assert wall.now_ns == 123_456_789 + due_ns / speed


def test_a_sleep_that_ends_early_is_continued() -> None:
    wall = FakeWall(0, factor=Fraction(1, 2))
    assert wall.clock().wait_until(SECOND_NS) >= 0
    assert wall.now_ns >= SECOND_NS
    assert len(wall.slept) > 1


def test_a_sleep_that_ends_late_is_reported_and_caught_up() -> None:
    wall = FakeWall(0, factor=Fraction(3, 2))
    clock = wall.clock()
    assert clock.wait_until(SECOND_NS) == SECOND_NS // 2
    assert clock.wait_until(SECOND_NS + SECOND_NS // 4) == SECOND_NS // 4  # no sleep: already late
    assert len(wall.slept) == 1
    wall.factor = Fraction(1)
    assert clock.wait_until(3 * SECOND_NS) == 0
    assert wall.now_ns == 3 * SECOND_NS  # lateness does not accumulate


def test_lateness_without_sleep_is_the_wall_time_passed() -> None:
    wall = FakeWall(5)
    clock = wall.clock(2.0)
    wall.now_ns += 3 * SECOND_NS
    assert clock.wait_until(2 * SECOND_NS) == 2 * SECOND_NS
    assert wall.slept == []


@given(
    st.sampled_from([0.5, 1.0, 2.0]),
    st.lists(st.tuples(st.integers(0, SECOND_NS), st.integers(0, SECOND_NS)), min_size=1, max_size=8),
    st.integers(0, SECOND_NS),
)
def test_a_slip_stops_logical_time_and_keeps_earlier_times(speed: float, walk: list[tuple[int, int]], later_ns: int) -> None:
    wall = FakeWall(7)
    clock = wall.clock(speed)
    known = [(0, round(-7 * speed))]  # wall time, logical time; ns
    for goes_ns, stands_ns in walk:
        known.append((wall.now_ns + goes_ns // 2, clock.logical_ns(wall.now_ns + goes_ns // 2)))
        wall.now_ns += goes_ns
        known.append((wall.now_ns, clock.logical_ns(wall.now_ns)))
        known.append((wall.now_ns + stands_ns // 2, known[-1][1]))
        wall.now_ns += stands_ns
        clock.slip(stands_ns)
        known.append((wall.now_ns, known[-1][1]))
    known.append((wall.now_ns + later_ns, known[-1][1] + round(later_ns * speed)))
    found = [clock.logical_ns(when_ns) for when_ns, _ in known]
    assert found == sorted(found)
    assert all(abs(now - was) <= 1 for now, (_, was) in zip(found, known, strict=True))  # rounding


def test_after_a_slip_times_continue_from_the_late_instant() -> None:
    wall = FakeWall(0)
    clock = wall.clock()
    assert clock.wait_until(SECOND_NS) == 0
    wall.now_ns += 3 * SECOND_NS
    clock.slip(clock.wait_until(2 * SECOND_NS))
    assert [clock.logical_ns(each * SECOND_NS) for each in range(7)] == [each * SECOND_NS for each in (0, 1, 2, 2, 2, 3, 4)]
    assert clock.monotonic_ns(3 * SECOND_NS) == 5 * SECOND_NS


@pytest.mark.parametrize("speed", [0.0, -1.0, float("inf"), float("nan")])
def test_a_speed_is_positive_and_finite(speed: float) -> None:
    with pytest.raises(ValueError, match="positive"):
        WallClock(speed)


@given(st.lists(st.integers(0, 10**18)))
def test_simulated_time_jumps_and_is_never_late(dues: list[int]) -> None:
    clock: Clock = SimClock()
    clock.start()
    assert [clock.wait_until(due) for due in dues] == [0] * len(dues)
