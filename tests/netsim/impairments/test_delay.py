"""Delays, rate limit, copies and order of arrival: exact values, and distributions of random ones."""

import math
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.support.netsim.channels import even_uniforms, make_channel, make_frame, plain_channel, send
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.netsim.impairments.delay import EmpiricalDelay, FixedDelay, GammaDelay, NoDelay, NormalDelay, UniformDelay
from vcmvsp.netsim.impairments.delivery import Delivery
from vcmvsp.netsim.interfaces.layers import Delay, Floats, Ints
from vcmvsp.netsim.phy.dsss import Dsss

pytestmark = pytest.mark.slow


def never() -> Any:
    raise AssertionError("nothing here needs chance")


@pytest.mark.parametrize("seconds", [0.1, 0.25, 0.3, 1.0, 2.0, 0.0013])
@pytest.mark.parametrize("propagation", [False, True])
def test_fixed_delay_is_exact_and_contains_the_air_time_and_the_travel(seconds: float, propagation: bool) -> None:
    channel = make_channel("wifi-b-1", delay={"seconds": seconds, "propagation": propagation})
    for k in range(5):
        sent_ns = k * 3_000_000_000
        expected = sent_ns + round(seconds * 1e9)
        assert send(channel, 10.0, sent_ns=sent_ns).received_ns.tolist() == [expected]


@given(
    seconds=st.floats(0.0, 3.0),
    jitter_s=st.floats(0.0, 3.0),
    sends=st.lists(st.tuples(st.integers(0, 10**9), st.integers(0, 1500)), min_size=1, max_size=20),
)
def test_reception_is_later_than_sending_by_the_air_time_at_least(
    seconds: float, jitter_s: float, sends: list[tuple[int, int]]
) -> None:
    channel = plain_channel(delay=FixedDelay(seconds, jitter_s))
    now, free, latest = 0, 0, round((seconds + jitter_s) * 1e9) + 1
    for gap, size in sends:
        now += gap
        free = max(now, free) + Dsss().air_time_ns(size)
        for received in send(channel, 1.0, 1.0, sent_ns=now, size_bytes=size).received_ns.tolist():
            assert now < free <= received <= max(free, now + latest)


def test_fixed_delays_need_no_random_numbers() -> None:
    assert NoDelay().delay_ns(make_frame(3), never).tolist() == [0, 0, 0]
    assert FixedDelay(0.1).delay_ns(make_frame(3), never).tolist() == [100_000_000] * 3


@pytest.mark.parametrize("kind", ["none", "fixed"])
def test_propagation_delay_counts_if_enabled(kind: str) -> None:
    delay = {"kind": kind, "propagation": True} | ({"seconds": 0.0} if kind == "fixed" else {})
    plain, propagating = (
        send(make_channel("wifi-b-1", delay=keys, path_loss={"exponent": 2.0}), 30.0, 299.792458)
        for keys in ({"kind": "none"}, delay)
    )
    assert (propagating.received_ns - plain.received_ns).tolist() == [100, 1000]
    assert propagating.rssi_dbm.tolist() == plain.rssi_dbm.tolist()


EVEN = even_uniforms(200_000)
MEASURED = EmpiricalDelay(((0.0, 0.002), (0.5, 0.004), (0.99, 0.03), (1.0, 0.2)))


def seconds(layer: Delay) -> Floats:
    delay = layer.delay_ns(make_frame(len(EVEN)), lambda: EVEN)
    assert delay.dtype == np.int64
    return np.asarray(delay * 1e-9, np.float64)


@pytest.mark.parametrize("layer", [UniformDelay(0.01, 0.05), FixedDelay(0.03, jitter_s=0.02)])
def test_uniform_delays_have_their_quantiles_and_spread(layer: Delay) -> None:
    delay = seconds(layer)
    assert np.percentile(delay, [0, 25, 50, 100]) == pytest.approx([0.01, 0.02, 0.03, 0.05], abs=1e-6)
    assert delay.std() == pytest.approx(0.04 / math.sqrt(12), rel=1e-4)


def test_normal_delays_have_their_quantiles_and_are_never_negative() -> None:
    delay = seconds(NormalDelay(0.1, 0.01))
    assert np.percentile(delay, [2.275, 15.866, 50, 84.134, 97.725]) == pytest.approx([0.08, 0.09, 0.1, 0.11, 0.12], abs=2e-4)
    assert (delay.mean(), delay.std()) == pytest.approx((0.1, 0.01), rel=5e-3)
    assert seconds(NormalDelay(0.0, 0.01)).min() == 0.0


@pytest.mark.parametrize(("mean_s", "sigma_s"), [(0.02, 0.02), (0.02, 0.005), (0.02, 0.04), (0.02, 0.001)])
def test_gamma_delays_have_their_mean_and_spread(mean_s: float, sigma_s: float) -> None:
    delay = seconds(GammaDelay(mean_s, sigma_s, fixed_s=0.003)) - 0.003
    assert delay.min() >= 0.0
    assert (delay.mean(), delay.std()) == pytest.approx((mean_s, sigma_s), rel=2e-3)
    if mean_s == sigma_s:  # exponential
        assert np.percentile(delay, [10, 50, 99]) == pytest.approx(-mean_s * np.log([0.9, 0.5, 0.01]), rel=1e-3)


def test_measured_quantiles_are_interpolated() -> None:
    delay = seconds(MEASURED)
    assert np.percentile(delay, [25, 50, 74.5, 99, 99.5]) == pytest.approx([0.003, 0.004, 0.017, 0.03, 0.115], rel=1e-3)
    assert delay.min() >= 0.002
    assert delay.max() <= 0.2


@pytest.mark.parametrize("layer", [UniformDelay(0.0, 0.1), NormalDelay(0.01, 0.01), GammaDelay(0.01, 0.01), MEASURED])
def test_no_draw_gives_a_delay_before_the_sending(layer: Delay) -> None:
    edges = np.array([(0.0, 0.0), (1.0 - 2.0**-53, 0.0), (0.0, 1.0 - 2.0**-53)])
    assert (layer.delay_ns(make_frame(3), lambda: edges) >= 0).all()


def test_delay_parameters_without_a_meaning_are_refused() -> None:
    with pytest.raises(ScenarioError, match=r"to_s.*not be less than from_s"):
        UniformDelay(0.2, 0.1)
    for mean_s, sigma_s in ((0.1, 0.0), (0.0, 0.0), (0.0, 0.1), (0.1, 10.0)):
        with pytest.raises(ScenarioError, match=r"sigma_s.*between"):
            GammaDelay(mean_s, sigma_s)
    falling = ((0.0, 0.2), (1.0, 0.1))
    for quantiles in ((), ((0.0, 0.1),), ((0.1, 0.1), (1.0, 0.2)), falling, ((0.0, 0.1), (0.0, 0.2), (1.0, 0.3))):
        with pytest.raises(ScenarioError, match=r"quantiles.*in increasing order"):
            EmpiricalDelay(quantiles)


MS = 1_000_000


def opened(count: int = 2, **parameters: Any) -> Delivery:
    layer = Delivery(**parameters)
    layer.open(count)
    return layer


def one_link(layer: Delivery, received_ns: list[int], size_bytes: int = 125, draw: Any = never) -> tuple[list[int], list[int]]:
    """Arrivals and copies of frames on the link from radio 0 to radio 1."""
    row = np.array([1])
    found = [layer.deliver(0, row, np.array([t]), size_bytes, draw) for t in received_ns]
    return [int(arrival[0]) for arrival, _ in found], [int(copy[0]) for _, copy in found]


times = st.lists(st.integers(-1, 20 * MS), max_size=40)


@given(times)
def test_delivery_without_parameters_changes_nothing(received_ns: list[int]) -> None:
    assert one_link(opened(), received_ns) == (received_ns, [-1] * len(received_ns))


@given(times, st.sampled_from([None, 0.0, 0.0005, 0.004]), st.sampled_from([1e5, 1e6, 3e6]))
def test_rate_is_lindleys_recursion(received_ns: list[int], queue_s: float | None, rate_bps: float) -> None:
    """Frame by frame, with times that may go back and frames that were lost earlier."""
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
            _, copies = one_link(opened(duplicate=duplicate), [5], draw=partial(np.full, (1, 2), draw))
            assert copies == [5 if doubled else -1]


@given(times, st.sampled_from([0.0, 0.5, 1.0]), st.sampled_from([0.0, 0.002]))
def test_in_order_nothing_overtakes(received_ns: list[int], duplicate: float, delay_s: float) -> None:
    """Whatever arrives later was sent later, copies included; nothing arrives early, and no later than the order demands."""
    rng = np.random.default_rng(len(received_ns))
    layer = opened(duplicate=duplicate, duplicate_delay_s=delay_s, reorder=False)
    arrivals, copies = one_link(layer, received_ns, draw=lambda: rng.random((1, 2)))
    last = -1
    for received, arrival, copy in zip(received_ns, arrivals, copies, strict=True):
        assert arrival == (max(received, last + 1) if received >= 0 else -1)
        assert copy in {-1, arrival + round(delay_s * 1e9)}
        last = max(last, arrival, copy)


calls = st.lists(
    st.tuples(st.integers(0, 3), st.lists(st.integers(-1, 9 * MS), min_size=4, max_size=4), st.integers(1, 3)), max_size=30
)


@given(calls)
def test_links_do_not_know_of_each_other(sent: list[tuple[int, list[int], int]]) -> None:
    """All receivers in one call equal one receiver at a time on a network of its own."""
    limited: dict[str, Any] = {"rate_bps": 1e6, "queue_s": 0.002}
    settings = limited | {"duplicate": 0.5, "duplicate_delay_s": 0.001, "reorder": False}
    together, links = opened(4, **settings), {(a, b): opened(4, **settings) for a in range(4) for b in range(4)}
    for k, (sender, received_ns, size) in enumerate(sent):
        uniforms = np.random.default_rng(k).random((4, 2))
        rows: NDArray[np.intp] = np.array([row for row in range(4) if row != sender])
        all_at_once = together.deliver(sender, rows, np.array(received_ns)[rows], 40 * size, uniforms[rows].copy)
        for place, row in enumerate(rows.tolist()):
            one, draw = np.array([row]), uniforms[[row]].copy
            alone = links[sender, row].deliver(sender, one, np.array(received_ns)[one], 40 * size, draw)
            assert [int(each[place]) for each in all_at_once] == [int(each[0]) for each in alone]


def test_delivery_opened_again_starts_empty() -> None:
    layer = opened(rate_bps=1e6, reorder=False)
    first = one_link(layer, [5, 5, 5])
    layer.open(2)
    assert one_link(layer, [5, 5, 5]) == first


def test_delivery_does_not_change_its_arguments() -> None:
    received = np.array([5, -1, 7])
    received.flags.writeable = False
    layer = opened(4, rate_bps=1e6, duplicate=1.0, reorder=False)
    layer.deliver(0, np.array([1, 2, 3]), received, 10, lambda: np.zeros((3, 2)))
    assert received.tolist() == [5, -1, 7]


@pytest.mark.parametrize(
    ("parameters", "key", "message"),
    [
        ({"queue_s": 1.0}, "queue_s", "queue_s limits the wait in a rate-limited queue: set rate_bps"),
        ({"rate_bps": 0.0}, "rate_bps", "must be a number >= 1"),
        ({"duplicate": 1.1}, "duplicate", "must be a number >= 0 and <= 1, not 1.1"),
        ({"duplicate_delay_s": -1.0}, "duplicate_delay_s", ">= 0"),
        ({"rate": 1e6}, "rate", r"unknown key 'rate'; did you mean 'rate_bps'\?"),
    ],
)
def test_bad_parameters_are_refused_with_their_key(parameters: dict[str, Any], key: str, message: str) -> None:
    with pytest.raises(ScenarioError, match=message) as raised:
        binding.call(Delivery, parameters, key="radio.delivery")
    assert raised.value.key == f"radio.delivery.{key}"
