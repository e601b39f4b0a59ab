"""Checks of shared media: Bianchi's model of IEEE 802.11, and ns-3 with the same radios and traffic."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from vcmvsp.cosim.assembly.parts import channel_trial
from vcmvsp.cosim.assembly.parts.radio import Channel
from vcmvsp.cosim.reproduction.row import Row, absolute, relative
from vcmvsp.cosim.reproduction.validation.radio import channel, decided, send
from vcmvsp.cosim.types import Array, FrameReport

SATURATED: Mapping[str, Any] = {"kind": "dcf", "lifetime_s": 1e6, "queue_frames": 1_000_000}
EQUAL: Mapping[str, Any] = {"kind": "log_distance", "exponent": 2.0, "reference_distance_m": 1000.0, "reference_loss_db": 76.0}
SLOT_NS, SIFS_NS, DIFS_NS, ACK_NS = 20_000, 10_000, 50_000, 203_000  # of 802.11b; the acknowledgement is sent at 11 Mbit/s
EDGES_M = (0.0, 20.0, 40.0, 60.0, 75.0, 86.0)


class Ns3Case(NamedTuple):
    """Radios uniform in a square that broadcast 100 bytes at random times, and the results of ns-3."""

    preset: str
    radios: int
    side_m: float
    exponent: float
    hz: float  # frames per second and radio
    seconds: int
    runs: int
    delivery: float
    mean_ms: float
    quantiles_ms: tuple[float, float, float]
    shares: tuple[float, float, float]  # cumulative shares of delays up to these values
    by_distance: tuple[float, ...]  # delivery, see `EDGES_M`


NS3 = {
    "802.11b, 50 in one domain": Ns3Case(
        *("wifi-b-1", 50, 200.0, 2.0, 10.0, 4, 2, 0.9617, 2.952),
        (2.191, 7.366, 11.023),
        (0.500, 0.950, 0.990),
        (0.9953, 0.9902, 0.9785, 0.9713, 0.9650, 0.9524),
    ),
    "802.11b, 100 in one domain, overloaded": Ns3Case(
        *("wifi-b-1", 100, 200.0, 2.0, 10.0, 2, 2, 0.6223, 12.597),
        (10.985, 29.476, 39.012),
        (0.500, 0.950, 0.990),
        (0.9687, 0.8801, 0.7618, 0.6714, 0.6082, 0.5406),
    ),
    "802.11b, 30, hidden from each other": Ns3Case(
        *("wifi-b-1", 30, 170.0, 3.0, 15.0, 6, 3, 0.4155, 1.721),
        (1.330, 3.376, 5.015),
        (0.700, 0.950, 0.990),
        (0.9826, 0.9568, 0.9273, 0.8476, 0.7423, 0.0),
    ),
    "802.11g, 100 in one domain": Ns3Case(
        *("wifi-g-6", 100, 200.0, 2.0, 30.0, 1, 3, 0.8684, 0.748),
        (0.499, 2.096, 2.937),
        (0.503, 0.950, 0.990),
        (0.9879, 0.9634, 0.9264, 0.8916, 0.8709, 0.8358),
    ),
    "802.11g, 40, hidden from each other": Ns3Case(
        *("wifi-g-6", 40, 170.0, 3.0, 40.0, 2, 3, 0.4129, 0.327),
        (0.264, 0.650, 1.022),
        (0.800, 0.950, 0.990),
        (0.9846, 0.9699, 0.9387, 0.8824, 0.8032, 0.0),
    ),
}
# Each radio broadcasts 100 bytes at 10 Hz: preset, radios in a square of 200 m, delivery, mean delay in ms.
PERIODIC = (
    ("wifi-b-1", 10, 0.9993, 1.45),
    ("wifi-b-1", 50, 0.9631, 2.83),
    ("wifi-b-1", 100, 0.6169, 12.1),
    ("wifi-g-6", 10, 1.0, 0.270),
    ("wifi-g-6", 50, 0.9938, 0.301),
    ("wifi-g-6", 100, 0.9864, 0.347),
)
# 802.15.4, random times: layout, radios, frames per second each, payload, seconds, runs, delivery, mean delay in ms.
LRWPAN = (
    ("room", 5, 10.0, 100, 20.0, 2, 0.9816, 6.335),
    ("room", 20, 5.0, 100, 10.0, 2, 0.9371, 7.572),
    ("room", 20, 10.0, 100, 10.0, 2, 0.7786, 10.310),
    ("room", 50, 10.0, 20, 4.0, 2, 0.7571, 6.031),
    ("line", 3, 20.0, 100, 30.0, 2, 0.6134, 6.293),
)


def bianchi() -> Iterator[Row]:
    """Saturated radios at equal levels: throughput of unicast, and collisions of broadcast."""
    for count in (3, 10):
        on, position = channel("wifi-b-11", mac=SATURATED, path_loss=EQUAL), _near(count)
        for k in range(9000):
            send(on, position, sender=k % count, to=(k + 1) % count, size_bytes=1000)
        reports = on.advance(8 * 10**9)
        received = sum(each == "received" for report in reports for each in report.outcome)
        yield relative(f"unicast, {count} radios: frames received a second", _rate_hz(count, reports), received / 8.0, 0.03)
    for count in (3, 20):
        on, position = channel("wifi-b-11", mac=SATURATED, path_loss=EQUAL), _near(count)
        for k in range(5000):
            send(on, position, sender=k % count)
        ends = [report for report in on.advance(10**10) if report.access_ns + report.queue_ns > 20_000_000][:4000]
        collided = float(np.mean([set(report.outcome) != {"received"} for report in ends]))
        exact = 1 - (1 - 2 / 33) ** (count - 1)
        yield absolute(f"broadcast, {count} radios: share that collides", exact, collided, 0.02)


def _near(count: int) -> Array:
    return np.array([(float(number), 0.0, 0.0) for number in range(count)])


def _rate_hz(count: int, reports: Sequence[FrameReport]) -> float:
    """Throughput of saturated radios, frames a second."""
    tau, air_ns = sending_chance(count), reports[0].air_time_ns
    idle, alone = (1 - tau) ** count, count * tau * (1 - tau) ** (count - 1)
    slot_ns = idle * SLOT_NS + alone * (air_ns + SIFS_NS + ACK_NS + DIFS_NS) + (1 - idle - alone) * (air_ns + DIFS_NS)
    return 1e9 * alone / slot_ns


def sending_chance(count: int, window: int = 32, stages: int = 5) -> float:
    """Send probability of a saturated radio in a slot (G. Bianchi, IEEE JSAC 18(3), 2000, equations 7 and 9), by bisection."""
    low, high, tau = 0.0, 1.0, 0.0
    for _ in range(60):
        p = (low + high) / 2.0
        tau = 2.0 / (1.0 + window + p * window * sum((2.0 * p) ** stage for stage in range(stages)))
        low, high = (p, high) if 1 - (1 - tau) ** (count - 1) > p else (low, p)
    return tau


def periodic(seeds: int = 20) -> Iterator[Row]:
    """Radios with random phases, in several placements: ``vcmvsp channel``."""
    for preset, count, delivery, mean_ms in PERIODIC:
        counts = []
        for seed in range(seeds):
            position = np.random.default_rng(seed).uniform(0.0, 200.0, (count, 3)) * (1.0, 1.0, 0.0)
            waypoints = channel_trial.Waypoints.fixed(position)
            plan = channel_trial.TrialTraffic(waypoints=waypoints, rate_hz=10.0, size_bytes=100, duration_s=2.0, seed=seed)
            counts.append(channel_trial.run(channel(preset, path_loss={"exponent": 2.0}), plan))
        weights = [each["receptions"] for each in counts]
        delay_s = np.average([each["delay_s"]["mean"] for each in counts], weights=weights)
        share, case = float(np.mean([each["delivery_ratio"] for each in counts])), f"{preset}, {count} radios"
        yield absolute(f"{case}: delivery", delivery, share, 0.01)
        yield relative(f"{case}: mean delay, ms", mean_ms, 1e3 * delay_s, 0.1 if mean_ms > 10.0 else 0.05)


def judged(name: str) -> Iterator[Row]:
    """Compare one case of `NS3`."""
    of = NS3[name]
    position = np.zeros((of.radios, 3))
    position[:, :2] = np.random.default_rng(1).uniform(0.0, of.side_m, (of.radios, 2))
    apart = np.linalg.norm(position[:, None] - position, axis=-1)
    bins, frames, receptions = np.digitize(apart, EDGES_M[1:]), np.zeros(len(EDGES_M)), np.zeros(len(EDGES_M))
    delays = []
    for seed in range(of.runs):
        on = channel(of.preset, seed=seed, path_loss={"exponent": of.exponent})
        for report in _random(on, position, of.hz, of.seconds, 100, np.random.default_rng(seed)):
            own = int(report.sender.removeprefix("v"))
            arrived, others = np.asarray(report.received_ns) >= 0, np.delete(bins[own], own)
            frames += np.bincount(others, minlength=len(EDGES_M))
            receptions += np.bincount(others[arrived], minlength=len(EDGES_M))
            delays.append((np.asarray(report.received_ns)[arrived] - report.sent_ns) / 1e6)
    delay_ms = np.concatenate(delays)
    yield absolute("delivery", of.delivery, receptions.sum() / frames.sum(), 0.01)
    yield relative("mean delay, ms", of.mean_ms, delay_ms.mean(), 0.05)
    for at_ms, share, within in zip(of.quantiles_ms, of.shares, (0.03, 0.015, 0.015), strict=True):
        yield absolute(f"share of delays up to {at_ms:g} ms", share, float(np.mean(delay_ms <= at_ms + 1e-3)), within)
    for low, expected, measured in zip(EDGES_M, of.by_distance, receptions / frames, strict=True):
        yield absolute(f"delivery from {low:g} m on", expected, measured, 0.02)


def lrwpan() -> Iterator[Row]:
    """Unslotted CSMA/CA in a room of 10 m, and on a line with hidden ends."""
    for kind, count, hz, size, seconds, runs, delivery, mean_ms in LRWPAN:
        arrived, expected, delays = 0, 0, []
        for seed in range(runs):
            rng = np.random.default_rng((seed, 3))
            position = np.zeros((count, 3))
            position[:, 0] = 25.0 * np.arange(count)
            if kind == "room":
                position[:, :2] = rng.uniform(0.0, 10.0, (count, 2))
            exponent = 2.0 if kind == "room" else 3.0
            on = channel("zigbee", seed=seed, path_loss={"exponent": exponent, "reference_loss_db": 40.052})
            for report in _random(on, position, hz, seconds, size, rng):
                arrivals_ns = np.asarray(report.received_ns)
                arrivals_ns = arrivals_ns[arrivals_ns >= 0]
                arrived, expected = arrived + len(arrivals_ns), expected + count - 1
                delays.append((arrivals_ns - report.sent_ns) / 1e6)
        case = f"{kind}, {count} radios, {hz:g} Hz, {size} bytes"
        yield absolute(f"{case}: delivery", delivery, arrived / expected, 0.02)
        yield relative(f"{case}: mean delay, ms", mean_ms, np.concatenate(delays).mean(), 0.05)


def _random(on: Channel, position: Array, hz: float, seconds: float, size: int, rng: np.random.Generator) -> list[FrameReport]:
    count = len(position)
    frames = round(count * hz * seconds)
    times = np.sort(rng.integers(0, round(seconds * 1e9), frames)).tolist()
    reports: list[FrameReport] = []
    for at, sender in zip(times, rng.integers(0, count, frames).tolist(), strict=True):
        reports += send(on, position, sent_ns=at, sender=sender, size_bytes=size)
        reports += on.advance(at)
    return [*reports, *decided(on)]
