"""Frames as columns: what a recorder keeps of them while a run goes on, and the columns of the table of the radio.

A report is a kilobyte or two of small objects. Packed, a receiver of a frame takes some tens of bytes.
"""

from collections.abc import Iterable, Sequence
from operator import attrgetter
from typing import Any

import numpy as np

from cosim.record.columns import column, joined, name_column
from cosim.types import Array, FrameReport

CHUNK_ROWS = 1 << 10  # so many are packed together, within milliseconds; a frame counts as one more: it may have no receivers
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


class Names:
    """Numbers for names: those known beforehand in their order, others as they come."""

    def __init__(self, known: Sequence[str]) -> None:
        self._known = len(known)
        self._codes = {name: i for i, name in enumerate(known)}
        self._seen: dict[tuple[str, ...], Array] = {}

    def code(self, name: str) -> int:
        """The number of a name."""
        return self._codes.setdefault(name, len(self._codes))

    def codes(self, names: tuple[str, ...]) -> Array:
        """Those of a frame's receivers, say: of few different tuples, so that each is translated once."""
        known = self._seen.get(names)
        if known is None:
            known = self._seen[names] = np.array([self.code(name) for name in names], np.int32)
        return known

    def forget(self) -> None:
        """Let go of tuples that were translated: of fates of many receivers hardly two are the same."""
        self._seen.clear()

    def column(self, codes: Array) -> Any:
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

    def columns(self) -> dict[str, Any]:
        """The Arrow columns of the table, rows in the order in which frames entered the channel. Nothing is left here."""
        self._pack()
        counts, frame = self._taken("receivers"), self._taken("frame")
        order: Any = slice(None)  # of frames, and of their rows
        rows: Any = slice(None)
        if (frame[1:] < frame[:-1]).any():
            order, rows = np.argsort(frame, kind="stable"), np.argsort(np.repeat(frame, counts), kind="stable")
        counts = counts[order]

        def each(name: str) -> Array:
            return np.repeat(self._taken(name)[order], counts)

        receiver, sender = self._taken("receiver")[rows], self._taken("sender")[order]
        vehicles, new = self._vehicles.in_order_of(np.concatenate([receiver, sender]))
        found = {
            "frame": column(np.repeat(frame[order], counts)),
            "sender": vehicles.column(np.repeat(new[sender], counts)),
            "receiver": vehicles.column(new[receiver]),
        }
        del frame, receiver, sender
        sent, received = each("sent_ns"), self._taken("received_ns")[rows]
        found["sent_ns"] = column(sent)
        found["received_ns"] = column(received, valid=received >= 0)
        found["delay_ns"] = column(received - sent, valid=received >= 0)
        del sent, received
        for name in ("size_bytes", "air_time_ns", "queue_ns", "access_ns"):
            found[name] = column(each(name))
        for name, names in (("outcome", self._outcomes), ("wall_materials", self._materials)):
            codes = self._taken(name)[rows]
            renamed, new = names.in_order_of(codes)
            found[name] = renamed.column(new[codes])
        for name in ("distance_m", "rssi_dbm", *BUDGET):
            values = self._taken(name)[rows]
            found[name] = column(values, valid=_known(name, values))
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
        packed["receiver"] = joined([self._vehicles.codes(each) for each in told["receivers"]], (0,), np.int32)
        packed["sender"] = np.array([self._vehicles.code(each) for each in told["sender"]], np.int32)
        packed["outcome"] = joined([self._outcomes.codes(each) for each in told["outcome"]], (0,), np.int32)
        crossed = (each or ("",) * n for each, n in zip(told["wall_materials"], counts, strict=True))
        packed["wall_materials"] = joined([self._materials.codes(each) for each in crossed], (0,), np.int32)
        for names in (self._vehicles, self._outcomes, self._materials):
            names.forget()
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


def _slim(values: Array) -> Array:
    """The same values; where all have the same bits, in the space of one."""
    bits = values.view(f"i{values.itemsize}")
    return np.broadcast_to(values[0].copy(), values.shape) if len(values) and (bits == bits[0]).all() else values


def _dtype(name: str) -> Any:
    if name in ("receiver", "sender", "outcome", "wall_materials"):
        return np.int32
    return {**PER_ROW, **BUDGET}.get(name, np.int64)


def _known(name: str, values: Array) -> Array | None:
    """Which values of a column are told; None: all."""
    if name == "copy_ns":
        return np.asarray(values > 0)
    return np.isfinite(values) if name == "sinr_db" else None
