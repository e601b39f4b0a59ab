"""Link statistics of a run, from its ``radio.parquet``: deliveries, losses and their causes.

Counts obey ``frames = received + sum of losses + under_way``: a frame in transit at the end of the run is neither received nor
lost. Levels and ratios are taken over frames that were on the air. Unmeasurable values are None.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.metrics.radio import quantiles
from vcmvsp.cosim.recording.recorded_run import radio_columns
from vcmvsp.cosim.tables.columns import code_of, codes_of, names_of, nulls, numbers
from vcmvsp.cosim.tables.radio_frames import UNDER_WAY
from vcmvsp.cosim.tables.schema import Table, blocks_of
from vcmvsp.cosim.types import Array

SCHEMA = "vcmvsp.radio/1"
RECEIVED = "received"
_NAMES = ("sender", "receiver", "outcome", "wall_materials")
NUMBERS = (
    *("frame", "sent_ns", "received_ns", "size_bytes", "distance_m", "rssi_dbm", "delay_ns", "snr_db", "sinr_db"),
    *("path_loss_db", "walls", "wall_loss_db", "shadowing_db", "fading_db", "air_time_ns", "queue_ns", "access_ns"),
)
"""Columns read from the table."""
Pair = tuple[str, str]


class Log:
    """The frames of a run by link; columns are read on demand.

    ``tell`` receives a line for the user if the run was cut: how far its recording goes.

    Raises:
        UsageError: the folder is no run, or its tables are unreadable.
    """

    def __init__(self, folder: Path, tell: Callable[[str], None] = lambda _: None) -> None:
        if not folder.is_dir():
            raise UsageError(f"{folder}: not the folder of a run; for a scenario, use --coverage VEHICLE")
        try:
            self.facts, names, self._read = radio_columns(folder, tell)
        except (OSError, ValueError) as error:  # a damaged table
            raise UsageError(f"{folder} cannot be read: {error}") from error
        missing = [name for name in (*_NAMES, *NUMBERS) if name not in names]
        if missing:
            raise UsageError(f"{folder}: radio.parquet of another version has no {missing[0]}: run the scenario again")
        self.folder, self.vehicles = folder, self.facts.vehicles
        self._columns: dict[str, Array] = {}  # cached columns, sorted by link
        self.names: dict[str, tuple[str, ...]] = {}
        """Names behind the codes of each column of names."""
        self._spans, self._order = self._by_link()

    def pairs(self, link: str = "*/*") -> list[Pair]:
        """The links (sender, receiver) that match an expression such as ``car1/car2`` or ``car1/*``, in the order of the run.

        Raises:
            UsageError: the expression is invalid, or matches no vehicle or link.
        """
        sender, slash, receiver = link.partition("/")
        if not slash or not sender or not receiver or "/" in receiver:
            raise UsageError(f"--link {link}: must be SENDER/RECEIVER, e.g. car1/car2, or car1/* for all that car1 sends")
        senders = [name for name in self.vehicles if fnmatchcase(name, sender)]
        receivers = [name for name in self.vehicles if fnmatchcase(name, receiver)]
        for name, matches in ((sender, senders), (receiver, receivers)):
            if not matches:
                raise UsageError(f"--link {link}: {binding.unknown('vehicle', name, self.vehicles)}")
        pairs = [(a, b) for a in senders for b in receivers if a != b]
        if not pairs:
            alone = f"{self.folder}: a run with one vehicle, {self.vehicles[0]}, has no links"
            raise UsageError(alone if len(self.vehicles) == 1 else f"--link {link}: a vehicle has no link to itself")
        return pairs

    def frames(self, pair: Pair) -> "LinkFrames":
        """The frames of a link, in order of sending."""
        return LinkFrames(self, np.arange(*self._spans.get(pair, (0, 0))))

    def only(self, pairs: Sequence[Pair]) -> None:
        """Drop all other links to free their memory."""
        kept_pairs = [pair for pair in dict.fromkeys(pairs) if pair in self._spans]
        parts = [self._order[slice(*self._spans[pair])] for pair in kept_pairs]
        self._spans = _spans(kept_pairs, list(map(len, parts)))
        self._order, self._columns = np.concatenate([np.empty(0, np.int64), *parts]), {}

    def column(self, name: str) -> Array:
        """A column by name, read on first use."""
        if name not in self._columns:
            if name == "under_way":
                outcome, names = self.column("outcome"), self.names["outcome"]
                self._columns[name] = outcome == code_of(names, UNDER_WAY)
            else:
                self._columns[name] = self._column(name)[self._order]
        return self._columns[name]

    def _column(self, name: str) -> Array:
        """A column in table order: numbers, or codes of names."""
        try:
            table = self._read(name)
        except (OSError, ValueError) as error:
            raise UsageError(f"{self.folder} cannot be read: {error}") from error
        if name in _NAMES:
            self.names[name], codes = names_of(table, name)
            return codes
        values = numbers(table, name, null=-1)
        return np.where(nulls(table, name), np.nan, values) if name == "sinr_db" else values

    def _by_link(self) -> tuple[dict[Pair, tuple[int, int]], Array]:
        """The span of rows of each link, and all rows sorted by link, in table order within each link."""
        link = self._column("sender").astype(np.int32)  # of at most `limits.VEHICLES` squared
        senders, receiver = self.names["sender"], self._column("receiver")
        receivers = self.names["receiver"]
        link *= max(1, len(receivers))
        link += receiver
        is_small = link.max(initial=0) < 1 << 16  # radix sort, in linear time
        order = np.argsort(link.astype(np.uint16) if is_small else link, kind="stable")
        link = link[order]
        first = np.flatnonzero(np.diff(link, prepend=-1))
        pairs = [(senders[code // len(receivers)], receivers[code % len(receivers)]) for code in link[first].tolist()]
        return _spans(pairs, np.diff(first, append=len(link)).tolist()), order


class LinkFrames:
    """Selected rows of a run's radio log (``radio.parquet``), read by column name."""

    def __init__(self, log: Log, rows: Array) -> None:
        self._log, self._rows = log, rows

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, name: str) -> Array:
        """A column: numbers, or codes of names; received_ns and delay_ns are -1 and sinr_db is NaN without a value."""
        return self._log.column(name)[self._rows]

    def select(self, chosen: Array) -> "LinkFrames":
        """The rows for which ``chosen`` (n,) is true."""
        return LinkFrames(self._log, self._rows[chosen])

    def words(self, name: str) -> list[str]:
        """A column of names as text."""
        codes = self[name].tolist()
        return [self._log.names[name][code] for code in codes]

    def counts(self, name: str) -> dict[str, int]:
        """Frequency of each name in a column, most frequent first."""
        counts, names = np.bincount(self[name]), self._log.names[name]
        return {names[code]: int(counts[code]) for code in np.argsort(-counts, kind="stable") if counts[code]}

    @property
    def decided(self) -> "LinkFrames":
        """The frames received or lost before the run ended."""
        return self.select(~self["under_way"])

    @property
    def arrived(self) -> "LinkFrames":
        """The frames received before the run ended."""
        return self.decided.select(self.decided["received_ns"] >= 0)


def overview(log: Log, link: str = "*/*") -> list[dict[str, Any]]:
    """The links that match an expression, worst first: frames, received, losses, and medians of level and distance."""
    rows = []
    for pair in log.pairs(link):
        frames = log.frames(pair)
        sent, gaps = frames.select(frames["air_time_ns"] > 0), _receptions(frames.arrived["received_ns"])
        medians: dict[str, float | None] = dict.fromkeys(("rssi_dbm", "distance_m"))
        if len(sent):
            medians = {name: float(np.median(sent[name])) for name in medians}
        rows.append({**_counts(pair, frames), **medians, "longest_gap_s": gaps["longest_gap_s"]})
    return sorted(rows, key=lambda row: math.inf if row["delivery_ratio"] is None else row["delivery_ratio"])


def link_report(log: Log, pair: Pair) -> dict[str, Any]:
    """All statistics of one link."""
    frames = log.frames(pair)
    sent, arrived = frames.select(frames["air_time_ns"] > 0), frames.arrived
    sinr = sent["sinr_db"]
    return {
        **_counts(pair, frames),
        "rssi_dbm": quantiles(sent["rssi_dbm"], ("p5", "median", "p95")),
        "snr_db": quantiles(sent["snr_db"], ("p5", "median", "p95")),
        "sinr_db": quantiles(sinr[np.isfinite(sinr)], ("p5", "median", "p95")),
        "distance_m": quantiles(sent["distance_m"], ("min", "median", "max")),
        "path_loss_db": quantiles(sent["path_loss_db"], ("mean", "sd")),
        "walls": {
            **quantiles(sent["walls"], ("mean",)),
            "loss_db": quantiles(sent["wall_loss_db"], ("mean",))["mean"],
            "materials": {name or "none": count / len(sent) for name, count in sent.counts("wall_materials").items()},
        },
        "shadowing_db": quantiles(sent["shadowing_db"], ("mean", "sd")),
        "fading_db": quantiles(sent["fading_db"], ("mean", "sd")),
        "delay_s": quantiles(arrived["delay_ns"] / SECOND_NS, ("mean", "p5", "median", "p95", "p99", "max")),
        "queue_s": quantiles(frames["queue_ns"] / SECOND_NS, ("mean", "p95", "max")),
        "access_s": quantiles(sent["access_ns"] / SECOND_NS, ("mean", "p95", "max")),
        "receptions": _receptions(arrived["received_ns"]),
    }


def _spans(pairs: Sequence[Pair], counts: Sequence[int]) -> dict[Pair, tuple[int, int]]:
    return dict(zip(pairs, pairwise(accumulate(counts, initial=0)), strict=True))


def _counts(pair: Pair, frames: LinkFrames) -> dict[str, Any]:
    decided = frames.decided
    outcomes = decided.counts("outcome")
    received = outcomes.pop(RECEIVED, 0)
    losses = {cause: {"frames": count, "share": count / len(decided)} for cause, count in outcomes.items()}
    return {
        "sender": pair[0],
        "receiver": pair[1],
        "frames": len(frames),
        "received": received,
        "under_way": len(frames) - len(decided),
        "delivery_ratio": received / len(decided) if len(decided) else None,
        "losses": losses,
    }


def _receptions(received_ns: Array) -> dict[str, float | None]:
    times, gaps = np.sort(received_ns), np.diff(np.sort(received_ns))
    report = dict.fromkeys(("first_s", "last_s", "longest_gap_s", "gap_from_s"))
    if len(times):
        report |= {"first_s": float(times[0] / SECOND_NS), "last_s": float(times[-1] / SECOND_NS)}
    if len(gaps):
        report |= {"longest_gap_s": float(gaps.max() / SECOND_NS), "gap_from_s": float(times[gaps.argmax()] / SECOND_NS)}
    return report


@dataclass(frozen=True)
class Links:
    """Statistics of all links: arrays (n, n), [sender, receiver], in the order of ``names``.

    Counts are as in `Log`; ratios are over decided frames, levels over frames that were on the air.
    """

    names: tuple[str, ...]
    sent: Array
    received: Array
    under_way: Array
    level_dbm: Array  # mean; NaN where no frame was on the air
    frames: Array  # (n,) sent by each; a frame for several receivers counts once
    losses: Mapping[str, Array]  # by cause, the most frequent first

    @property
    def pairs(self) -> Iterator[tuple[int, int]]:
        """The links with at least one frame, in the order of the run."""
        yield from ((int(a), int(b)) for a, b in np.argwhere(self.sent > 0))

    def ratio(self, a: int, b: int) -> float | None:
        """Share of decided frames that were received."""
        decided = int(self.sent[a, b] - self.under_way[a, b])
        return int(self.received[a, b]) / decided if decided else None

    def lost_to(self, a: int, b: int) -> str:
        """Losses of a link by cause, as text."""
        counts = [(cause, int(lost[a, b])) for cause, lost in self.losses.items()]
        return ", ".join(f"{count} {cause}" for cause, count in sorted(counts, key=lambda each: -each[1]) if count)


def links_of(radio: Table, vehicles: Sequence[str]) -> Links:
    """Compute the statistics of all links of a run; ``vehicles`` in the order of the table."""
    names = _all_names(radio, vehicles)
    n, newest = len(names), -1
    fates = defaultdict[str, Array](lambda: np.zeros((n, n), np.int64))
    aired, level_dbm, frames = np.zeros((n, n), np.int64), np.zeros(n * n), np.zeros(n, np.int64)
    for block in blocks_of(radio, ("sender", "receiver", "outcome", "air_time_ns", "rssi_dbm", "frame")):
        (senders, by), (receivers, to), (words, fate) = (names_of(block, name) for name in ("sender", "receiver", "outcome"))
        by = codes_of(names, senders)[by]
        code = by * n + codes_of(names, receivers)[to]
        for number, word in enumerate(words):
            fates[word] += _by_pair(code[fate == number], n)
        on_air = numbers(block, "air_time_ns") > 0
        aired += _by_pair(code[on_air], n)
        np.add.at(level_dbm, code[on_air], numbers(block, "rssi_dbm")[on_air])
        frame = numbers(block, "frame")
        frames += np.bincount(by[np.diff(frame, prepend=newest) != 0], minlength=n)  # the rows of a frame are adjacent
        newest = int(frame[-1]) if len(frame) else newest
    mean_dbm = np.full((n, n), np.nan)
    np.divide(level_dbm.reshape(n, n), aired, out=mean_dbm, where=aired > 0)
    sent = sum(fates.values(), start=np.zeros((n, n), np.int64))
    received, under_way = fates.pop(RECEIVED, 0 * sent), fates.pop(UNDER_WAY, 0 * sent)
    most = sorted(fates.items(), key=lambda each: -int(each[1].sum()))
    return Links(names, sent, received, under_way, mean_dbm, frames, {cause: lost for cause, lost in most if lost.any()})


def _by_pair(code: Array, n: int) -> Array:
    return np.bincount(code, minlength=n * n).reshape(n, n)


def _all_names(radio: Table, vehicles: Sequence[str]) -> tuple[str, ...]:
    """The vehicles, and any other names in the table."""
    names = dict.fromkeys(vehicles)
    for block in blocks_of(radio, ("sender", "receiver")):
        names |= dict.fromkeys((*names_of(block, "sender")[0], *names_of(block, "receiver")[0]))
    return tuple(names)
