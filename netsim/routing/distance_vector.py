"""Distance-vector routing: vehicles advertise their routes to their neighbours.

Sequence numbers separate old routes from new ones, as in DSDV (Perkins and Bhagwat, SIGCOMM 1994). The feasibility condition
of Babel (RFC 8966, section 2.4) prevents loops at every instant, even if updates are lost: for each destination a vehicle
stores the best ``(number, hops)`` that it has advertised (newer number first, then fewer hops), and accepts a neighbour's route
only if that is better still. So routes improve strictly along next hops.
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
"""Jitter of updates, a share of the period: updates of two vehicles do not collide for ever."""

_NOTHING = (-1, 0)

Some = Annotated[int, msgspec.Meta(ge=1, le=1000)]


@dataclass(frozen=True)
class DistanceVector:
    """Each vehicle broadcasts an update of its routes once a period: destinations and hops.

    Two vehicles are neighbours as long as each lists the other in its updates. A unicast message takes the fewest hops; without
    a known route of at most ``hop_limit`` hops it is not sent. Broadcasts are flooded.
    """

    period_s: Period = 1.0  # period of updates, with a jitter of a tenth
    missed: Some = 3  # a neighbour is lost after this many missed updates
    hop_limit: HopLimit = 8  # longest route
    jitter_s: Seconds = 0.01  # largest delay before a broadcast is forwarded, uniform

    def open(self, vehicles: Sequence[str], seed: int) -> Router:
        """Begin a run."""
        draws = [stream(seed, f"radio/{name}/updates") for name in vehicles]
        times = seconds_to_ns(self.period_s), seconds_to_ns(self.jitter_s)
        return DistanceVectorRouter(draws, *times, missed=self.missed, hop_limit=self.hop_limit)


class RouteUpdate(msgspec.Struct, frozen=True):
    """Content of an update."""

    number: int  # sequence number of the sender
    neighbours: frozenset[int]  # vehicles from which the sender receives updates
    routes: dict[int, tuple[int, int]]  # by destination, including the sender: its newest number, hops


class _Neighbour(msgspec.Struct):
    received_ns: int
    update: RouteUpdate


class DistanceVectorRouter:
    """The routing tables of all vehicles; parameters: see `DistanceVector`. ``draws``: of the update times, by vehicle."""

    def __init__(
        self, draws: Sequence[np.random.Generator], period_ns: int, jitter_ns: int, *, missed: int, hop_limit: int
    ) -> None:
        self.hop_limit, self.jitter_ns = hop_limit, jitter_ns
        self._draws, self._period_ns = draws, period_ns
        self._lives_ns = int(period_ns * (missed * (1.0 + SPREAD) + 0.25))  # a quarter for queues
        self._number = [0] * len(draws)
        self._neighbours: list[dict[int, _Neighbour]] = [{} for _ in draws]
        self._best: list[dict[int, tuple[int, int]]] = [{} for _ in draws]  # advertised so far: number, minus hops

    def first_ns(self) -> Sequence[int]:
        """Times of the first updates, within the first period."""
        return [1 + int(draw.random() * self._period_ns) for draw in self._draws]

    def update(self, row: int, now_ns: int) -> Update:
        """All routes of a vehicle, and its neighbours."""
        self._number[row] += 1
        neighbours = self._live_neighbours(row, now_ns)
        routes = {row: (self._number[row], 0)}
        best = self._best[row]
        for to in sorted({to for each in neighbours.values() for to in each.update.routes if to != row}):
            if (route := self._route(row, to, now_ns)) is not None:
                _, number, hops = route
                routes[to] = number, hops
                best[to] = max(best.get(to, _NOTHING), (number, -hops))
        content = RouteUpdate(self._number[row], frozenset(neighbours), routes)
        wait_ns = self._period_ns * (1.0 - SPREAD + 2.0 * SPREAD * self._draws[row].random())
        size_bytes = ENTRY_BYTES * len(routes.keys() | neighbours.keys())
        return Update(content, size_bytes, now_ns + max(1, int(wait_ns)))

    def take(self, row: int, by: int, content: Any, now_ns: int) -> None:
        """Store a neighbour's update, unless a newer one is stored."""
        update: RouteUpdate = content
        previous = self._neighbours[row].get(by)
        if previous is None or update.number > previous.update.number:
            self._neighbours[row][by] = _Neighbour(now_ns, update)

    def next_hop(self, row: int, to: int, now_ns: int) -> int | None:
        """The neighbour on the best route."""
        route = self._route(row, to, now_ns)
        return None if route is None else route[0]

    def relays(self, row: int, by: int) -> bool:
        """Always: broadcasts are flooded."""
        return True

    def _live_neighbours(self, row: int, now_ns: int) -> dict[int, _Neighbour]:
        return {by: each for by, each in self._neighbours[row].items() if now_ns - each.received_ns <= self._lives_ns}

    def _route(self, row: int, to: int, now_ns: int) -> tuple[int, int, int] | None:
        """Next hop, number and hops of the best feasible route; of equal ones that over the first vehicle."""
        best = self._best[row].get(to, _NOTHING)
        chosen: tuple[int, int, int] | None = None
        for by, each in self._live_neighbours(row, now_ns).items():
            if row in each.update.neighbours and (route := each.update.routes.get(to)) is not None:
                number, hops = route
                feasible = (number, -hops) > best and hops < self.hop_limit
                if feasible and (chosen is None or (hops + 1, by) < (chosen[2], chosen[0])):
                    chosen = by, number, hops + 1
        return chosen
