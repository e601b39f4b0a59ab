"""Datagrams of a bridge process until the run has settled them, and their deliveries, on a loop with timers of microseconds."""

import asyncio
import heapq
import selectors
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.util.polling import readable
from vcmvsp.netsim.bridge.gateways.base import BROADCAST, Gateway

MOST = 4096
MOST_BYTES = 16 * 2**20
"""Limits for each vehicle: a gateway stops reading from a program that sends more than the run takes."""

BATCH = 512
BATCH_OF_ONE = 128
BATCH_BYTES = 100_000
"""Largest batch: datagrams in total, of one vehicle, and bytes if payloads are sent to the run (or one longer datagram)."""

FIRST_SPOKEN = -(2**62)

AT_ONCE = 200  # deliveries, before others have their turn


@dataclass(slots=True)
class StoredDatagram:
    """A datagram, from its reception until it is settled and all its deliveries are made."""

    gateway: Gateway | None
    sender: int
    to: int
    payload: bytes
    came_ns: int
    size_bytes: int  # payload on the channel
    radio: int = 0  # number of the radio, of several
    waiting: int = 0  # deliveries
    settled: bool = False
    arrived: bool = False


class DatagramStore:
    """Datagrams by number; bounded for each of ``vehicles`` vehicles. ``payloads``: batches are limited in bytes, too."""

    def __init__(self, vehicles: int, *, payloads: bool = False) -> None:
        self._datagrams: dict[int, StoredDatagram] = {}
        self._new: list[deque[int]] = [deque() for _ in range(vehicles)]  # by vehicle: numbers not sent to the run yet
        self._count, self._bytes = [0] * vehicles, [0] * vehicles
        self._newest_ns = [0] * vehicles
        self._number, self._first = 0, 0
        self._spoken = FIRST_SPOKEN
        self._batch_bytes = BATCH_BYTES if payloads else MOST_BYTES * vehicles

    def __len__(self) -> int:
        return len(self._datagrams)

    def __getitem__(self, number: int) -> StoredDatagram:
        return self._datagrams[number]

    def put(
        self,
        gateway: Gateway | None,
        sender: int,
        to: int,
        payload: bytes,
        came_ns: int,
        size_bytes: int | None = None,
        radio: int = 0,
    ) -> bool:
        """Store a new datagram, unless its vehicle has too many; returns whether it was stored.

        ``size_bytes``: payload on the channel; None: the length of ``payload``. ``radio``: its number, of several.
        """
        held_bytes = self._bytes[sender] + len(payload)
        if self._count[sender] >= MOST or held_bytes > MOST_BYTES:
            return False
        self._count[sender] += 1
        self._bytes[sender] = held_bytes
        came_ns = self._newest_ns[sender] = max(came_ns, self._newest_ns[sender])
        number, self._number = self._number, self._number + 1
        size = len(payload) if size_bytes is None else size_bytes
        self._datagrams[number] = StoredDatagram(gateway, sender, to, payload, came_ns, size, radio)
        self._new[sender].append(number)
        return True

    def speak(self, sender: int, payload: bytes, radio: int = 0) -> int:
        """Store an agent's payload until it is delivered; returns its number, below all numbers of programs' datagrams."""
        number, self._spoken = self._spoken, self._spoken + 1
        datagram = self._datagrams[number] = StoredDatagram(None, sender, BROADCAST, payload, 0, len(payload), radio)
        datagram.waiting, datagram.settled = 1, True
        return number

    def batch(self) -> list[int]:
        """Numbers of the next batch for the run, in the order of reception; vehicles take turns to be first."""
        numbers: list[int] = []
        room_bytes = self._batch_bytes
        for sender in (*range(self._first, len(self._new)), *range(self._first)):
            new = self._new[sender]
            for index in range(min(len(new), BATCH_OF_ONE)):
                size = len(self._datagrams[new[0]].payload)
                if len(numbers) == BATCH or (size > room_bytes and numbers):
                    self._first = sender + 1 if index else sender
                    return sorted(numbers)
                numbers.append(new.popleft())
                room_bytes -= size
        return sorted(numbers)

    def due(self, number: int) -> None:
        """Note a future delivery of a datagram."""
        datagram = self._datagrams[number]
        datagram.waiting += 1
        datagram.arrived = True

    def mark_delivered(self, number: int) -> None:
        """Note that a delivery was made."""
        datagram = self._datagrams[number]
        datagram.waiting -= 1
        if datagram.settled and not datagram.waiting:
            self._forget(number, datagram)

    def settle(self, number: int) -> StoredDatagram | None:
        """Note that no further delivery follows; returns the datagram if it was unicast and is lost."""
        datagram = self._datagrams[number]
        datagram.settled = True
        if not datagram.waiting:
            self._forget(number, datagram)
        return None if datagram.arrived or datagram.to == BROADCAST else datagram

    def _forget(self, number: int, datagram: StoredDatagram) -> None:
        del self._datagrams[number]
        if number >= 0:
            self._count[datagram.sender] -= 1
            self._bytes[datagram.sender] -= len(datagram.payload)


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
