"""When which velocity is said: laws, in simulated time."""

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.hardware.drivers.command_repeater import NOT_YET, CommandRepeater

MS = 10**6
Speeds = tuple[float, float]
ZERO: Speeds = (0.0, 0.0)


def said(pace: CommandRepeater[Speeds], now_ns: int) -> list[Speeds]:
    speeds = []
    while (each := pace.advance(now_ns)) is not None:
        speeds.append(each)
    return speeds


def test_zero_comes_first_then_the_newest_command_at_once_and_again_at_its_rate() -> None:
    pace = CommandRepeater(ZERO, 0.5, again_ns=100 * MS)
    assert pace.stopped == NOT_YET
    pace.command((0.1, 0.0), 0)
    pace.command((0.2, 0.1), 0)
    assert said(pace, 0) == [ZERO, (0.2, 0.1)]
    assert pace.due_ns == 100 * MS
    assert said(pace, 99 * MS) == []
    assert said(pace, 100 * MS) == [(0.2, 0.1)]
    pace.command((0.3, 0.0), 120 * MS)
    assert pace.due_ns <= 120 * MS
    assert said(pace, 120 * MS) == [(0.3, 0.0)]


def test_without_commands_it_says_zero_and_goes_on_saying_it() -> None:
    pace = CommandRepeater(ZERO, 0.5, again_ns=1000 * MS)
    pace.command((0.2, 0.1), 0)
    said(pace, 0)
    assert pace.due_ns == 500 * MS
    assert said(pace, 500 * MS) == [ZERO]
    assert pace.stopped == "no command for 0.5 s"
    assert said(pace, 1500 * MS) == [ZERO]


def test_a_stop_is_said_ahead_of_the_command_that_follows() -> None:
    pace = CommandRepeater(ZERO, 0.5, again_ns=100 * MS)
    pace.command((0.2, 0.0), 0)
    said(pace, 0)
    pace.command((0.4, 0.0), MS)
    pace.stop("enough")
    pace.command((0.1, 0.0), 2 * MS)
    assert said(pace, 2 * MS) == [ZERO, (0.1, 0.0)]
    assert pace.stopped == ""


@given(least=st.integers(1, 200), again=st.integers(1, 500), gaps=st.lists(st.integers(1, 300), min_size=1, max_size=20))
def test_between_two_there_is_a_least_time_and_at_rest_a_steady_one(least: int, again: int, gaps: list[int]) -> None:
    """Asked only when it says that it is due, or commanded."""
    pace = CommandRepeater(ZERO, 10.0, again_ns=again, least_ns=least)
    times, now, given_at = [], 0, [sum(gaps[: each + 1]) for each in range(len(gaps))]
    while now < given_at[-1] + least + 2 * again + 2:
        if now in given_at:
            pace.command((1.0, 0.0), now)
        if pace.advance(now) is not None:
            times.append(now)
        now = min([max(now + 1, pace.due_ns), *(each for each in given_at if each > now)])
    apart = [b - a for a, b in pairwise(times)]
    assert all(min(least, again) <= each <= max(least, again) for each in apart)
    assert apart[-1] == again


def test_where_there_is_a_least_time_a_stop_waits_for_none_and_is_said_again_after_it() -> None:
    pace = CommandRepeater(ZERO, 0.5, again_ns=200 * MS, least_ns=100 * MS)
    said(pace, 0)
    pace.command((0.2, 0.0), MS)
    assert said(pace, 100 * MS) == [(0.2, 0.0)]
    pace.stop("geofence")
    assert said(pace, 110 * MS) == [ZERO]
    assert said(pace, 209 * MS) == []
    assert said(pace, 210 * MS) == [ZERO]
    assert said(pace, 409 * MS) == []
    assert said(pace, 410 * MS) == [ZERO]
