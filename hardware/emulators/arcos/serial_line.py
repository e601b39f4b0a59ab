"""One direction of a serial line as bytes and times: baud rate and random faults. It has no clock."""

from collections import deque

import msgspec
import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Probability

BITS = 10  # of a byte on the line: start, 8 data, stop (8N1)


class Faults(msgspec.Struct, frozen=True, kw_only=True):
    """Probabilities of faults of each byte; draws depend on the seed and the bytes' numbers alone."""

    drop: Probability = 0.0  # it is lost
    flip: Probability = 0.0  # one of its bits is inverted
    split: Probability = 0.0  # a gap of `gap_ns` comes before it
    gap_ns: int = 30_000_000
    seed: int = 0


class Wire:
    """Bytes go in and come out later, in order, fewer or changed.

    Attributes:
        baud: bits a second; None: no delay.
        dropped: bytes lost so far.
        flipped: bytes changed so far.
    """

    def __init__(self, faults: Faults, draws: np.random.Generator, baud: int | None = None) -> None:
        self.faults, self.baud = faults, baud
        self.dropped = self.flipped = 0
        self._draws = draws
        self._queue: deque[tuple[int, int]] = deque()  # when it is there, byte
        self._last_ns = 0

    def push(self, data: bytes, now_ns: int) -> None:
        """Bytes go in."""
        if not data:
            return
        faults = self.faults
        luck = self._draws.random((len(data), 4)).tolist()
        byte_ns = BITS * SECOND_NS // self.baud if self.baud else 0
        for byte, (drop, flip, split, bit) in zip(data, luck, strict=True):
            self._last_ns = max(self._last_ns, now_ns) + byte_ns + (faults.gap_ns if split < faults.split else 0)
            if drop < faults.drop:
                self.dropped += 1
                continue
            changed = flip < faults.flip
            self.flipped += changed
            self._queue.append((self._last_ns, byte ^ (1 << int(8 * bit)) if changed else byte))

    def pop(self, now_ns: int) -> bytes:
        """The bytes that are there by now."""
        out = bytearray()
        while self._queue and self._queue[0][0] <= now_ns:
            out.append(self._queue.popleft()[1])
        return bytes(out)

    @property
    def due_ns(self) -> int | None:
        """When the next byte is there; None: nothing is on its way."""
        return self._queue[0][0] if self._queue else None
