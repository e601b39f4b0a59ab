"""Values at any time of a recording that depend on all messages of a topic: frames, log lines, notes, stopped vehicles."""

from array import array
from bisect import bisect_right
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from operator import attrgetter
from typing import Any

import msgspec
import numpy as np

from vcmvsp.cosim.recording.foxglove import LEVELS, Log
from vcmvsp.cosim.recording.run_state import LogLine, changes
from vcmvsp.cosim.types import Array, Halted
from vcmvsp.cosim.util.documents import json_reader
from vcmvsp.cosim.view.player.mcap_index import Taker

FRAMES, LOG, HALTED = "radio/frame", "log", "operator/halted"
NOTE = "note"  # of each vehicle
LINES = 200  # log lines shown at once
ROWS_BETWEEN = 1 << 17  # rows of frame and receiver between two stored sums: counting so many takes a third of a millisecond
_LEVEL = {number: word for word, number in LEVELS.items()}
_time_ns = attrgetter("time_ns")  # of a line


class _Frame(msgspec.Struct):
    sender: str
    receivers: tuple[str, ...]
    received_ns: list[int]


class _Names(msgspec.Struct):
    values: dict[str, Any]


_read_frame = json_reader(_Frame)
_read_log = json_reader(Log)
_read_halted = json_reader(Halted)
_read_note = json_reader(_Names)


class Collected:
    """Collects, while a file is indexed, the values that depend on all messages of a topic.

    Attributes:
        lines: log lines and changes of notes; in order of time after `close`.
        ending: the last log line; empty without one.
    """

    def __init__(self, vehicles: tuple[str, ...]) -> None:
        self.vehicles = vehicles
        self.counts = Counts(self.vehicles)
        self.lines: list[LogLine] = []
        self.ending = ""
        self.notes: dict[str, Notes] = {}  # by topic
        self._noted: dict[str, dict[str, Any]] = {}  # newest notes by vehicle
        self._halted: list[tuple[int, tuple[str, ...]]] = []

    def taker(self, topic: str) -> Taker | None:
        """Function that receives all messages of a topic; None if they are not needed."""
        vehicle, _, kind = topic.partition("/")
        if kind == NOTE:
            self.notes[topic], self._noted[vehicle] = Notes(), {}
            return partial(self._take_note, vehicle, self.notes[topic])
        return {FRAMES: self.counts.take, LOG: self._take_line, HALTED: self._take_halted}.get(topic)

    def close(self) -> None:
        """Finish collecting."""
        self.lines.sort(key=_time_ns)
        self.counts.close()

    def halted(self, time_ns: int) -> tuple[str, ...]:
        """Vehicles stopped by the operator at a time."""
        return next((names for when_ns, names in reversed(self._halted) if when_ns <= time_ns), ())

    def log_lines(self, time_ns: int, since_ns: int | None) -> tuple[LogLine, ...]:
        """The newest log lines; with ``since_ns``, the later ones only."""
        first = 0 if since_ns is None else bisect_right(self.lines, since_ns, key=_time_ns)
        last = bisect_right(self.lines, time_ns, key=_time_ns)
        return tuple(self.lines[max(first, last - LINES) : last])

    def _take_line(self, time_ns: int, data: bytes) -> None:
        message = _read_log(data)
        self.lines.append(LogLine(time_ns=time_ns, level=_LEVEL[message.level], text=message.message))
        self.ending = message.message

    def _take_note(self, vehicle: str, notes: "Notes", time_ns: int, data: bytes) -> None:
        values, newest = _read_note(data).values, self._noted[vehicle]
        notes.take(values)
        self.lines.extend(changes(vehicle, time_ns, newest, values))
        newest.update(values)

    def _take_halted(self, time_ns: int, data: bytes) -> None:
        message = _read_halted(data)
        before = self._halted[-1][1] if self._halted else ()
        stand = {*before, *message.vehicles} if message.halted else {*before} - {*message.vehicles}
        self._halted.append((time_ns, tuple(name for name in self.vehicles if name in stand)))


class Notes:
    """The notes of one vehicle. Notes with the same names form a sort, and only the newest of each sort is read."""

    def __init__(self) -> None:
        self._sorts: dict[tuple[str, ...], array[int]] = {}  # names -> numbers of the notes with these names
        self._count = 0

    def take(self, names: Iterable[str]) -> None:
        """Add the next note, which has these names."""
        self._sorts.setdefault(tuple(names), array("q")).append(self._count)
        self._count += 1

    def at(self, number: int, get: Callable[[int], Mapping[str, Any]]) -> dict[str, Any]:
        """Merged notes up to the note of this number; ``get`` returns a note by its number."""
        newest = [numbers[place - 1] for numbers in self._sorts.values() if (place := bisect_right(numbers, number))]
        return {name: value for each in sorted(newest) for name, value in get(each).items()}


class Counts:
    """Counts of frames sent from vehicle to vehicle, and of those received, at any time."""

    def __init__(self, vehicles: Sequence[str]) -> None:
        self._row = {name: i for i, name in enumerate(vehicles)}
        self._times, self._ends = array("q"), array("q")  # per frame: time of report, and number of rows including its own
        self._senders = array("q")  # per frame
        self._rows: list[Array] = []  # per frame: a code per receiver
        self._codes = np.zeros(0, np.int32)  # of all frames: (sender, receiver) as one number, repeated if received
        self._sums = np.zeros((1, 0), np.int64)
        self._newest = np.full((1, len(self._row)), -1)  # at each stored sum: row of the newest reception of each vehicle
        self._of: dict[tuple[str, ...], Array] = {}

    def take(self, time_ns: int, data: bytes) -> None:
        """Count a frame reported at this time; times do not decrease."""
        frame = _read_frame(data)
        receivers = self._of.get(frame.receivers)
        if receivers is None:
            receivers = self._of[frame.receivers] = np.array([self._row[name] for name in frame.receivers], np.int32)
        arrived = np.array(frame.received_ns, np.int64) >= 0
        sender = self._row[frame.sender]
        codes = 2 * (sender * len(self._row) + receivers) + arrived
        self._rows.append(codes.astype(np.int32))
        self._senders.append(sender)
        self._times.append(time_ns)
        self._ends.append(len(codes) + (self._ends[-1] if self._ends else 0))

    def close(self) -> None:
        """Finish counting: compute the stored sums."""
        self._codes = np.concatenate([np.zeros(0, np.int32), *self._rows])
        self._rows.clear()
        between = self._between
        parts = [self._count(self._codes[start : start + between]) for start in range(0, len(self._codes), between)]
        self._sums = np.cumsum([self._count(self._codes[:0]), *parts], axis=0)
        newest = [self._newest_receptions(start, start + between) for start in range(0, len(self._codes), between)]
        self._newest = np.maximum.accumulate([self._newest_receptions(0, 0), *newest], axis=0)

    def frames(self, time_ns: int) -> int:
        """Number of frames reported up to a time."""
        return bisect_right(self._times, time_ns)

    def newest(self, first: int, last: int) -> list[int]:
        """Newest frame of each sender among the frames ``first`` to ``last`` - 1."""
        numbers = np.full(len(self._row), -1)
        numbers[np.array(self._senders[first:last], np.int64)] = np.arange(first, last)  # the last of equal indices counts
        return sorted(numbers[numbers >= 0].tolist())

    def at(self, time_ns: int) -> tuple[Array, Array]:
        """Frames sent and received up to a time, (n, n) int64 each, one row per sender."""
        frames = self.frames(time_ns)
        rows = self._ends[frames - 1] if frames else 0
        block = rows // self._between
        both = (self._sums[block] + self._count(self._codes[block * self._between : rows])).reshape(-1, 2)
        shape = len(self._row), len(self._row)
        return both.sum(axis=1).reshape(shape), both[:, 1].reshape(shape)

    def last_reception_ns(self, time_ns: int, since_ns: int | None) -> dict[str, int]:
        """Time of the newest reception of each vehicle up to a time and after ``since_ns``, as its frame was reported."""
        frames = self.frames(time_ns)
        rows = self._ends[frames - 1] if frames else 0
        block = rows // self._between
        newest = np.maximum(self._newest[block], self._newest_receptions(block * self._between, rows))
        rows_of = zip(self._row, newest.tolist(), strict=True)
        times = [(name, self._times[bisect_right(self._ends, row)]) for name, row in rows_of if row >= 0]
        return {name: at_ns for name, at_ns in times if since_ns is None or at_ns > since_ns}

    def _newest_receptions(self, begin: int, end: int) -> Array:
        """The last row with a reception of each vehicle among some rows, (n,); -1: none."""
        newest, codes = np.full(len(self._row), -1), self._codes[begin:end]
        received = np.flatnonzero(codes & 1)
        newest[codes[received] // 2 % len(self._row)] = begin + received  # the last of equal indices counts
        return newest

    @property
    def _between(self) -> int:
        """Rows between two stored sums, chosen so that the sums need no more memory than the rows."""
        return max(ROWS_BETWEEN, 4 * len(self._row) ** 2)

    def _count(self, codes: Array) -> Array:
        return np.bincount(codes, minlength=2 * len(self._row) ** 2)
