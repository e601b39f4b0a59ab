"""Files of traces: read, checked, and sorted by link and time."""

from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import csv, parquet

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.config.binding import unknown
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.netsim.interfaces.layers import Floats, Ints

KEYS = ("time_s", "sender", "receiver")
LEVELS = ("snr_db", "rssi_dbm")
VALUES = (*LEVELS, "loss", "delay_s")

_LONGEST_S = 1e9  # either way: nanoseconds fit into 64 bits


class TraceRows(NamedTuple):
    """N rows of L links, sorted by link, and by time within each link; rows of the same time in the order of the file."""

    links: tuple[tuple[str, str], ...]  # sender and receiver of each link
    first: NDArray[np.intp]  # (L + 1,) first row of each link; N
    row_ns: Ints  # (N,)
    times_ns: Ints  # all different times, increasing
    stride: int  # more than there are times
    order: Ints  # (N,) link x stride + place of the time among `times_ns`: increasing
    values: dict[str, Floats]  # the columns that the file has, (N,) each


def read_rows(file: str) -> TraceRows:
    """The rows of a file.

    Raises:
        ScenarioError: it cannot be read, a column is missing, unknown or given twice, a value is missing, not finite or out of
            its range, or the time of a link goes back; with the first line (Parquet: row) for which that is so.
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
    return TraceRows(
        links=tuple((names[each // len(names)], names[each % len(names)]) for each in links.tolist()),
        first=np.searchsorted(link, np.arange(len(links) + 1)),
        row_ns=row_ns,
        times_ns=times_ns,
        stride=len(times_ns) + 1,
        order=link * (len(times_ns) + 1) + place,
        values={name: columns[name][rows] for name in VALUES if name in columns},
    )


def _read(path: Path) -> pa.Table:
    if path.suffix not in {".csv", ".parquet"}:
        raise ScenarioError(f"must be a .csv or .parquet file, not {path.name}", key="file")
    if not path.is_file():
        raise ScenarioError(f"there is no file {path}", key="file")
    try:
        if path.suffix == ".parquet":
            return parquet.read_table(path)
        kinds = {name: pa.string() if name in KEYS[1:] else pa.float64() for name in (*KEYS, *VALUES)}
        # One thread, so that errors name their row.
        return csv.read_csv(
            path, read_options=csv.ReadOptions(use_threads=False), convert_options=csv.ConvertOptions(column_types=kinds)
        )
    except (pa.ArrowException, OSError) as error:
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
        _refuse(path, f"says nothing about its links: it needs one or more of the columns {', '.join(VALUES)}")
    if set(LEVELS) <= set(columns):
        _refuse(path, "has both snr_db and rssi_dbm, which are the same quantity")


def _numbers(file: str, table: Any, name: str) -> Floats:
    """A column of numbers, each within its range."""
    try:
        column: Floats = table[name].cast(pa.float64()).to_numpy()
    except pa.ArrowException as error:
        _refuse(file, f"column {name} holds no numbers: {error}")
    low, high = {"loss": (0.0, 1.0), "delay_s": (0.0, _LONGEST_S), "time_s": (-_LONGEST_S, _LONGEST_S)}.get(name, (-1e9, 1e9))
    wrong = ~((column >= low) & (column <= high))
    if wrong.any():
        k = int(np.argmax(wrong))
        _refuse(file, f"{name} must be a number from {low:g} to {high:g}, not {column[k]:g}", row=k)
    return column


def _names(file: str, table: Any) -> tuple[list[str], tuple[Ints, Ints]]:
    """All names, and the place of each row's sender and receiver among them, (N,) each."""
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
    return coded.dictionary.to_pylist(), (places[: table.num_rows], places[table.num_rows :])


def _refuse(file: str | Path, problem: str, row: int | None = None) -> NoReturn:
    path = Path(file)
    where = "" if row is None else f" row {row + 1}:" if path.suffix == ".parquet" else f" line {_line(path, row)}:"
    raise ScenarioError(f"{path.name}{where} {problem}", key="file")


def _line(path: Path, row: int) -> int:
    """The line of a CSV file in which a row stands: header and empty lines count too."""
    with path.open(encoding="utf-8") as lines:
        filled = (number for number, line in enumerate(lines, start=1) if line.strip("\r\n"))
        return next(number for k, number in enumerate(filled) if k == row + 1)
