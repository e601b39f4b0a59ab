"""Received levels: distance, walls, shadowing, fading."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.special import j0

from vcmvsp.cosim.reproduction.row import Row, absolute, relative
from vcmvsp.cosim.reproduction.validation.channel_setup import channel, heard, line, part
from vcmvsp.cosim.runs.api import run
from vcmvsp.cosim.tables.columns import numbers
from vcmvsp.cosim.types import Array

LIGHT_M_S = 299_792_458.0
HZ = 2.4e9
DISTANCES_M = (1.0, 3.0, 10.0, 47.0, 200.0, 2000.0)
PERCENT = (1, 5, 10, 25, 50, 75, 90, 95, 99)
# Quantiles in dB of 4e6 gains of NakagamiPropagationLossModel with m0 = m.
NAKAGAMI_DB: Mapping[float, Sequence[float]] = {
    0.5: (-38.0687, -24.0382, -17.9964, -9.9331, -3.4222, 1.2142, 4.3241, 5.8433, 8.2139),
    1.0: (-19.9894, -12.9111, -9.7832, -5.4153, -1.5904, 1.4194, 3.6226, 4.7625, 6.6300),
    1.5: (-14.1451, -9.2989, -7.1060, -3.9335, -1.0308, 1.3653, 3.1886, 4.1602, 5.7793),
    3.0: (-8.3829, -5.6459, -4.3492, -2.3945, -0.4982, 1.1634, 2.4920, 3.2194, 4.4762),
}
# Of a noncentral chi-squared distribution with 2 degrees of freedom and noncentrality 2 K, over 2 (K + 1).
RICIAN_DB: Mapping[float, Sequence[float]] = {
    1.0: (-18.6671, -11.6712, -8.6426, -4.5437, -1.1159, 1.4891, 3.3623, 4.3289, 5.9087),
    10.0: (-6.1836, -3.9823, -2.9978, -1.5625, -0.2003, 0.9797, 1.9215, 2.4404, 3.3381),
}
# Material, thickness m, loss dB at 2.437 and 5.2 GHz.
SLABS = (
    ("plasterboard", 0.025, 1.0, 1.5),
    ("wood", 0.04, 0.8, 1.5),
    ("glass", 0.006, 1.7, 1.8),
    ("brick", 0.11, 3.5, 3.8),
    ("concrete", 0.15, 11.4, 19.4),
    ("concrete", 0.2, 14.7, 25.4),
)
SIGMA_DB, APART_M = 4.0, 10.0
DOPPLER_HZ, LAGS_S = 8.0, (0.005, 0.01, 0.02, 0.03, 0.048, 0.08, 0.12)


def path_loss() -> Sequence[Row]:
    """Three laws over 1 m to 2 km, and the range with the numbers of the Wireless Simulation Server."""
    d, height = np.array(DISTANCES_M), 1.5
    free = 20.0 * np.log10(4.0 * math.pi * d * HZ / LIGHT_M_S)
    laws = {
        "friis": (free, {"kind": "friis", "frequency_hz": HZ}),
        "log_distance, exponent 2.7": (
            40.052 + 27.0 * np.log10(d),
            {"kind": "log_distance", "exponent": 2.7, "reference_distance_m": 1.0, "reference_loss_db": 40.052},
        ),
        "two_ray_ground, antennas at 1.5 m": (
            np.where(d <= 4.0 * math.pi * height**2 * HZ / LIGHT_M_S, free, 40.0 * np.log10(d) - 40.0 * math.log10(height)),
            {"kind": "two_ray_ground", "frequency_hz": HZ},
        ),
    }
    rows = []
    for name, (expected, layer) in laws.items():
        losses = part("path_loss_db", channel("ideal", path_loss=layer), line(DISTANCES_M, height))
        for far, exact, measured in zip(DISTANCES_M, expected, losses, strict=True):
            rows.append(absolute(f"{name}, {far:g} m: loss, dB", exact, measured, 1e-4))
    for exponent in (2.0, 2.5, 3.0, 4.0):
        reach = 2.0 * 10.0 ** ((-49.67 + 93.0) / (10.0 * exponent))
        edge = np.linspace(reach - 0.05, reach + 0.05, 1001)
        report = heard(channel("wss", path_loss={"exponent": exponent}), line(edge.tolist()))
        rows.append(
            absolute(f"wss, exponent {exponent:g}: range, m", reach, edge[np.array(report.received_ns) >= 0].max(), 2e-4)
        )
    return rows


def walls() -> Sequence[Row]:
    """Slabs of usual walls in a world between two vehicles."""
    rows = []
    for material, thick, *expected in SLABS:
        for hz, loss_db in zip((2.437e9, 5.2e9), expected, strict=True):
            box = {"center": (5.0, 0.0, 1.0), "size": (thick, 8.0, 2.0), "material": material}
            still = {"kind": "trajectory", "speed": 0.0}
            scenario = {
                "name": "wall",
                "duration_s": 0.2,
                "physics": {"kind": "kinematic"},
                "world": {"kind": "boxes", "boxes": [box]},
                "radio": {"preset": "wifi-b-1", "walls": {"kind": "itu", "frequency_hz": hz}},
                "vehicles": {"kind": "kinematic"},
                "vehicle": [{"name": "a", "agent": still}, {"name": "b", "pose": (10.0, 0.0, 0.0), "agent": still}],
            }
            measured = numbers(run(scenario, mcap=False).radio, "wall_loss_db")
            rows.append(absolute(f"{material}, {1000 * thick:g} mm, {hz / 1e9:g} GHz: loss, dB", loss_db, measured[0], 0.051))
    return rows


def shadowing() -> Sequence[Row]:
    """Spread and correlation over 20,000 links in 2 km, from twenty transmitters; both directions."""
    layer = {"kind": "gudmundson", "sigma_db": SIGMA_DB, "correlation_distance_m": APART_M}
    rng, on = np.random.default_rng(3), channel("ideal", shadowing=layer)
    before, after, back = [], {delta: list[Array]() for delta in (3.0, 10.0, 30.0)}, []
    for _ in range(20):
        position = rng.uniform(-1000.0, 1000.0, (1001, 3)) * (1.0, 1.0, 0.02)
        way = rng.normal(size=(1001, 3))
        way[0] = 0.0
        way[1:] /= np.linalg.norm(way[1:], axis=1, keepdims=True)
        before.append(part("shadowing_db", on, position))
        for delta, measured in after.items():
            measured.append(part("shadowing_db", on, position + delta * way))
        there_first = position[[1, 0]]
        back.append(part("shadowing_db", on, there_first)[0] - before[-1][0])
    values = np.concatenate(before)
    rows = [
        relative("standard deviation, dB", SIGMA_DB, values.std(), 0.02),
        absolute("mean, dB", 0.0, values.mean(), 0.15),
        absolute("largest difference between there and back, dB", 0.0, np.abs(back).max(), 1e-9),
    ]
    for delta, measured in after.items():
        rho = np.corrcoef(values, np.concatenate(measured))[0, 1]
        case = f"one end moved by {delta:g} m: correlation, exp(-d / 10 m)"
        rows.append(absolute(case, math.exp(-delta / APART_M), rho, 0.03))
    return rows


def fading() -> Sequence[Row]:
    """A million gains of each distribution."""
    rows = []
    for m, expected in NAKAGAMI_DB.items():
        rows += _quantiles(f"Nakagami m = {m:g}", {"kind": "nakagami", "m": m}, expected, 1.0 / m, 0.15 if m >= 1.0 else 0.3)
    for k, expected in RICIAN_DB.items():
        spread = (2.0 * k + 1.0) / (k + 1.0) ** 2
        rows += _quantiles(f"Rician K = {k:g}", {"kind": "rician", "k_factor": k}, expected, spread, 0.15)
    exact = 10.0 * np.log10(-np.log1p(-np.array(PERCENT) / 100.0))
    return [*rows, *_quantiles("Rayleigh", {"kind": "rayleigh"}, exact.tolist(), 1.0, 0.15)]


def doppler() -> Sequence[Row]:
    """A thousand links with gains that vary in time, at 60 instants within an hour and a little later."""
    rows = []
    for name, layer, direct in (
        ("Rayleigh", {"kind": "rayleigh", "doppler_hz": DOPPLER_HZ}, 0.0),
        ("Rician K = 4", {"kind": "rician", "k_factor": 4.0, "doppler_hz": DOPPLER_HZ}, 4.0),
    ):
        on, position = channel("ideal", fading=layer), line(np.linspace(1.0, 2.0, 1000).tolist())
        times = np.sort(np.random.default_rng(2).uniform(0.0, 3600.0, 60))[:, np.newaxis] + np.array((0.0, *LAGS_S))
        decibels = [part("fading_db", on, position, sent_ns=round(1e9 * at)) for at in np.sort(times, axis=None).tolist()]
        order = np.argsort(np.argsort(times, axis=None)).reshape(times.shape)
        gain = 10.0 ** (np.array(decibels)[order] / 10.0)
        now = gain[:, 0] - gain[:, 0].mean()
        for number, lag_s in enumerate(LAGS_S, 1):
            later = gain[:, number] - gain[:, number].mean()
            bessel = float(j0(2.0 * math.pi * DOPPLER_HZ * lag_s))
            exact = (2.0 * direct * bessel + bessel**2) / (2.0 * direct + 1.0)
            measured = float((now * later).mean() / (now.std() * later.std()))
            rows.append(absolute(f"{name}, {DOPPLER_HZ:g} Hz: correlation after {1e3 * lag_s:g} ms", exact, measured, 0.05))
    return rows


def _quantiles(name: str, layer: Mapping[str, object], expected: Sequence[float], variance: float, within: float) -> list[Row]:
    on, position = channel("ideal", fading=layer), line(np.linspace(1.0, 2.0, 20_000).tolist())
    decibels = np.concatenate([part("fading_db", on, position, sent_ns=k * 10**9) for k in range(50)])
    gain = 10.0 ** (decibels / 10.0)
    pairs = zip(PERCENT, expected, np.percentile(decibels, PERCENT), strict=True)
    return [
        *(absolute(f"{name}: quantile {percent} %, dB", exact, measured, within) for percent, exact, measured in pairs),
        absolute(f"{name}: mean power", 1.0, gain.mean(), 0.01),
        relative(f"{name}: variance of the power", variance, gain.var(), 0.02),
    ]
