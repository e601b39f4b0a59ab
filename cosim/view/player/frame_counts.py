"""How many frames each vehicle had sent to each other one, and how many of them arrived, at any time of a recording."""

from array import array
from bisect import bisect_right
from collections.abc import Sequence

import msgspec
import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util.documents import json_reader

ROWS_BETWEEN = 1 << 17  # of frame and receiver, between two sums that are kept: counting so many takes a third of a millisecond


class _Frame(msgspec.Struct):
    sender: str
    receivers: tuple[str, ...]
    received_ns: list[int]


_read_frame = json_reader(_Frame)


class Counts:
    """The frames of a run, in the order in which they were reported.

    Args:
        vehicles: of the run: the rows and columns of what is counted.
    """

    def __init__(self, vehicles: Sequence[str]) -> None:
        self.vehicles = tuple(vehicles)
        self._number = {name: i for i, name in enumerate(vehicles)}
        self._times, self._ends = array("q"), array("q")  # of each frame: when it was reported, and rows up to and with it
        self._senders = array("q")  # of each frame
        self._rows: list[Array] = []  # of each frame: a code per receiver
        self._codes = np.zeros(0, np.int32)  # of all: (sender, receiver) as one number, once more if it arrived
        self._sums = np.zeros((1, 0), np.int64)
        self._of: dict[tuple[str, ...], Array] = {}

    def take(self, time_ns: int, data: bytes) -> None:
        """Count a frame that was reported then; times do not decrease."""
        frame = _read_frame(data)
        receivers = self._of.get(frame.receivers)
        if receivers is None:
            receivers = self._of[frame.receivers] = np.array([self._number[name] for name in frame.receivers], np.int32)
        arrived = np.array(frame.received_ns, np.int64) >= 0
        sender = self._number[frame.sender]
        codes = 2 * (sender * len(self.vehicles) + receivers) + arrived
        self._rows.append(codes.astype(np.int32))
        self._senders.append(sender)
        self._times.append(time_ns)
        self._ends.append(len(codes) + (self._ends[-1] if self._ends else 0))

    def close(self) -> None:
        """There are no more: sum up."""
        self._codes = np.concatenate([np.zeros(0, np.int32), *self._rows])
        self._rows.clear()
        between = self._between
        parts = [self._count(self._codes[start : start + between]) for start in range(0, len(self._codes), between)]
        self._sums = np.cumsum([self._count(self._codes[:0]), *parts], axis=0)

    def frames(self, time_ns: int) -> int:
        """How many frames were reported by then."""
        return bisect_right(self._times, time_ns)

    def newest(self, first: int, last: int) -> list[int]:
        """Of the frames from number ``first`` up to ``last``, which is not one of them, the newest of each sender."""
        numbers = np.full(len(self.vehicles), -1)
        numbers[np.array(self._senders[first:last], np.int64)] = np.arange(first, last)  # of equal ones the last counts
        return sorted(numbers[numbers >= 0].tolist())

    def at(self, time_ns: int) -> tuple[Array, Array]:
        """Frames sent and received by then, (n, n) int64 each, a row per sender."""
        frames = self.frames(time_ns)
        rows = self._ends[frames - 1] if frames else 0
        known = rows // self._between
        both = (self._sums[known] + self._count(self._codes[known * self._between : rows])).reshape(-1, 2)
        shape = len(self.vehicles), len(self.vehicles)
        return both.sum(axis=1).reshape(shape), both[:, 1].reshape(shape)

    @property
    def _between(self) -> int:
        """Rows between two sums, which need no more memory than the rows."""
        return max(ROWS_BETWEEN, 4 * len(self.vehicles) ** 2)

    def _count(self, codes: Array) -> Array:
        return np.bincount(codes, minlength=2 * len(self.vehicles) ** 2)
