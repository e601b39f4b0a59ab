"""Which time is evaluated, and who follows whom when."""

from collections.abc import Iterable, Sequence

import numpy as np

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.tables.schema import Placement
from vcmvsp.cosim.types import Array, Follows

FOREVER_NS = 2**62
Window = tuple[float, float | None]  # s, both ends included; None: the end of the run


def window_ns(window: Window) -> tuple[int, int]:
    """Both ends in ns."""
    begin, end = window
    return seconds_to_ns(begin), FOREVER_NS if end is None else seconds_to_ns(end)


def followers(names: Iterable[str], follows: Sequence[Placement]) -> list[str]:
    """Those of these vehicles that follow somebody at some time."""
    following = {placement.vehicle for placement in follows}
    return [name for name in names if name in following]


def stretches(name: str, follows: Sequence[Placement]) -> list[tuple[int, int, Follows]]:
    """Begin, end (ns) and place of each stretch of a follower's time."""
    own = [placement for placement in follows if placement.vehicle == name]
    ends = [*(placement.time_ns for placement in own[1:]), FOREVER_NS]
    return [(placement.time_ns, end, placement.follows) for placement, end in zip(own, ends, strict=True)]


def between(time_ns: Array, begin_ns: int, end_ns: int) -> slice:
    """The instants with ``begin <= t < end``."""
    return slice(*np.searchsorted(time_ns, [begin_ns, end_ns]).tolist())
