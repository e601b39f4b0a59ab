"""Fixtures of hardware tests."""

import threading
import time
from collections.abc import Iterator

import pytest

from tests.support.cosim.run_processes import reserve_port

HELD_UP_NS = 100_000_000


@pytest.fixture
def steady(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A monotonic clock that skips delays of this process.

    For tests with a driver and its robot in one process: after a delay, each would consider the other one silent. A delay is
    the part beyond 0.1 s between two readings of the clock; a thread reads it every 10 ms.
    """
    real_ns, lock, over = time.monotonic_ns, threading.Lock(), threading.Event()
    shown_ns = looked_ns = real_ns()

    def now_ns() -> int:
        nonlocal shown_ns, looked_ns
        with lock:
            at_ns = real_ns()
            shown_ns += min(at_ns - looked_ns, HELD_UP_NS)
            looked_ns = at_ns
            return shown_ns

    def look() -> None:
        while not over.wait(0.01):
            now_ns()

    monkeypatch.setattr(time, "monotonic_ns", now_ns)
    monkeypatch.setattr(time, "monotonic", lambda: now_ns() / 1e9)
    looking = threading.Thread(target=look)
    looking.start()
    yield
    over.set()
    looking.join()


@pytest.fixture
def port() -> Iterator[int]:
    """A reserved port."""
    with reserve_port() as port:
        yield port
