"""The datagrams that a bridge process holds: until the run has taken them, decided on them, and all that arrives has left."""

from collections import deque

from vcmvsp.netsim.bridge.gateways.base import BROADCAST, Door

MOST = 4096
MOST_BYTES = 16 * 2**20
"""Of a vehicle, at a time: who sends more than the run deals with is told so."""

BATCH = 512
BATCH_OF_ONE = 128
BATCH_BYTES = 100_000
"""What the run is given at once: of all, of a vehicle, and of bytes where these go along (if no datagram alone is longer)."""

FIRST_SPOKEN = -(2**62)


class Kept:
    """A datagram."""

    __slots__ = ("arrived", "came_ns", "door", "payload", "sender", "settled", "to", "waiting")

    def __init__(self, door: Door | None, sender: int, to: int, payload: bytes, came_ns: int) -> None:
        self.door, self.sender, self.to, self.payload, self.came_ns = door, sender, to, payload, came_ns
        self.waiting = 0  # deliveries
        self.settled = self.arrived = False


class Store:
    """All of them, by number; bounded for each vehicle.

    Args:
        vehicles: how many.
        payloads: whether batches are limited in bytes, too.
    """

    def __init__(self, vehicles: int, *, payloads: bool = False) -> None:
        self._kept: dict[int, Kept] = {}
        self._new: list[deque[int]] = [deque() for _ in range(vehicles)]  # of a vehicle, that the run does not know of
        self._count, self._bytes = [0] * vehicles, [0] * vehicles
        self._newest_ns = [0] * vehicles
        self._number, self._first = 0, 0
        self._spoken = FIRST_SPOKEN
        self._batch_bytes = BATCH_BYTES if payloads else MOST_BYTES * vehicles

    def __len__(self) -> int:
        return len(self._kept)

    def __getitem__(self, number: int) -> Kept:
        return self._kept[number]

    def put(self, door: Door | None, sender: int, to: int, payload: bytes, came_ns: int) -> bool:
        """Keep one that is new, unless its vehicle has too many: whether it was taken."""
        held_bytes = self._bytes[sender] + len(payload)
        if self._count[sender] >= MOST or held_bytes > MOST_BYTES:
            return False
        self._count[sender] += 1
        self._bytes[sender] = held_bytes
        came_ns = self._newest_ns[sender] = max(came_ns, self._newest_ns[sender])
        number, self._number = self._number, self._number + 1
        self._kept[number] = Kept(door, sender, to, payload, came_ns)
        self._new[sender].append(number)
        return True

    def speak(self, sender: int, payload: bytes) -> int:
        """Keep what an agent said until it has `left`; its number is less than those of all datagrams."""
        number, self._spoken = self._spoken, self._spoken + 1
        kept = self._kept[number] = Kept(None, sender, BROADCAST, payload, 0)
        kept.waiting, kept.settled = 1, True
        return number

    def batch(self) -> list[int]:
        """The numbers of what the run is given next, in the order in which it came; vehicles take turns at being first."""
        found: list[int] = []
        left_bytes = self._batch_bytes
        for sender in (*range(self._first, len(self._new)), *range(self._first)):
            new = self._new[sender]
            for taken in range(min(len(new), BATCH_OF_ONE)):
                size = len(self._kept[new[0]].payload)
                if len(found) == BATCH or (size > left_bytes and found):
                    self._first = sender + 1 if taken else sender
                    return sorted(found)
                found.append(new.popleft())
                left_bytes -= size
        return sorted(found)

    def due(self, number: int) -> None:
        """A delivery of it is to come."""
        kept = self._kept[number]
        kept.waiting += 1
        kept.arrived = True

    def left(self, number: int) -> None:
        """That was one of them."""
        kept = self._kept[number]
        kept.waiting -= 1
        if kept.settled and not kept.waiting:
            self._forget(number, kept)

    def settle(self, number: int) -> Kept | None:
        """Nothing is due of it any more but what is known: the datagram, if it was meant for one vehicle and is lost."""
        kept = self._kept[number]
        kept.settled = True
        if not kept.waiting:
            self._forget(number, kept)
        return None if kept.arrived or kept.to == BROADCAST else kept

    def _forget(self, number: int, kept: Kept) -> None:
        del self._kept[number]
        if number < 0:
            return
        self._count[kept.sender] -= 1
        self._bytes[kept.sender] -= len(kept.payload)
