"""Column storage of frames: packing during a run, and the columns of the radio table.

A report is one or two kilobytes of small objects. Packed, a receiver of a frame takes some tens of bytes.
"""

from collections.abc import Collection, Iterable, Sequence
from itertools import chain
from operator import attrgetter
from typing import Any

import numpy as np
import pyarrow as pa

from vcmvsp.cosim.tables.columns import column, joined, name_column
from vcmvsp.cosim.types import Array, FrameReport

UNDER_WAY = "under way"  # outcome of a frame in transit at the end of the run
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
NAMED = ("sender", "receiver", "outcome", "wall_materials")
COLUMNS = (*PER_FRAME, "sender", "receiver", *PER_ROW, "delay_ns", "outcome", "wall_materials", *BUDGET)
_LAST_USE = {  # columns released after the column that is made from them
    **dict.fromkeys(("sent_ns", "sender", "received_ns"), ()),
    "receiver": ("receiver", "sender"),
    "delay_ns": ("sent_ns",),
    "outcome": ("outcome", "received_ns"),
}
_FIELDS = (*PER_FRAME, *PER_ROW, *BUDGET, "sender", "receivers", "outcome", "wall_materials")
_FIELDS_OF = attrgetter(*_FIELDS)


class _Numbered(dict[str, int]):
    def __missing__(self, name: str) -> int:
        number = self[name] = len(self)
        return number


class Names:
    """Codes for names: given names in their order, others in order of appearance."""

    def __init__(self, known: Sequence[str]) -> None:
        self._known = len(known)
        self._codes = _Numbered((name, i) for i, name in enumerate(known))

    def codes(self, names: Iterable[str]) -> Array:
        """Codes of the names."""
        return np.fromiter(map(self._codes.__getitem__, names), np.int32)

    def column(self, codes: Array) -> "pa.Array[Any]":
        """An Arrow column of the names of these codes."""
        return name_column(list(self._codes), codes)

    def in_order_of(self, codes: Array) -> tuple["Names", Array]:
        """The names with initially unknown ones sorted by first occurrence in ``codes``, and the new codes."""
        first = np.full(len(self._codes), len(codes))
        first[codes[::-1]] = np.arange(len(codes))[::-1]  # duplicate indices: the last assignment counts
        first[: self._known] = -1
        order, names = np.argsort(first, kind="stable"), list(self._codes)
        return Names([names[old] for old in order.tolist()]), np.argsort(order).astype(np.int32)


class Frames:
    """Packed frame reports; one row per intended receiver of a frame."""

    def __init__(self, vehicles: Sequence[str]) -> None:
        self._vehicles, self._outcomes, self._materials = Names(vehicles), Names(("received",)), Names(("",))
        self._waiting: list[FrameReport] = []
        self._held = 0  # frames and rows not packed yet
        self._chunks: dict[str, list[Array]] = {}  # packed parts of each column
        self._counts = np.empty(0, np.int64)  # rows of each frame, in the order of the table
        self._order: Array | None = None  # sort order of frames and rows
        self._rows: Array | None = None

    def extend(self, reports: Iterable[FrameReport]) -> None:
        """Add frame reports; every frame comes once, in any order."""
        for report in reports:
            self._waiting.append(report)
            self._held += 1 + len(report.receivers)
            if self._held >= CHUNK_ROWS:
                self._pack()

    def columns(self, end_ns: int = 2**63 - 1, wanted: Collection[str] | None = None) -> dict[str, Any]:
        """The Arrow columns of the table, rows in the order in which frames entered the channel.

        Frames that would arrive after ``end_ns`` are `UNDER_WAY`. Without ``wanted``, the stored columns are released.
        """
        self._pack()
        self._counts, frame = self._joined("receivers"), self._joined("frame")
        self._order = self._rows = None
        if (frame[1:] < frame[:-1]).any():
            self._order, rows = np.argsort(frame, kind="stable"), np.repeat(frame, self._counts)
            self._rows, self._counts = np.argsort(rows, kind="stable"), self._counts.take(self._order)
        del frame
        found = {}
        for name in COLUMNS if wanted is None else wanted:
            found[name] = self._column(name, end_ns)
            for done in _LAST_USE.get(name, (name,)) if wanted is None else ():
                self._chunks.pop(done, None)
        if wanted is None:
            self._chunks.clear()
        return found

    def _column(self, name: str, end_ns: int) -> "pa.Array[Any]":
        if name in PER_FRAME:
            return column(self._of_frames(name))
        if name in ("sender", "receiver"):
            receiver, sender = self._of_rows("receiver"), _in_order(self._joined("sender"), self._order)
            vehicles, new = self._vehicles.in_order_of(np.concatenate([receiver, sender]))
            return vehicles.column(new[receiver] if name == "receiver" else np.repeat(new[sender], self._counts))
        if name in ("received_ns", "delay_ns"):
            arrival = self._of_rows("received_ns")
            received = np.where(arrival > end_ns, -1, arrival)
            return column(received - self._of_frames("sent_ns") if name == "delay_ns" else received, valid=received >= 0)
        values = self._of_rows(name)
        if name in ("outcome", "wall_materials"):
            names = self._outcomes if name == "outcome" else self._materials
            if name == "outcome":
                values = np.where(self._of_rows("received_ns") > end_ns, names.codes((UNDER_WAY,)), values)
            renamed, new = names.in_order_of(values)
            return renamed.column(new[values])
        return column(values, valid=_known(name, values, end_ns))

    def _of_rows(self, name: str) -> Array:
        return _in_order(self._joined(name), self._rows)

    def _of_frames(self, name: str) -> Array:
        """A column with one value per frame, repeated for its rows."""
        return np.repeat(_in_order(self._joined(name), self._order), self._counts)

    def _joined(self, name: str) -> Array:
        return joined(self._chunks.get(name, []), (0,), dtype_of(name))

    def _pack(self) -> None:
        reports, self._waiting, self._held = self._waiting, [], 0
        if not reports:
            return
        told = dict(zip(_FIELDS, zip(*map(_FIELDS_OF, reports), strict=True), strict=True))
        counts = [len(receivers) for receivers in told["receivers"]]
        packed = {name: np.array(told[name], np.int64) for name in PER_FRAME}
        packed["receivers"] = np.array(counts, np.int64)
        packed["receiver"] = self._vehicles.codes(chain.from_iterable(told["receivers"]))
        packed["sender"] = self._vehicles.codes(told["sender"])
        packed["outcome"] = self._outcomes.codes(chain.from_iterable(told["outcome"]))
        crossed = (each or ("",) * n for each, n in zip(told["wall_materials"], counts, strict=True))
        packed["wall_materials"] = self._materials.codes(chain.from_iterable(crossed))
        for name, dtype in PER_ROW.items():
            packed[name] = joined(list(told[name]), (0,), dtype)
        for name, dtype in BUDGET.items():
            parts = zip(told[name], counts, strict=True)
            packed[name] = (
                joined([np.zeros(n, dtype) if part is None else part for part, n in parts], (0,), dtype)
                if any(part is not None for part in told[name])
                else np.zeros(sum(counts), dtype)
            )
        for name, values in packed.items():
            self._chunks.setdefault(name, []).append(_slim(values))


def _in_order(values: Array, order: Array | None) -> Array:
    return values if order is None else values.take(order)


def _slim(values: Array) -> Array:
    """The values; if all have the same bits, a broadcast of one."""
    bits = values.view(f"i{values.itemsize}")
    return np.broadcast_to(values[0].copy(), values.shape) if len(values) and (bits == bits[0]).all() else values


def dtype_of(name: str) -> type[np.number]:
    """Type of a column's numbers, or of its codes of names."""
    return np.int32 if name in NAMED else {**PER_ROW, **BUDGET}.get(name, np.int64)


def _known(name: str, values: Array, end_ns: int) -> Array | None:
    if name == "copy_ns":
        return np.asarray((values > 0) & (values <= end_ns))
    return np.isfinite(values) if name == "sinr_db" else None
