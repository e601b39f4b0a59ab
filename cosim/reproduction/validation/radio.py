"""Checks of one radio link: a channel as described by ``[radio]`` of a scenario, and frames sent through it."""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import j0

from vcmvsp.cosim.assembly import radio
from vcmvsp.cosim.assembly.parts import channel_trial
from vcmvsp.cosim.assembly.parts.radio import Channel
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.reproduction.figures.scenarios import scene
from vcmvsp.cosim.reproduction.row import Row, absolute, relative
from vcmvsp.cosim.runs.api import run
from vcmvsp.cosim.tables.columns import numbers
from vcmvsp.cosim.types import Array, FrameReport, Message

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
BITS = 1088  # of a PSDU of 136 bytes
# By preset and model: SINR dB and success, from the error models of ns-3.
SUCCESS: Mapping[tuple[str, str], Sequence[tuple[float, float]]] = {
    ("wifi-b-1", "dsss"): ((-6.0, 0.114408641), (-5.2, 0.492387011), (-4.1, 0.90090911)),
    ("wifi-b-2", "dsss"): ((-1.8, 0.098592624), (-0.8, 0.503983425), (0.4, 0.897292683)),
    ("wifi-b-5.5", "dsss"): ((1.0, 0.097880127), (1.9, 0.489886115), (3.0, 0.892215516)),
    ("wifi-b-11", "dsss"): ((4.0, 0.09515186), (4.9, 0.484629977), (6.1, 0.908406873)),
    ("wifi-a-6", "yans"): ((-1.9, 0.115129482), (-1.2, 0.506310104), (-0.2, 0.909650688)),
    ("wifi-a-12", "yans"): ((0.9, 0.084900767), (1.7, 0.488377795), (2.7, 0.896574009)),
    ("wifi-a-24", "yans"): ((6.8, 0.110641195), (7.7, 0.479551247), (9.0, 0.907638945)),
    ("wifi-a-54", "yans"): ((16.4, 0.097598723), (17.2, 0.502460811), (18.2, 0.897385047)),
    ("wifi-a-6", "nist"): ((2.4, 0.113828396), (2.7, 0.472891842), (3.3, 0.908955549)),
    ("wifi-a-12", "nist"): ((5.4, 0.104814328), (5.7, 0.460088165), (6.3, 0.90585467)),
    ("wifi-a-24", "nist"): ((11.7, 0.067550663), (12.1, 0.466304622), (12.7, 0.886183479)),
    ("wifi-a-54", "nist"): ((20.8, 0.122778052), (21.2, 0.535521127), (21.8, 0.897401443)),
    ("zigbee", "oqpsk"): ((-1.5, 0.060843949), (-0.7, 0.481240135), (0.2, 0.894607301)),
}
# SINR in dB of ns-3's table for a success of one half, PSDU of 128 bytes.
HALF_DB = {"6": -0.60, "9": 0.97, "12": 2.39, "18": 4.88, "24": 7.82, "36": 10.99, "48": 14.99, "54": 16.33}
# 20,000 broadcasts over one link: preset, model, received level dBm, payload bytes, number received.
RECEIVED = (
    ("wifi-b-1", "dsss", -99.5, 1, 13870),
    ("wifi-b-11", "dsss", -89.0, 100, 10344),
    ("wifi-g-6", "yans", -94.5, 100, 16222),
    ("wifi-g-54", "yans", -76.5, 100, 10415),
    ("zigbee", "oqpsk", -87.0, 4, 12161),
    ("zigbee", "oqpsk", -86.0, 100, 11973),
)
SIZES = (1, 7, 100, 333, 1500, 2000)
AIR_US = {  # of broadcasts with these payloads
    "wifi-b-1": (488, 536, 1280, 3144, 12480, 16480),
    "wifi-b-2": (340, 364, 736, 1668, 6336, 8336),
    "wifi-b-5.5": (246, 255, 390, 729, 2427, 3154),
    "wifi-b-11": (219, 224, 291, 461, 1310, 1673),
    "wifi-a-6": (76, 84, 208, 516, 2072, 2740),
    "wifi-a-12": (48, 52, 116, 268, 1048, 1380),
    "wifi-a-24": (36, 36, 68, 144, 536, 700),
    "wifi-a-54": (28, 28, 44, 76, 248, 324),
    "zigbee": (576, 768, 3744),
}
T_NS = 100_000_000
LINKS = 1000


def channel(preset: str = "ideal", *, seed: int = 1, **layers: object) -> Channel:
    """A channel of a preset with some layers changed, drawing from ``seed``."""
    built: Channel
    built, _ = radio.build({"preset": preset, **layers}, Source("validation", Path()))
    built.start(seed)
    return built


def names_of(count: int) -> tuple[str, ...]:
    """Names of ``count`` vehicles."""
    return tuple(f"v{number}" for number in range(count))


def line(distances_m: Sequence[float], height_m: float = 0.0) -> Array:
    """Antennas: one at x = 0, the others at these distances on the x axis."""
    return np.array([(x, 0.0, height_m) for x in (0.0, *distances_m)])


def send(
    on: Channel, position: Array, *, sent_ns: int = 0, sender: int = 0, to: int | None = None, size_bytes: int = 100
) -> list[FrameReport]:
    """Send one frame among vehicles at these positions (n, 3); returns the reports that it decides."""
    names = names_of(len(position))
    message = Message(sender=names[sender], body={}, size_bytes=size_bytes, to=None if to is None else names[to])
    return on.send(sent_ns, message, names, position)


def report_of(on: Channel, position: Array, **frame: int) -> FrameReport:
    """The report of a frame on a channel that decides at once."""
    (report,) = send(on, position, **frame)
    return report


def part(name: str, on: Channel, position: Array, **frame: int) -> Array:
    """A component of the link budget of a frame at all its receivers, by its name in the report."""
    return np.asarray(getattr(report_of(on, position, **frame), name))


def decided(on: Channel) -> Iterator[FrameReport]:
    """The reports of all open frames."""
    while (due_ns := on.next_ns()) is not None:
        yield from on.advance(due_ns + SECOND_NS)


def path_loss() -> Iterator[Row]:
    """Three laws over 1 m to 2 km, and the range with the parameters of the Wireless Simulation Server."""
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
    for name, (expected, layer) in laws.items():
        losses = part("path_loss_db", channel("ideal", path_loss=layer), line(DISTANCES_M, height))
        for far, exact, measured in zip(DISTANCES_M, expected, losses, strict=True):
            yield absolute(f"{name}, {far:g} m: loss, dB", exact, measured, 1e-4)
    for exponent in (2.0, 2.5, 3.0, 4.0):
        reach = 2.0 * 10.0 ** ((-49.67 + 93.0) / (10.0 * exponent))
        edge = np.linspace(reach - 0.05, reach + 0.05, 1001)
        report = report_of(channel("wss", path_loss={"exponent": exponent}), line(edge.tolist()))
        yield absolute(f"wss, exponent {exponent:g}: range, m", reach, edge[np.array(report.received_ns) >= 0].max(), 2e-4)


def walls() -> Iterator[Row]:
    """Slabs of common walls in a world between two vehicles."""
    for material, thick, *expected in SLABS:
        for hz, loss_db in zip((2.437e9, 5.2e9), expected, strict=True):
            box = {"center": (5.0, 0.0, 1.0), "size": (thick, 8.0, 2.0), "material": material}
            still = {"kind": "trajectory", "speed": 0.0}
            scenario = scene(
                "wall",
                0.2,
                [{"name": "a", "agent": still}, {"name": "b", "pose": (10.0, 0.0, 0.0), "agent": still}],
                world={"kind": "boxes", "boxes": [box]},
                radio={"preset": "wifi-b-1", "walls": {"kind": "itu", "frequency_hz": hz}},
                vehicles={"kind": "kinematic"},
            )
            measured = numbers(run(scenario, mcap=False).radio, "wall_loss_db")
            yield absolute(f"{material}, {1000 * thick:g} mm, {hz / 1e9:g} GHz: loss, dB", loss_db, measured[0], 0.051)


def shadowing() -> Iterator[Row]:
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
    yield relative("standard deviation, dB", SIGMA_DB, values.std(), 0.02)
    yield absolute("mean, dB", 0.0, values.mean(), 0.15)
    yield absolute("largest difference between there and back, dB", 0.0, np.abs(back).max(), 1e-9)
    for delta, measured in after.items():
        rho = np.corrcoef(values, np.concatenate(measured))[0, 1]
        case = f"one end moved by {delta:g} m: correlation, exp(-d / 10 m)"
        yield absolute(case, math.exp(-delta / APART_M), rho, 0.03)


def fading() -> Iterator[Row]:
    """A million gains of each distribution."""
    for m, expected in NAKAGAMI_DB.items():
        within = 0.15 if m >= 1.0 else 0.3
        yield from _quantiles(f"Nakagami m = {m:g}", {"kind": "nakagami", "m": m}, expected, 1.0 / m, within)
    for k, expected in RICIAN_DB.items():
        spread = (2.0 * k + 1.0) / (k + 1.0) ** 2
        yield from _quantiles(f"Rician K = {k:g}", {"kind": "rician", "k_factor": k}, expected, spread, 0.15)
    exact = 10.0 * np.log10(-np.log1p(-np.array(PERCENT) / 100.0))
    yield from _quantiles("Rayleigh", {"kind": "rayleigh"}, exact.tolist(), 1.0, 0.15)


def doppler() -> Iterator[Row]:
    """A thousand links with time-varying gains, at 60 instants within an hour and a little later."""
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
            yield absolute(f"{name}, {DOPPLER_HZ:g} Hz: correlation after {1e3 * lag_s:g} ms", exact, measured, 0.05)


def _quantiles(
    name: str, layer: Mapping[str, object], expected: Sequence[float], variance: float, within: float
) -> Iterator[Row]:
    on, position = channel("ideal", fading=layer), line(np.linspace(1.0, 2.0, 20_000).tolist())
    decibels = np.concatenate([part("fading_db", on, position, sent_ns=k * 10**9) for k in range(50)])
    gain = 10.0 ** (decibels / 10.0)
    for percent, exact, measured in zip(PERCENT, expected, np.percentile(decibels, PERCENT), strict=True):
        yield absolute(f"{name}: quantile {percent} %, dB", exact, measured, within)
    yield absolute(f"{name}: mean power", 1.0, gain.mean(), 0.01)
    yield relative(f"{name}: variance of the power", variance, gain.var(), 0.02)


def success() -> Iterator[Row]:
    """The error models behind ``vcmvsp per``."""
    for (preset, model), points in SUCCESS.items():
        errors, _ = channel_trial.error_rate(channel(preset).phy, model)
        sinr_db, expected = np.array(points).T
        within = 1e-6 if model == "oqpsk" else 1e-5
        for at, exact, share in zip(sinr_db, expected, errors.success(sinr_db, BITS), strict=True):
            yield absolute(f"{preset}, {model}, {at:g} dB: success of {BITS} bits", exact, share, within)
    sinr_db = np.arange(-10.0, 30.0, 0.002)
    for rate, half_db in HALF_DB.items():
        errors, _ = channel_trial.error_rate(channel(f"wifi-a-{rate}").phy, "table")
        measured_db = float(np.interp(0.5, errors.success(sinr_db, 1024), sinr_db))
        yield absolute(f"wifi-a-{rate}, table: SINR of one half, dB", half_db, measured_db, 0.1)


def received() -> Iterator[Row]:
    """Noise, headers, padding bits and error curves together; within 3.5 standard deviations."""
    for preset, model, level_dbm, size, arrived in RECEIVED:
        on = channel(preset)
        errors, _ = channel_trial.error_rate(on.phy, model)
        snr_db = np.array([level_dbm - on.hearing.noise_dbm])
        chance = channel_trial.packet_errors(errors, snr_db, size)["success"][0]
        within = 3.5 * np.sqrt(chance * (1.0 - chance) / 20_000)
        yield absolute(f"{preset}, {level_dbm:g} dBm, {size} bytes: share received", arrived / 20_000, chance, within)


def air_time() -> Iterator[Row]:
    """Air time of sent frames."""
    sizes = {"zigbee": (1, 7, 100)}
    for preset, expected in AIR_US.items():
        for size, us in zip(sizes.get(preset, SIZES), expected, strict=True):
            report = report_of(channel(preset, mac={"kind": "ideal"}), line([1.0]), size_bytes=size)
            yield absolute(f"{preset}, {size} bytes: time on the air, us", us, report.air_time_ns / 1e3, 0.0)


def chance() -> Iterator[Row]:
    """Losses of Bernoulli and of Gilbert and Elliott on a thousand links: frequency, burst length, correlation."""
    position = line(np.linspace(1.0, 2.0, LINKS).tolist())
    for p in (0.1, 0.5, 0.9):
        on = channel("ideal", loss={"kind": "bernoulli", "probability": p})
        share = float(np.mean([_lost(report_of(on, position, sent_ns=k * T_NS).outcome) for k in range(200)]))
        yield absolute(f"bernoulli {p:g}: share lost", p, share, 5.0 * math.sqrt(p * (1.0 - p) / (200 * LINKS)))
    for bad, good in ((2.0, 3.0), (5.0, 0.5)):
        layer = {"kind": "gilbert_elliott", "to_bad_per_s": bad, "to_good_per_s": good, "bad_loss": 1.0, "good_loss": 0.0}
        on, rate, share = channel("ideal", loss=layer), bad + good, bad / (bad + good)
        step_ns = round(0.02 / rate * 1e9)
        lost = np.array([_lost(report_of(on, position, sent_ns=k * step_ns).outcome) for k in range(1500)])
        case = f"gilbert_elliott, {bad:g} and {good:g} per s"
        yield absolute(f"{case}: share lost, p / (p + r)", share, lost.mean(), 0.015)
        for lag in (15, 50):
            correlation = np.mean((lost[lag:] - share) * (lost[:-lag] - share)) / (share * (1.0 - share))
            yield absolute(
                f"{case}: correlation after {0.02 * lag:g} / (p + r)", math.exp(-0.02 * lag), float(correlation), 0.03
            )


def _lost(outcome: tuple[str, ...]) -> Array:
    return np.array([each != "received" for each in outcome], float)


def queue() -> Iterator[Row]:
    """A radio with randomly arriving frames: Lindley's recursion frame by frame, and the mean wait of M/D/1."""
    air_ns, position = 1_280_000, line([5.0])
    for load in (0.3, 0.6, 0.8):
        on = channel("wifi-b-1", mac={"kind": "ideal"})
        times = np.cumsum(np.rint(np.random.default_rng(1).exponential(air_ns / load, 60_000)))
        waits = np.array([report_of(on, position, sent_ns=int(at)).queue_ns for at in times.tolist()])
        walk = np.concatenate([[0.0], np.cumsum(air_ns - np.diff(times))])
        exact = walk - np.minimum.accumulate(walk)
        mean = load * air_ns / (2.0 * (1.0 - load))
        yield absolute(f"load {load:g}: largest difference from Lindley's recursion, ns", 0.0, np.abs(waits - exact).max(), 0.0)
        yield relative(f"load {load:g}: mean wait of M/D/1, us", mean / 1e3, waits.mean() / 1e3, 0.01 + 0.05 * load)


def age() -> Iterator[Row]:
    """A message every 0.1 s, lost with p, received d later: mean age over time, and mean of its peaks."""
    period_s = T_NS / 1e9
    for p, delay_s in ((0.0, 0.1), (0.3, 0.0), (0.5, 0.25), (0.8, 0.1)):
        layers: dict[str, Any] = {
            "loss": {"kind": "bernoulli", "probability": p},
            "delay": {"kind": "fixed", "seconds": delay_s},
        }
        on = channel("ideal", **layers)
        position, sent_ns = line(np.linspace(1.0, 2.0, 100).tolist()), np.arange(1000) * T_NS
        received_ns = np.array([report_of(on, position, sent_ns=int(at)).received_ns for at in sent_ns])
        ramps = [_ramps(sent_ns[arrived], column[arrived]) for column in received_ns.T if (arrived := column >= 0).any()]
        start, end = (np.concatenate(parts) for parts in zip(*ramps, strict=True))
        mean = (end**2 - start**2).sum() / 2.0 / (end - start).sum()
        case = f"loss {p:g}, delay {delay_s:g} s"
        exact = delay_s + period_s * (1.0 + p) / (2.0 * (1.0 - p))
        yield relative(f"{case}: mean age, d + T (1 + p) / (2 (1 - p)), s", exact, mean, 0.01)
        yield relative(f"{case}: mean of its peaks, d + T / (1 - p), s", delay_s + period_s / (1.0 - p), end.mean(), 0.01)


def _ramps(sent_ns: Array, received_ns: Array) -> tuple[Array, Array]:
    """Age of the newest message, s, just after each reception and just before the next one."""
    return (received_ns[:-1] - sent_ns[:-1]) / 1e9, (received_ns[1:] - sent_ns[:-1]) / 1e9
