"""Replay of recorded frames: each frame has its recorded outcome again, at the same receivers."""

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.tables.columns import names_of, nulls, numbers
from vcmvsp.cosim.tables.radio_frames import PATHS
from vcmvsp.cosim.tables.schema import RADIO_SCHEMA, read_table
from vcmvsp.cosim.types import Array, FrameReport, Message, frozen

_TIMES = ("air_time_ns", "queue_ns", "access_ns")  # of a frame, equal at all receivers
_LAYERS = ("walls", "wall_loss_db", "shadowing_db", "fading_db", "snr_db", "path_loss_db")


class RecordedFrames:
    """Outcomes of the frames of a recorded run, by sender and the sender's frame number.

    Sender, number and receivers identify a frame; the time and place of sending do not matter. Its recorded delays, levels,
    distance and cause apply, relative to the new time of sending. The frame is reported at once and does not occupy the medium
    of frames that are drawn.

    Args:
        path: ``radio.parquet`` of the run.
        tell: called at the end with a line for the user: the number of frames that were not in the recording.
        networks: name and members of the radios on this channel, of several radios; none: the only radio.
    """

    def __init__(
        self,
        path: Path,
        tell: Callable[[str], None] = lambda _: None,
        networks: Sequence[tuple[str, Sequence[str]]] = (),
    ) -> None:
        self._tell = tell
        self._reached = {name: frozenset(members) for _, members in networks for name in members}
        self.start()
        try:
            table = read_table(path)
        except OSError as error:
            raise UsageError(f"{path}: {error.strerror or error}") from error
        except (ValueError, pa.ArrowException) as error:
            raise UsageError(f"{path} cannot be read: {error}") from error
        kinds = dict(zip(table.schema.names, table.schema.types, strict=True))
        if wrong := [field.name for field in RADIO_SCHEMA if kinds.get(field.name) != field.type]:
            raise UsageError(f"{path} is not a recording of a radio: no column {', '.join(wrong)} of the right type")
        table = _of_networks(table, [name for name, _ in networks], path)
        self._columns = {name: frozen(numbers(table, name)) for name in ("distance_m", "rssi_dbm", *_TIMES)}
        self._columns["sinr_db"] = frozen(numbers(table, "sinr_db", np.nan))
        for name in _LAYERS:  # zeros: the run had no such layer
            values = numbers(table, name)
            if values.any():
                self._columns[name] = frozen(values)
        self._columns |= {name: frozen(numbers(table, name, np.nan)) for name in PATHS if name in kinds}
        self._delay_ns = numbers(table, "delay_ns", -1)
        copied = ~nulls(table, "copy_ns")
        self._copy_ns = np.where(copied, numbers(table, "copy_ns") - numbers(table, "sent_ns"), -1) if copied.any() else None
        self._receivers, self._outcomes = _texts(table, "receiver"), _texts(table, "outcome")
        self._materials = _texts(table, "wall_materials")
        self._rows = _rows(numbers(table, "frame"), *names_of(table, "sender"))

    def start(self) -> None:
        """Reset the count of frames that are not in the recording."""
        self.unknown = 0

    def report(self, message: Message, names: tuple[str, ...], number: int, frame: int, sent_ns: int) -> FrameReport | None:
        """The recorded report of a frame as if it had been sent now; None: it is not in the recording.

        Args:
            message: content of the frame.
            names: the vehicles, in the order of the receivers.
            number: the sender's frame number.
            frame: its number in the channel now.
            sent_ns: now.
        """
        receivers = _others(names, message.sender, self._reached.get(message.sender)) if message.to is None else (message.to,)
        rows = self._rows.get((message.sender, number))
        if rows is None or tuple(self._receivers[rows].tolist()) != receivers:
            self.unknown += len(receivers) > 0  # a frame without receivers is in no recording
            return None
        parts: dict[str, Any] = {name: column[rows] for name, column in self._columns.items()}
        for name in _TIMES:
            parts[name] = int(parts[name][0])
        if self._copy_ns is not None:
            parts["copy_ns"] = _since(sent_ns, self._copy_ns[rows])
        materials = tuple(self._materials[rows].tolist())
        if any(materials):
            parts["wall_materials"] = materials
        return FrameReport(
            frame=frame,
            sender=message.sender,
            sent_ns=sent_ns,
            size_bytes=message.size_bytes,
            receivers=receivers,
            received_ns=_since(sent_ns, self._delay_ns[rows]),
            outcome=tuple(self._outcomes[rows].tolist()),
            **parts,
        )

    def close(self, sent: int) -> None:
        """Report how many of the ``sent`` frames were not in the recording."""
        if self.unknown:
            self._tell(f"{self.unknown} of {sent} frames are not in the recording; the radio model decided their reception")


@lru_cache(maxsize=4096)
def _others(names: tuple[str, ...], sender: str, reached: frozenset[str] | None) -> tuple[str, ...]:
    return tuple(name for name in names if name != sender and (reached is None or name in reached))


def _of_networks(table: pa.Table, networks: Sequence[str], path: Path) -> pa.Table:
    """The frames of some of several radios; without names the table of the only radio."""
    if "radio" not in table.column_names:
        if networks:
            raise UsageError(f"{path} has no column radio: it is of a run with one radio, and this one has several")
        return table
    names, of = names_of(table, "radio")
    if not networks:
        raise UsageError(f"{path} is the recording of a run with several radios ({', '.join(sorted(names))}), not of one")
    return table.filter(pa.array(np.isin(of, [code for code, name in enumerate(names) if name in networks])))


def _texts(table: pa.Table, name: str) -> Array:
    names, codes = names_of(table, name)
    return np.array(names, object)[codes] if len(codes) else np.empty(0, object)


def _rows(frame: Array, names: tuple[str, ...], sender: Array) -> dict[tuple[str, int], slice]:
    """Rows by sender and number; rows of one frame are adjacent, frames are in the order of sending."""
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
    return frozen(np.where(delay_ns >= 0, sent_ns + delay_ns, -1))
