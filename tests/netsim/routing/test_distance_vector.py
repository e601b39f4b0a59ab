"""Distance-vector routes: the shortest, free of loops at any time, and repaired when links go."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.sparse.csgraph import shortest_path

from tests.support.netsim.routing_runs import HOP_NS, line, message_at, run
from vcmvsp.cosim.rng import stream
from vcmvsp.netsim.routing.distance_vector import ENTRY_BYTES, SPREAD, DistanceVector, DistanceVectorRouter
from vcmvsp.netsim.routing.router import HEADER_BYTES, Update

pytestmark = pytest.mark.slow

PERIOD_NS = 1_000_000_000
Graph = NDArray[np.bool_]
Lost = Callable[[int, int], bool]


def vectors(count: int, seed: int = 1, missed: int = 3, hop_limit: int = 50) -> DistanceVectorRouter:
    draws = [stream(seed, f"{row}") for row in range(count)]
    return DistanceVectorRouter(draws, PERIOD_NS, 0, missed=missed, hop_limit=hop_limit)


class Neighbourhood:
    """Updates of vehicles over a graph that may change, without a radio: what is not lost arrives after a delay."""

    def __init__(self, count: int, seed: int = 1, hop_limit: int = 50) -> None:
        self.router, self.now_ns = vectors(count, seed, hop_limit=hop_limit), 0
        self._due = [(at_ns, row) for row, at_ns in enumerate(self.router.first_ns())]
        self._coming: list[tuple[int, int, int, Update]] = []

    def go_on(
        self,
        until_ns: int,
        graph: Graph,
        lost: Lost = lambda a, b: False,
        delay: Callable[[], int] = lambda: 1_000,
        check: Callable[[], None] = lambda: None,
    ) -> None:
        while True:
            at_ns, row = min(self._due)
            arrival_ns, to, by, update = min(self._coming, key=lambda each: each[:3], default=(2**62, 0, 0, None))
            if min(at_ns, arrival_ns) > until_ns:
                self.now_ns = until_ns
                return
            if update is not None and arrival_ns <= at_ns:
                self._coming.remove((arrival_ns, to, by, update))
                self.now_ns = arrival_ns
                self.router.take(to, by, update.content, arrival_ns)
            else:
                self.now_ns = at_ns
                own_update = self.router.update(row, at_ns)
                self._due[row] = own_update.next_ns, row
                for other in np.flatnonzero(graph[row]).tolist():
                    if not lost(row, other):
                        self._coming.append((at_ns + delay(), other, row, own_update))
            check()

    def hops(self) -> NDArray[np.float64]:
        """Hops between all pairs, from next hop to next hop; infinite without a route."""
        n = len(self._due)
        return np.array([[self._hops(row, to) for to in range(n)] for row in range(n)])

    def _hops(self, row: int, to: int) -> float:
        for hops in range(len(self._due)):
            if row == to:
                return float(hops)
            if (after := self.router.next_hop(row, to, self.now_ns)) is None:
                return np.inf
            row = after
        raise AssertionError("a circle")

    def assert_no_circle(self) -> None:
        n = len(self._due)
        for to in range(n):
            after = {row: self.router.next_hop(row, to, self.now_ns) for row in range(n) if row != to}
            for row in after:
                visited: set[int | None] = set()
                at: int | None = row
                while at is not None and at != to:
                    assert at not in visited, f"a circle on the way from {row} to {to}"
                    visited.add(at)
                    at = after[at]


def graphs(least: int = 2, most: int = 7) -> st.SearchStrategy[Graph]:
    def of(count: int) -> st.SearchStrategy[Graph]:
        pairs = [(a, b) for a in range(count) for b in range(a)]

        def made(bits: Sequence[bool]) -> Graph:
            graph = np.zeros((count, count), np.bool_)
            for (a, b), bit in zip(pairs, bits, strict=True):
                graph[a, b] = graph[b, a] = bit
            return graph

        return st.lists(st.booleans(), min_size=len(pairs), max_size=len(pairs)).map(made)

    return st.integers(least, most).flatmap(of)


def chain(count: int) -> Graph:
    return np.eye(count, k=1, dtype=np.bool_) | np.eye(count, k=-1, dtype=np.bool_)


@settings(max_examples=60)
@given(graphs(3), graphs(3), st.integers(0, 1000), st.floats(0.0, 0.9), st.booleans())
def test_next_hops_never_form_a_circle_whatever_is_lost_late_or_changes(
    before: Graph, after: Graph, seed: int, loss: float, one_way: bool
) -> None:
    """With updates that overtake each other, and links that come, go, or work one way only: at every instant."""
    n = min(len(before), len(after))
    before, after = before[:n, :n], after[:n, :n].copy()
    draw = np.random.default_rng(seed)
    if one_way:
        after &= draw.random((n, n)) < 0.7
    world = Neighbourhood(n, seed)
    for graph, until_s in ((before, 6), (after, 14), (before, 20)):
        world.go_on(
            until_s * PERIOD_NS,
            graph,
            lost=lambda a, b: bool(draw.random() < loss),
            delay=lambda: int(draw.random() * 2.5 * PERIOD_NS),
            check=world.assert_no_circle,
        )


@settings(max_examples=30)
@given(graphs(2, 6), graphs(2, 6), st.integers(0, 1000))
def test_all_take_the_shortest_ways_and_again_after_a_change(before: Graph, after: Graph, seed: int) -> None:
    n = min(len(before), len(after))
    before, after = before[:n, :n], after[:n, :n]
    world = Neighbourhood(n, seed)
    world.go_on((n + 4) * PERIOD_NS, before)
    assert np.array_equal(world.hops(), shortest_path(before.astype(float), unweighted=True))
    world.go_on(world.now_ns + (2 * n + 8) * PERIOD_NS, after, check=world.assert_no_circle)
    assert np.array_equal(world.hops(), shortest_path(after.astype(float), unweighted=True))


def test_routes_stay_the_shortest_while_numbers_are_renewed() -> None:
    """A newer sequence number that arrives over a longer way first does not replace the route."""
    ring = chain(7) | (np.abs(np.subtract.outer(np.arange(7), np.arange(7))) == 6)
    world = Neighbourhood(7)
    world.go_on(12 * PERIOD_NS, ring)
    shortest = shortest_path(ring.astype(float), unweighted=True)

    def check() -> None:
        assert np.array_equal(world.hops(), shortest)

    world.go_on(40 * PERIOD_NS, ring, check=check)


@settings(max_examples=30)
@given(graphs(3), st.integers(0, 1000), st.integers(1, 4))
def test_no_route_is_longer_than_the_hop_limit(graph: Graph, seed: int, limit: int) -> None:
    world = Neighbourhood(len(graph), seed, limit)
    world.go_on((len(graph) + 4) * PERIOD_NS, graph)
    shortest = shortest_path(graph.astype(float), unweighted=True)
    assert np.array_equal(world.hops(), np.where(shortest <= limit, shortest, np.inf))


def test_a_message_that_would_end_on_its_way_is_not_sent() -> None:
    messages = [message_at("car1", 9_000_000_000, to=to) for to in ("car4", "car5")]
    outcome = run(DistanceVector(hop_limit=3), line(5), *messages, seconds=10.0)
    assert [each.receivers for each in sorted(outcome.messages, key=lambda each: each.number)] == [("car2", "car3", "car4"), ()]
    assert sorted(len(each.frames) for each in outcome.messages) == [0, 3]


def test_links_that_work_one_way_are_no_routes() -> None:
    graph = chain(2)
    graph[1, 0] = False  # updates of 1 do not reach 0
    world = Neighbourhood(2)
    world.go_on(10 * PERIOD_NS, graph)
    assert np.isinf(world.hops()[~np.eye(2, dtype=bool)]).all()


def test_a_silent_neighbour_is_dropped_after_the_missed_updates() -> None:
    router = vectors(2, missed=3)
    for number in range(3):
        for row in (0, 1):
            router.take(1 - row, row, router.update(row, number).content, number)
    last_ns = 2
    within_ns, beyond_ns = 3 * int(PERIOD_NS * (1 + SPREAD)), 4 * int(PERIOD_NS * (1 - SPREAD))
    assert router.next_hop(0, 1, last_ns + within_ns) == 1
    assert router.next_hop(0, 1, last_ns + beyond_ns) is None


def test_messages_go_over_the_hops_that_were_found_and_not_before() -> None:
    messages = [
        message_at("car1", 10_000_000, to="car5"),
        message_at("car1", 9_000_000_000, to="car5"),
        message_at("car5", 9_500_000_000, to="car2"),
    ]
    outcome = run(DistanceVector(), line(5), *messages, seconds=10.0)
    assert [each.receivers for each in outcome.messages] == [(), ("car2", "car3", "car4", "car5"), ("car4", "car3", "car2")]
    assert [each.received_ns - each.sent_ns for each in outcome.routed_receptions] == [4 * HOP_NS, 3 * HOP_NS]


def test_broadcasts_are_flooded() -> None:
    outcome = run(DistanceVector(), line(4), message_at("car2", 0))
    assert sorted(each.receiver for each in outcome.routed_receptions) == ["car1", "car3", "car4"]


@pytest.mark.parametrize("period_s", [0.5, 2.0])
def test_updates_keep_to_their_budget(period_s: float) -> None:
    count, seconds = 5, 20.0
    outcome = run(DistanceVector(period_s=period_s), line(count), seconds=seconds)
    updates = [each for each in outcome.routed if each.update]
    assert len(outcome.frames) == len(updates)  # which no vehicle forwards
    least, most = (seconds / (period_s * share) for share in (1.0 + SPREAD, 1.0 - SPREAD))
    assert count * (least - 2) < len(updates) < count * (most + 2)
    size_bytes = HEADER_BYTES + count * ENTRY_BYTES
    assert {frame.size_bytes for frame in outcome.frames if frame.sent_ns > seconds / 2 * 1e9} == {size_bytes}
    assert max(frame.size_bytes for frame in outcome.frames) == size_bytes


def test_when_a_relay_is_cut_off_another_way_is_found() -> None:
    """A diamond: car1 reaches car4 over car2 until that falls silent, then over car3."""
    diamond = [(0.0, 0.0), (60.0, 30.0), (60.0, -30.0), (120.0, 0.0)]
    silent = {"from_s": 10.0, "links": ["car2/*", "*/car2"], "loss": 1.0}
    messages = [message_at("car1", seconds * 1_000_000_000, to="car4") for seconds in (9, 11, 17)]
    outcome = run(DistanceVector(), diamond, *messages, seconds=18.0, script={"kind": "script", "changes": [silent]})
    assert [each.receivers for each in outcome.messages] == [("car2", "car4"), (), ("car3", "car4")]
    assert [len(each.frames) for each in outcome.messages] == [2, 1, 2]
