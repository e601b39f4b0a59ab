"""Rows of ``radio.parquet`` that go to a file as frames are decided, for runs whose rows do not fit into memory."""

import shutil
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import pyarrow as pa
import pyarrow.parquet as pq

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.tables.schema import RunFacts, radio_table
from vcmvsp.cosim.types import FrameReport
from vcmvsp.cosim.util.files import PART

ROWS = 1 << 18  # in a group, and those of one frame


class RowFile:
    """A Parquet file with a row per frame and receiver, in the order in which frames were sent.

    It is written beside ``path`` and takes that name when all is well; otherwise nothing is left. The same reports give
    the same bytes.
    """

    def __init__(self, path: Path, facts: RunFacts, rows: int = ROWS) -> None:
        self._path, self._facts, self._rows = path, facts, rows
        self._early: dict[int, FrameReport] = {}  # by frame: what was decided before a frame that was sent earlier
        self._next = 0
        self._batch: list[FrameReport] = []
        self._held = 0

    def __enter__(self) -> Self:
        if self._path.is_dir():
            raise UsageError(f"{self._path} is a folder; name a file")
        if not self._path.parent.is_dir():
            raise UsageError(f"cannot write {self._path}: there is no folder {self._path.parent}")
        schema = radio_table([], self._facts).schema
        options: dict[str, Any] = {  # those of `cosim.tables.schema.write_table`
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
        """Take over one frame; every frame comes once, in any order."""
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
