"""Media that simulate the radios as state machines over one queue of events."""

import heapq
from collections import deque
from collections.abc import Sequence
from enum import IntEnum
from typing import Generic, TypeVar

import numpy as np

from vcmvsp.netsim.interfaces.medium import Decided, Fate, Offered


class QueuedRadio:
    """A radio, and the frames that wait for it."""

    def __init__(self, row: int) -> None:
        self.row = row
        self.queue: list[tuple[int, int, Offered]] = []  # heap: higher priorities first, then first come, first served


K = TypeVar("K", bound=IntEnum)
R = TypeVar("R", bound=QueuedRadio)


class EventMedium(Generic[K, R]):
    """Base of a `netsim.interfaces.medium.Medium` with its own events; at the same time, events come before offers.

    Args:
        radios: all radios, by row.
        queue_frames: maximum number of frames at a sender, with the frame on the air; None: no limit.
    """

    def __init__(self, radios: Sequence[R], queue_frames: int | None) -> None:
        self._radios, self._limit = radios, queue_frames
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

    def _admit(self, frame: Offered, *, sends: bool) -> bool:
        """Put a frame into the queue of its sender, unless it is full; ``sends``: the sender has one more frame."""
        queue = self._radios[frame.sender].queue
        if self._limit is not None and len(queue) + sends >= self._limit:
            self._refuse(frame, frame.time_ns, Fate.QUEUE_FULL)
            return False
        self._running += 1
        heapq.heappush(queue, (-frame.priority, self._running, frame))
        return True

    def _refuse(self, frame: Offered, now_ns: int, fate: Fate) -> None:
        """Decide a frame that was never sent."""
        count = len(self._radios)
        self._decide(Decided(frame.number, -1, now_ns, 0, np.full(count, fate, np.uint8), np.full(count, np.nan)))

    def _decide(self, decided: Decided) -> None:
        self._decided.append(decided)

    def _enqueue(self, frame: Offered) -> None:
        """Process an offer."""
        raise NotImplementedError

    def _happen(self) -> None:
        """Remove the first event of the heap, and process it."""
        raise NotImplementedError
