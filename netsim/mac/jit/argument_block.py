"""Named arrays and numbers as one pointer for compiled code.

A block is a row of 8-byte words: for each field of a named tuple its value, or address and shape of an array.
"""

from typing import Any

import numpy as np

WORD = 8  # bytes

Layout = tuple[tuple[str, str, int], ...]
"""For each field of a block: name, NumPy type string, number of dimensions; 0: a single number."""


class Block:
    """The fields of a named tuple: C-contiguous arrays, ints and floats. They live as long as it does."""

    def __init__(self, fields: Any) -> None:
        self.fields = fields
        words: list[int] = []
        layout: list[tuple[str, str, int]] = []
        for name, value in zip(getattr(fields, "_fields", ()), fields, strict=True):
            if isinstance(value, np.ndarray):
                if not value.flags.c_contiguous:
                    raise ValueError(f"{name} is not C-contiguous")
                layout.append((name, value.dtype.str, value.ndim))
                words += [value.ctypes.data, *value.shape]
            elif isinstance(value, (int, np.integer)):
                layout.append((name, "<i8", 0))
                words.append(int(value))
            else:
                layout.append((name, "<f8", 0))
                words.append(int(np.float64(value).view(np.int64)))
        self.layout: Layout = tuple(layout)
        self._words = np.array(words, np.int64)
        self.address = self._words.ctypes.data
