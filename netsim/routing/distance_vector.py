"""Distance vectors: vehicles tell their neighbours how far everybody is, and so find routes by themselves.

Numbers that grow tell old routes from new ones, as in DSDV (Perkins and Bhagwat, SIGCOMM 1994), and a vehicle takes a route
only where nobody could have learnt it from the vehicle itself, as in Babel (RFC 8966, section 2.4): at no instant, whatever is
lost, do next hops form a circle. For each destination a vehicle remembers the best that it ever told of: ``(number, hops)``,
better if the number is newer, or the same and the hops are fewer. It takes a neighbour's route only if that is better still.
What the neighbour has told of is at least as good as this route, so along next hops it gets better from vehicle to vehicle.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
import numpy as np

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Period, Seconds
from vcmvsp.netsim.routing.router import HopLimit, Router, Update

ENTRY_BYTES = 5
"""Of an update: a destination (2), hops to it and whether it was heard itself (1), and its newest number (2)."""

SPREAD = 0.1
"""Share of the period by which updates come earlier or later, so that those of two vehicles do not meet for ever."""

_NOTHING = (-1, 0)

Some = Annotated[int, msgspec.Meta(ge=1, le=1000)]


@dataclass(frozen=True)
class DistanceVector:
    """Each vehicle tells once a period, in a frame of its own, which vehicles it reaches and over how many hops.

    Two vehicles are neighbours as long as each says that it hears the other. Messages to one vehicle go over the fewest hops;
    where no route of at most ``hop_limit`` is known, they are not sent. Broadcasts are flooded.
    """

    period_s: Period = 1.0  # from update to update, give or take a tenth
    missed: Some = 3  # of so many updates in a row a vehicle has heard none: that neighbour is gone
    hop_limit: HopLimit = 8  # transmissions from the origin to whom it reaches, at most
    jitter_s: Seconds = 0.01  # a broadcast waits so long at most before it is passed on, uniform

    def open(self, vehicles: Sequence[str], seed: int) -> Router:
        """Begin a run."""
        draws = [stream(seed, f"radio/{name}/updates") for name in vehicles]
        times = seconds_to_ns(self.period_s), seconds_to_ns(self.jitter_s)
        return DistanceVectorRouter(draws, *times, missed=self.missed, hop_limit=self.hop_limit)


class RouteUpdate(msgspec.Struct, frozen=True):
    """The content of an update."""

    number: int  # of its sender's updates
    heard: frozenset[int]  # neighbours that its sender has heard
    routes: dict[int, tuple[int, int]]  # by destination, the sender itself included: its newest number, hops to it


class _Neighbour(msgspec.Struct):
    heard_ns: int
    told: RouteUpdate


class DistanceVectorRouter:
    """What all vehicles know, each by itself.

    Args:
        draws: of each vehicle, for the times of its updates.
        period_ns, missed, hop_limit, jitter_ns: as `DistanceVector` has them.
    """

    def __init__(
        self, draws: Sequence[np.random.Generator], period_ns: int, jitter_ns: int, *, missed: int, hop_limit: int
    ) -> None:
        self.hop_limit, self.jitter_ns = hop_limit, jitter_ns
        self._draws, self._period_ns = draws, period_ns
        self._lives_ns = int(period_ns * (missed * (1.0 + SPREAD) + 0.25))  # a quarter for queues
        self._number = [0] * len(draws)
        self._neighbours: list[dict[int, _Neighbour]] = [{} for _ in draws]
        self._best: list[dict[int, tuple[int, int]]] = [{} for _ in draws]  # told of so far: number, minus hops

    def first_ns(self) -> Sequence[int]:
        """Within the first period."""
        return [1 + int(draw.random() * self._period_ns) for draw in self._draws]

    def update(self, row: int, now_ns: int) -> Update:
        """All routes of a vehicle, and whom it has heard."""
        self._number[row] += 1
        heard = self._heard(row, now_ns)
        routes = {row: (self._number[row], 0)}
        best = self._best[row]
        for to in sorted({to for each in heard.values() for to in each.told.routes if to != row}):
            if (found := self._route(row, to, now_ns)) is not None:
                _, number, hops = found
                routes[to] = number, hops
                best[to] = max(best.get(to, _NOTHING), (number, -hops))
        told = RouteUpdate(self._number[row], frozenset(heard), routes)
        wait_ns = self._period_ns * (1.0 - SPREAD + 2.0 * SPREAD * self._draws[row].random())
        size_bytes = ENTRY_BYTES * len(routes.keys() | heard.keys())
        return Update(told, size_bytes, now_ns + max(1, int(wait_ns)))

    def take(self, row: int, by: int, content: Any, now_ns: int) -> None:
        """Remember what a neighbour tells, in place of what it told before."""
        told: RouteUpdate = content
        known = self._neighbours[row].get(by)
        if known is None or told.number > known.told.number:
            self._neighbours[row][by] = _Neighbour(now_ns, told)

    def next_hop(self, row: int, to: int, now_ns: int) -> int | None:
        """The neighbour with the fewest hops to it."""
        found = self._route(row, to, now_ns)
        return None if found is None else found[0]

    def relays(self, row: int, by: int) -> bool:
        """Always: broadcasts are flooded."""
        return True

    def _heard(self, row: int, now_ns: int) -> dict[int, _Neighbour]:
        return {by: each for by, each in self._neighbours[row].items() if now_ns - each.heard_ns <= self._lives_ns}

    def _route(self, row: int, to: int, now_ns: int) -> tuple[int, int, int] | None:
        """Next hop, number, and hops of the best route that may be taken; of equal ones that over the first vehicle."""
        best = self._best[row].get(to, _NOTHING)
        found: tuple[int, int, int] | None = None
        for by, each in self._heard(row, now_ns).items():
            if row in each.told.heard and (told := each.told.routes.get(to)) is not None:
                number, hops = told
                better = (number, -hops) > best and hops < self.hop_limit
                if better and (found is None or (hops + 1, by) < (found[2], found[0])):
                    found = by, number, hops + 1
        return found
