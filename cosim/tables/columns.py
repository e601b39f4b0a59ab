"""Conversion between Arrow columns and NumPy arrays, by their buffers.

`pyarrow.array` and ``to_numpy`` import pandas if it is installed, which takes a second of every run.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import DTypeLike

from vcmvsp.cosim.types import Array


def column(values: Array, valid: Array | None = None) -> "pa.Array[Any]":
    """An Arrow array of the values, null where not valid; it shares their memory, so they must not change."""
    bits = None if valid is None or valid.all() else as_bits(valid)
    whole = pa.py_buffer(np.ascontiguousarray(values).data)
    return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), len(values), [bits, whole])


def name_column(names: Sequence[str], codes: Array) -> "pa.Array[Any]":
    """An Arrow array in which row i is ``names[codes[i]]``."""
    return pa.DictionaryArray.from_arrays(column(codes), texts(names))


def texts(values: Sequence[str | None]) -> "pa.Array[Any]":
    """An Arrow array of texts, null for None."""
    encoded = [(value or "").encode() for value in values]
    offsets = np.cumsum([0, *map(len, encoded)], dtype=np.int32)
    valid = np.array([value is not None for value in values], np.bool_)
    bits = None if valid.all() else as_bits(valid)
    buffers = [bits, pa.py_buffer(offsets.tobytes()), pa.py_buffer(b"".join(encoded))]
    return pa.Array.from_buffers(pa.string(), len(values), buffers)


def as_bits(values: Array) -> pa.Buffer:
    """Truth values as bits."""
    return pa.py_buffer(np.packbits(values, bitorder="little").tobytes())


def numbers(table: pa.Table, name: str, null: float = 0) -> Array:
    """The numbers of a column, with ``null`` for missing values."""
    chunks = table[name].chunks
    return joined([_numbers(chunk, null) for chunk in chunks], (0,), table.schema.field(name).type.to_pandas_dtype())


def names_of(table: pa.Table, name: str) -> tuple[tuple[str, ...], Array]:
    """The distinct names of a column of names, and the index of each row's name among them."""
    chunks: Any = table[name].unify_dictionaries().chunks
    names = tuple(map(str, chunks[0].dictionary)) if chunks else ()
    return names, joined([_numbers(chunk.indices, 0) for chunk in chunks], (0,), np.int32)


def code_of(names: Sequence[str], name: str) -> int:
    """Index of a name among the names; -1: not among them."""
    return names.index(name) if name in names else -1


def codes_of(names: Sequence[str], others: Sequence[str]) -> Array:
    """Index of each of the others among the names, as `code_of`."""
    numbered = {name: number for number, name in enumerate(names)}
    return np.array([numbered.get(each, -1) for each in others], np.int64)


def nulls(table: pa.Table, name: str) -> Array:
    """Mask of the missing values of a column."""
    chunks = table[name].chunks
    return joined([~_valid(chunk) for chunk in chunks], (0,), np.bool_)


def joined(parts: Sequence[Array], empty: tuple[int, ...], dtype: DTypeLike = np.float64) -> Array:
    """Concatenate arrays; a single one is returned unchanged, none gives an array of shape ``empty``."""
    whole = parts[0] if len(parts) == 1 else np.concatenate([np.empty(empty, dtype), *parts])
    return whole.astype(dtype, copy=False)


def _numbers(chunk: Any, null: float) -> Array:
    values = np.frombuffer(chunk.buffers()[1], chunk.type.to_pandas_dtype(), len(chunk) + chunk.offset)[chunk.offset :]
    return np.where(_valid(chunk), values, np.asarray(null, values.dtype)) if chunk.null_count else values


def _valid(chunk: Any) -> Array:
    bits = chunk.buffers()[0]
    if bits is None:
        return np.ones(len(chunk), np.bool_)
    unpacked = np.unpackbits(np.frombuffer(bits, np.uint8), count=len(chunk) + chunk.offset, bitorder="little")
    return unpacked[chunk.offset :].astype(np.bool_)
