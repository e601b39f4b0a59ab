"""Live clock: pause, steps, and changes of speed during a run."""

from collections.abc import Callable
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.clock import LISTEN_NS, SECOND_NS, Clock, LiveClock


class LiveWall:
    """A wall clock that moves only by sleeping; ``acts`` are executed at given wall times, ns."""

    def __init__(self, speed: float | None, acts: dict[int, Callable[[LiveClock], None]] | None = None) -> None:
        self.now_ns, self.acts = 0, dict(acts or {})
        self.clock = LiveClock(speed, self.listen, now=lambda: self.now_ns, sleep=self.sleep)
        self.clock.start()

    def listen(self) -> None:
        for when in [each for each in self.acts if each <= self.now_ns]:
            self.acts.pop(when)(self.clock)

    def sleep(self, seconds: float) -> None:
        self.now_ns += max(1, round(Fraction(seconds) * SECOND_NS))


def pause(clock: LiveClock) -> None:
    clock.go(paused=True, speed=clock.speed)


def go_on(clock: LiveClock) -> None:
    clock.go(paused=False, speed=clock.speed)


def test_it_is_a_clock() -> None:
    clock: Clock = LiveClock(None, lambda: None)
    clock.start()
    assert (clock.speed, clock.wait_until(SECOND_NS), clock.slipped_ns) == (None, 0, 0)


@given(st.floats(0.1, 100.0), st.lists(st.integers(1, SECOND_NS), max_size=20))
def test_by_default_it_follows_the_wall(speed: float, gaps: list[int]) -> None:
    watched, due_ns = LiveWall(speed), 0
    for gap in gaps:
        due_ns += gap
        assert watched.clock.wait_until(due_ns) <= 1
        assert watched.now_ns == pytest.approx(due_ns / speed, abs=1 + len(gaps))


def test_without_a_speed_it_never_waits() -> None:
    watched = LiveWall(None)
    assert [watched.clock.wait_until(each * SECOND_NS) for each in range(100)] == [0] * 100
    assert watched.now_ns == 0


@pytest.mark.parametrize("speed", [None, 2.0])
def test_a_pause_stops_time_and_is_not_caught_up(speed: float | None) -> None:
    watched = LiveWall(speed, {SECOND_NS: go_on})
    pause(watched.clock)
    assert watched.clock.wait_until(SECOND_NS) == 0
    assert watched.now_ns >= SECOND_NS + (SECOND_NS / speed if speed else 0)
    assert watched.now_ns <= SECOND_NS + (SECOND_NS / speed if speed else 0) + 2 * LISTEN_NS


def test_a_step_ends_after_its_length() -> None:
    watched = LiveWall(None, {SECOND_NS: go_on})
    watched.clock.wait_until(SECOND_NS)
    watched.clock.go(paused=True, speed=None, step_ns=100)
    for due_ns in (SECOND_NS + 1, SECOND_NS + 100):
        watched.clock.wait_until(due_ns)
        assert watched.now_ns == 0
    watched.clock.wait_until(SECOND_NS + 101)
    assert watched.now_ns >= SECOND_NS


def test_a_new_speed_applies_from_now_on_also_during_a_wait() -> None:
    watched = LiveWall(1.0)
    watched.clock.wait_until(SECOND_NS)
    watched.clock.go(paused=False, speed=10.0)
    watched.clock.wait_until(2 * SECOND_NS)
    assert watched.now_ns == SECOND_NS + SECOND_NS // 10
    watched = LiveWall(0.001, {SECOND_NS // 2: lambda clock: clock.go(paused=False, speed=None)})
    assert watched.clock.wait_until(SECOND_NS) == 0
    assert watched.now_ns <= SECOND_NS // 2 + 2 * LISTEN_NS


def test_a_slip_is_not_caught_up() -> None:
    watched = LiveWall(1.0)
    watched.now_ns = 3 * SECOND_NS
    assert watched.clock.wait_until(SECOND_NS) == 2 * SECOND_NS
    watched.clock.slip(2 * SECOND_NS)
    assert watched.clock.wait_until(2 * SECOND_NS) == 0
    assert (watched.now_ns, watched.clock.slipped_ns) == (4 * SECOND_NS, 2 * SECOND_NS)
