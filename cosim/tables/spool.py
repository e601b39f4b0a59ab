"""Columns of numbers kept outside memory until the end of a run: in a nameless temporary file, which ends with the process."""

import io
import tempfile
import weakref
from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO

import numpy as np

from vcmvsp.cosim.tables.columns import joined
from vcmvsp.cosim.types import Array

MEMORY_BYTES = 1 << 22  # kept in memory before there is a file: a short run makes none


class Spool:
    """Columns of numbers, appended part by part and read back column by column.

    A column whose values in a part are all the same takes no space there.

    Args:
        folder: of the temporary file; None: the system's folder for them.

    Attributes:
        starts: first row of each part, and the number of rows.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder
        self._file: IO[bytes] = io.BytesIO()
        self._size = 0
        self._parts: list[dict[str, Array | tuple[int, np.dtype[np.generic], int]]] = []
        self.starts = [0]

    def __len__(self) -> int:
        """Number of parts."""
        return len(self._parts)

    def append(self, part: Mapping[str, Array], rows: int) -> None:
        """Keep the next part of each column: so many rows of a table, of which a column may keep fewer values.

        Raises:
            OSError: e.g. the disk is full; nothing of the part is kept.
        """
        places: dict[str, Array | tuple[int, np.dtype[np.generic], int]] = {}
        self._file.seek(self._size)
        size = self._size
        for name, values in part.items():
            if _is_constant(values):
                places[name] = np.broadcast_to(values[0].copy(), values.shape)
            else:
                places[name] = size, values.dtype, len(values)
                size += self._file.write(values.tobytes())
        self._file.flush()
        if size > MEMORY_BYTES and isinstance(self._file, io.BytesIO):
            self._file = self._moved(self._file.getvalue())
        self._size = size
        self._parts.append(places)
        self.starts.append(self.starts[-1] + rows)

    def around(self, first: int, stop: int) -> tuple[range, slice]:
        """The parts with the rows from ``first`` to before ``stop``, and which of their rows these are."""
        parts = range(bisect_right(self.starts, first) - 1, bisect_left(self.starts, stop))
        return parts, slice(first - self.starts[parts.start], stop - self.starts[parts.start])

    def constant(self, name: str, part: int) -> Array | None:
        """A column in a part if all its values there are the same."""
        column = self._parts[part].get(name)
        return None if isinstance(column, tuple) else column

    def read(self, name: str, parts: Sequence[int], dtype: type[np.generic]) -> Array:
        """A column over these parts."""
        return joined([self._read(name, part) for part in parts], (0,), dtype)

    def _moved(self, content: bytes) -> IO[bytes]:
        """The temporary file, with this content."""
        file = tempfile.TemporaryFile(dir=self._folder)  # noqa: SIM115  open as long as this object exists
        weakref.finalize(self, file.close)
        file.write(content)
        file.flush()
        return file

    def _read(self, name: str, part: int) -> Array:
        column = self._parts[part][name]
        if not isinstance(column, tuple):
            return column
        place, dtype, count = column
        self._file.seek(place)
        return np.frombuffer(self._file.read(count * dtype.itemsize), dtype, count)


def _is_constant(values: Array) -> bool:
    """Whether all values have the same bits; no values have none."""
    bits = values.view(f"i{values.itemsize}")
    return len(bits) > 0 and bits[0] == bits[-1] and bool((bits == bits[0]).all())
