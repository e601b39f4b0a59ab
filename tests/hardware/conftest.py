"""What several tests of hardware ask for."""

import threading
import time
from collections.abc import Iterator

import pytest

from tests.support.cosim.run_processes import reserved

HELD_UP_NS = 100_000_000


@pytest.fixture
def steady(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A monotonic clock that leaves out the time in which this process was held up.

    It is for tests that have a driver and its robot in this process: held up, each takes the other for silent.
    A hold-up is what is beyond 0.1 s from one look at the clock to the next, and a thread looks at it every 10 ms.
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
    """A port that nobody else takes."""
    with reserved() as port:
        yield port
