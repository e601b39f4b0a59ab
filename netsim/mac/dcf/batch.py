"""Frames that are decided, many in one."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from vcmvsp.netsim.interfaces.layers import Floats, Ints
from vcmvsp.netsim.interfaces.medium import Codes, Decided
from vcmvsp.netsim.mac.dcf.state import NEVER, DcfState


class DecidedFrames(NamedTuple):
    """m frames at n radios, in the order of time; see `netsim.interfaces.medium.Decided`."""

    number: Ints  # (m,)
    start_ns: Ints
    end_ns: Ints
    attempts: Ints
    fate: Codes  # (m, n)
    least_sinr: Floats  # (m, n)

    def frames(self) -> Iterator[Decided]:
        """One by one."""
        columns = (column.tolist() for column in self[:4])
        for k, (number, start_ns, end_ns, attempts) in enumerate(zip(*columns, strict=True)):
            yield Decided(number, start_ns, end_ns, attempts, self.fate[k], self.least_sinr[k])

    @classmethod
    def untold(cls, s: DcfState, number: Ints, count: int) -> "DecidedFrames":
        """Of the first ``count`` in the output, whose frames have these numbers by their places, those not told before."""
        which: Any = slice(count)
        if NEVER in s.out_end[:count].tolist():
            which = (s.out_end[:count] != NEVER).nonzero()[0]
        columns = (s.out_start, s.out_end, s.out_attempts, s.out_fate, s.out_least)
        return cls(number[s.out_frame[which]], *(column[which].copy() for column in columns))

    @classmethod
    def all_of(cls, batches: Sequence["DecidedFrames"], count: int) -> "DecidedFrames":
        """One behind the other; at ``count`` radios, if there are none."""
        if len(batches) == 1:
            return batches[0]
        if not batches:
            return cls(*(np.empty(0, np.int64),) * 4, np.empty((0, count), np.uint8), np.empty((0, count)))
        return cls(*map(np.concatenate, zip(*batches, strict=True)))
