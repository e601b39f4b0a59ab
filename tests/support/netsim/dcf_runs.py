"""Runs of IEEE 802.11 radios, for tests."""

import itertools
from collections.abc import Sequence

import numpy as np

from vcmvsp.cosim.rng import key64
from vcmvsp.netsim.interfaces.layers import Floats
from vcmvsp.netsim.interfaces.medium import Decided, Fate, Offered
from vcmvsp.netsim.mac.dcf.medium import DcfMedium
from vcmvsp.netsim.mac.dcf.parameters import Dcf
from vcmvsp.netsim.phy.dsss import Dsss
from vcmvsp.netsim.phy.ofdm import Ofdm

STRONG = 1e-6  # mW: -60 dBm, 34 dB above the noise
MS = 1_000_000  # ns
US = 1_000
UNTIL = 10_000 * MS
PHYS: list[Dsss | Ofdm] = [Dsss(1e6), Dsss(11e6), Ofdm(6e6), Ofdm(54e6, "5GHz")]


def open_air(
    count: int, phy: Dsss | Ofdm | None = None, mac: Dcf | None = None, *, seed: int = 1, compiled: bool = False
) -> DcfMedium:
    phy = phy or Dsss()
    keys = np.array([key64(seed, f"radio{i}") for i in range(count)], np.uint64)
    return (mac or Dcf()).open(phy, count, keys, 10.0 ** (phy.noise_dbm / 10.0), compile_core=compiled)


def frame(
    number: int,
    time_ns: int,
    sender: int,
    power_mw: Floats,
    *,
    to: int = -1,
    size: int = 100,
    priority: int = 0,
    patience: Floats | float = np.inf,
) -> Offered:
    """A frame with these levels at every attempt; by default only interference can spoil it where it is detected."""
    patience = np.broadcast_to(np.asarray(patience, np.float64), power_mw.shape)
    return Offered(number, time_ns, sender, to, size, priority, power_mw, patience, lambda attempt, start: (power_mw, patience))


def all_equal(count: int, power_mw: float = STRONG) -> Floats:
    """Equal levels on all links: (n,) levels."""
    return np.full(count, power_mw)


def run(medium: DcfMedium, frames: Sequence[Offered], until_ns: int) -> list[Decided]:
    for each in frames:
        medium.offer(each)
    return list(medium.advance(until_ns))


def whole_slots(wait_ns: int, slot_ns: int = 20 * US, largest: int = 31) -> int:
    """Number of slots of a backoff, which ``wait_ns`` must be."""
    slots, rest = divmod(wait_ns, slot_ns)
    assert (rest, 0 <= slots <= largest) == (0, True)
    return slots


def saturated_receptions(levels: Floats, phy: Dsss | Ofdm, mac: Dcf, to: Sequence[int], size: int, duration_s: int) -> int:
    """Received frames of saturated radios with destinations ``to``; -1: a silent radio."""
    senders = [i for i, other in enumerate(to) if other >= 0]
    medium, offered = open_air(len(levels), phy, mac, compiled=True), itertools.count()
    medium.levels[:] = levels
    sent: dict[int, int] = {}

    def offer(sender: int, time_ns: int) -> None:
        number = next(offered)
        sent[number] = sender
        medium.offer(frame(number, time_ns, sender, levels[sender], to=to[sender], size=size, patience=1.0))

    for sender in senders * 3:
        offer(sender, 0)
    received = 0
    for now in range(MS // 10, duration_s * 1000 * MS, MS // 10):
        for each in medium.advance(now):
            received += bool(each.fate[to[sent[each.number]]] == Fate.RECEIVED)
            offer(sent[each.number], now)
    return received


def square_levels(count: int, side_m: float, exponent: float, seed: int) -> Floats:
    """Levels (n, n) mW in a square: 40 mW, 40.052 dB at 1 m."""
    place = np.random.default_rng(seed).uniform(0.0, side_m, (count, 2))
    distance = np.linalg.norm(place[:, None] - place, axis=-1) + np.eye(count)
    return 10.0 ** ((16.0206 - 40.052) / 10.0 - exponent * np.log10(np.maximum(distance, 1.0)))


def periodic(levels: Floats, hz: float, until_ns: int, *, size: int = 100, seed: int = 1, after_ns: int = 0) -> list[Offered]:
    """Every radio broadcasts at this rate, from a random phase on."""
    count, rng = len(levels), np.random.default_rng(seed)
    period = round(1e9 / hz)
    phases = rng.integers(after_ns, after_ns + period, count).tolist()
    times = sorted((time, i) for i, phase in enumerate(phases) for time in range(phase, until_ns, period))
    patience = rng.exponential(size=(len(times), count))
    return [frame(k, time, i, levels[i], size=size, patience=patience[k]) for k, (time, i) in enumerate(times)]


def delivery(decided: Sequence[Decided], frames: Sequence[Offered]) -> tuple[float, Floats]:
    """Share of receptions, and the delay of each, ms."""
    fates = np.array([each.fate for each in decided])
    count = fates.shape[1]
    sent = np.array([frames[each.number].time_ns for each in decided])
    delay_ms = (np.array([each.end_ns for each in decided]) - sent) / 1e6
    received = (fates == 0).sum(axis=1)
    return float(received.sum() / (len(decided) * (count - 1))), np.repeat(delay_ms, received)


def bytes_of(decided: Sequence[Decided]) -> list[tuple[object, ...]]:
    return [
        (each.number, each.start_ns, each.end_ns, each.attempts, each.fate.tobytes(), each.least_sinr.tobytes())
        for each in decided
    ]


def mixed_traffic(seed: int, *, count: int = 6, frames: int = 60) -> list[Offered]:
    """Broadcast and unicast of all sizes and priorities, with hidden nodes, in bursts."""
    rng = np.random.default_rng(seed)
    levels = square_levels(count, 200.0, 3.0, seed)
    times = np.sort(rng.integers(0, 60 * MS, frames)).tolist()
    offered = []
    for k, time in enumerate(times):
        sender = int(rng.integers(count))
        to = -1 if rng.random() < 0.5 else int((sender + rng.integers(1, count)) % count)
        size, priority = int(rng.choice([1, 100, 1000])), int(rng.integers(3))
        if rng.random() < 0.3:
            offered.append(fading(k, time, sender, to, size, priority, levels[sender]))
        else:
            patience = rng.exponential(size=count)
            offered.append(frame(k, time, sender, levels[sender], to=to, size=size, priority=priority, patience=patience))
    return offered


def fading(number: int, time: int, sender: int, to: int, size: int, priority: int, level: Floats) -> Offered:
    """Levels and patience that change with every attempt, and are unknown beforehand."""

    def renew(attempt: int, start_ns: int) -> tuple[Floats, Floats]:
        rng = np.random.default_rng((number, attempt, start_ns))
        return level * rng.exponential(size=len(level)), rng.exponential(size=len(level))

    def answer(start_ns: int) -> float:
        return float(np.random.default_rng((number, start_ns)).exponential())

    return Offered(number, time, sender, to, size, priority, None, None, renew, answer)
