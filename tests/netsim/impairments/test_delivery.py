"""The rate limit against Lindley's recursion and queueing theory, copies, and the order of arrival."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.netsim.impairments.delay import Delivery
from vcmvsp.netsim.interfaces.layers import Draw, Floats, Ints

MS = 1_000_000


def opened(count: int = 2, **parameters: Any) -> Delivery:
    layer = Delivery(**parameters)
    layer.open(count)
    return layer


def never() -> Any:
    raise AssertionError("nothing here needs chance")


def one_link(layer: Delivery, received_ns: list[int], size_bytes: int = 125, draw: Any = never) -> tuple[list[int], list[int]]:
    """Arrivals and copies of frames on the link from radio 0 to radio 1."""
    row = np.array([1])
    found = [layer.deliver(0, row, np.array([t]), size_bytes, draw) for t in received_ns]
    return [int(arrival[0]) for arrival, _ in found], [int(copy[0]) for _, copy in found]


def drawn(uniforms: Floats) -> Draw:
    return lambda: uniforms


times = st.lists(st.integers(-1, 20 * MS), max_size=40)


@given(times)
def test_by_default_nothing_changes(received_ns: list[int]) -> None:
    assert one_link(opened(), received_ns) == (received_ns, [-1] * len(received_ns))


@given(times, st.sampled_from([None, 0.0, 0.0005, 0.004]), st.sampled_from([1e5, 1e6, 3e6]))
def test_rate_is_lindleys_recursion(received_ns: list[int], queue_s: float | None, rate_bps: float) -> None:
    """Frame by frame, with times that may go back and frames that were lost before."""
    service, free, expected = math.ceil(1000 * 1e9 / rate_bps), 0, []
    for t in received_ns:
        wait = max(0, free - t)
        if t < 0 or (queue_s is not None and wait > queue_s * 1e9):
            expected.append(-1)
            continue
        free = t + wait + service
        expected.append(free)
    assert one_link(opened(rate_bps=rate_bps, queue_s=queue_s), received_ns)[0] == expected


@pytest.mark.parametrize("load", [0.3, 0.6, 0.8])
def test_mean_wait_of_poisson_arrivals(load: float) -> None:
    """M/D/1: ``load T / (2 (1 - load))`` (Pollaczek and Khinchine), on 400 links of 500 frames behind 500 more."""
    rng, service = np.random.default_rng(7), MS
    layer, rows = opened(401, rate_bps=1e6), np.arange(1, 401)
    arrivals: Ints = np.cumsum(rng.exponential(service / load, (1000, 400)), axis=0).round().astype(np.int64)
    waits = np.array([layer.deliver(0, rows, each, 125, never)[0] - each - service for each in arrivals])[500:]
    mean = load * service / (2.0 * (1.0 - load))
    error = waits.mean(axis=0).std() / math.sqrt(400)  # links are independent, frames of a link are not
    assert waits.mean() == pytest.approx(mean, abs=4.5 * error)
    assert 4.5 * error < 0.12 * mean


def test_a_saturated_link_passes_its_rate() -> None:
    """1 Mbit/s, offered 4: a frame of 125 bytes leaves each ms, and none waits longer than 5 ms: at most 6 are inside."""
    arrived, _ = one_link(opened(rate_bps=1e6, queue_s=0.005), [k * MS // 4 for k in range(4000)])
    passed = [t for t in arrived if t >= 0]
    assert np.diff(passed).tolist() == [MS] * (len(passed) - 1)
    assert len(passed) == pytest.approx(1000, abs=7)
    assert max(t - k * MS // 4 for k, t in enumerate(arrived) if t >= 0) == 6 * MS


def test_copies_with_their_probability_and_delay() -> None:
    layer, rng, rows = opened(101, duplicate=0.2, duplicate_delay_s=0.003), np.random.default_rng(3), np.arange(1, 101)
    received = np.where(np.arange(100) % 4 == 0, -1, 10 * MS)
    found = [layer.deliver(0, rows, received, 100, lambda: rng.random((100, 2))) for _ in range(1000)]
    assert all(np.array_equal(arrival, received) for arrival, _ in found)
    copies = np.array([copy for _, copy in found])
    assert set(np.unique(copies[:, received >= 0]).tolist()) == {-1, 13 * MS}
    assert (copies[:, received < 0] == -1).all()
    assert (copies[:, received >= 0] >= 0).mean() == pytest.approx(0.2, abs=4.5 * math.sqrt(0.16 / 75_000))


def test_a_copy_is_sure_or_never_at_the_ends() -> None:
    for duplicate, doubled in ((0.0, False), (1.0, True)):
        for draw in (0.0, 1.0 - 2.0**-53):
            _, copies = one_link(opened(duplicate=duplicate), [5], draw=drawn(np.full((1, 2), draw)))
            assert copies == [5 if doubled else -1]


@given(times, st.sampled_from([0.0, 0.5, 1.0]), st.sampled_from([0.0, 0.002]))
def test_in_order_nothing_overtakes(received_ns: list[int], duplicate: float, delay_s: float) -> None:
    """Whatever arrives later was sent later, copies included; nothing is early; each is as early as that allows."""
    rng = np.random.default_rng(len(received_ns))
    layer = opened(duplicate=duplicate, duplicate_delay_s=delay_s, reorder=False)
    arrivals, copies = one_link(layer, received_ns, draw=lambda: rng.random((1, 2)))
    last = -1
    for received, arrival, copy in zip(received_ns, arrivals, copies, strict=True):
        assert arrival == (max(received, last + 1) if received >= 0 else -1)
        assert copy in {-1, arrival + round(delay_s * 1e9)}
        last = max(last, arrival, copy)


def test_a_rate_keeps_the_order_by_itself() -> None:
    late_first = [9 * MS, 1 * MS, 5 * MS]
    assert one_link(opened(rate_bps=1e6), late_first)[0] == [10 * MS, 11 * MS, 12 * MS]


calls = st.lists(
    st.tuples(st.integers(0, 3), st.lists(st.integers(-1, 9 * MS), min_size=4, max_size=4), st.integers(1, 3)), max_size=30
)


@given(calls)
def test_links_do_not_know_of_each_other(sent: list[tuple[int, list[int], int]]) -> None:
    """All receivers in one call, or one at a time on a network of their own: the same."""
    settings: dict[str, Any] = {
        "rate_bps": 1e6,
        "queue_s": 0.002,
        "duplicate": 0.5,
        "duplicate_delay_s": 0.001,
        "reorder": False,
    }
    together, links = opened(4, **settings), {(a, b): opened(4, **settings) for a in range(4) for b in range(4)}
    for k, (sender, received_ns, size) in enumerate(sent):
        uniforms = np.random.default_rng(k).random((4, 2))
        rows: NDArray[np.intp] = np.array([row for row in range(4) if row != sender])
        all_at_once = together.deliver(sender, rows, np.array(received_ns)[rows], 40 * size, drawn(uniforms[rows]))
        for place, row in enumerate(rows.tolist()):
            one, draw = np.array([row]), drawn(uniforms[[row]])
            alone = links[sender, row].deliver(sender, one, np.array(received_ns)[one], 40 * size, draw)
            assert [int(each[place]) for each in all_at_once] == [int(each[0]) for each in alone]


def test_opened_anew_it_has_forgotten_all_frames() -> None:
    layer = opened(rate_bps=1e6, reorder=False)
    first = one_link(layer, [5, 5, 5])
    layer.open(2)
    assert one_link(layer, [5, 5, 5]) == first


def test_what_it_is_given_stays_as_it_is() -> None:
    received = np.array([5, -1, 7])
    received.flags.writeable = False
    layer = opened(4, rate_bps=1e6, duplicate=1.0, reorder=False)
    layer.deliver(0, np.array([1, 2, 3]), received, 10, lambda: np.zeros((3, 2)))
    assert received.tolist() == [5, -1, 7]


@pytest.mark.parametrize(
    ("parameters", "key", "message"),
    [
        ({"queue_s": 1.0}, "queue_s", "queue_s limits the wait for a rate: give rate_bps"),
        ({"rate_bps": 0.0}, "rate_bps", "must be a number >= 1"),
        ({"duplicate": 1.1}, "duplicate", "must be a number >= 0 and <= 1, not 1.1"),
        ({"duplicate_delay_s": -1.0}, "duplicate_delay_s", ">= 0"),
        ({"rate": 1e6}, "rate", r"unknown key 'rate'; did you mean 'rate_bps'\?"),
    ],
)
def test_errors_by_name(parameters: dict[str, Any], key: str, message: str) -> None:
    with pytest.raises(ScenarioError, match=message) as raised:
        binding.call(Delivery, parameters, key="radio.delivery")
    assert raised.value.key == f"radio.delivery.{key}"
