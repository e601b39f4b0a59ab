"""What is between a radio and a receiver that is in range: losses, bursts, queues, and how old information gets."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from vcmvsp.cosim.reproduction.row import Row, absolute, relative
from vcmvsp.cosim.reproduction.validation.channel_setup import channel, heard, line
from vcmvsp.cosim.types import Array

T_NS = 100_000_000
LINKS = 1000


def chance() -> Sequence[Row]:
    """Losses of Bernoulli and of Gilbert and Elliott on a thousand links: how many, how long, how much alike."""
    position, rows = line(np.linspace(1.0, 2.0, LINKS).tolist()), []
    for p in (0.1, 0.5, 0.9):
        on = channel("ideal", loss={"kind": "bernoulli", "probability": p})
        share = float(np.mean([_lost(heard(on, position, sent_ns=k * T_NS).outcome) for k in range(200)]))
        rows.append(absolute(f"bernoulli {p:g}: share lost", p, share, 5.0 * math.sqrt(p * (1.0 - p) / (200 * LINKS))))
    for bad, good in ((2.0, 3.0), (5.0, 0.5)):
        layer = {"kind": "gilbert_elliott", "to_bad_per_s": bad, "to_good_per_s": good, "bad_loss": 1.0, "good_loss": 0.0}
        on, rate, share = channel("ideal", loss=layer), bad + good, bad / (bad + good)
        step_ns = round(0.02 / rate * 1e9)
        lost = np.array([_lost(heard(on, position, sent_ns=k * step_ns).outcome) for k in range(1500)])
        case = f"gilbert_elliott, {bad:g} and {good:g} per s"
        rows.append(absolute(f"{case}: share lost, p / (p + r)", share, lost.mean(), 0.015))
        for lag in (15, 50):
            correlation = np.mean((lost[lag:] - share) * (lost[:-lag] - share)) / (share * (1.0 - share))
            rows.append(
                absolute(f"{case}: correlation after {0.02 * lag:g} / (p + r)", math.exp(-0.02 * lag), float(correlation), 0.03)
            )
    return rows


def _lost(outcome: tuple[str, ...]) -> Array:
    return np.array([each != "received" for each in outcome], float)


def queue() -> Sequence[Row]:
    """A radio that is handed frames at random: Lindley's recursion frame by frame, and the mean wait of M/D/1."""
    air_ns, position, rows = 1_280_000, line([5.0]), []
    for load in (0.3, 0.6, 0.8):
        on = channel("wifi-b-1", mac={"kind": "ideal"})
        times = np.cumsum(np.rint(np.random.default_rng(1).exponential(air_ns / load, 60_000)))
        waits = np.array([heard(on, position, sent_ns=int(at)).queue_ns for at in times.tolist()])
        walk = np.concatenate([[0.0], np.cumsum(air_ns - np.diff(times))])
        exact = walk - np.minimum.accumulate(walk)
        mean = load * air_ns / (2.0 * (1.0 - load))
        rows += [
            absolute(f"load {load:g}: largest difference from Lindley's recursion, ns", 0.0, np.abs(waits - exact).max(), 0.0),
            relative(f"load {load:g}: mean wait of M/D/1, us", mean / 1e3, waits.mean() / 1e3, 0.01 + 0.05 * load),
        ]
    return rows


def age() -> Sequence[Row]:
    """A message every 0.1 s, lost with p, received d later: the mean of the age over time, and that of its peaks."""
    period_s, rows = T_NS / 1e9, []
    for p, delay_s in ((0.0, 0.1), (0.3, 0.0), (0.5, 0.25), (0.8, 0.1)):
        layers: dict[str, Any] = {
            "loss": {"kind": "bernoulli", "probability": p},
            "delay": {"kind": "fixed", "seconds": delay_s},
        }
        on = channel("ideal", **layers)
        position, sent_ns = line(np.linspace(1.0, 2.0, 100).tolist()), np.arange(1000) * T_NS
        received_ns = np.array([heard(on, position, sent_ns=int(at)).received_ns for at in sent_ns])
        ramps = [_ramps(sent_ns[arrived], column[arrived]) for column in received_ns.T if (arrived := column >= 0).any()]
        start, end = (np.concatenate(parts) for parts in zip(*ramps, strict=True))
        mean = (end**2 - start**2).sum() / 2.0 / (end - start).sum()
        case = f"loss {p:g}, delay {delay_s:g} s"
        exact = delay_s + period_s * (1.0 + p) / (2.0 * (1.0 - p))
        rows += [
            relative(f"{case}: mean age, d + T (1 + p) / (2 (1 - p)), s", exact, mean, 0.01),
            relative(f"{case}: mean of its peaks, d + T / (1 - p), s", delay_s + period_s / (1.0 - p), end.mean(), 0.01),
        ]
    return rows


def _ramps(sent_ns: Array, received_ns: Array) -> tuple[Array, Array]:
    """Age of the newest message, s, just after each reception and just before the next one."""
    return (received_ns[:-1] - sent_ns[:-1]) / 1e9, (received_ns[1:] - sent_ns[:-1]) / 1e9
