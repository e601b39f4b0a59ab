"""Waiting for a condition."""

import time
from collections.abc import Callable
from typing import Any


def wait_for(holds: Callable[[], Any], seconds: float = 60.0) -> Any:
    """Wait until ``holds`` returns a true value, and return it; fails after a timeout."""
    end_s = time.monotonic() + seconds
    while not (value := holds()):
        assert time.monotonic() < end_s, "not in time"
        time.sleep(0.01)
    return value
