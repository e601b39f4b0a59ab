"""The caller's side of a driver's thread, without any robot."""

import threading

import pytest

from vcmvsp.cosim.types import Odometry, Vec3
from vcmvsp.hardware.drivers.base import DriverError, HandshakeError, PortError, Sample
from vcmvsp.hardware.drivers.threaded import ThreadedDriver

SAMPLE = Sample(number=1, link=1, arrived_ns=1, measured_ns=1, odometry=Odometry(pose=(0.0, 0.0, 0.0), v=0.0, w=0.0))


class Fake(ThreadedDriver):
    """Works until it is closed, unless it is told to fail, or to hang."""

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
def test_a_stop_is_told_once_by_the_driver_unless_somebody_else_tells_of_it(elsewhere: bool) -> None:
    driver = Fake(elsewhere=elsewhere)
    driver.stop("before")
    driver.open()
    driver.stop("while it is open")
    assert causes(driver) == ["before"] + ["while it is open"] * (not elsewhere)
    driver.close()
    driver.stop("after")
    assert causes(driver) == ["after"]
    assert driver.held == ["while it is open"]


def test_a_sample_is_handed_over_once() -> None:
    driver = Fake()
    driver.open()
    assert [driver.read(), driver.read()] == [SAMPLE, None]
    assert driver.taken == 1
    driver.close()
    with pytest.raises(RuntimeError, match="nowhere is not open"):
        driver.read()


def test_what_ended_it_is_raised_and_forgotten_when_it_is_opened_again() -> None:
    driver = Fake(PortError("nowhere", "it is gone", "look for it"))
    with pytest.raises(PortError, match="it is gone"):
        driver.open()
    driver.fails = ValueError("boom")
    with pytest.raises(DriverError, match=r"the driver failed \(ValueError: boom\); report this"):
        driver.open()
    driver.fails = None
    driver.open()
    with pytest.raises(RuntimeError, match="nowhere is open already"):
        driver.open()
    driver.close()  # with a sample that nobody has read
    driver.fails = PortError("nowhere", "it is gone", "look for it")
    with pytest.raises(PortError):
        driver.open()
    assert driver._sample is None


def test_one_that_is_not_ready_in_time_hangs_and_is_closed() -> None:
    driver, before = Fake(hangs=True), threading.active_count()
    with pytest.raises(HandshakeError, match="the connection hangs; look at the network"):
        driver.open()
    assert threading.active_count() == before
