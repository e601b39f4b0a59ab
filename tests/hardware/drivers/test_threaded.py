"""Driver thread without a robot, and the command schedule in simulated time."""

import threading
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.types import Odometry, Vec3
from vcmvsp.hardware.drivers.base import DriverError, HandshakeError, PortError, Sample
from vcmvsp.hardware.drivers.threaded import NOT_YET, ClosedByCaller, CommandRepeater, ReconnectingDriver, ThreadedDriver

SAMPLE = Sample(number=1, link=1, arrived_ns=1, measured_ns=1, odometry=Odometry(pose=(0.0, 0.0, 0.0), v=0.0, w=0.0))


class Fake(ThreadedDriver):
    """Works until closed, unless set to fail or to hang."""

    def __init__(self, fails: Exception | None = None, *, hangs: bool = False, elsewhere: bool = False) -> None:
        super().__init__("nowhere", open_deadline_s=0.05 if hangs else 10.0, close_deadline_s=10.0)
        self.fails, self.hangs, self.elsewhere = fails, hangs, elsewhere
        self.taken, self.held = 0, list[str]()

    def _prepare(self, start: Vec3) -> None:
        self._woken = threading.Event()

    def _was_read(self) -> None:
        self.taken += 1

    def _hold(self, cause: str) -> bool:
        self.held.append(cause)
        return self.elsewhere

    def _wake(self) -> None:
        if self._thread is not None:
            self._woken.set()

    def _work(self) -> None:
        if self.fails is not None:
            raise self.fails
        with self._lock:
            self._sample = SAMPLE
        if not self.hangs:
            self._ready.set()
        while not self._closing.is_set():
            self._woken.wait(10.0)


def causes(driver: ThreadedDriver) -> list[str]:
    return [each.cause for each in driver.notices()]


@pytest.mark.parametrize("elsewhere", [False, True])
def test_a_stop_gives_one_notice_unless_reported_elsewhere(elsewhere: bool) -> None:
    driver = Fake(elsewhere=elsewhere)
    driver.stop("before")
    driver.open()
    driver.stop("while it is open")
    assert causes(driver) == ["before"] + ["while it is open"] * (not elsewhere)
    driver.close()
    driver.stop("after")
    assert causes(driver) == ["after"]
    assert driver.held == ["while it is open"]


def test_a_sample_is_returned_once() -> None:
    driver = Fake()
    driver.open()
    assert [driver.read(), driver.read()] == [SAMPLE, None]
    assert driver.taken == 1
    driver.close()
    with pytest.raises(RuntimeError, match="nowhere is not open"):
        driver.read()


def test_its_error_is_raised_and_cleared_on_reopening() -> None:
    driver = Fake(PortError("nowhere", "it is gone", "look for it"))
    with pytest.raises(PortError, match="it is gone"):
        driver.open()
    driver.fails = ValueError("boom")
    with pytest.raises(DriverError, match=r"the driver failed \(ValueError: boom\); report this"):
        driver.open()
    driver.fails = None
    driver.open()
    with pytest.raises(RuntimeError, match="nowhere is already open"):
        driver.open()
    driver.close()  # with an unread sample
    driver.fails = PortError("nowhere", "it is gone", "look for it")
    with pytest.raises(PortError):
        driver.open()
    assert driver._sample is None


def test_a_driver_not_ready_in_time_is_closed() -> None:
    driver, before = Fake(hangs=True), threading.active_count()
    with pytest.raises(HandshakeError, match="the connection hangs; check the network"):
        driver.open()
    assert threading.active_count() == before


class Stuck(ReconnectingDriver):
    """Its thread does not look at what wakes it until the driver closes, as in a call of the system that hangs."""

    def _connect(self, within_s: float) -> None:
        self._ready.set()

    def _converse(self) -> None:
        self._closing.wait(600.0)
        raise ClosedByCaller


def test_a_caller_never_waits_for_a_thread_that_hangs() -> None:
    driver = Stuck("nowhere", connect_s=10.0, silence_s=1.0, reconnect_s=0.0, open_deadline_s=10.0, close_deadline_s=10.0)
    driver.open()
    for _ in range(70_000):  # a pipe holds 65,536 bytes
        driver._wake()
    driver.close()


MS = 10**6
Speeds = tuple[float, float]
ZERO: Speeds = (0.0, 0.0)


def due_speeds(pace: CommandRepeater[Speeds], now_ns: int) -> list[Speeds]:
    speeds = []
    while (each := pace.advance(now_ns)) is not None:
        speeds.append(each)
    return speeds


def test_zero_comes_first_then_the_newest_command_at_once_and_again_at_its_rate() -> None:
    pace = CommandRepeater(ZERO, 0.5, again_ns=100 * MS)
    assert pace.stopped == NOT_YET
    pace.command((0.1, 0.0), 0)
    pace.command((0.2, 0.1), 0)
    assert due_speeds(pace, 0) == [ZERO, (0.2, 0.1)]
    assert pace.due_ns == 100 * MS
    assert due_speeds(pace, 99 * MS) == []
    assert due_speeds(pace, 100 * MS) == [(0.2, 0.1)]
    pace.command((0.3, 0.0), 120 * MS)
    assert pace.due_ns <= 120 * MS
    assert due_speeds(pace, 120 * MS) == [(0.3, 0.0)]


def test_without_commands_it_repeats_zero() -> None:
    pace = CommandRepeater(ZERO, 0.5, again_ns=1000 * MS)
    pace.command((0.2, 0.1), 0)
    due_speeds(pace, 0)
    assert pace.due_ns == 500 * MS
    assert due_speeds(pace, 500 * MS) == [ZERO]
    assert pace.stopped == "no command for 0.5 s"
    assert due_speeds(pace, 1500 * MS) == [ZERO]


def test_a_stop_is_sent_before_the_next_command() -> None:
    pace = CommandRepeater(ZERO, 0.5, again_ns=100 * MS)
    pace.command((0.2, 0.0), 0)
    due_speeds(pace, 0)
    pace.command((0.4, 0.0), MS)
    pace.stop("enough")
    pace.command((0.1, 0.0), 2 * MS)
    assert due_speeds(pace, 2 * MS) == [ZERO, (0.1, 0.0)]
    assert pace.stopped == ""


@given(least=st.integers(1, 200), again=st.integers(1, 500), gaps=st.lists(st.integers(1, 300), min_size=1, max_size=20))
def test_intervals_have_a_minimum_and_a_steady_rate_at_rest(least: int, again: int, gaps: list[int]) -> None:
    """Called only when due or commanded."""
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


def test_a_stop_ignores_the_least_interval_and_is_repeated_after_it() -> None:
    pace = CommandRepeater(ZERO, 0.5, again_ns=200 * MS, least_ns=100 * MS)
    due_speeds(pace, 0)
    pace.command((0.2, 0.0), MS)
    assert due_speeds(pace, 100 * MS) == [(0.2, 0.0)]
    pace.stop("geofence")
    assert due_speeds(pace, 110 * MS) == [ZERO]
    assert due_speeds(pace, 209 * MS) == []
    assert due_speeds(pace, 210 * MS) == [ZERO]
    assert due_speeds(pace, 409 * MS) == []
    assert due_speeds(pace, 410 * MS) == [ZERO]
