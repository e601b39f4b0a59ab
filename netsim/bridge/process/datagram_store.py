"""Datagrams of a bridge process, from reception until the run has settled them and all their deliveries are made."""

from collections import deque

from vcmvsp.netsim.bridge.gateways.base import BROADCAST, Gateway

MOST = 4096
MOST_BYTES = 16 * 2**20
"""Limits for each vehicle: a gateway stops reading from a program that sends more than the run takes."""

BATCH = 512
BATCH_OF_ONE = 128
BATCH_BYTES = 100_000
"""Largest batch: datagrams in total, of one vehicle, and bytes if payloads are sent to the run (or one longer datagram)."""

FIRST_SPOKEN = -(2**62)


class StoredDatagram:
    """A datagram."""

    __slots__ = ("arrived", "came_ns", "gateway", "payload", "sender", "settled", "to", "waiting")

    def __init__(self, gateway: Gateway | None, sender: int, to: int, payload: bytes, came_ns: int) -> None:
        self.gateway, self.sender, self.to, self.payload, self.came_ns = gateway, sender, to, payload, came_ns
        self.waiting = 0  # deliveries
        self.settled = self.arrived = False


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

    def put(self, gateway: Gateway | None, sender: int, to: int, payload: bytes, came_ns: int) -> bool:
        """Store a new datagram, unless its vehicle has too many; returns whether it was stored."""
        held_bytes = self._bytes[sender] + len(payload)
        if self._count[sender] >= MOST or held_bytes > MOST_BYTES:
            return False
        self._count[sender] += 1
        self._bytes[sender] = held_bytes
        came_ns = self._newest_ns[sender] = max(came_ns, self._newest_ns[sender])
        number, self._number = self._number, self._number + 1
        self._datagrams[number] = StoredDatagram(gateway, sender, to, payload, came_ns)
        self._new[sender].append(number)
        return True

    def speak(self, sender: int, payload: bytes) -> int:
        """Store an agent's payload until it is delivered; returns its number, below those of all datagrams of programs."""
        number, self._spoken = self._spoken, self._spoken + 1
        datagram = self._datagrams[number] = StoredDatagram(None, sender, BROADCAST, payload, 0)
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

    def left(self, number: int) -> None:
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
