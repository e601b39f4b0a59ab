"""Column storage of frames: packing during a run, and the columns of the radio table.

A report is one or two kilobytes of small objects. Packed, a receiver of a frame takes some tens of bytes.
"""

from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import pyarrow as pa
from msgspec import UNSET
from numpy.typing import DTypeLike

from vcmvsp.cosim.tables.columns import column, joined, name_column
from vcmvsp.cosim.tables.spool import Spool
from vcmvsp.cosim.types import Array, FrameReport

UNDER_WAY = "under way"  # outcome of a frame in transit at the end of the run
GROUPED_NAMES = 1 << 18  # in groups of names whose codes are remembered
SORTED_ROWS = 1 << 16  # sorted at once
CHUNK_ROWS = 1 << 13  # rows packed at once, within milliseconds; a frame counts as one more row, as it may have no receivers
PER_FRAME = ("frame", "sent_ns", "size_bytes", "air_time_ns", "queue_ns", "access_ns")
PER_ROW = {"received_ns": np.int64, "distance_m": np.float64, "rssi_dbm": np.float64}
BUDGET = {  # zeros where the channel has no such layer
    "copy_ns": np.int64,
    "snr_db": np.float64,
    "sinr_db": np.float64,
    "path_loss_db": np.float64,
    "walls": np.int64,
    "wall_loss_db": np.float64,
    "shadowing_db": np.float64,
    "fading_db": np.float64,
}
PATHS = {"path_delay_ns": np.float64, "delay_spread_ns": np.float64}
"""Columns of tables of channels that know the paths of the wave; NaN: this channel does not."""
NAMED = ("sender", "receiver", "outcome", "wall_materials")
COLUMNS = (*PER_FRAME, "sender", "receiver", *PER_ROW, "delay_ns", "outcome", "wall_materials", *BUDGET)
_FIELDS = (*PER_FRAME, *PER_ROW, *BUDGET, *PATHS, "sender", "receivers", "outcome", "wall_materials")
_FIELDS_OF = attrgetter(*_FIELDS)
T = TypeVar("T")


class Names:
    """Codes for names: given names in their order, others in order of appearance."""

    def __init__(self, known: Sequence[str]) -> None:
        self.known = len(known)
        self._codes = defaultdict[str, int](None, zip(known, range(len(known)), strict=True))
        self._codes.default_factory = self._codes.__len__  # a new name gets the next code
        self._groups: dict[tuple[str, ...], Array] = {}  # codes of groups that may come again
        self._grouped = 0  # names in these groups

    def __len__(self) -> int:
        return len(self._codes)

    def codes(self, names: Iterable[str]) -> Array:
        """Codes of the names."""
        return np.fromiter(map(self._codes.__getitem__, names), np.int32)

    def codes_of_groups(self, groups: Iterable[tuple[str, ...]]) -> Array:
        """Codes of the names in all groups, one group after the other."""
        codes_of, parts = self._groups, []
        for group in groups:
            codes = codes_of.get(group)
            if codes is None:
                if self._grouped > GROUPED_NAMES:
                    codes_of.clear()
                    self._grouped = 0
                codes = codes_of[group] = self.codes(group)
                self._grouped += len(group)
            parts.append(codes)
        return joined(parts, (0,), np.int32)

    def column(self, codes: Array) -> "pa.Array[Any]":
        """An Arrow column of the names of these codes."""
        return name_column(list(self._codes), codes)

    def in_order_of(self, codes: Iterable[int]) -> tuple["Names", Array]:
        """The names with initially unknown ones in the order of these codes, and the new codes."""
        order, names = list(dict.fromkeys([*range(self.known), *codes, *range(len(self))])), list(self._codes)
        return Names([names[old] for old in order]), np.argsort(order).astype(np.int32)


class PackedRows(Generic[T]):
    """Rows of a table, packed many at once and kept outside memory (`Spool`).

    Args:
        vehicles: names of the run's vehicles.
        folder: of the temporary file; None: the system's folder for them.
    """

    def __init__(self, vehicles: Sequence[str], folder: Path | None = None) -> None:
        self._vehicles, self._folder, self._spool = Names(vehicles), folder, Spool(folder)
        self._waiting: list[T] = []
        self._held = 0  # rows not packed yet

    @property
    def rows(self) -> int:
        """Number of rows so far."""
        self._pack()
        return self._spool.starts[-1]

    def _pack(self) -> None:
        if self._waiting:
            self._keep(self._packed(self._waiting))
            self._waiting, self._held = [], 0

    def _packed(self, waiting: Sequence[T]) -> dict[str, Array]:
        raise NotImplementedError

    def _keep(self, packed: dict[str, Array]) -> None:
        self._spool.append(packed, len(packed["vehicle"]))


class Frames(PackedRows[FrameReport]):
    """Packed frame reports; one row per intended receiver of a frame. A frame counts as one more row while it waits."""

    def __init__(self, vehicles: Sequence[str], folder: Path | None = None) -> None:
        super().__init__(vehicles, folder)
        self._outcomes, self._materials = Names(("received",)), Names(("",))
        self._newest = 0  # greatest number of a packed frame
        self._knows_paths = False
        self._is_sorted = True
        self._latest_ns: list[int] = []  # last arrival in each part
        self._cache: dict[tuple[str, int], tuple[Names, Array]] = {}  # names and new codes of a column, for an end of the run

    def extend(self, reports: Iterable[FrameReport]) -> None:
        """Add frame reports; every frame comes once, in any order."""
        for report in reports:
            self._waiting.append(report)
            self._held += 1 + len(report.receivers)
            if self._held >= CHUNK_ROWS:
                self._pack()

    @property
    def has_paths(self) -> bool:
        """Whether some frame has the columns `PATHS`."""
        self._pack()
        return self._knows_paths

    def columns(
        self, end_ns: int = 2**63 - 1, names: Collection[str] = COLUMNS, rows: tuple[int, int] | None = None
    ) -> dict[str, Any]:
        """The Arrow columns of the table, rows in the order in which frames entered the channel; ``rows``: first and last + 1.

        Frames that would arrive after ``end_ns`` are `UNDER_WAY`.
        """
        first, stop = rows or (0, self.rows)
        self._sort()
        parts, cut = self._spool.around(first, stop)
        return {name: self._column(name, end_ns, parts, cut) for name in names}

    def _column(self, name: str, end_ns: int, parts: range, cut: slice) -> "pa.Array[Any]":
        if name in NAMED:
            names, new = self._names(name, end_ns)
            codes = new.take(self._codes(name, end_ns, parts))
            return names.column((np.repeat(codes, self._read("receivers", parts)) if name == "sender" else codes)[cut])
        if name in PER_FRAME:
            return column(self._of_frames(name, parts)[cut])
        if name in ("received_ns", "delay_ns"):
            received = self._read("received_ns", parts)[cut]
            if self._is_late(end_ns, parts):
                received = np.where(received > end_ns, -1, received)
            valid = received >= 0
            return column(received - self._of_frames("sent_ns", parts)[cut] if name == "delay_ns" else received, valid)
        values = self._read(name, parts)[cut]
        return column(values, valid=_validity(name, values, end_ns))

    def _read(self, name: str, parts: range) -> Array:
        return self._spool.read(name, parts, dtype_of(name))

    def _of_frames(self, name: str, parts: range) -> Array:
        """A column with one value per frame, repeated for its rows."""
        return np.repeat(self._read(name, parts), self._read("receivers", parts))

    def _is_late(self, end_ns: int, parts: range) -> bool:
        """Whether any frame would arrive after the end."""
        return any(self._latest_ns[part] > end_ns for part in parts)

    def _codes(self, name: str, end_ns: int, parts: range) -> Array:
        """Codes of the names in a column, in order of appearance in this process; senders once per frame."""
        codes = self._read(name, parts)
        if name == "outcome" and self._is_late(end_ns, parts):
            codes = np.where(self._read("received_ns", parts) > end_ns, self._outcomes.codes((UNDER_WAY,)), codes)
        return codes

    def _names(self, name: str, end_ns: int) -> tuple[Names, Array]:
        """The names of a column in the order in which its rows have them, and their new codes."""
        if (name, end_ns) not in self._cache:
            self._outcomes.codes((UNDER_WAY,))
            if name in ("sender", "receiver"):
                names = self._vehicles
                codes = [code for each in ("receiver", "sender") for code in self._codes_by_occurrence(each, names)]
            else:
                names = self._outcomes if name == "outcome" else self._materials
                codes = [*self._codes_by_occurrence(name, names, end_ns)]
            self._cache[name, end_ns] = names.in_order_of(codes)
        return self._cache[name, end_ns]

    def _codes_by_occurrence(self, name: str, names: Names, end_ns: int = 2**63 - 1) -> Iterable[int]:
        """Codes of initially unknown names by first occurrence."""
        seen = dict.fromkeys(range(names.known))
        for number in range(len(self._spool)):
            if len(seen) == len(names):
                break
            part = range(number, number + 1)
            constant = None if self._is_late(end_ns, part) else self._spool.constant(name, number)
            codes = self._codes(name, end_ns, part) if constant is None else constant[:1]
            first = {code: int(np.argmax(codes == code)) for code in np.flatnonzero(np.bincount(codes)).tolist()}
            seen |= dict.fromkeys(sorted(first, key=first.__getitem__))
        return seen

    def _packed(self, waiting: Sequence[FrameReport]) -> dict[str, Array]:
        reports = sorted(waiting, key=attrgetter("frame"))
        columns = dict(zip(_FIELDS, zip(*map(_FIELDS_OF, reports), strict=True), strict=True))
        counts = [len(receivers) for receivers in columns["receivers"]]
        packed = {name: np.array(columns[name], np.int64) for name in PER_FRAME}
        packed["receivers"] = np.array(counts, np.int64)
        packed["receiver"] = _narrow(self._vehicles.codes_of_groups(columns["receivers"]))
        packed["sender"] = _narrow(self._vehicles.codes(columns["sender"]))
        packed["outcome"] = _narrow(self._outcomes.codes_of_groups(columns["outcome"]))
        crossed = (each or ("",) * n for each, n in zip(columns["wall_materials"], counts, strict=True))
        packed["wall_materials"] = _narrow(self._materials.codes_of_groups(crossed))
        for name, dtype in PER_ROW.items():
            packed[name] = joined(list(columns[name]), (0,), dtype)
        for name, dtype in BUDGET.items():
            packed[name] = _filled(columns[name], counts, None, 0, dtype)
        for name, dtype in PATHS.items():
            packed[name] = _filled(columns[name], counts, UNSET, np.nan, dtype)
            self._knows_paths |= any(part is not UNSET for part in columns[name])
        return packed

    def _keep(self, packed: dict[str, Array]) -> None:
        """Keep the next part of all columns, sorted by frame."""
        self._spool.append(packed, len(packed["receiver"]))
        self._latest_ns.append(int(packed["received_ns"].max(initial=-1)))
        self._is_sorted &= bool(packed["frame"][0] >= self._newest)
        self._newest = max(self._newest, int(packed["frame"][-1]))
        self._cache.clear()

    def _sort(self) -> None:
        """Keep all parts anew in order of frame numbers, if the parts overlap."""
        if self._is_sorted:
            return
        old, everything = self._spool, range(len(self._spool))
        into = Frames((), self._folder)
        frame = old.read("frame", everything, np.int64)
        order = np.argsort(frame, kind="stable")
        del frame
        counts = old.read("receivers", everything, np.int64)
        frames_of = [len(old.read("frame", range(part, part + 1), np.int64)) for part in everything]
        first_of = np.cumsum([0, *frames_of])
        edges = np.flatnonzero(np.diff(np.cumsum(counts[order] + 1) // SORTED_ROWS, prepend=0))
        del counts
        for chosen in np.split(order, edges):
            if len(chosen):
                into._keep(_selected(old, chosen, first_of))
        self._spool, self._latest_ns, self._is_sorted = into._spool, into._latest_ns, True
        self._cache.clear()


def _selected(spool: Spool, frames: Array, first_of: Array) -> dict[str, Array]:
    """The packed columns of chosen frames, by their places in all parts; ``first_of``: place of each part's first frame."""
    part_of = first_of.searchsorted(frames, side="right") - 1
    parts = np.unique(part_of)
    held = np.diff(first_of)[parts]  # frames of these parts
    rows = frames - first_of[part_of] + (np.cumsum(held) - held)[parts.searchsorted(part_of)]
    numbers = parts.tolist()
    counts = spool.read("receivers", numbers, np.int64)
    chosen = counts[rows]
    starts = (np.cumsum(counts) - counts)[rows] - (np.cumsum(chosen) - chosen)
    places = np.repeat(starts, chosen) + np.arange(chosen.sum())
    columns = dict.fromkeys((*PER_FRAME, "receivers", "sender"), rows)
    columns |= dict.fromkeys(("receiver", "outcome", "wall_materials", *PER_ROW, *BUDGET, *PATHS), places)
    return {name: spool.read(name, numbers, dtype_of(name))[chosen] for name, chosen in columns.items()}


def _filled(parts: Sequence[Any], counts: Sequence[int], missing: object, value: float, dtype: DTypeLike) -> Array:
    """The parts of a column one after the other; this value stands in place of missing parts."""
    if all(part is missing for part in parts):
        return np.full(sum(counts), value, dtype)

    def whole(part: Any, count: int) -> Array:
        return np.full(count, value, dtype) if part is missing else part

    return joined(list(map(whole, parts, counts)), (0,), dtype)


def _narrow(codes: Array) -> Array:
    """The codes in two bytes each if they fit."""
    return codes.astype(np.int16) if codes.max(initial=0) < 2**15 else codes


def dtype_of(name: str) -> type[np.number]:
    """Type of a column's numbers, or of its codes of names."""
    return np.int32 if name in NAMED else {**PER_ROW, **BUDGET, **PATHS}.get(name, np.int64)


def _validity(name: str, values: Array, end_ns: int) -> Array | None:
    if name == "copy_ns":
        return np.asarray((values > 0) & (values <= end_ns))
    return np.isfinite(values) if name == "sinr_db" or name in PATHS else None
