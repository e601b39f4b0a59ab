"""Calls that may hang, with an end: a driver that does not come back must not keep a robot's port, nor outlive its run."""

import contextlib
import math
import signal
from collections.abc import Callable, Iterator
from types import FrameType

from vcmvsp.hardware.drivers.base import DriverError

TICK_S = 0.2


def nothing() -> str:
    """No reason to give up."""
    return ""


@contextlib.contextmanager
def within(seconds: float, device: str, doing: str, abort_reason: Callable[[], str] = nothing) -> Iterator[Callable[[], None]]:
    """Raise a `DriverError` in what is done here if it takes longer, or as soon as ``given_up`` tells a reason.

    In the main thread, by its alarm clock, which also wakes what sleeps. Ticks are counted and not time, so that a process
    that was frozen does not take itself for one that hangs. What is yielded lets the time begin anew.
    """
    ticks = most = math.ceil(seconds / TICK_S)

    def begin_anew() -> None:
        nonlocal ticks
        ticks = most

    def tick(_number: int, _frame: FrameType | None) -> None:
        nonlocal ticks
        ticks -= 1
        if reason := abort_reason():
            raise DriverError(device, reason, f"it was {doing}")
        if ticks <= 0:
            happened = f"it hangs: {doing} took longer than {seconds:g} s"
            raise DriverError(device, happened, "unplug it and plug it in again, and look at its driver")

    before = signal.signal(signal.SIGALRM, tick)
    signal.setitimer(signal.ITIMER_REAL, TICK_S, TICK_S)
    try:
        yield begin_anew
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
