"""Why messages arrived or not: the links of a run, from its ``radio.parquet``.

Counts obey ``frames = received + sum of losses + under_way``: a frame that was on its way when the run ended is neither
received nor lost. Levels and ratios are those of frames that were on the air. What cannot be measured is None.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.config import messages
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.recording.run_tables import tables_of
from vcmvsp.cosim.tables.columns import names_of, nulls, numbers
from vcmvsp.cosim.tables.radio_frames import UNDER_WAY
from vcmvsp.cosim.types import Array

SCHEMA = "vcmvsp.radio/1"
RECEIVED = "received"
_NAMES = ("sender", "receiver", "outcome", "wall_materials")
NUMBERS = (
    *("frame", "sent_ns", "received_ns", "size_bytes", "distance_m", "rssi_dbm", "delay_ns", "snr_db", "sinr_db"),
    *("path_loss_db", "walls", "wall_loss_db", "shadowing_db", "fading_db", "air_time_ns", "queue_ns", "access_ns"),
)
"""Columns that are read."""
Pair = tuple[str, str]


class Log:
    """The frames of a run, by link.

    Args:
        folder: that a run has left.
        tell: takes a line for the user: that the run was cut, and how far its recording goes.

    Raises:
        UsageError: it is no such folder, or its tables cannot be read.
    """

    def __init__(self, folder: Path, tell: Callable[[str], None] = lambda _: None) -> None:
        if not folder.is_dir():
            raise UsageError(f"{folder}: is no directory of a run; for a scenario, ask for --coverage VEHICLE")
        try:
            recording = tables_of(folder, tell)
        except (OSError, ValueError) as error:  # a damaged table
            raise UsageError(f"{folder} cannot be read: {error}") from error
        missing = [name for name in (*_NAMES, *NUMBERS) if name not in recording.radio.column_names]
        if missing:
            raise UsageError(f"{folder}: radio.parquet has no {missing[0]}: it was written by another version; run it again")
        self.folder, self.facts = folder, recording.facts
        self._columns, self._words = _columns(recording.radio)
        self._columns["under_way"] = self._columns["outcome"] == self._code("outcome", UNDER_WAY)
        self._rows = self._by_link()

    @property
    def vehicles(self) -> tuple[str, ...]:
        """Those of the run."""
        return self.facts.vehicles

    def pairs(self, link: str = "*/*") -> list[Pair]:
        """The links (sender, receiver) that an expression like ``car1/car2`` or ``car1/*`` means, in the order of the run.

        Raises:
            UsageError: it is no such expression, or there is no such vehicle or link.
        """
        sender, slash, receiver = link.partition("/")
        if not slash or not sender or not receiver or "/" in receiver:
            raise UsageError(f"--link {link}: must be SENDER/RECEIVER, e.g. car1/car2, or car1/* for all that car1 sends")
        for name in (sender, receiver):
            if not any(fnmatchcase(each, name) for each in self.vehicles):
                raise UsageError(f"--link {link}: {messages.unknown('vehicle', name, self.vehicles)}")
        meant = [
            (a, b)
            for a in self.vehicles
            for b in self.vehicles
            if a != b and fnmatchcase(a, sender) and fnmatchcase(b, receiver)
        ]
        if not meant:
            alone = f"{self.folder}: {self.vehicles[0]} was the only vehicle, and there is no link"
            raise UsageError(alone if len(self.vehicles) == 1 else f"--link {link}: a vehicle has no link to itself")
        return meant

    def frames(self, pair: Pair) -> "Frames":
        """The frames of a link, in the order in which they were sent."""
        return Frames(self._columns, self._words, self._rows.get(pair, np.empty(0, np.int64)))

    def _by_link(self) -> dict[Pair, Array]:
        """Rows of each link, in the order of the table."""
        senders, receivers = self._words["sender"], self._words["receiver"]
        link = self._columns["sender"].astype(np.int64) * max(1, len(receivers)) + self._columns["receiver"]
        order = np.argsort(link, kind="stable")
        found, first = np.unique(link[order], return_index=True)
        pairs = [(senders[code // len(receivers)], receivers[code % len(receivers)]) for code in found.tolist()]
        return dict(zip(pairs, np.split(order, first[1:]), strict=True)) if pairs else {}

    def _code(self, column: str, word: str) -> int:
        words = self._words[column]
        return words.index(word) if word in words else -1


class Frames:
    """Some rows of the log."""

    def __init__(self, columns: Mapping[str, Array], words: Mapping[str, tuple[str, ...]], rows: Array) -> None:
        self._columns, self._words, self._rows = columns, words, rows

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, name: str) -> Array:
        """A column: numbers, or codes of names; received_ns and delay_ns are -1, sinr_db is NaN, where there is none."""
        values: Array = self._columns[name][self._rows]
        return values

    def where(self, chosen: Array) -> "Frames":
        """Those of them for which ``chosen`` (n,) is true."""
        return Frames(self._columns, self._words, self._rows[chosen])

    def words(self, name: str) -> list[str]:
        """A column of names."""
        return [self._words[name][code] for code in self[name].tolist()]

    def counts(self, name: str) -> dict[str, int]:
        """How often each name stands in a column, most frequent first."""
        counts = np.bincount(self[name], minlength=len(self._words[name]))
        return {self._words[name][code]: int(counts[code]) for code in np.argsort(-counts, kind="stable") if counts[code]}

    @property
    def decided(self) -> "Frames":
        """Those that were received or lost before the run ended."""
        return self.where(~self["under_way"])

    @property
    def arrived(self) -> "Frames":
        """Those that were received before the run ended."""
        return self.decided.where(self.decided["received_ns"] >= 0)


def overview(log: Log, link: str = "*/*") -> list[dict[str, Any]]:
    """The links that an expression means, the worst first: frames, received, losses, and medians of level and distance."""
    rows = [{**_counts(pair, log.frames(pair)), **_medians(log.frames(pair))} for pair in log.pairs(link)]
    return sorted(rows, key=lambda row: math.inf if row["delivery_ratio"] is None else row["delivery_ratio"])


def link_report(log: Log, pair: Pair) -> dict[str, Any]:
    """Everything about one link."""
    frames = log.frames(pair)
    sent, arrived = frames.where(frames["air_time_ns"] > 0), frames.arrived
    sinr = sent["sinr_db"]
    return {
        **_counts(pair, frames),
        "rssi_dbm": _quantiles(sent["rssi_dbm"], 5, 50, 95),
        "snr_db": _quantiles(sent["snr_db"], 5, 50, 95),
        "sinr_db": _quantiles(sinr[np.isfinite(sinr)], 5, 50, 95),
        "distance_m": _quantiles(sent["distance_m"], 0, 50, 100),
        "path_loss_db": _mean_and_sd(sent["path_loss_db"]),
        "walls": {
            "mean": _mean(sent["walls"]),
            "loss_db": _mean(sent["wall_loss_db"]),
            "materials": {name or "none": count / len(sent) for name, count in sent.counts("wall_materials").items()},
        },
        "shadowing_db": _mean_and_sd(sent["shadowing_db"]),
        "fading_db": _mean_and_sd(sent["fading_db"]),
        "delay_s": {
            "mean": _mean(arrived["delay_ns"] / SECOND_NS),
            **_quantiles(arrived["delay_ns"] / SECOND_NS, 5, 50, 95, 99, 100),
        },
        "queue_s": {"mean": _mean(frames["queue_ns"] / SECOND_NS), **_quantiles(frames["queue_ns"] / SECOND_NS, 95, 100)},
        "access_s": {"mean": _mean(sent["access_ns"] / SECOND_NS), **_quantiles(sent["access_ns"] / SECOND_NS, 95, 100)},
        "receptions": _receptions(arrived["received_ns"]),
    }


def _columns(radio: pa.Table) -> tuple[dict[str, Array], dict[str, tuple[str, ...]]]:
    """Columns as arrays, of names their codes; and the names."""
    columns = {name: numbers(radio, name, null=-1) for name in NUMBERS}
    columns["sinr_db"] = np.where(nulls(radio, "sinr_db"), np.nan, columns["sinr_db"])
    words = {}
    for name in _NAMES:
        words[name], columns[name] = names_of(radio, name)
    return columns, words


def _counts(pair: Pair, frames: Frames) -> dict[str, Any]:
    decided = frames.decided
    outcomes = decided.counts("outcome")
    received = outcomes.pop(RECEIVED, 0)
    return {
        "sender": pair[0],
        "receiver": pair[1],
        "frames": len(frames),
        "received": received,
        "under_way": len(frames) - len(decided),
        "delivery_ratio": received / len(decided) if len(decided) else None,
        "losses": {cause: {"frames": count, "share": count / len(decided)} for cause, count in outcomes.items()},
    }


def _medians(frames: Frames) -> dict[str, Any]:
    sent = frames.where(frames["air_time_ns"] > 0)
    return {
        "rssi_dbm": _median(sent["rssi_dbm"]),
        "distance_m": _median(sent["distance_m"]),
        "longest_gap_s": _receptions(frames.arrived["received_ns"])["longest_gap_s"],
    }


def _receptions(received_ns: Array) -> dict[str, float | None]:
    """First and last reception, and the longest time between two that follow each other."""
    times = np.sort(received_ns)
    longest = int(np.argmax(np.diff(times))) if len(times) > 1 else None
    return {
        "first_s": float(times[0] / SECOND_NS) if len(times) else None,
        "last_s": float(times[-1] / SECOND_NS) if len(times) else None,
        "longest_gap_s": None if longest is None else float((times[longest + 1] - times[longest]) / SECOND_NS),
        "gap_from_s": None if longest is None else float(times[longest] / SECOND_NS),
    }


def _quantiles(values: Array, *percents: int) -> dict[str, float | None]:
    """Percentiles, linear between ranks; those with a name are called by it."""
    named = {0: "min", 50: "median", 100: "max"}
    keys: Iterable[str] = [named.get(percent, f"p{percent}") for percent in percents]
    found = np.percentile(values, percents).tolist() if len(values) else [None] * len(percents)
    return dict(zip(keys, found, strict=True))


def _median(values: Array) -> float | None:
    return float(np.median(values)) if len(values) else None


def _mean(values: Array) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _mean_and_sd(values: Array) -> dict[str, float | None]:
    return {"mean": _mean(values), "sd": float(np.std(values)) if len(values) else None}
