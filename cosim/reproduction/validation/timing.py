"""Checks of time and reproducibility: ticks without drift, exact delays, published vectors of the generator, equal bytes."""

import math
from collections.abc import Iterator
from fractions import Fraction
from typing import Any

import numpy as np
from scipy.special import lambertw

from vcmvsp.cosim.clock import SECOND_NS, Ticks
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.reproduction.figures.formation.consensus import growth
from vcmvsp.cosim.reproduction.figures.scenarios import ASIDE, UNLIMITED, R, T, V, W, fleet, lossy, tracks
from vcmvsp.cosim.reproduction.row import Row, absolute, relative
from vcmvsp.cosim.rng import philox4x32
from vcmvsp.cosim.runs.api import run
from vcmvsp.cosim.types import Array

START_M = 0.5  # behind its slot
# Known answers of Random123 for philox4x32 with ten rounds: counter, key, answer.
PHILOX = (
    ("00000000 00000000 00000000 00000000", "00000000 00000000", "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
    ("ffffffff ffffffff ffffffff ffffffff", "ffffffff ffffffff", "408f276d 41c83b0e a20bc7c6 6d5451fd"),
    ("243f6a88 85a308d3 13198a2e 03707344", "a4093822 299f31d0", "d16cfe09 94fdcceb 5001e420 24126ea1"),
)


def ticks() -> Iterator[Row]:
    """Times of tick trains after an hour, and the instants of a run in which agents of several rates act."""
    for hz in (10, 30, 60, 120, 1000 / 7):
        train, exact = Ticks.rate(hz), Fraction(repr(float(hz)))
        late = max(abs(train.at(k) - k * SECOND_NS / exact) for k in (1, 7, 1_000, 3600 * int(hz)))
        yield absolute(f"{hz:g} Hz: furthest from k / rate within an hour, ns", 0.0, float(late), 1.0)
    rates = {"car1": 0.1, "car2": 0.03, "car3": 1.0 / 64.0}
    scenario, acts = fleet(6.0, [{}, {}]), {name: list[int]() for name in rates}
    for car in scenario["vehicle"]:
        car["agent"] = {**car["agent"], "period_s": rates[car["name"]]}

    def observe(event: Event) -> None:
        name, _, topic = event.key.partition("/")
        if topic == "command":
            acts[name].append(event.time_ns)

    run(scenario, mcap=False, observe=observe)
    for name, period_s in rates.items():
        train = Ticks.every(period_s)
        off = np.abs(np.array(acts[name]) - [train.at(k) for k in range(len(acts[name]))])
        case = f"agent of {period_s:g} s in a run of 6 s"
        yield absolute(f"{case}: commands", math.ceil(6.0 / period_s - 1e-9), len(acts[name]), 0.0)
        yield absolute(f"{case}: furthest from its tick, ns", 0.0, off.max(), 0.0)


def late_loop() -> Iterator[Row]:
    """``z' = -k z(t - d)``, sampled and held: every latency exact to the tick, and the stability limit."""
    for latency_s in (0.0, 0.05, 0.1, 0.25, 0.3):
        _, z = _delayed_follower(2.0, latency_s, 10.0)
        off = np.abs(z - _recursion(2.0, latency_s / T, len(z))).max()
        yield absolute(f"latency {latency_s:g} s: furthest from the recursion, m", 0.0, off, 1e-9)
    for late in (0, 1, 2, 3, 5):
        limit = 2.0 * math.sin(math.pi / (2 * (2 * late + 1))) / T
        for factor in (0.97, 1.03):
            time_s, z = _delayed_follower(factor * limit, late * T, 40.0)
            begin, end = np.abs(z[(time_s > 5) & (time_s <= 15)]).max(), np.abs(z[time_s > 30]).max()
            case = f"{late} ticks late, {factor:g} of 2 sin(pi / (2 (2 d + 1))) / T: grows (1) or not (0)"
            yield absolute(case, float(factor > 1.0), float(end > begin), 0.0)
    delay_s, period_s = 0.3, 0.01
    for k_d in (1.45, 1.52, 1.60, 1.70):
        time_s, z = _delayed_follower(k_d / delay_s, delay_s, 12.0, period_s=period_s)
        age_s = delay_s + 0.5 * period_s
        exact = math.exp((lambertw(-k_d / delay_s * age_s) / age_s).real)
        yield relative(f"k d = {k_d:g}: growth a second, exp(W(-k d) / d)", exact, growth(z[time_s > 4.0], 20) ** 100, 0.01)


def _delayed_follower(gain: float, latency_s: float, duration_s: float, *, period_s: float = T) -> tuple[Array, Array]:
    """A follower behind its slot at a stationary leader, with delayed commands: times, s, and z1, m."""
    follower = {"pose": (-1.0 - START_M, 0.0, 0.0), "k1": gain, "latency_s": latency_s, **UNLIMITED}
    periods: dict[str, Any] = {"agents": {"period_s": period_s}, "record": {"period_s": period_s}}
    scenario = fleet(duration_s, [follower], path="straight", leader={"speed": 0.0}, **periods)
    run_tracks = tracks(run(scenario, mcap=False), scenario)
    return run_tracks.time_s, run_tracks.z[:, 0, 0]


def _recursion(gain: float, late: float, count: int) -> Array:
    """``z[i + 1] = z[i] - k T ((1 - f) z[i - d] + f z[i - d - 1])``, ``late`` = d + f; the first command is that of tick 1."""
    whole, part = divmod(late, 1.0)
    z, reported = [START_M], [0.0] * (int(whole) + 2)  # nothing is reported at tick 0
    for i in range(count - 1):
        older, old = reported[i : i + 2]
        z.append(z[i] - gain * T * ((1.0 - part) * old + part * older))
        reported.append(z[-1])
    return np.array(z)


def old_reports() -> Iterator[Row]:
    """``hold``: lag caused by the age of reports, on a line and along the arc of a circle."""
    for delay_s in (0.0, 0.25, 0.3, 1.0):
        age_s = T * max(1, math.ceil(delay_s / T - 1e-9))
        more: dict[str, Any] = {"radio": lossy(delay_s=delay_s), "agents": {"estimator": "hold"}, "metrics": {"from_s": 40.0}}
        scenario = fleet(60.0, **more)
        result = run(scenario, mcap=False)
        for side, error in zip((ASIDE, -ASIDE), tracks(result, scenario).error[-1], strict=True):
            chord = 2.0 * (R + side) * math.sin(0.5 * W * age_s)
            case = f"delay {delay_s:g} s, circle of {R + side:g} m: 2 R sin(w a / 2), m"
            yield relative(case, chord, error, 1e-4)
        measured_s = result.metrics["radio"]["age_s"]["max"]
        yield absolute(f"delay {delay_s:g} s: age in use, s", age_s, measured_s, 1e-9)
        line = run(fleet(60.0, path="straight", **more), mcap=False).metrics["formation"]["final_m"]
        yield relative(f"delay {delay_s:g} s, line: v a, m", V * age_s, line, 1e-6)


def draws() -> Iterator[Row]:
    """The generator behind every draw of a link, against published vectors."""
    for number, (counter, key, answer) in enumerate(PHILOX, 1):
        c0, c1, c2, c3 = _words(counter)
        k0, k1 = _words(key)
        words = [int(each) for each in philox4x32((c0, c1, c2, c3), (k0, k1))]
        wrong = sum(word != expected for word, expected in zip(words, _words(answer), strict=True))
        yield absolute(f"vector {number} of philox4x32 x 10: words that differ", 0.0, wrong, 0.0)


def _words(text: str) -> list[int]:
    return [int(word, 16) for word in text.split()]


def same_bytes() -> Iterator[Row]:
    """Digests of everything that a run records, from scenarios with random draws and with bodies."""
    short = {"duration_s": 4.0, "metrics.from_s": 2.0}
    ways: dict[str, dict[str, Any]] = {
        "again": {"set": short},
        "agents in another process": {"set": {**short, "agents.processes": 1}, "agents": "process"},
    }
    for name in ("formation-slalom", "formation-circle"):
        first = run(name, set=short, mcap=False).metrics["digest"]
        for way, settings in ways.items():
            same = run(name, mcap=False, **settings).metrics["digest"] == first
            yield absolute(f"{name}, {way}: the same digest (1: yes)", 1.0, same, 0.0)
        same = run(name, seed=4711, set=short, mcap=False).metrics["digest"] == first
        yield absolute(f"{name}, another seed: the same digest (1: yes)", 0.0, same, 0.0)
