"""Rows and table of a study.

Until a table is built, a row is kept as the compressed JSON of its worker, which takes a twentieth of a dictionary's memory.
Columns, their order and types depend on the rows alone, not on the worker or time of a run.
"""

import re
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa

from vcmvsp.cosim.studies.plan import Plan, Run, label
from vcmvsp.cosim.tables.columns import as_bits, column, texts
from vcmvsp.cosim.types import Array

LOSSES = "radio.losses."


class Row(msgspec.Struct, frozen=True):
    """Row of one run."""

    values: dict[str, float | int | str | None] = {}  # flattened metrics
    error: str | None = None


encode = msgspec.json.Encoder().encode
decode = msgspec.json.Decoder(Row).decode


def packed(row: bytes) -> bytes:
    """An encoded row, compressed."""
    return zlib.compress(row, 1)


unpacked = zlib.decompress


def flat(metrics: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Every scalar of a nested mapping, by its path."""
    scalars: dict[str, Any] = {}
    for name, value in metrics.items():
        if isinstance(value, Mapping):
            scalars |= flat(value, f"{prefix}{name}.")
        elif not isinstance(value, list | tuple):
            scalars[f"{prefix}{name}"] = value
    return scalars


class Column:
    """Column of a metric, filled run by run: numbers or texts."""

    def __init__(self, size: int) -> None:
        self._numbers, self._valid = np.zeros(size), np.zeros(size, np.bool_)
        self._texts: dict[int, str] = {}
        self._whole = True

    def put(self, row: int, value: float | str) -> None:
        """Set a run's value."""
        if isinstance(value, str):
            self._texts[row] = value
            return
        self._numbers[row], self._valid[row] = value, True
        self._whole = self._whole and isinstance(value, int)

    def fill(self, rows: Array, value: int) -> None:
        """Set the value of the selected runs that have none."""
        empty = rows & ~self._valid
        self._numbers[empty], self._valid[empty] = value, True

    def arrow(self) -> "pa.Array[Any]":
        """Arrow array of texts, whole numbers, or numbers; an empty column is one of numbers."""
        if self._texts:
            return self.texts()
        whole = self._whole and self._valid.any()
        return column(self._numbers.astype(np.int64) if whole else self._numbers, self._valid)

    def texts(self) -> "pa.Array[Any]":
        """Arrow array of texts, also without any value."""
        return texts([self._texts.get(row) for row in range(len(self._valid))])


def table_of(plan: Plan, answers: Mapping[str, bytes]) -> pa.Table:
    """The table of the runs that have an answer (`packed`), in the plan's order.

    Columns: the varied keys, ``seed``, the metrics in alphabetical order (numbers in names by size), ``error``, ``digest``.
    """
    runs = [run for run in plan.runs if run.key in answers]
    metrics: dict[str, Column] = {name: Column(len(runs)) for name in plan.metrics}
    errors: list[str | None] = []
    for place, run in enumerate(runs):  # one by one, to save memory
        row = decode(unpacked(answers[run.key]))
        errors.append(row.error)
        for name, value in row.values.items():
            if name not in metrics:
                metrics[name] = Column(len(runs))
            if value is not None:
                metrics[name].put(place, value)
    succeeded = np.array([error is None for error in errors], np.bool_)
    digest = metrics.pop("digest", Column(len(runs)))
    columns: dict[str, Any] = {}
    for place, (key, values) in enumerate(plan.vary.items()):
        columns[key] = _varied([run.point[place] for run in runs], values)
    columns["seed"] = column(np.array([run.seed for run in runs], np.int64))
    for name in sorted(metrics.keys() - columns.keys() - {"error"}, key=_natural):
        metric = metrics.pop(name)  # frees the memory of the column
        if name.startswith(LOSSES):
            metric.fill(succeeded, 0)  # a loss cause that did not occur
        columns[name] = metric.arrow()
    columns["error"] = texts(errors)
    columns["digest"] = digest.texts()
    return pa.table(columns)


def answers_of(table: pa.Table, keys: Sequence[str], *, failed: bool = False) -> dict[str, bytes]:
    """Restore the answers (`packed`) of a table; of failed runs, which are repeated, only with ``failed``."""
    answers: dict[str, bytes] = {}
    names = [name for name in table.column_names if name not in (*keys, "seed", "error")]
    for batch in table.to_batches(max_chunksize=500):
        for row in batch.to_pylist():
            if failed or row["error"] is None:
                run = Run(tuple(row[key] for key in keys), row["seed"])
                answers[run.key] = packed(encode(Row({name: row[name] for name in names}, row["error"])))
    return answers


def _natural(name: str) -> list[Any]:
    """Sort key of a name: ``car2`` before ``car10``."""
    parts: list[Any] = re.split(r"(\d+)", name)
    parts[1::2] = map(int, parts[1::2])
    return parts


def _varied(values: Sequence[Any], all_values: Sequence[Any]) -> "pa.Array[Any]":
    """Column of a varied key, of the type of all its values in the plan; text for mixed types, lists and tables."""
    kinds = {type(value) for value in all_values}
    if kinds == {bool}:
        return pa.Array.from_buffers(pa.bool_(), len(values), [None, as_bits(np.array(values, np.bool_))])
    if kinds == {int}:
        return column(np.array(values, np.int64))
    if kinds <= {int, float}:
        return column(np.array(values, np.float64))
    return texts([label(value) for value in values])
