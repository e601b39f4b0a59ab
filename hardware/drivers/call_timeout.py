"""Time-out of calls that may hang, so that a driver cannot keep a robot's port, nor outlive its run."""

import contextlib
import math
import signal
from collections.abc import Callable, Iterator
from types import FrameType

from vcmvsp.hardware.drivers.base import DriverError

TICK_S = 0.2


def nothing() -> str:
    """No reason to abort."""
    return ""


@contextlib.contextmanager
def within(seconds: float, device: str, doing: str, abort_reason: Callable[[], str] = nothing) -> Iterator[Callable[[], None]]:
    """Raise a `DriverError` inside the block if it takes longer, or as soon as ``abort_reason`` returns a text.

    It works in the main thread, by its alarm clock, which also interrupts sleep. It counts ticks instead of time, so that a
    process that was frozen does not time out. The yielded function restarts the time.
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
