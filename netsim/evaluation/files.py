"""Files of a trial: positions from CSV, and rows of ``radio.parquet`` that are written as frames are decided."""

import math
import shutil
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.tables.schema import RunFacts, radio_table
from vcmvsp.cosim.types import FrameReport
from vcmvsp.cosim.util.files import PART, read_cells
from vcmvsp.netsim.interfaces.layers import Floats

COLUMNS = ("x", "y", "z")
FARTHEST_M = 1e9


def read_positions(path: Path) -> Floats:
    """Read positions from a CSV file, (n, 3) m; empty lines are ignored.

    Raises:
        UsageError: invalid file; the message names file, line and column.
    """
    points: list[tuple[float, ...]] = []
    for place, (number, cells) in enumerate(read_cells(path)):
        where = f"{path} line {number}"
        if place or not _is_header(cells, where):
            points.append(_point(cells, where))
    if not points:
        raise UsageError(f"{path}: has no positions; write a line x,y,z (metres) for each vehicle")
    return np.array(points)


def _is_header(cells: list[str], where: str) -> bool:
    """Whether a line is a header; wrong column names are an error."""
    if any(_number(cell) is not None for cell in cells):
        return False
    if tuple(cell.lower().removesuffix("_m") for cell in cells) != COLUMNS:
        raise UsageError(f"{where}: the columns must be x,y,z, not {','.join(cells)}")
    return True


def _point(cells: list[str], where: str) -> tuple[float, ...]:
    if len(cells) != len(COLUMNS):
        raise UsageError(f"{where}: must have 3 columns (x,y,z), not {len(cells)}: {','.join(cells)[:60]}")
    return tuple(_coordinate(cell, f"{where}, column {name}") for cell, name in zip(cells, COLUMNS, strict=True))


def _coordinate(cell: str, where: str) -> float:
    value = _number(cell)
    if value is None:
        raise UsageError(f"{where}: must be a number, not {cell[:60]!r}")
    if not math.isfinite(value):
        raise UsageError(f"{where}: must be finite, not {cell}")
    if abs(value) > FARTHEST_M:
        raise UsageError(f"{where}: must be from -{FARTHEST_M:g} to {FARTHEST_M:g} m, not {cell}")
    return value


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None


ROWS = 1 << 18  # in a row group, exceeded by at most one frame's rows


class RowFile:
    """A Parquet file with a row per frame and receiver, in the order in which frames were sent.

    The file is written beside ``path`` and renamed on success; on failure it is deleted. Equal reports give equal bytes.
    """

    def __init__(self, path: Path, facts: RunFacts, rows: int = ROWS) -> None:
        self._path, self._facts, self._rows = path, facts, rows
        self._early: dict[int, FrameReport] = {}  # by frame: decided before a frame that was sent earlier
        self._next = 0
        self._batch: list[FrameReport] = []
        self._held = 0

    def __enter__(self) -> Self:
        if self._path.is_dir():
            raise UsageError(f"{self._path} is a folder; give a file name")
        if not self._path.parent.is_dir():
            raise UsageError(f"cannot write {self._path}: the folder {self._path.parent} does not exist; create it first")
        schema = radio_table([], self._facts).schema
        options: dict[str, Any] = {  # as in `cosim.tables.schema.write_table`
            "use_dictionary": [field.name for field in schema if pa.types.is_dictionary(field.type)],
            "use_byte_stream_split": [field.name for field in schema if pa.types.is_floating(field.type)],
        }
        try:
            self._beside = Path(tempfile.mkdtemp(prefix=".vcmvsp-", suffix=PART, dir=self._path.parent))
            self._partial = self._beside / self._path.name
            self._writer = pq.ParquetWriter(self._partial, schema, compression="zstd", **options)
        except OSError as error:
            raise self._refused(error) from error
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            if kind is None:
                self._write()
            self._writer.close()
            if kind is None:
                self._partial.replace(self._path)
        except OSError as problem:
            raise self._refused(problem) from problem
        finally:
            shutil.rmtree(self._beside, ignore_errors=True)

    def add(self, report: FrameReport) -> None:
        """Add the report of one frame: each frame once, in any order."""
        self._early[report.frame] = report
        while (following := self._early.pop(self._next, None)) is not None:
            self._next += 1
            self._batch.append(following)
            self._held += len(following.receivers)
        if self._held >= self._rows:
            try:
                self._write()
            except OSError as problem:
                raise self._refused(problem) from problem

    def _write(self) -> None:
        if self._held:
            self._writer.write_table(radio_table(self._batch, self._facts), row_group_size=self._held)
        self._batch, self._held = [], 0

    def _refused(self, error: OSError) -> UsageError:
        return UsageError(f"cannot write {self._path}: {error.strerror or error}")
