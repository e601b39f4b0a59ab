"""Media that simulate the radios as state machines over one queue of events."""

from collections import deque
from collections.abc import Sequence
from enum import IntEnum
from typing import Generic, TypeVar

from vcmvsp.netsim.interfaces.medium import Decided, Offered

K = TypeVar("K", bound=IntEnum)
R = TypeVar("R")


class EventMedium(Generic[K, R]):
    """Base of a `netsim.interfaces.medium.Medium` with its own events; at the same time, events come before offers."""

    def __init__(self) -> None:
        self._events: list[tuple[int, K, int, R, int]] = []  # heap: time, kind, running number, radio, stamp of the radio
        self._offers: deque[Offered] = deque()
        self._running = 0
        self._decided: list[Decided] = []

    def expect(self, frames: int) -> None:
        """Do nothing: this medium has no compiled code."""

    def offer(self, frame: Offered) -> None:
        """Hand over a frame."""
        self._offers.append(frame)

    def advance(self, until_ns: int) -> Sequence[Decided]:
        """Process all events and offers up to ``until_ns``."""
        events, offers = self._events, self._offers
        while True:
            event_ns = events[0][0] if events else until_ns + 1
            if offers and offers[0].time_ns < event_ns:
                if offers[0].time_ns > until_ns:
                    break
                self._enqueue(offers.popleft())
            elif event_ns <= until_ns:
                self._happen()
            else:
                break
        decided, self._decided = self._decided, []
        return decided

    def _enqueue(self, frame: Offered) -> None:
        """Put a frame into the queue of its sender."""
        raise NotImplementedError

    def _happen(self) -> None:
        """Remove the first event of the heap, and process it."""
        raise NotImplementedError
