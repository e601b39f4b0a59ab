"""A driver of tests, open and commanded at the pace of the wall clock."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeVar

from vcmvsp.cosim.types import ORIGIN, Vec3, Velocity
from vcmvsp.hardware.drivers.base import Driver, Sample

D = TypeVar("D", bound=Driver)

PATIENCE_S = 20.0  # for what takes milliseconds on a machine that is not loaded


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
    """Command this every 20 ms, for so long and until something was heard; what was heard meanwhile, which is never nothing."""
    samples: list[Sample] = []
    end = time.monotonic() + seconds
    last = end + PATIENCE_S
    while not samples or time.monotonic() < end:
        driver.write(Velocity(linear=(linear[0], linear[1], linear[2]), yaw_rate=yaw_rate))
        time.sleep(0.02)
        if (sample := driver.read()) is not None:
            samples.append(sample)
        assert time.monotonic() < last, "nothing was heard"
    return samples


def eventually(what: Callable[[], object], seconds: float = PATIENCE_S) -> None:
    """Wait until it is true."""
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.01)


def held() -> set[str]:
    """What this process holds: open files, and threads."""
    files = set()
    for number in Path("/proc/self/fd").iterdir():
        with suppress(OSError):  # that of this list
            files.add(f"{number.name} {number.readlink()}")
    return files | {f"{each.name} {each.ident}" for each in threading.enumerate()}


def rest(seconds: float) -> None:
    """Wait for so long by the clock that driver and robot have, which may leave out what this process is held up."""
    end, tick = time.monotonic() + seconds, threading.Event()
    while time.monotonic() < end:
        tick.wait(0.01)
