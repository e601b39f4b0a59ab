"""Deliveries at their times, on an event loop with timers of microseconds."""

import asyncio
import heapq
import selectors
import time
from collections.abc import Callable
from typing import NamedTuple

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.util.polling import readable

AT_ONCE = 200  # deliveries, before others have their turn


class TimedDelivery(NamedTuple):
    """Delivery to one receiver; field order is the order of deliveries."""

    at_ns: int  # on ``time.monotonic_ns()``
    number: int  # of the datagram
    row: int  # number of the delivery
    receiver: int


class Pacer:
    """Calls ``leave`` with each delivery at its time, the earliest first."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        leave: Callable[[TimedDelivery], None],
        now: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._loop, self._leave, self._now = loop, leave, now
        self._heap: list[TimedDelivery] = []
        self._timer: asyncio.Handle | None = None
        self._armed_ns = 0  # when the timer goes off

    def put(self, delivery: TimedDelivery) -> None:
        """Add a delivery; call `arm` afterwards, once for any number of deliveries."""
        heapq.heappush(self._heap, delivery)

    def arm(self) -> None:
        """Set the timer to the next delivery."""
        if not self._heap or (self._timer is not None and self._armed_ns <= self._heap[0].at_ns):
            return
        if self._timer is not None:
            self._timer.cancel()
        self._armed_ns = self._heap[0].at_ns
        left_ns = self._armed_ns - self._now()
        if left_ns > 0:
            self._timer = self._loop.call_later(left_ns / SECOND_NS, self.turn)
        else:
            self._timer = self._loop.call_soon(self.turn)

    def turn(self) -> None:
        """Make all deliveries that are due."""
        self._timer = None
        heap, leave, now = self._heap, self._leave, self._now
        try:
            for _ in range(AT_ONCE):
                if not heap or heap[0].at_ns > now():
                    break
                leave(heapq.heappop(heap))
        finally:
            self.arm()


class FineSelector(selectors.EpollSelector):
    """An ``EpollSelector`` with waits in microseconds: the original waits for whole milliseconds."""

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Wait for readiness, at most ``timeout`` s (None: as long as it takes)."""
        if timeout is not None and timeout > 0.0:
            readable([self.fileno()], timeout)  # its own descriptor is readable when something is ready
            timeout = 0.0
        return super().select(timeout)


def new_loop() -> asyncio.AbstractEventLoop:
    """An event loop with a `FineSelector`; the caller closes it."""
    return asyncio.SelectorEventLoop(FineSelector())
