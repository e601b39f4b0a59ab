"""Frames that fare as they did in a run that was recorded: what was lost there is lost again, at the same receivers."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.tables.columns import names_of, nulls, numbers
from vcmvsp.cosim.tables.schema import RADIO_SCHEMA, read_table
from vcmvsp.cosim.types import Array, FrameReport, Message, frozen
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.channel.runtime_changes import RuntimeChanges
from vcmvsp.netsim.interfaces.layers import Floats

_LAYERS = ("walls", "wall_loss_db", "shadowing_db", "fading_db", "snr_db", "path_loss_db")


class RecordedFrames:
    """The frames of a recorded run, by their senders and their numbers among those of their sender.

    Args:
        path: ``radio.parquet`` of the run.
    """

    def __init__(self, path: Path) -> None:
        try:
            table = read_table(path)
        except OSError as error:
            raise UsageError(f"{path}: {error.strerror or error}") from error
        except (ValueError, pa.ArrowException) as error:
            raise UsageError(f"{path} cannot be read: {error}") from error
        kinds = dict(zip(table.schema.names, table.schema.types, strict=True))
        if wrong := [field.name for field in RADIO_SCHEMA if kinds.get(field.name) != field.type]:
            raise UsageError(f"{path} is no recording of a radio: it has no column {', '.join(wrong)} of the right type")
        self._columns = {name: frozen(numbers(table, name)) for name in ("distance_m", "rssi_dbm", "air_time_ns", "queue_ns")}
        self._columns["access_ns"] = frozen(numbers(table, "access_ns"))
        self._columns["sinr_db"] = frozen(numbers(table, "sinr_db", np.nan))
        for name in _LAYERS:  # zeros stand for a layer that was not there
            values = numbers(table, name)
            if values.any():
                self._columns[name] = frozen(values)
        self._delay_ns = numbers(table, "delay_ns", -1)
        copied = ~nulls(table, "copy_ns")
        self._copy_ns = np.where(copied, numbers(table, "copy_ns") - numbers(table, "sent_ns"), -1) if copied.any() else None
        self._receivers, self._outcomes, self._materials = (
            np.array(names, object)[codes] if len(codes) else np.empty(0, object)
            for names, codes in (names_of(table, name) for name in ("receiver", "outcome", "wall_materials"))
        )
        self._rows = _rows(numbers(table, "frame"), *names_of(table, "sender"))

    def find(self, sender: str, number: int, receivers: tuple[str, ...]) -> slice | None:
        """The rows of a frame; None: there is none of this number, or it was meant for others."""
        rows = self._rows.get((sender, number))
        return rows if rows is not None and tuple(self._receivers[rows].tolist()) == receivers else None

    def report(self, rows: slice, frame: int, message: Message, sent_ns: int) -> FrameReport:
        """What became of the frame in these rows, as if it had been sent now."""
        delay_ns, copy_ns = self._delay_ns[rows], None if self._copy_ns is None else self._copy_ns[rows]
        parts: dict[str, Any] = {name: column[rows] for name, column in self._columns.items()}
        for name in ("air_time_ns", "queue_ns", "access_ns"):
            parts[name] = int(parts[name][0])
        materials = tuple(self._materials[rows].tolist())
        return FrameReport(
            frame=frame,
            sender=message.sender,
            sent_ns=sent_ns,
            size_bytes=message.size_bytes,
            receivers=tuple(self._receivers[rows].tolist()),
            received_ns=_since(sent_ns, delay_ns),
            copy_ns=None if copy_ns is None else _since(sent_ns, copy_ns),
            outcome=tuple(self._outcomes[rows].tolist()),
            wall_materials=materials if any(materials) else None,
            **parts,
        )


class RecordedChannel:
    """A channel for those frames that the recording does not know, which are drawn anew; the others fare as recorded.

    A frame is known by its sender and its number among those of that sender, and by whom it is meant for, not by when it is
    sent or from where: what the recording says of it (delays, levels, distance, cause) holds, counted from the moment at which
    it is sent now. That is told at once; it takes up no time on the air of the frames that are drawn.

    Args:
        channel: decides what becomes of the others.
        path: ``radio.parquet`` of the recorded run.
        tell: takes a line for the user, at the end: how many were not in the recording.
    """

    def __init__(self, channel: Channel, path: Path, tell: Callable[[str], None] = lambda _: None) -> None:
        self._channel, self._recorded, self._tell = channel, RecordedFrames(path), tell
        self.start(seed=0)

    def start(self, seed: int) -> None:
        """Forget all frames; those that are drawn are drawn from ``seed`` from now on."""
        self._channel.start(seed)
        self._numbers: dict[str, int] = {}
        self._meant: dict[tuple[str, str | None], tuple[str, ...]] = {}
        self._names: tuple[str, ...] = ()
        self.unknown = 0

    @property
    def contends(self) -> bool:
        """Whether radios share the air."""
        return self._channel.contends

    def send(
        self, sent_ns: int, message: Message, names: tuple[str, ...], position: Floats, *, handover_ns: int = 0
    ) -> list[FrameReport]:
        """Hand over one message; arguments and result as for `Channel.send`."""
        number = self._numbers.get(message.sender, 0)
        self._numbers[message.sender] = number + 1
        receivers = self._receivers(message, names)
        rows = self._recorded.find(message.sender, number, receivers)
        if rows is None:
            self.unknown += len(receivers) > 0  # what nobody could have heard is in no recording
            return self._channel.send(sent_ns, message, names, position, handover_ns=handover_ns)
        return [self._recorded.report(rows, self._channel.skip(message.sender), message, sent_ns)]

    def send_all(self, *_: object) -> None:
        """One by one."""

    def expect(self, frames: int) -> None:
        """As `Channel.expect`."""
        self._channel.expect(frames)

    def foresee(self, frames: int) -> None:
        """As `Channel.foresee`."""
        self._channel.foresee(frames)

    def advance(self, until_ns: int) -> list[FrameReport]:
        """The frames that are drawn, as `Channel.advance`."""
        return self._channel.advance(until_ns)

    def next_ns(self) -> int | None:
        """The same, as `Channel.next_ns`."""
        return self._channel.next_ns()

    def finish(self) -> list[FrameReport]:
        """The same, as `Channel.finish`."""
        return self._channel.finish()

    @property
    def operated(self) -> RuntimeChanges:
        """What an operator may change of the channel: it concerns the frames that are drawn."""
        return self._channel.operated

    def levels_dbm(self, names: tuple[str, ...], position: Floats) -> Floats:
        """As of frames that are drawn, as `Channel.levels_dbm`."""
        return self._channel.levels_dbm(names, position)

    def cut_off(self, vehicles: Sequence[str], from_ns: int, until_ns: int) -> None:
        """For the frames that are drawn, as `Channel.cut_off`: of the others the recording tells."""
        self._channel.cut_off(vehicles, from_ns, until_ns)

    def change(self, key: str, value: float) -> None:
        """The same, as `Channel.change`."""
        self._channel.change(key, value)

    def close(self) -> None:
        """Say how much was not in the recording."""
        if self.unknown:
            sent = sum(self._numbers.values())
            self._tell(f"{self.unknown} of {sent} frames were not in the recording: the radio has drawn what became of them")

    def _receivers(self, message: Message, names: tuple[str, ...]) -> tuple[str, ...]:
        """For whom it is meant, in the order of a report."""
        if message.to is not None:
            return (message.to,)
        if names is not self._names:
            self._names = names
            self._meant.clear()
        key = message.sender, None
        if key not in self._meant:
            self._meant[key] = tuple(name for name in names if name != message.sender)
        return self._meant[key]


def _rows(frame: Array, names: tuple[str, ...], sender: Array) -> dict[tuple[str, int], slice]:
    """Which rows are about which frame: rows of one frame stand together, frames in the order in which they were sent."""
    if not len(frame):
        return {}
    first = np.flatnonzero(np.diff(frame, prepend=frame[0] - 1)).tolist()
    rows: dict[tuple[str, int], slice] = {}
    counts = dict.fromkeys(names, 0)
    for begin, end in zip(first, [*first[1:], len(frame)], strict=True):
        name = names[sender[begin]]
        rows[name, counts[name]] = slice(begin, end)
        counts[name] += 1
    return rows


def _since(sent_ns: int, delay_ns: Array) -> Array:
    """When something arrives that takes so long; -1: it does not."""
    return frozen(np.where(delay_ns >= 0, sent_ns + delay_ns, -1))
