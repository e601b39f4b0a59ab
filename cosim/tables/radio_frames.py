"""Frames as columns: what a recorder keeps of them while a run goes on, and the columns of the table of the radio.

A report is a kilobyte or two of small objects. Packed, a receiver of a frame takes some tens of bytes.
"""

from collections.abc import Iterable, Sequence
from itertools import chain
from operator import attrgetter
from typing import Any

import numpy as np
import pyarrow as pa

from vcmvsp.cosim.tables.columns import column, joined, name_column
from vcmvsp.cosim.types import Array, FrameReport

UNDER_WAY = "under way"  # the fate of a frame that had neither arrived nor been lost when the run ended
CHUNK_ROWS = 1 << 13  # so many are packed together, within milliseconds; a frame counts as one more: it may have no receivers
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
_FIELDS = (*PER_FRAME, *PER_ROW, *BUDGET, "sender", "receivers", "outcome", "wall_materials")
_FIELDS_OF = attrgetter(*_FIELDS)


class _Numbered(dict[str, int]):
    """A name that is asked for gets the next number, if it has none."""

    def __missing__(self, name: str) -> int:
        number = self[name] = len(self)
        return number


class Names:
    """Numbers for names: those known beforehand in their order, others as they come."""

    def __init__(self, known: Sequence[str]) -> None:
        self._known = len(known)
        self._codes = _Numbered((name, i) for i, name in enumerate(known))

    def codes(self, names: Iterable[str]) -> Array:
        """Their numbers."""
        return np.fromiter(map(self._codes.__getitem__, names), np.int32)

    def column(self, codes: Array) -> "pa.Array[Any]":
        """An Arrow column of these numbers' names."""
        return name_column(list(self._codes), codes)

    def in_order_of(self, codes: Array) -> tuple["Names", Array]:
        """The same names with those that were not known in the order in which they occur there; and new numbers for old."""
        first = np.full(len(self._codes), len(codes))
        first[codes[::-1]] = np.arange(len(codes))[::-1]  # of places given to one name the last one stands
        first[: self._known] = -1
        order, names = np.argsort(first, kind="stable"), list(self._codes)
        return Names([names[old] for old in order.tolist()]), np.argsort(order).astype(np.int32)


class Frames:
    """Frames as they are reported; a row for each receiver that a frame was meant for.

    Args:
        vehicles: of the run, in its order.
    """

    def __init__(self, vehicles: Sequence[str]) -> None:
        self._vehicles, self._outcomes, self._materials = Names(vehicles), Names(("received",)), Names(("",))
        self._waiting: list[FrameReport] = []
        self._held = 0  # frames and rows of those
        self._chunks: dict[str, list[Array]] = {}  # of each column

    def extend(self, reports: Iterable[FrameReport]) -> None:
        """Take over frames; every frame comes once, in any order."""
        for report in reports:
            self._waiting.append(report)
            self._held += 1 + len(report.receivers)
            if self._held >= CHUNK_ROWS:
                self._pack()

    def columns(self, end_ns: int = 2**63 - 1) -> dict[str, Any]:
        """The Arrow columns of the table, rows in the order in which frames entered the channel. Nothing is left here.

        Args:
            end_ns: of the run: an arrival after it is not known, and the frame is `UNDER_WAY`.
        """
        self._pack()
        counts, frame = self._taken("receivers"), self._taken("frame")
        order: Array | None = None  # of frames, and of their rows
        rows: Array | None = None
        if (frame[1:] < frame[:-1]).any():
            order, rows = np.argsort(frame, kind="stable"), np.argsort(np.repeat(frame, counts), kind="stable")
        counts = _in_order(counts, order)

        def each(name: str) -> Array:
            return np.repeat(_in_order(self._taken(name), order), counts)

        receiver, sender = _in_order(self._taken("receiver"), rows), _in_order(self._taken("sender"), order)
        vehicles, new = self._vehicles.in_order_of(np.concatenate([receiver, sender]))
        found = {
            "frame": column(np.repeat(_in_order(frame, order), counts)),
            "sender": vehicles.column(np.repeat(new[sender], counts)),
            "receiver": vehicles.column(new[receiver]),
        }
        del frame, receiver, sender
        sent, arrival = each("sent_ns"), _in_order(self._taken("received_ns"), rows)
        late = arrival > end_ns
        received = np.where(late, -1, arrival)
        found["sent_ns"] = column(sent)
        found["received_ns"] = column(received, valid=received >= 0)
        found["delay_ns"] = column(received - sent, valid=received >= 0)
        del sent, received, arrival
        for name in ("size_bytes", "air_time_ns", "queue_ns", "access_ns"):
            found[name] = column(each(name))
        for name, names in (("outcome", self._outcomes), ("wall_materials", self._materials)):
            codes = _in_order(self._taken(name), rows)
            if name == "outcome":
                codes = np.where(late, names.codes((UNDER_WAY,)), codes)
            renamed, new = names.in_order_of(codes)
            found[name] = renamed.column(new[codes])
        for name in ("distance_m", "rssi_dbm", *BUDGET):
            values = _in_order(self._taken(name), rows)
            found[name] = column(values, valid=_known(name, values, end_ns))
        return found

    def _taken(self, name: str) -> Array:
        """A column, of which nothing is kept."""
        return joined(self._chunks.pop(name, []), (0,), _dtype(name))

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
    """The same values; where all have the same bits, in the space of one."""
    bits = values.view(f"i{values.itemsize}")
    return np.broadcast_to(values[0].copy(), values.shape) if len(values) and (bits == bits[0]).all() else values


def _dtype(name: str) -> type[np.number]:
    if name in ("receiver", "sender", "outcome", "wall_materials"):
        return np.int32
    return {**PER_ROW, **BUDGET}.get(name, np.int64)


def _known(name: str, values: Array, end_ns: int) -> Array | None:
    """Which values of a column are told; None: all."""
    if name == "copy_ns":
        return np.asarray((values > 0) & (values <= end_ns))
    return np.isfinite(values) if name == "sinr_db" else None
