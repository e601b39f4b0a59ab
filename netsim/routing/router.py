"""Protocol of routing kinds: next hops, forwarding of broadcasts, route updates.

A kind is a frozen dataclass with the keys of ``[routing]`` as fields; for each run it opens a router. Vehicles are rows. A
router decides for a vehicle from the information of that vehicle alone: its tables and the updates that it has received.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any, Protocol, runtime_checkable

import msgspec

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.config.binding import convert, unknown
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Seconds

BROADCAST = -1
"""Instead of the row of a vehicle: all vehicles in range."""

HEADER_BYTES = 8
"""Routing header of each frame: type (1), remaining hops (1), origin (2), destination (2), number of the packet (2). The next
hop is in the frame's own header."""

HopLimit = Annotated[int, msgspec.Meta(ge=1, le=255)]


class Update(msgspec.Struct, frozen=True):
    """A route update of a vehicle."""

    content: Any  # for `AdvertisingRouter.take`
    size_bytes: int  # after the header
    next_ns: int  # time of the next update; later than now


class Router(Protocol):
    """The routing of a run."""

    hop_limit: int
    jitter_ns: int  # largest delay before a broadcast is forwarded

    def next_hop(self, row: int, to: int, now_ns: int) -> int | None:
        """Next hop of a message to ``to``: a neighbour, `BROADCAST`, or None without a route."""

    def relays(self, row: int, by: int) -> bool:
        """Whether a vehicle forwards a broadcast of which ``by`` sent the first copy."""


@runtime_checkable
class AdvertisingRouter(Router, Protocol):
    """A router with route updates."""

    def first_ns(self) -> Sequence[int]:
        """Time of the first update of each vehicle."""

    def update(self, row: int, now_ns: int) -> Update:
        """The update that a vehicle sends now."""

    def take(self, row: int, by: int, content: Any, now_ns: int) -> None:
        """A vehicle receives an update of another."""


class Routing(Protocol):
    """A kind of routing, as a scenario configures it."""

    def open(self, vehicles: Sequence[str], seed: int) -> Router:
        """The router of a run, perhaps an `AdvertisingRouter`.

        Raises:
            ScenarioError: an unknown vehicle, or a route that never reaches its destination.
        """


@dataclass(frozen=True)
class Flooding:
    """Every vehicle forwards the first copy of a message that it receives, once, up to ``hop_limit`` hops.

    Unicast messages are flooded, too; their destination does not forward them. Flooding needs no tables and finds every route,
    at the cost of a frame for each vehicle and message. Receivers of one frame would forward it at the same instant, so each
    waits a random time first. The first copy may thus have come over the longer route, and be at its limit: every reachable
    vehicle is reached for certain only with a ``hop_limit`` of the number of vehicles less one, or more.
    """

    hop_limit: HopLimit = 8  # longest route
    jitter_s: Seconds = 0.01  # largest delay before a message is forwarded, uniform

    def open(self, vehicles: Sequence[str], seed: int) -> Router:
        """Begin a run."""
        return _Flood(self.hop_limit, seconds_to_ns(self.jitter_s))


class _Flood:
    def __init__(self, hop_limit: int, jitter_ns: int) -> None:
        self.hop_limit, self.jitter_ns = hop_limit, jitter_ns

    def next_hop(self, row: int, to: int, now_ns: int) -> int | None:
        return BROADCAST

    def relays(self, row: int, by: int) -> bool:
        return True


@dataclass(frozen=True)
class Static:
    """Unicast messages follow a table of next hops; without an entry they go directly to the destination.

    A broadcast is forwarded once by each vehicle on these routes that has another neighbour on a route than the sender.

    Args:
        chain: vehicles in a row: each forwards messages to the neighbour in the direction of the destination.
        next_hop: next hop by vehicle and destination, ``{ car1 = { car4 = "car2" } }``; has priority over ``chain``; None: the
            chain alone.
        hop_limit: longest route.
        jitter_s: largest delay before a broadcast is forwarded, uniform.
    """

    chain: tuple[str, ...] = ()
    next_hop: Mapping[str, Any] | None = None  # of tables, checked one by one, so that an error names the table
    hop_limit: HopLimit = 8
    jitter_s: Seconds = 0.01

    def __post_init__(self) -> None:
        if not self.chain and not self.next_hop:
            raise ValueError("static routing needs chain or next_hop; set one of them")
        for source, hops in (self.next_hop or {}).items():
            convert(hops, Mapping[str, Any], key=f"next_hop.{source}")
            for to, via in hops.items():
                convert(via, str, key=f"next_hop.{source}.{to}")

    def open(self, vehicles: Sequence[str], seed: int) -> Router:
        """Begin a run.

        Raises:
            ScenarioError: an unknown or repeated vehicle, a chain of one, routes in a circle, or one of more hops than
                ``hop_limit``.
        """
        row = {name: place for place, name in enumerate(vehicles)}
        table = self._of_chain(row) | self._of_table(row)
        edges = set[tuple[int, int]]()
        for source, to in table:
            path = [source]
            while path[-1] != to:
                path.append(table.get((path[-1], to), to))
                if path[-1] in path[:-1] or len(path) - 1 > self.hop_limit:
                    raise self._leads_nowhere(vehicles, path, to)
            edges.update(pairwise(path))
        neighbours: list[set[int]] = [set() for _ in vehicles]
        for a, b in edges:
            neighbours[a].add(b)
            neighbours[b].add(a)
        return _Tables(table, neighbours, self.hop_limit, seconds_to_ns(self.jitter_s))

    def _of_chain(self, row: Mapping[str, int]) -> dict[tuple[int, int], int]:
        for place, name in enumerate(self.chain):
            if name not in row:
                raise ScenarioError(unknown("vehicle", name, row), key="routing.chain")
            if name in self.chain[:place]:
                raise ScenarioError(f"contains {name} twice", key="routing.chain")
        if len(self.chain) == 1:
            raise ScenarioError("must have at least two vehicles", key="routing.chain")
        rows = [row[name] for name in self.chain]
        forward = {(rows[i], to): rows[i + 1] for i in range(len(rows)) for to in rows[i + 1 :]}
        backward = {(rows[i], to): rows[i - 1] for i in range(len(rows)) for to in rows[:i]}
        return forward | backward

    def _of_table(self, row: Mapping[str, int]) -> dict[tuple[int, int], int]:
        table = {}
        for source, hops in (self.next_hop or {}).items():
            for to, via in hops.items():
                for name in (source, to, via):
                    if name not in row:
                        raise ScenarioError(unknown("vehicle", name, row), key=f"routing.next_hop.{source}")
                if source in (to, via):
                    raise ScenarioError(f"{source} cannot be its own next hop", key=f"routing.next_hop.{source}.{to}")
                table[row[source], row[to]] = row[via]
        return table

    def _leads_nowhere(self, vehicles: Sequence[str], path: Sequence[int], to: int) -> ScenarioError:
        source = vehicles[path[0]]
        words = " -> ".join(vehicles[place] for place in path)
        why = "is a loop" if path[-1] in path[:-1] else f"has more hops than hop_limit = {self.hop_limit}: raise it"
        is_entry = vehicles[to] in (self.next_hop or {}).get(source, ())
        key = f"routing.next_hop.{source}.{vehicles[to]}" if is_entry else "routing.chain"
        return ScenarioError(f"the route from {source} to {vehicles[to]}, {words}, {why}", key=key)


class _Tables:
    def __init__(
        self, table: Mapping[tuple[int, int], int], neighbours: Sequence[set[int]], hop_limit: int, jitter_ns: int
    ) -> None:
        self.hop_limit, self.jitter_ns = hop_limit, jitter_ns
        self._table, self._neighbours = table, neighbours

    def next_hop(self, row: int, to: int, now_ns: int) -> int | None:
        return self._table.get((row, to), to)

    def relays(self, row: int, by: int) -> bool:
        return not self._neighbours[row] <= {by}
