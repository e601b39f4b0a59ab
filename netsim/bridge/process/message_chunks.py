"""What the bridge's process is told that may be too long for one message: in as many as it takes."""

from collections.abc import Iterator

import numpy as np

from vcmvsp.cosim.types import Array, Traffic, frozen
from vcmvsp.netsim.bridge.process import messages

MOST = 5000  # deliveries in a message, and numbers of those that are settled
MOST_LEVELS = 10_000  # in one, if no row alone is longer

_NONE = np.zeros(0, np.int64)
_NO = slice(0)


def taken_over(taken: int) -> messages.Due:
    """That so many datagrams were taken so far, and nothing else."""
    return messages.Due(taken=taken, number=_NONE, receiver=_NONE, at_ns=_NONE, settled=_NONE)


def due(taken: int, traffic: Traffic, at_ns: Array) -> Iterator[messages.Due]:
    """What arrives, and behind all of that what is settled.

    Args:
        taken: datagrams that were taken so far.
        traffic: n deliveries, and numbers that are settled.
        at_ns: when each delivery is due, (n,) ns on this machine's monotonic clock.
    """
    deliveries, settled = _parts(len(traffic.number)), _parts(len(traffic.settled))
    together = (deliveries[-1], settled[0])
    for some, done in [*((each, _NO) for each in deliveries[:-1]), together, *((_NO, each) for each in settled[1:])]:
        number, receiver = traffic.number[some], traffic.receiver[some]
        yield messages.Due(taken=taken, number=number, receiver=receiver, at_ns=at_ns[some], settled=traffic.settled[done])


def levels(dbm: Array) -> Iterator[messages.Levels]:
    """Mean levels, (n, n) dBm: of the row's radio at the column's; as many rows at a time as fit."""
    rows = max(1, MOST_LEVELS // len(dbm))
    for first in range(0, len(dbm), rows):
        yield messages.Levels(first=first, dbm=frozen(dbm[first : first + rows], np.float64))


def _parts(count: int) -> list[slice]:
    """So many rows in pieces that fit into a message: one, at least."""
    return [slice(first, first + MOST) for first in range(0, max(count, 1), MOST)]
