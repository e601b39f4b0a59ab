"""An aerial vehicle, integrated exactly, behind the aerial supervisor, for the tests of its laws."""

import itertools
import math
from collections.abc import Iterator
from typing import Any

import msgspec

from vcmvsp.hardware.safety.obstacles import Polygon
from vcmvsp.hardware.safety.supervisor import Limits, Safety

Flight = tuple[float, float, float, float]  # x, y, z m, yaw rad; or the speeds


def safety_of(limits: Limits, **others: Any) -> Safety:
    """These limits, in a fence, with timeouts for all sources."""
    fence: Polygon | None = others.pop("fence", None)
    corners = None if fence is None else tuple((x, y) for x, y in fence.a.tolist())
    usual = {"reaction_s": 0.1, "operator_s": 0.5}
    return Safety(**msgspec.structs.asdict(limits), fence=corners, **{**usual, **others})


def flight_of(
    place: Flight, speeds: Flight, target_speeds: Flight, dt: float, limits: Limits, *, ideal: bool
) -> Iterator[tuple[Flight, Flight]]:
    """Positions and speeds after parts of a period.

    An ideal vehicle has the commanded velocity at once; the other goes straight there at its guaranteed deceleration,
    horizontally and vertically each.
    """
    if ideal:
        for part in range(1, 5):
            yield tuple(each + speed * dt * part / 4 for each, speed in zip(place, target_speeds, strict=True)), target_speeds  # type: ignore[misc]
        return
    change = [b - a for a, b in zip(speeds, target_speeds, strict=True)]
    across = math.hypot(change[0], change[1])
    ready = [across / limits.decel] * 2 + [abs(change[2]) / limits.decel, abs(change[3]) / limits.yaw_decel]

    def at(t: float) -> list[float]:
        return [a + d * (1.0 if t >= end else t / end) for a, d, end in zip(speeds, change, ready, strict=True)]

    now = list(place)
    for t0, t1 in itertools.pairwise(sorted({0.0, 0.5 * dt, dt, *(min(dt, each) for each in ready)})):
        before, after = at(t0), at(t1)  # linear in between
        now = [x + 0.5 * (a + b) * (t1 - t0) for x, a, b in zip(now, before, after, strict=True)]
        yield (now[0], now[1], now[2], now[3]), (after[0], after[1], after[2], after[3])
