"""A fingerprint of what a run recorded: states, frames, commands, messages, odometry, fixes, notes, places and contacts.

It is taken over the values themselves, so it does not depend on how a table is chunked, in which order a dictionary lists its
names, or on the versions of the file formats.
"""

import hashlib

import numpy as np
import pyarrow as pa

from vcmvsp.cosim.tables.columns import names_of, nulls, numbers
from vcmvsp.cosim.types import Array


def digest(tables: list[pa.Table], rest: bytes = b"") -> str:
    """SHA-256 (hex) over all columns of the tables, name by name, and ``rest``."""
    total = hashlib.sha256()
    for table in tables:
        total.update(f"table {table.num_rows} {table.num_columns}\n".encode())
        for name in table.column_names:
            for part in _values(table, name):
                total.update(part)
    total.update(rest)
    return total.hexdigest()


def _values(table: pa.Table, name: str) -> list[bytes | memoryview]:
    """Name, type, names used, null mask and raw little-endian values of one column."""
    used: list[str] = []
    column_type = table.schema.field(name).type
    if pa.types.is_dictionary(column_type):
        kind, (used, raw) = "name", _canonical(*names_of(table, name))
    elif pa.types.is_floating(column_type):
        kind, raw = "float64", numbers(table, name).astype("<f8", copy=False)
    else:
        kind, raw = "int64", numbers(table, name).astype("<i8", copy=False)
    return [repr((name, kind, used)).encode(), np.packbits(nulls(table, name)).data, raw.data]


def _canonical(names: tuple[str, ...], codes: Array) -> tuple[list[str], Array]:
    """The names that occur, in alphabetical order, and each row as its place in that list."""
    used = sorted(names[code] for code in np.flatnonzero(np.bincount(codes)).tolist())
    place = {name: i for i, name in enumerate(used)}
    return used, np.array([place.get(name, 0) for name in names], "<i4")[codes]
