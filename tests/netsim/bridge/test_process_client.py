"""A bridge's process that never says a word is waited for as long as it may take, and no longer."""

import itertools
from types import SimpleNamespace
from typing import Any, cast

import pytest

from vcmvsp.cosim.errors import FederateError
from vcmvsp.netsim.bridge import messages, process_client
from vcmvsp.netsim.bridge.process_client import BridgeClient

STEP_S = 7.0


class Silent:
    """A link to somebody who says nothing, and how long each wait was to be: one for less than no time has no end."""

    ended = False

    def __init__(self) -> None:
        self.waits: list[float] = []

    def wait(self, seconds: float) -> None:
        self.waits.append(seconds)

    def receive(self) -> list[bytes]:
        return []

    def send(self, message: bytes) -> bool:
        return True

    def close(self) -> None:
        pass


@pytest.fixture
def slow_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seconds pass between any two looks at the clock."""
    now = itertools.count(0.0, STEP_S)
    monkeypatch.setattr(process_client, "time", SimpleNamespace(monotonic=lambda: next(now)))


def silent() -> tuple[BridgeClient, Silent]:
    link = Silent()
    process = SimpleNamespace(pid=1, link=link, close=lambda _: False)
    opening = messages.Opening(run="run", folder=".", vehicles=("a",), gateways=(), payloads=False)
    return BridgeClient(cast("Any", process), opening), link


def test_doors_that_do_not_open_are_said_when_time_is_over(slow_clock: None) -> None:
    waiting, link = silent()
    with pytest.raises(FederateError, match="its gateways were not open after 60 s"):
        waiting.wait_ready()
    assert len(link.waits) == pytest.approx(process_client.READY_S / STEP_S, abs=1.0)
    assert min(link.waits) > 0.0


def test_one_that_does_not_leave_is_killed_when_time_is_over(slow_clock: None) -> None:
    waiting, link = silent()
    assert waiting.close() == []
    assert waiting.killed
    assert link.waits
    assert min(link.waits) > 0.0
