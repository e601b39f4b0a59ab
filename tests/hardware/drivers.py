"""A driver of tests, open and commanded at the pace of the wall clock."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from cosim.types import Vec3, Velocity
from hardware.driver import ORIGIN, Driver, Sample

D = TypeVar("D", bound=Driver)


@contextmanager
def connected(driver: D, start: Vec3 = ORIGIN) -> Iterator[D]:
    """Open; closed twice at the end, which is allowed."""
    driver.open(start)
    try:
        yield driver
    finally:
        driver.close()
        driver.close()


def drive(driver: Driver, seconds: float, v: float = 0.0, w: float = 0.0) -> list[Sample]:
    """Command this on the ground; what was heard meanwhile."""
    return fly(driver, seconds, v, 0.0, 0.0, yaw_rate=w)


def fly(driver: Driver, seconds: float, *linear: float, yaw_rate: float = 0.0) -> list[Sample]:
    """Command this every 20 ms; what was heard meanwhile."""
    samples, end = [], time.monotonic() + seconds
    while time.monotonic() < end:
        driver.write(Velocity(linear=(linear[0], linear[1], linear[2]), yaw_rate=yaw_rate))
        time.sleep(0.02)
        if (sample := driver.read()) is not None:
            samples.append(sample)
    return samples


def eventually(what: Callable[[], object], seconds: float = 20.0) -> None:
    """Wait until it is true."""
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.01)
