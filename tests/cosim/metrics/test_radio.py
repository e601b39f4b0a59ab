"""Ages over all time against a plain loop, and connectivity against closed forms."""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.cosim.recordings import TENTH, follows, frame, recorder_after
from vcmvsp.cosim.clock import SECOND_NS, Ticks
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.metrics.age import age_metrics
from vcmvsp.cosim.metrics.radio import MOST_VEHICLES, Parts, adjacency, algebraic_connectivity
from vcmvsp.cosim.types import Array

pytestmark = pytest.mark.slow

MS = 1_000_000


# --- ages -----------------------------------------------------------------------------------------------------------------


sends = st.lists(
    st.tuples(st.sampled_from("abc"), st.integers(0, 900), st.lists(st.none() | st.integers(1, 400), min_size=2, max_size=2)),
    max_size=30,
)


def area(sent: int, begin: int, end: int) -> float:
    """Integral of an age from ``begin`` to ``end`` ms, s2."""
    return ((end - sent) ** 2 - (begin - sent) ** 2) / 2e6


@given(sends, st.sampled_from([50, 100, 170]), st.integers(0, 900), st.integers(0, 1200) | st.none(), st.booleans())
@settings(deadline=None, max_examples=50)
def test_ages_equal_a_plain_loop(sent: list[Any], period: int, begin: int, end: int | None, led: bool) -> None:
    """Against the definition, in steps of one millisecond, one frame at a time."""
    events, rows = [], []
    for number, (sender, at, delays) in enumerate(sorted(sent, key=lambda item: item[1])):
        received = dict(zip([name for name in "abc" if name != sender], delays, strict=True))
        arrives = {to: None if delay is None else (at + delay) * MS for to, delay in received.items()}
        events.append(frame(number, sender, at * MS, arrives))
        rows += [(to, sender, at, at + delay) for to, delay in received.items() if delay is not None]
    if led:
        events += [follows("b", "a", (0.0, 0.0), 0.1), follows("b", "c", (0.0, 0.0), 0.1, 300 * MS)]
    recorder = recorder_after("abc", events, SECOND_NS)

    acts, at_ticks = Ticks.every(period / 1e3), []
    spans = [("b", "a", 0, 300), ("b", "c", 300, 2000)] if led else [(to, by, 0, 2000) for to in "abc" for by in "abc"]
    total, length, peaks = 0.0, 0, []
    for to, by, since, until in spans:
        times = [(s, r) for t, b, s, r in rows if (t, b) == (to, by)]
        newest = [max((s for s, r in times if r <= now), default=None) for now in range(1001)]
        last = min(1000, until, 1001 if end is None else end + 1)
        ticks = [now for now in range(0, 1000, period) if max(begin, since) <= now < last]
        at_ticks += [(now - at) / 1e3 for now in ticks if (at := newest[now]) is not None]
        for now in range(max(begin, since), min(1000, until, 1000 if end is None else end)):
            old, new = newest[now], newest[now + 1]
            if old is not None:
                total, length = total + area(old, now, now + 1), length + 1
                if new != old:
                    peaks.append((now + 1 - old) / 1e3)
    window = begin / 1e3, None if end is None else end / 1e3
    found = age_metrics(Parts(recorder.radio), recorder.follows, dict.fromkeys("abc", acts), window, SECOND_NS)
    assert found["time_average"] == (pytest.approx(total / (length / 1e3)) if length else None)
    assert found["peak"] == (pytest.approx(np.mean(peaks)) if peaks else None)
    of_ticks = [np.mean(at_ticks), np.percentile(at_ticks, 95), max(at_ticks)] if at_ticks else [None] * 3
    assert [found["mean"], found["p95"], found["max"]] == (pytest.approx(of_ticks) if at_ticks else of_ticks)


def test_only_agents_have_ages() -> None:
    """Without followers, a vehicle without an agent has no age."""
    parts = Parts(recorder_after("ab", [frame(0, "a", 0, {"b": MS})], SECOND_NS).radio)
    assert age_metrics(parts, [], {"a": TENTH}, (0.0, None), SECOND_NS)["time_average"] is None
    assert age_metrics(parts, [], {"b": TENTH}, (0.0, None), SECOND_NS)["time_average"] == pytest.approx((1.0 + 0.001) / 2)


# --- connectivity ---------------------------------------------------------------------------------------------------------

Edges = list[tuple[int, int]]


def graph(n: int, edges: Iterable[tuple[int, int]]) -> Array:
    adjacent = np.zeros((1, n, n), np.bool_)
    for i, j in edges:
        adjacent[0, i, j] = adjacent[0, j, i] = True
    return adjacent


def star(n: int) -> Edges:
    return [(0, i) for i in range(1, n)]


def complete(n: int) -> Edges:
    return [(i, j) for i in range(n) for j in range(i)]


def path(n: int) -> Edges:
    return [(i, i + 1) for i in range(n - 1)]


@pytest.mark.parametrize("n", [3, 4, 7, 50])
def test_algebraic_connectivity_of_known_graphs(n: int) -> None:
    """Star 1, complete N, path 2 (1 - cos(pi/N)), ring 2 (1 - cos(2 pi/N)), disconnected 0."""
    known = {
        1.0: star(n),
        float(n): complete(n),
        2 * (1 - math.cos(math.pi / n)): path(n),
        2 * (1 - math.cos(2 * math.pi / n)): [*path(n), (n - 1, 0)] if n > 3 else complete(3),
        0.0: path(n - 1),
    }
    graphs = np.concatenate([graph(n, edges) for edges in known.values()])
    assert algebraic_connectivity(graphs) == pytest.approx(list(known), abs=1e-8)


@given(st.integers(2, 8).flatmap(lambda n: st.tuples(st.just(n), st.sets(st.sampled_from(complete(n))))))
@settings(deadline=None, max_examples=50)
def test_connectivity_is_positive_exactly_for_connected_graphs(given_graph: tuple[int, set[tuple[int, int]]]) -> None:
    n, edges = given_graph
    adjacent = graph(n, edges)
    reached = np.linalg.matrix_power(adjacent[0].astype(int) + np.eye(n, dtype=int), n) > 0
    assert (algebraic_connectivity(adjacent)[0] > 0.0) == reached.all()


def edge_frames(n: int, seconds: list[Edges]) -> list[Event]:
    """One frame per edge and second, sent in the middle of the second and received in one direction."""
    names = [f"car{i}" for i in range(n)]
    events: list[Event] = []
    for second, edges in enumerate(seconds):
        for i, j in edges:
            at = second * SECOND_NS + SECOND_NS // 2
            receivers: dict[str, int | None] = {name: None for name in names if name != names[i]}
            receivers[names[j]] = at + MS
            events.append(frame(len(events), names[i], at, receivers))
    return events


def connectivity(n: int, seconds: list[Edges], window: tuple[float, float | None] = (0.0, None)) -> dict[str, Any]:
    names = [f"car{i}" for i in range(n)]
    recorder = recorder_after(names, edge_frames(n, seconds), len(seconds) * SECOND_NS, Ticks.every(1.0))
    return recorder.metrics(window=window)["connectivity"]


def test_connectivity_is_of_each_second_in_the_window() -> None:
    seconds = [complete(5), star(5), path(4), [], star(5)]
    some = {"mean": pytest.approx((5 + 1 + 0 + 0 + 1) / 5), "min": 0.0, "connected_share": pytest.approx(0.6)}
    assert connectivity(5, seconds) == some
    first = {"mean": pytest.approx(3.0), "min": pytest.approx(1.0), "connected_share": 1.0}
    assert connectivity(5, seconds, (0.0, 2.0)) == first
    assert connectivity(5, seconds, (0.4, 1.39))["mean"] is None  # not a whole second
    assert connectivity(5, seconds, (1.4, 2.8))["mean"] == pytest.approx(1.0)  # only the star


def test_a_second_counts_its_arrivals() -> None:
    events = [frame(0, "a", 0, {"b": SECOND_NS}), frame(1, "a", SECOND_NS // 2, {"b": SECOND_NS - 1})]
    parts = Parts(recorder_after("ab", events[:1], 2 * SECOND_NS).radio)
    assert adjacency(parts, "ab", 0, 2).any(axis=(1, 2)).tolist() == [False, True]
    parts = Parts(recorder_after("ab", events[1:], 2 * SECOND_NS).radio)
    assert adjacency(parts, "ab", 0, 2).any(axis=(1, 2)).tolist() == [True, False]


def test_connectivity_of_one_vehicle_and_of_too_many_is_none() -> None:
    nothing = dict.fromkeys(("mean", "min", "connected_share"))
    assert connectivity(1, [[]]) == nothing
    assert connectivity(MOST_VEHICLES + 1, [[]]) == nothing
    assert connectivity(2, [[]]) == {"mean": 0.0, "min": 0.0, "connected_share": 0.0}
