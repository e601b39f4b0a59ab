"""Messages between a run and its bridge process; long ones go in chunks.

Times are of this machine's monotonic clock, ns; rows are vehicles'.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from vcmvsp.cosim.types import Array, Traffic, Value, frozen
from vcmvsp.cosim.util.codec import Decoder

WARY = "wary"  # argument of a process that has more rights than the run, which therefore may not name code
MOST_DUE = 5000  # deliveries in a message, and numbers of those that are settled
MOST_LEVELS = 10_000  # in a message, if no row alone is longer

_NONE = np.zeros(0, np.int64)
_NO = slice(0)


class DoorSpec(Value, frozen=True, kw_only=True):
    """A door that the process opens."""

    name: str  # ``bridge.NAME`` is its table
    kind: str  # short name, module:Class or file.py:Class
    params: dict[str, Any]


class Opening(Value, frozen=True, kw_only=True, tag="opening"):
    """The first thing that the process is told."""

    run: str
    folder: str  # of the scenario
    vehicles: tuple[str, ...]
    doors: tuple[DoorSpec, ...]
    payloads: bool  # hand the bytes to the run, too: agents hear programs


class Due(Value, frozen=True, kw_only=True, tag="due"):
    """Datagrams that arrive, and those of which nothing is to come any more. Answers `Came`, whose batch it names."""

    taken: int  # datagrams taken over so far: their batch makes room for the next
    number: Array  # (n,) int64
    receiver: Array  # (n,) int32
    at_ns: Array  # (n,) int64: when
    settled: Array  # (k,) int64 numbers that can be forgotten once what is due of them has left


class Spoken(Value, frozen=True, kw_only=True, tag="spoken"):
    """What an agent said, for the programs of who heard it."""

    sender: int
    receiver: int
    at_ns: int
    payload: bytes


class Levels(Value, frozen=True, kw_only=True, tag="levels"):
    """Mean levels, `Hall.level_dbm`: some rows of them."""

    first: int  # row
    dbm: Array  # (k, n) float64: of the row's radio at the column's


class Leave(Value, frozen=True, kw_only=True, tag="leave"):
    """Close all doors and end."""


class Ready(Value, frozen=True, kw_only=True, tag="ready"):
    """All doors are open."""

    lines: tuple[str, ...]  # for the user


class Came(Value, frozen=True, kw_only=True, tag="came"):
    """Datagrams that programs have handed over, in the order in which they came."""

    number: Array  # (n,) int64, counted from 0 by the process
    door: Array  # (n,) int32: row of the door
    sender: Array  # (n,) int32
    to: Array  # (n,) int32; -1: broadcast
    size_bytes: Array  # (n,) int64
    came_ns: Array  # (n,) int64, not decreasing for one sender
    payloads: tuple[bytes, ...] = ()


class Went(Value, frozen=True, kw_only=True, tag="went"):
    """What was delivered, and when."""

    due: Array  # (n,) int64: which, counted from 0 through all that was `Due`
    went_ns: Array  # (n,) int64


class Asked(Value, frozen=True, kw_only=True, tag="asked"):
    """A door wants levels, from now on."""


class Counted(Value, frozen=True, kw_only=True, tag="counted"):
    """All that was counted so far of some vehicles: of whom that has changed."""

    counts: dict[str, dict[str, int]]  # vehicle -> words -> number


class Failed(Value, frozen=True, kw_only=True, tag="failed"):
    """The process ends, for this reason."""

    problem: str


Up = Ready | Came | Went | Asked | Counted | Failed
Down = Opening | Due | Spoken | Levels | Leave
ups: Decoder[Up] = Decoder(Up)
downs: Decoder[Down] = Decoder(Down)


def taken_over(taken: int) -> Due:
    """Only how many datagrams were taken so far."""
    return Due(taken=taken, number=_NONE, receiver=_NONE, at_ns=_NONE, settled=_NONE)


def due_in_chunks(taken: int, traffic: Traffic, at_ns: Array) -> Iterator[Due]:
    """All that arrives, then all that is settled, in messages of limited length.

    Args:
        taken: datagrams that were taken so far.
        traffic: n deliveries, and numbers that are settled.
        at_ns: when each delivery is due, (n,) ns on this machine's monotonic clock.
    """
    deliveries, settled = _parts(len(traffic.number)), _parts(len(traffic.settled))
    together = (deliveries[-1], settled[0])
    for some, done in [*((each, _NO) for each in deliveries[:-1]), together, *((_NO, each) for each in settled[1:])]:
        number, receiver = traffic.number[some], traffic.receiver[some]
        yield Due(taken=taken, number=number, receiver=receiver, at_ns=at_ns[some], settled=traffic.settled[done])


def levels_in_chunks(dbm: Array) -> Iterator[Levels]:
    """Mean levels, (n, n) dBm: of the row's radio at the column's; as many rows a message as fit."""
    rows = max(1, MOST_LEVELS // len(dbm))
    for first in range(0, len(dbm), rows):
        yield Levels(first=first, dbm=frozen(dbm[first : first + rows], np.float64))


def _parts(count: int) -> list[slice]:
    """Slices of at most `MOST_DUE` of so many rows: one, at least."""
    return [slice(first, first + MOST_DUE) for first in range(0, max(count, 1), MOST_DUE)]
