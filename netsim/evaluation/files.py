"""Files of a trial: positions from CSV, and rows of ``radio.parquet`` that are written as frames are decided."""

import contextlib
import math
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.tables.schema import RunFacts, radio_table
from vcmvsp.cosim.types import FrameReport, Name
from vcmvsp.cosim.util.files import read_cells, replacing
from vcmvsp.netsim.evaluation.broadcast_trial import Waypoints

COLUMNS = ("x", "y", "z")
PATH_COLUMNS = ("t", "name", *COLUMNS)
FARTHEST_M = 1e9
LATEST_S = 1e9

_Place = tuple[str, list[str]]  # file and line, for messages; cells


def read_positions(path: Path) -> Waypoints:
    """Read antennas' positions from a CSV file; empty lines are ignored.

    A line is either ``x,y,z``: a radio at rest, v0 being the first; or ``t,name,x,y,z``: a radio's position at a time. A header
    is optional. Units: m, s.

    Raises:
        UsageError: invalid file; the message names file, line and column.
    """
    lines = [(f"{path} line {number}", cells) for number, cells in read_cells(path)]
    over_time = bool(lines) and len(lines[0][1]) == len(PATH_COLUMNS)
    columns = PATH_COLUMNS if over_time else COLUMNS
    if lines and _is_header(*lines[0], columns):
        del lines[0]
    if not lines:
        raise UsageError(f"{path}: has no positions; write a line x,y,z (metres) for each vehicle")
    for where, cells in lines:
        if len(cells) != len(columns):
            problem = f"must have {len(columns)} columns ({','.join(columns)}), not {len(cells)}"
            raise UsageError(f"{where}: {problem}: {','.join(cells)[:60]}")
    if over_time:
        return _paths(lines)
    return Waypoints.fixed(np.array([_point(*each) for each in lines]))


def _is_header(where: str, cells: list[str], columns: tuple[str, ...]) -> bool:
    """Whether a line is a header; wrong column names are an error."""
    if any(_number(cell) is not None for cell in cells):
        return False
    if tuple(cell.lower().removesuffix("_m").removesuffix("_s") for cell in cells) != columns:
        problem = f"the columns must be {','.join(columns)}, not {','.join(cells)[:60]}"
        others = "" if columns == PATH_COLUMNS else f"; for positions over time {','.join(PATH_COLUMNS)}"
        raise UsageError(f"{where}: {problem}{others}")
    return True


def _paths(lines: list[_Place]) -> Waypoints:
    """Waypoints from lines ``t,name,x,y,z``, in which the times of a name increase."""
    times_ns: dict[str, list[int]] = {}
    points: dict[str, list[tuple[float, ...]]] = {}
    for where, cells in lines:
        time_ns = seconds_to_ns(_finite(cells[0], f"{where}, column t", -LATEST_S, LATEST_S, "s"))
        name = binding.convert(cells[1], Name, key=f"{where}, column name")
        earlier_ns = times_ns.setdefault(name, [])
        if earlier_ns and time_ns <= earlier_ns[-1]:
            raise UsageError(f"{where}: the times of {name} must increase, and {cells[0]} s is not after the one before")
        earlier_ns.append(time_ns)
        points.setdefault(name, []).append(_point(where, cells[2:]))
    return Waypoints(
        names=tuple(times_ns), times_ns=tuple(map(tuple, times_ns.values())), points=tuple(map(np.array, points.values()))
    )


def _point(where: str, cells: list[str]) -> tuple[float, ...]:
    named_cells = zip(cells, COLUMNS, strict=True)
    return tuple(_finite(cell, f"{where}, column {name}", -FARTHEST_M, FARTHEST_M, "m") for cell, name in named_cells)


def _finite(cell: str, where: str, least: float, most: float, unit: str) -> float:
    value = _number(cell)
    if value is None:
        raise UsageError(f"{where}: must be a number, not {cell[:60]!r}")
    if not math.isfinite(value):
        raise UsageError(f"{where}: must be finite, not {cell}")
    if not least <= value <= most:
        raise UsageError(f"{where}: must be from {least:g} to {most:g} {unit}, not {cell}")
    return value


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None


ROWS = 1 << 18  # in a row group, exceeded by at most one frame's rows


class RowFile:
    """A Parquet file with a row per frame and receiver, in the order in which frames were sent.

    The file is there on success only. Equal reports give equal bytes.
    """

    def __init__(self, path: Path, facts: RunFacts, rows: int = ROWS) -> None:
        self._path, self._facts, self._rows = path, facts, rows
        self._early: dict[int, FrameReport] = {}  # by frame: decided before a frame that was sent earlier
        self._next = 0
        self._batch: list[FrameReport] = []
        self._row_count = 0

    def __enter__(self) -> Self:
        if self._path.is_dir():
            raise UsageError(f"{self._path} is a folder; give a file name")
        if not self._path.parent.is_dir():
            raise UsageError(f"cannot write {self._path}: the folder {self._path.parent} does not exist; create it first")
        schema = radio_table([], self._facts).schema
        names = [field.name for field in schema if pa.types.is_dictionary(field.type)]
        floats = [field.name for field in schema if pa.types.is_floating(field.type)]
        options: dict[str, Any] = {"use_dictionary": names, "use_byte_stream_split": floats}  # as `cosim.tables.schema` has
        try:
            with contextlib.ExitStack() as opened:
                place = opened.enter_context(replacing(self._path))
                self._writer = opened.enter_context(pq.ParquetWriter(place, schema, compression="zstd", **options))
                opened.push(self._write_rest)
                self._open = opened.pop_all()
        except OSError as error:
            raise self._refused(error) from error
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            self._open.__exit__(kind, error, trace)
        except OSError as problem:
            raise self._refused(problem) from problem

    def _write_rest(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self._write()

    def add(self, report: FrameReport) -> None:
        """Add the report of one frame: each frame once, in any order."""
        self._early[report.frame] = report
        while (following := self._early.pop(self._next, None)) is not None:
            self._next += 1
            self._batch.append(following)
            self._row_count += len(following.receivers)
        if self._row_count >= self._rows:
            try:
                self._write()
            except OSError as problem:
                raise self._refused(problem) from problem

    def _write(self) -> None:
        if self._row_count:
            self._writer.write_table(radio_table(self._batch, self._facts), row_group_size=self._row_count)
        self._batch, self._row_count = [], 0

    def _refused(self, error: OSError) -> UsageError:
        return UsageError(f"cannot write {self._path}: {error.strerror or error}")
