"""A driver under test, open and commanded at wall-clock pace."""

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from tests.support.paths import ROOT
from vcmvsp.cosim.types import ORIGIN, Vec3, Velocity
from vcmvsp.hardware.drivers.base import Driver, DriverError, Sample

D = TypeVar("D", bound=Driver)

PATIENCE_S = 20.0  # for work of milliseconds on an idle machine


@contextmanager
def open_driver(driver: D, start: Vec3 = ORIGIN) -> Iterator[D]:
    """Open driver; closed twice at the end, which is allowed."""
    driver.open(start)
    try:
        yield driver
    finally:
        driver.close()
        driver.close()


def drive(driver: Driver, seconds: float, v: float = 0.0, w: float = 0.0) -> list[Any]:
    """Command a speed on the ground; returns the readings meanwhile."""
    return fly(driver, seconds, v, 0.0, 0.0, yaw_rate=w)


def fly(driver: Driver, seconds: float, *linear: float, yaw_rate: float = 0.0) -> list[Any]:
    """Command every 20 ms, for a time and until there is a reading; returns the readings, at least one."""
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


def eventually(condition: Callable[[], object], seconds: float = PATIENCE_S) -> None:
    """Wait until a condition holds."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.01)


def newest(driver: Driver) -> Any:
    """The next sample."""
    samples: list[Sample] = []
    eventually(lambda: (sample := driver.read()) is not None and not samples.append(sample))  # type: ignore[func-returns-value]
    return samples[-1]


def error_of(driver: Driver) -> DriverError | None:
    """Error that reading a driver raises, if it does."""
    try:
        driver.read()
    except DriverError as error:
        return error
    return None


@contextmanager
def module_process(name: str, *words: object) -> Iterator["subprocess.Popen[str]"]:
    """A module of these helpers in a process of its own, which is killed at the end."""
    command = [sys.executable, "-m", f"tests.support.hardware.{name}", *map(str, words)]
    with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def open_resources() -> set[str]:
    """Open files and threads of this process."""
    files = set()
    for number in Path("/proc/self/fd").iterdir():
        with suppress(OSError):  # the file of this listing
            files.add(f"{number.name} {number.readlink()}")
    return files | {f"{each.name} {each.ident}" for each in threading.enumerate()}


def rest(seconds: float) -> None:
    """Wait by the clock shared by driver and robot, which may omit time in which the process does not run."""
    end, tick = time.monotonic() + seconds, threading.Event()
    while time.monotonic() < end:
        tick.wait(0.01)
