"""Levels of frames, in rows that frames share as long as they are needed, and that are used again."""

import numpy as np

from vcmvsp.netsim.interfaces.layers import Floats, Ints
from vcmvsp.netsim.mac.dcf.state import NOBODY


class PowerRows:
    """Rows of levels at n radios; ``table``, (r, n) mW, becomes another array when it grows."""

    def __init__(self, table: Floats) -> None:
        self.table = table
        self._free = free_numbers(0, len(table))
        self._uses = np.zeros(len(table), np.int64)
        self._by_sender: Floats | None = None  # of `of_senders`, and
        self._row_of = np.full(table.shape[1], NOBODY)  # where those of each sender are kept

    def keep(self, power_mw: Floats) -> int:
        """The row of a frame that shares its levels, (n,), with no other."""
        (row,) = self._take(1)
        self.table[row], self._uses[row] = power_mw, 1
        return row

    def of_senders(self, sender: Ints, power_mw: Floats) -> Ints:
        """The rows of frames of some senders (k,), by the levels of all, (n, n); the same array means the same levels."""
        if power_mw is not self._by_sender:
            self.leave(self._row_of[self._row_of != NOBODY])
            self._row_of[:] = NOBODY
            self._by_sender = power_mw
        missing = np.unique(sender[self._row_of[sender] == NOBODY])
        if len(missing):
            rows = self._take(len(missing))
            self.table[rows], self._uses[rows], self._row_of[missing] = power_mw[missing], 1, rows
        rows_of = self._row_of[sender]
        self._uses += np.bincount(rows_of, minlength=len(self._uses))
        return rows_of

    def leave(self, rows: Ints) -> None:
        """Frames that have been decided need these rows no more; NOBODY is none."""
        if len(rows) == 1:  # most often
            row = int(rows[0])
            if row != NOBODY:
                self._uses[row] -= 1
                self._free += [row] if self._uses[row] == 0 else []
        elif len(rows):
            rows = rows[rows != NOBODY]
            left = np.bincount(rows, minlength=len(self._uses))
            self._uses -= left
            self._free += np.flatnonzero((left > 0) & (self._uses == 0)).tolist()

    def _take(self, count: int) -> list[int]:
        while len(self._free) < count:
            rows = len(self.table)
            self.table = np.concatenate([self.table] * 2)
            self._uses = np.concatenate([self._uses, np.zeros_like(self._uses)])
            self._free += free_numbers(rows, 2 * rows)
        return take(self._free, count)


def free_numbers(begin: int, end: int) -> list[int]:
    """All of them, for `take`: the lowest first."""
    return list(range(begin, end))[::-1]


def take(free: list[int], count: int) -> list[int]:
    """The last ones, which are free no more."""
    taken = free[-count:]
    del free[-count:]
    return taken
