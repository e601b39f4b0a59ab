"""Trace-driven links: measured values, or values computed elsewhere, replace the models."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import ClassVar, NamedTuple, NoReturn

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import csv

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.config.binding import unknown
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.tables.schema import read_table
from vcmvsp.cosim.types import FileName
from vcmvsp.cosim.util import limits
from vcmvsp.netsim.interfaces.layers import Bools, Draw, Floats, Frame, Ints

KEYS = ("time_s", "sender", "receiver")
LEVELS = ("snr_db", "rssi_dbm")
VALUES = (*LEVELS, "loss", "delay_s")

_LONGEST_S = 1e9  # largest magnitude: nanoseconds fit into 64 bits


class TraceRows(NamedTuple):
    """N rows of L links, sorted by link, and by time within each link; rows of the same time in the order of the file."""

    links: tuple[tuple[str, str], ...]  # sender and receiver of each link
    first: NDArray[np.intp]  # (L + 1,) first row of each link; N
    row_ns: Ints  # (N,)
    times_ns: Ints  # all different times, increasing
    stride: int  # more than there are times
    order: Ints  # (N,) link x stride + place of the time among `times_ns`: increasing
    values: dict[str, Floats]  # the columns that the file has, (N,) each


class Moment(NamedTuple):
    """Rows of n links' traces at one instant: two neighbouring rows each, or one row twice."""

    traced: Bools  # (n,) whether the trace names the link
    before: NDArray[np.intp]  # (n,) row that counts
    after: NDArray[np.intp]  # (n,) the next row; without one, or without interpolation: the same
    weight: Floats  # (n,) of `after`, 0 to 1


@dataclass(frozen=True)
class Trace:
    """Links as a file has them: a row for each instant, sender and receiver, with what holds from then on.

    The file is CSV with a header, or Parquet. Its columns are ``time_s``, ``sender``, ``receiver``, and any of

    ===========================  =======================================================================================
    ``snr_db`` or ``rssi_dbm``   received level, above noise or absolute: instead of power, loss on the way, and fading
    ``loss``                     probability that a frame is lost: instead of what the models lose
    ``delay_s``                  from sending to reception, instead of the models'; but no frame arrives before its end
    ===========================  =======================================================================================

    A row is for one direction. Between rows the earlier one holds, or, with ``interpolate``, values are linear in time (levels
    in dB); a link's first row also holds before its time, the last row after it. Of rows with the same time the last one
    counts. A frame has the values of its start on the air. The models apply to links without rows.

    Args:
        file: path of a CSV or Parquet file with the columns ``time_s``, ``sender``, ``receiver`` and any of ``snr_db`` or
            ``rssi_dbm``, ``loss``, ``delay_s``; in a scenario relative to its folder.
        interpolate: straight lines between the rows, instead of steps.
        noise_dbm: what ``snr_db`` is counted from: the noise of the radio.
    """

    file: FileName
    interpolate: bool = False
    noise_dbm: float | None = None
    cause: ClassVar[str] = "traced loss"

    def __post_init__(self) -> None:
        if "snr_db" in self._rows.values and self.noise_dbm is None:
            raise ScenarioError("must be set: the file gives levels relative to it (snr_db)", key="noise_dbm")

    @property
    def columns(self) -> tuple[str, ...]:
        """The quantities in the file: ``snr_db`` or ``rssi_dbm``, ``loss``, ``delay_s``."""
        return tuple(self._rows.values)

    def names(self) -> tuple[str, ...]:
        """All senders and receivers in the file, sorted."""
        return tuple(sorted({name for link in self._rows.links for name in link}))

    def traced(self, frame: Frame) -> Bools:
        """Which of the frame's links the file names, (n,)."""
        return self._links(frame.sender, frame.receivers) >= 0

    def level_dbm(self, frame: Frame) -> Floats:
        """Level at each receiver, (n,) dBm; NaN: no value in the file."""
        column = next((name for name in LEVELS if name in self._rows.values), None)
        if column is None:
            return np.full(len(frame.receivers), np.nan)
        level = self._at(column, frame, untraced=np.nan)
        return level if column == "rssi_dbm" or self.noise_dbm is None else level + self.noise_dbm

    def lost(self, frame: Frame, draw: Draw) -> Bools:
        """Which receivers lose the frame, (n,); none without a value in the file."""
        if "loss" not in self._rows.values:
            return np.zeros(len(frame.receivers), np.bool_)
        return draw()[..., 0] < self._at("loss", frame, untraced=0.0)

    def delay_ns(self, frame: Frame, draw: Draw) -> Ints:
        """Earliest reception, counted from the sending, (n,) ns; 0: no value in the file."""
        if "delay_s" not in self._rows.values:
            return np.zeros(len(frame.receivers), np.int64)
        return np.rint(self._at("delay_s", frame, untraced=0.0) * SECOND_NS).astype(np.int64)

    def _at(self, column: str, frame: Frame, untraced: float) -> Floats:
        """A column at the frame's time, (n,)."""
        values, moment = self._rows.values[column], self._moment(frame.start_ns, frame.sender, frame.receivers)
        now = values[moment.before]
        if self.interpolate:
            now = now + moment.weight * (values[moment.after] - now)
        return np.where(moment.traced, now, untraced)

    def _find(self, time_ns: int, sender: str, receivers: tuple[str, ...]) -> Moment:
        rows, links = self._rows, self._links(sender, receivers)
        traced, links = links >= 0, np.maximum(links, 0)  # untraced links may find any row
        first, last = rows.first[links], rows.first[links + 1] - 1
        # Rows are sorted by link and time: one search, by link number and number of past times, finds the rows of all links.
        passed = np.searchsorted(rows.times_ns, time_ns, side="right")
        before = np.maximum(np.searchsorted(rows.order, links * rows.stride + passed) - 1, first)
        if not self.interpolate:
            return Moment(traced, before, before, np.zeros(len(links)))
        after = np.minimum(before + 1, last)
        begin, end = rows.row_ns[before], rows.row_ns[after]
        weight = np.clip((time_ns - begin) / np.maximum(end - begin, 1), 0.0, 1.0)
        return Moment(traced, before, after, weight)

    @cached_property
    def _rows(self) -> TraceRows:
        return read_rows(self.file)

    # All queries about one frame share a result: they precede the queries about the next frame.
    @cached_property
    def _moment(self) -> Callable[[int, str, tuple[str, ...]], Moment]:
        return lru_cache(maxsize=64)(self._find)

    @cached_property
    def _links(self) -> Callable[[str, tuple[str, ...]], NDArray[np.intp]]:
        """The number of each link in the file, (n,); -1: not in the file."""
        number = {link: k for k, link in enumerate(self._rows.links)}

        def links(sender: str, receivers: tuple[str, ...]) -> NDArray[np.intp]:
            return np.array([number.get((sender, receiver), -1) for receiver in receivers], np.intp)

        return lru_cache(maxsize=4096)(links)


def read_rows(file: str) -> TraceRows:
    """Read the rows of a trace file.

    Raises:
        ScenarioError: it cannot be read, a column is missing, unknown or given twice, a value is missing, not finite or out of
            its range, or the time of a link goes back; the message names the first such line (Parquet: row).
    """
    table = _read(Path(file))
    _check_columns(Path(file), table.column_names)
    if not table.num_rows:
        _refuse(file, "has no rows")
    columns = {name: _numbers(file, table, name) for name in table.column_names if name not in {"sender", "receiver"}}
    time_ns: Ints = np.rint(columns.pop("time_s") * SECOND_NS).astype(np.int64)

    names, ends = _names(file, table)
    links, link = np.unique(ends[0] * len(names) + ends[1], return_inverse=True)
    rows = np.argsort(link, kind="stable")
    link, row_ns = link[rows], time_ns[rows]
    back = (np.diff(row_ns) < 0) & (np.diff(link) == 0)
    if back.any():
        k, before = min(zip(rows[1:][back].tolist(), rows[:-1][back].tolist(), strict=True))
        times = f"{time_ns[k] / SECOND_NS:g} after {time_ns[before] / SECOND_NS:g}"
        _refuse(file, f"time_s goes back from {names[ends[0][k]]} to {names[ends[1][k]]}: {times}", row=k)
    times_ns, place = np.unique(row_ns, return_inverse=True)
    values = {name: columns[name][rows] for name in VALUES if name in columns}
    pairs = [divmod(each, len(names)) for each in links.tolist()]
    return TraceRows(
        links=tuple([(names[sender], names[receiver]) for sender, receiver in pairs]),
        first=np.searchsorted(link, np.arange(len(links) + 1)),
        row_ns=row_ns,
        times_ns=times_ns,
        stride=len(times_ns) + 1,
        order=link * (len(times_ns) + 1) + place,
        values=values,
    )


def _read(path: Path) -> pa.Table:
    if path.suffix not in {".csv", ".parquet"}:
        raise ScenarioError(f"must be a .csv or .parquet file, not {path.name}", key="file")
    if not path.is_file():
        raise ScenarioError(f"there is no file {path}", key="file")
    try:
        if path.suffix == ".parquet":
            return read_table(path)
        kinds = dict.fromkeys((*KEYS, *VALUES), pa.float64()) | dict.fromkeys(KEYS[1:], pa.string())
        limits.check_size(path, limits.CSV_BYTES)
        # One thread, so that errors name their row.
        return csv.read_csv(
            path, read_options=csv.ReadOptions(use_threads=False), convert_options=csv.ConvertOptions(column_types=kinds)
        )
    except (pa.ArrowException, ValueError, OSError) as error:
        _refuse(path, f"cannot be read: {error}")


def _check_columns(path: Path, columns: list[str]) -> None:
    for name in columns:
        if name not in (*KEYS, *VALUES):
            _refuse(path, "has an " + unknown("column", name, (*KEYS, *VALUES)))
        if columns.count(name) > 1:
            _refuse(path, f"has two columns {name}")
    missing = [name for name in KEYS if name not in columns]
    if missing:
        _refuse(path, f"has no column {', '.join(missing)}")
    if not set(columns) & set(VALUES):
        _refuse(path, f"has no quantity of a link: add one or more of the columns {', '.join(VALUES)}")
    if set(LEVELS) <= set(columns):
        _refuse(path, "has both snr_db and rssi_dbm; keep one of them")


def _numbers(file: str, table: pa.Table, name: str) -> Floats:
    """A column of numbers, each within its range."""
    try:
        column: Floats = table[name].cast(pa.float64()).to_numpy()
    except pa.ArrowException as error:
        _refuse(file, f"column {name} must hold numbers: {error}")
    low, high = {"loss": (0.0, 1.0), "delay_s": (0.0, _LONGEST_S), "time_s": (-_LONGEST_S, _LONGEST_S)}.get(name, (-1e9, 1e9))
    wrong = ~((column >= low) & (column <= high))
    if wrong.any():
        k = int(np.argmax(wrong))
        _refuse(file, f"{name} must be a number from {low:g} to {high:g}, not {column[k]:g}", row=k)
    return column


def _names(file: str, table: pa.Table) -> tuple[list[str], tuple[Ints, Ints]]:
    """All names, and the indices of each row's sender and receiver in them, (N,) each."""
    try:
        ends = [table[name].combine_chunks().cast(pa.string()) for name in ("sender", "receiver")]
    except pa.ArrowException as error:
        _refuse(file, f"sender and receiver must be names: {error}")
    both = pa.concat_arrays(ends)
    if both.null_count:
        missing = int(np.argmax(both.is_null().to_numpy(zero_copy_only=False))) % table.num_rows
        _refuse(file, "sender and receiver must be names", row=missing)
    coded = both.dictionary_encode()
    places = coded.indices.to_numpy().astype(np.int64)
    return [str(name) for name in coded.dictionary.to_pylist()], (places[: table.num_rows], places[table.num_rows :])


def _refuse(file: str | Path, problem: str, row: int | None = None) -> NoReturn:
    path = Path(file)
    where = ""
    if row is not None:
        where = f" row {row + 1}:" if path.suffix == ".parquet" else f" line {_line(path, row)}:"
    raise ScenarioError(f"{path.name}{where} {problem}", key="file")


def _line(path: Path, row: int) -> int:
    """Line number of a row in a CSV file; header and empty lines count."""
    with path.open(encoding="utf-8") as lines:
        filled = (number for number, line in enumerate(lines, start=1) if line.strip("\r\n"))
        return next(number for k, number in enumerate(filled) if k == row + 1)
