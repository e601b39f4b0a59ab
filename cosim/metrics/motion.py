"""Recorded motion of the vehicles as arrays, the evaluation window, leaders over time, and minimum separations."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.frames import yaws_of
from vcmvsp.cosim.tables.columns import names_of, numbers
from vcmvsp.cosim.tables.schema import Placement, Table, blocks_of
from vcmvsp.cosim.types import Array, Follows

_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")


@dataclass(frozen=True)
class Motion:
    """The recorded poses of m instants and n vehicles; NaN where a vehicle was absent."""

    time_ns: Array  # (m,)
    names: tuple[str, ...]
    position: Array  # (3, m, n) m, world
    yaw: Array  # (m, n) rad

    def column(self, name: str) -> int:
        """Column of a vehicle."""
        return self.names.index(name)

    def without(self, names: Collection[str]) -> "Motion":
        """The motion of all other vehicles."""
        rows = [number for number, name in enumerate(self.names) if name not in names]
        others = tuple([self.names[number] for number in rows])
        return Motion(self.time_ns, others, self.position[:, :, rows], self.yaw[:, rows]) if names else self


def motion(states: Table) -> Motion:
    """Convert the table of states to dense arrays."""
    instants = [np.unique(numbers(block, "time_ns")) for block in blocks_of(states, ("time_ns",))]
    times, values = np.unique(np.concatenate(instants)), np.empty((4, 0, 0))
    names: tuple[str, ...] = ()
    for block in blocks_of(states, ("time_ns", "vehicle", *_POSE)):
        names, code = names_of(block, "vehicle")
        if not values.size:
            values = np.full((4, len(times), len(names)), np.nan)
        x, y, z, *attitude = (numbers(block, name) for name in _POSE)
        instant = times.searchsorted(numbers(block, "time_ns"))
        for row, each in enumerate((x, y, z, yaws_of(np.stack(attitude, axis=-1)))):
            values[row, instant, code] = each
    return Motion(times, names, values[:3], values[3])


def safety_metrics(moved: Motion, collisions: int, clearance_m: float | None) -> dict[str, Any]:
    """The ``safety`` part; ``clearance_m`` is the minimum distance to an obstacle, None if unknown."""
    return {"collisions": collisions, "min_separation_m": min_separation_m(moved), "min_clearance_m": clearance_m}


def min_separation_m(moved: Motion) -> float | None:
    """Smallest distance (m) between the centres of any two vehicles at any recorded instant."""
    best = np.inf
    for shift in range(1, len(moved.names)):  # column j against column j + shift: every pair once, in contiguous blocks
        apart = moved.position[:, :, shift:] - moved.position[:, :, :-shift]
        squared = np.einsum("kmn,kmn->mn", apart, apart)
        best = min(best, np.fmin.reduce(squared, axis=None, initial=np.inf))
    return float(np.sqrt(best)) if best < np.inf else None


FOREVER_NS = 2**62
Window = tuple[float, float | None]  # s, both ends included; None: the end of the run


def window_ns(window: Window) -> tuple[int, int]:
    """Both ends of a window, ns."""
    begin, end = window
    return seconds_to_ns(begin), FOREVER_NS if end is None else seconds_to_ns(end)


def followers(names: Iterable[str], follows: Sequence[Placement]) -> list[str]:
    """The vehicles that follow a leader at any time."""
    following = {placement.vehicle for placement in follows}
    return [name for name in names if name in following]


def stretches(name: str, follows: Sequence[Placement]) -> list[tuple[int, int, Follows]]:
    """Begin, end (ns) and slot of each period in which a vehicle follows."""
    own = [placement for placement in follows if placement.vehicle == name]
    ends = [*(placement.time_ns for placement in own[1:]), FOREVER_NS]
    return [(placement.time_ns, end, placement.follows) for placement, end in zip(own, ends, strict=True)]


def between(time_ns: Array, begin_ns: int, end_ns: int) -> slice:
    """Slice of the instants with ``begin <= t < end``."""
    return slice(*np.searchsorted(time_ns, [begin_ns, end_ns]).tolist())
