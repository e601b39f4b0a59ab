"""What a run and its bridge process say to each other. Times are of this machine's monotonic clock, ns; rows are vehicles'."""

from typing import Any

from vcmvsp.cosim.types import Array, Value
from vcmvsp.cosim.util.codec import Decoder


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
