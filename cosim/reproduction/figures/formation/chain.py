"""A column in which each vehicle follows its predecessor: growth of sway from hop to hop, and its remedies."""

import math
from collections.abc import Iterator, Mapping
from functools import partial
from itertools import starmap
from typing import Any

import numpy as np

from vcmvsp.cosim.analysis import closed_forms
from vcmvsp.cosim.reproduction.figures.figure import Curve, Figure, Panel
from vcmvsp.cosim.reproduction.figures.scenarios import K1, UNLIMITED, fleet, lossy, rms, tracks
from vcmvsp.cosim.reproduction.row import Row, absolute, at_most, relative
from vcmvsp.cosim.reproduction.runner import Job, Runner
from vcmvsp.cosim.runs.api import Result
from vcmvsp.cosim.types import Array

LAG_S, DELAY_S, OMEGA = 0.5, 0.3, 0.8
# Use of the predecessor's reports by a follower.
WAYS: Mapping[str, Mapping[str, Any]] = {
    "hold": {"estimator": "hold"},
    "dr": {"estimator": "dr"},
    "none": {"estimator": "hold", "feed": "none"},
    "acceleration": {"estimator": "hold", "feed_forward_s": LAG_S},
}
LED: Mapping[str, Any] = {"estimator": "dr", "feed": "leader"}
LABELS = {
    "hold": "hold",
    "dr": "dr",
    "none": "speed not used",
    "acceleration": "hold, acceleration fed forward",
    "leader": "dr, leader's speed relayed",
}
OMEGAS = (0.3, 0.5, 0.8, 0.963, 1.3, 2.0, 3.0)  # rad/s
DELAYS_S = (0.1, 0.3, 1.0)
WARM_S = 40.0
LINKS, SPACING_M, HANDLE_M = 6, 0.8, 0.5
COLUMN = {"hold": (0.110, 0.152), "dr": (0.062, 0.258)}  # RMS of |z| of the first and the last link, m, integrated separately


def chain(runner: Runner) -> Figure:
    """Gain of a hop for a surging leader, at T = 10 ms; and the links of a column of seven on a random path at 0.1 s."""
    peaks = {d: _peak("dr", d) for d in DELAYS_S}
    swings = [(w, DELAY_S) for w in OMEGAS]
    swings += [(peaks[d][0], d) for d in DELAYS_S]
    columns = {**WAYS, "leader": LED}
    answers = runner([*starmap(_surge, swings), *map(column, columns.values())])
    gains, links = np.array(answers[: len(swings)]), dict(zip(columns, answers[len(swings) :], strict=True))
    rows = [*_gain_rows(gains, peaks), *_column_rows(links)]
    omega = np.geomspace(0.2, 5.0, 200)
    curves, lines = [], []
    for color, way in enumerate(WAYS, 1):
        curves += [
            Curve(np.array(OMEGAS), gains[: len(OMEGAS), color - 1], LABELS[way], color, "markers"),
            Curve(omega, closed_forms.hop_gain(omega, K1, LAG_S, DELAY_S, way), "", color),
        ]
    for color, (way, each) in enumerate(links.items(), 1):
        lines.append(Curve(np.arange(1, LINKS + 1), each, LABELS[way], color, "both"))
    panels = [
        Panel(
            "Gain of a hop, delay 0.3 s (points: runs; lines: |G|)",
            "angular frequency [rad/s]",
            "sway over that of the predecessor",
            curves,
            levels={"1": 1.0},
            log_x=True,
        ),
        Panel("Column of seven on a random path, delay 0.3 s", "link", "RMS |z| [m]", lines),
    ]
    return Figure("String stability, servo lag 0.5 s, k1 = 0.8 1/s", panels, rows)


def _gain_rows(gains: Array, peaks: Mapping[float, tuple[float, float]]) -> Iterator[Row]:
    must = {"hold": 1.213, "dr": 1.366, "none": 0.857, "acceleration": 1.0}
    at = OMEGAS.index(OMEGA)
    for i, (way, gain) in enumerate(must.items()):
        yield relative(f"gain of a hop, {LABELS[way]}, {OMEGA:g} rad/s, delay {DELAY_S:g} s", gain, gains[at, i], 0.015)
    top = _peak("hold", 0.0)
    yield relative(f"hold: largest gain, at {top[0]:.3f} rad/s", 1.2274, gains[OMEGAS.index(0.963), 0], 0.015)
    for row, d in zip(gains[len(OMEGAS) :], DELAYS_S, strict=True):
        yield relative(f"dr, delay {d:g} s: largest gain, at {peaks[d][0]:.3f} rad/s", peaks[d][1], row[1], 0.015)
    for i, way in enumerate(WAYS):
        exact = closed_forms.hop_gain(np.array(OMEGAS), K1, LAG_S, DELAY_S, way)
        yield absolute(f"{LABELS[way]}: largest share off |G|", 0.0, np.abs(gains[: len(OMEGAS), i] / exact - 1).max(), 0.015)


def _column_rows(links: Mapping[str, Array]) -> Iterator[Row]:
    for way, (first, last) in COLUMN.items():
        yield relative(f"column, {way}, link 1: RMS |z|, m", first, links[way][0], 0.1)
        yield relative(f"column, {way}, link {LINKS}: RMS |z|, m", last, links[way][-1], 0.1)
    over = links["dr"] / links["hold"]
    yield at_most("column, links 1 to 3: largest dr over hold", 1.0, over[:3].max())
    yield at_most("column, links 4 to 6: largest hold over dr", 1.0, (1.0 / over[3:]).max())
    for way in ("none", "acceleration", "leader"):
        grown = links[way][1:] / links[way][:-1]
        yield at_most(f"column, {LABELS[way]}: largest growth from link to link", 1.05, grown.max())


def _peak(way: str, delay_s: float) -> tuple[float, float]:
    """Frequency, rad/s, and value of the maximum gain of a hop."""
    omega = np.linspace(0.01, 5.0, 5000)
    gain = closed_forms.hop_gain(omega, K1, LAG_S, delay_s, way)
    return float(omega[gain.argmax()]), float(gain.max())


def _surge(omega: float, delay_s: float) -> Job:
    """A run of a leader that surges on a straight line, car2 that follows it, and one follower of car2 per way."""
    law = {**UNLIMITED, "handle": HANDLE_M}
    followers = [{**law, "estimator": "acc", "broadcast": True}, *({**law, "leader": "car2", **way} for way in WAYS.values())]
    scenario = fleet(
        WARM_S + 2.0 * math.tau / omega,
        followers,
        path="stopgo",
        leader={"yaw_rate": 0.0, "surge_s": math.tau / omega, "tell": ["a"]},
        kind="lag",
        radio=lossy(delay_s=delay_s),
        agents={"period_s": 0.01},
        record={"period_s": 0.05},
    )
    return Job(scenario, partial(sways, scenario=scenario, omega=omega))


def sways(result: Result, scenario: Mapping[str, Any], omega: float) -> Array:
    """Ratio of the sway of each follower of car2 at ``omega`` to that of car2."""
    run = tracks(result, scenario)
    late = run.time_s >= WARM_S
    t = run.time_s[late]
    basis = np.stack([np.ones_like(t), t, np.cos(omega * t), np.sin(omega * t)], axis=-1)
    fit = np.linalg.lstsq(basis, run.pose[late, 1:, 0], rcond=None)[0]
    size = np.hypot(fit[2], fit[3])
    return np.asarray(size[1:] / size[0])


def column(way: Mapping[str, Any]) -> Job:
    """A run of a column of seven with a leader without lag; gives the root mean square error of each link."""
    law = {"distance": SPACING_M, "handle": HANDLE_M, "broadcast": True, **way}
    followers = [{**law, "leader": f"car{number}"} for number in range(1, LINKS + 1)]
    scenario = fleet(120.0, followers, path="random", kind="lag", leader={"tell": ["a"]}, radio=lossy(delay_s=DELAY_S))
    scenario["vehicle"][0]["kind"] = "kinematic"
    return rms(scenario)
