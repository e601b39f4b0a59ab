"""Messages between a run and its bridge process; long ones go in chunks.

Times are of this machine's monotonic clock, ns; rows are vehicles'.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from vcmvsp.cosim.types import Array, Traffic, Value, frozen
from vcmvsp.cosim.util.codec import Decoder

WARY = "wary"  # argument of a process with more rights than the run: it loads no user code
MOST_DUE = 5000  # deliveries in a message, and settled numbers
MOST_LEVELS = 10_000  # in a message, unless one row is longer

_NONE = np.zeros(0, np.int64)
_NO = slice(0)


class GatewaySpec(Value, frozen=True, kw_only=True):
    """A gateway that the process opens."""

    name: str  # ``bridge.NAME`` is its table
    kind: str  # short name, module:Class or file.py:Class
    params: dict[str, Any]
    radio: str = ""  # one of several radios, which carries its datagrams; empty: the only one, or all


class Opening(Value, frozen=True, kw_only=True, tag="opening"):
    """First message to the process."""

    run: str
    folder: str  # of the scenario
    vehicles: tuple[str, ...]
    gateways: tuple[GatewaySpec, ...]
    payloads: bool  # send payloads to the run, too: agents receive them
    radios: Mapping[str, tuple[int, ...]] = {}  # rows of the vehicles with each of several radios, by its name


class Deliveries(Value, frozen=True, kw_only=True, tag="due"):
    """Deliveries of datagrams, and datagrams without further deliveries. Confirms a batch of `NewDatagrams`."""

    taken: int  # datagrams that the run has taken so far
    number: Array  # (n,) int64
    receiver: Array  # (n,) int32
    at_ns: Array  # (n,) int64
    settled: Array  # (k,) int64 numbers of datagrams without further deliveries


class AgentDatagram(Value, frozen=True, kw_only=True, tag="spoken"):
    """Payload of an agent's message, for the programs of one receiver."""

    sender: int
    receiver: int
    at_ns: int
    payload: bytes
    radio: str = ""  # name of its radio, of several


class LevelRows(Value, frozen=True, kw_only=True, tag="levels"):
    """Some rows of the mean levels of `GatewayContext.level_dbm`."""

    first: int  # row
    dbm: Array  # (k, n) float64: of the row's radio at the column's
    radio: str = ""  # name of the radio, of several


class Leave(Value, frozen=True, kw_only=True, tag="leave"):
    """Close all gateways and end."""


class Ready(Value, frozen=True, kw_only=True, tag="ready"):
    """All gateways are open."""

    lines: tuple[str, ...]  # for the user


class NewDatagrams(Value, frozen=True, kw_only=True, tag="came"):
    """Datagrams from programs, in the order of reception."""

    number: Array  # (n,) int64, counted from 0 by the process
    gateway: Array  # (n,) int32: row of the gateway
    sender: Array  # (n,) int32
    to: Array  # (n,) int32; -1: broadcast
    size_bytes: Array  # (n,) int64
    came_ns: Array  # (n,) int64, not decreasing for one sender
    payloads: tuple[bytes, ...] = ()
    radio: Array | None = None  # (n,) int32, number of the radio, of several


class Delivered(Value, frozen=True, kw_only=True, tag="went"):
    """Deliveries that were made."""

    due: Array  # (n,) int64: number of the delivery, counted from 0 over all `Deliveries`
    at_ns: Array  # (n,) int64


class LevelsRequest(Value, frozen=True, kw_only=True, tag="asked"):
    """A gateway needs levels from now on."""

    radio: str = ""  # name of the radio, of several


class Counts(Value, frozen=True, kw_only=True, tag="counted"):
    """Totals so far of the vehicles with new counts."""

    counts: dict[str, dict[str, int]]  # vehicle -> reason -> number


class BridgeFailed(Value, frozen=True, kw_only=True, tag="failed"):
    """The process ends because of a problem."""

    problem: str


Up = Ready | NewDatagrams | Delivered | LevelsRequest | Counts | BridgeFailed
Down = Opening | Deliveries | AgentDatagram | LevelRows | Leave
ups: Decoder[Up] = Decoder(Up)
downs: Decoder[Down] = Decoder(Down)


def confirmation_only(taken: int) -> Deliveries:
    """A confirmation without deliveries."""
    return Deliveries(taken=taken, number=_NONE, receiver=_NONE, at_ns=_NONE, settled=_NONE)


def due_in_chunks(taken: int, traffic: Traffic, at_ns: Array) -> Iterator[Deliveries]:
    """All deliveries, then all settled numbers, in messages of limited length; ``at_ns``: monotonic time of each, (n,)."""
    deliveries, settled = _parts(len(traffic.number)), _parts(len(traffic.settled))
    deliveries, settled = deliveries + [_NO] * (len(settled) - 1), [_NO] * (len(deliveries) - 1) + settled
    for rows, settled_rows in zip(deliveries, settled, strict=True):
        number, receiver, numbers = traffic.number[rows], traffic.receiver[rows], traffic.settled[settled_rows]
        yield Deliveries(taken=taken, number=number, receiver=receiver, at_ns=at_ns[rows], settled=numbers)


def levels_in_chunks(dbm: Array, radio: str = "") -> Iterator[LevelRows]:
    """Mean levels, (n, n) dBm: of the row's radio at the column's; as many rows a message as fit."""
    rows = max(1, MOST_LEVELS // len(dbm))
    for first in range(0, len(dbm), rows):
        yield LevelRows(first=first, dbm=frozen(dbm[first : first + rows], np.float64), radio=radio)


def _parts(count: int) -> list[slice]:
    """Slices of at most `MOST_DUE` of so many rows: one, at least."""
    return [slice(first, first + MOST_DUE) for first in range(0, max(count, 1), MOST_DUE)]
