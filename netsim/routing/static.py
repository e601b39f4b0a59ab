"""Static routing by a table of the scenario."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.config.binding import convert, unknown
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Seconds
from vcmvsp.netsim.routing.router import HopLimit, Router


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
            raise ValueError("static routing needs chain or next_hop")
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
                raise ScenarioError(f"{name} is twice in it", key="routing.chain")
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
        why = "goes in a circle" if path[-1] in path[:-1] else f"has more hops than hop_limit = {self.hop_limit}: raise it"
        key = (
            f"routing.next_hop.{source}.{vehicles[to]}"
            if vehicles[to] in (self.next_hop or {}).get(source, ())
            else "routing.chain"
        )
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
