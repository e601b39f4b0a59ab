"""Effect of message loss and delay on the triangle, and compensation by estimating the leader's present state."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from vcmvsp.cosim.analysis import closed_forms
from vcmvsp.cosim.reproduction.figures.figure import Curve, Figure, Heat, Panel
from vcmvsp.cosim.reproduction.figures.formation import loss_integration
from vcmvsp.cosim.reproduction.figures.scenarios import (
    ASIDE,
    K1,
    LEFT_BEHIND,
    RIGHT_BEHIND,
    TRIANGLE,
    UNLIMITED,
    R,
    T,
    V,
    W,
    errors_from,
    fleet,
    rms,
)
from vcmvsp.cosim.reproduction.figures.scenarios import lossy as radio
from vcmvsp.cosim.reproduction.row import Row, absolute, at_most, relative
from vcmvsp.cosim.reproduction.runner import Job, Runner
from vcmvsp.cosim.runs.api import Result
from vcmvsp.cosim.tables.columns import names_of, numbers
from vcmvsp.cosim.types import Array

PROBABILITIES = (0.0, 0.1, 0.3, 0.5, 0.7, 0.8, 0.9)
TEAM_S = 120.0  # s, of a run of `team`
FOLLOWERS = 40  # per estimator, half of them on either side; they share the leader and lose messages independently
MANY = 500  # followers behind each point of the lines in the figure
RARE = 0.7  # from this loss on, the closed form takes twice as many: errors last longer and scatter more
TITLES = {"slalom": "Leader on a slalom", "random": "Leader on a random path"}
DELAYS_S = (0.1, 0.3, 0.5, 1.0, 1.5, 2.0)
# RMS of |z|, m, over DELAYS_S: an independent integration of the same set-up.
REFERENCE = {
    "slalom": {
        "hold": (0.036, 0.102, 0.169, 0.334, 0.496, 0.656),
        "dr": (0.0085, 0.023, 0.041, 0.095, 0.165, 0.253),
        "acc": (0.0058, 0.0059, 0.0098, 0.037, 0.085, 0.154),
        "plan": (0.0061,) * 6,
    },
    "random": {
        "hold": (0.031, 0.090, 0.150, 0.297, 0.441, 0.582),
        "dr": (0.0099, 0.031, 0.054, 0.120, 0.193, 0.270),
        "acc": (0.0036, 0.010, 0.024, 0.079, 0.156, 0.244),
        "plan": (0.0033,) * 6,
    },
}
MAP_P, MAP_S = (0.0, 0.2, 0.4, 0.6, 0.8, 0.9), (0.1, 0.3, 0.5, 1.0, 1.5, 2.0)
CELL_FOLLOWERS = 20  # per estimator and cell of the map
NAMED = {(0.6, 0.5): (0.219, 0.057), (0.9, 2.0): (0.94, 0.55)}  # (p, delay s) -> RMS |z| m of hold and dr, as above


def loss(
    runner: Runner, followers: int = FOLLOWERS, probabilities: tuple[float, ...] = PROBABILITIES, straight: int = FOLLOWERS
) -> Figure:
    """RMS of |z| over loss probability: closed form on a straight line, direct integration on two other paths.

    The platform's reports are one tick old at first use, even without loss; expected values include that tick. The rows
    integrate with the actual losses of the run, the lines in the figure with many others.

    Args:
        runner: makes the runs.
        followers: number per estimator on the two paths; expected values use their actual losses, so few are enough.
        probabilities: loss probabilities.
        straight: number of followers on the straight line; expected values are means, so it must be large.
    """
    cases = [
        (path, p, estimator)
        for path in loss_integration.PATHS
        for p in probabilities
        for estimator in loss_integration.ESTIMATORS
    ]
    jobs = [team(path, radio(p), _enough(p, followers), (estimator,)) for path, p, estimator in cases]
    jobs += [_straight(p, _enough(p, straight * (1 + (p >= RARE)))) for p in probabilities]
    runs = runner(jobs)
    measured = {case: root_mean_square(each.rms) for case, each in zip(cases, runs, strict=False)}
    p, panels, rows = np.array(probabilities), [], []
    for path in loss_integration.PATHS:
        curves = []
        for color, estimator in enumerate(loss_integration.ESTIMATORS, 1):
            measured_m = np.array([measured[path, each, estimator] for each in probabilities])
            many = loss_integration.rms(path, estimator, p, np.ones(len(p), int), count=MANY)
            curves += [Curve(p, measured_m, estimator, color, "markers"), Curve(p, many, "", color)]
        rows += [
            relative(f"{path}, {case[2]}, p = {case[1]:g}: RMS |z|, m", integrated(path, each)[case[2]], measured[case], 0.001)
            for case, each in zip(cases, runs, strict=False)
            if case[0] == path
        ]
        rows += [
            at_most(f"{path}, p = {each:g}: dr over hold", 0.6, measured[path, each, "dr"] / measured[path, each, "hold"])
            for each in probabilities
            if 0.3 <= each <= 0.8
        ]
        panels.append(Panel(TITLES[path], "probability of loss", "RMS |z| [m]", curves, log_y=True))
    lags = np.array([root_mean_square(each) for each in runs[len(cases) :]])
    closed = np.array([closed_forms.lag_behind(V, K1, T, T, each)[1] for each in probabilities])
    for each, must, is_ in zip(probabilities, closed, lags, strict=True):
        share = 0.05 if each >= 0.9 else 0.03
        rows.append(relative(f"straight, hold, p = {each:g}: RMS |z|, closed form, m", must, is_, share))
    line = [Curve(p, lags, "hold", 1, "markers"), Curve(p, closed, "", 1)]
    panels.append(Panel("Leader on a straight line, closed form", "probability of loss", "RMS |z| [m]", line, log_y=True))
    return Figure("Formation error by loss (points: runs; lines: integration, other losses)", panels, rows, columns=3)


@dataclass(frozen=True)
class TeamRun:
    """Data of a run of `team`."""

    estimators: tuple[str, ...]
    rms: Array  # (followers,) m, from 20 s on
    missed: Array  # (ticks, followers): lost reports
    age: int  # age of the other reports at first use, ticks


def team(path: str, air: dict[str, Any], count: int, estimators: tuple[str, ...]) -> Job:
    """A run with ``count`` followers per estimator; gives a `TeamRun`."""
    places = (RIGHT_BEHIND, LEFT_BEHIND)
    followers = [{**places[i % 2], "estimator": each} for each in estimators for i in range(count)]
    needs = [need for need, user in (("a", "acc"), ("plan", "plan")) if user in estimators]
    scenario = fleet(TEAM_S, followers, path=path, leader={"tell": needs}, radio=air)
    return Job(scenario, partial(_read, scenario=scenario, estimators=estimators), seed=1)


def by_estimator(each: TeamRun) -> dict[str, float]:
    """Errors of a team by estimator, merged over its followers."""
    parts = np.split(each.rms, len(each.estimators))
    return {name: root_mean_square(part) for name, part in zip(each.estimators, parts, strict=True)}


def integrated(path: str, each: TeamRun) -> dict[str, float]:
    """Expected errors of a team by estimator, given its actual losses."""
    parts = np.split(each.missed, len(each.estimators), axis=1)
    age = np.full(parts[0].shape[1], each.age)
    return {
        name: root_mean_square(loss_integration.errors(path, name, part, age))
        for name, part in zip(each.estimators, parts, strict=True)
    }


def _read(result: Result, scenario: Mapping[str, Any], estimators: tuple[str, ...]) -> TeamRun:
    names, to = names_of(result.radio, "receiver")
    sent_ns, received_ns = (numbers(result.radio, name, null=-1) for name in ("sent_ns", "received_ns"))
    number = {car["name"]: i for i, car in enumerate(scenario["vehicle"][1:])}
    missed = np.zeros((round(scenario["duration_s"] / T) + 1, len(number)), bool)
    column = np.array([number.get(name, -1) for name in names])[to]
    missed[np.rint(sent_ns / 1e9 / T).astype(int), column] = received_ns < 0
    delay_s = (received_ns - sent_ns)[received_ns >= 0].min() / 1e9
    return TeamRun(estimators, errors_from(result, scenario, 20.0), missed, max(1, math.ceil(delay_s / T - 1e-6)))


def root_mean_square(each: Array) -> float:
    """Root mean square of several root mean squares over equal times."""
    return float(np.sqrt((each**2).mean()))


def _enough(p: float, count: int) -> int:
    """Number of followers: without losses all on one side have the same error."""
    return count if p else 2


def _straight(p: float, count: int) -> Job:
    """A run that gives the lag on a straight line, for followers that never stop following; 300 s each."""
    followers = [{**UNLIMITED, "estimator": "hold"}] * count
    return rms(fleet(300.0, followers, path="straight", radio=radio(p)), seed=1)


def delay(runner: Runner) -> Figure:
    """RMS of |z| over a constant delay of all messages, without loss: closed forms, and two paths without one.

    On a straight line ``hold`` lags by ``v d``; on a circle its error is ``2 (R + L') sin(w d / 2)``; ``dr`` is exact there.
    """
    both = ("hold", "dr")
    kinds = [(path, estimator) for path in ("straight", "circle") for estimator in both]
    exact = [
        rms(fleet(60.0, TRIANGLE, path=path, radio=radio(delay_s=d), agents={"estimator": estimator}), from_s=50.0)
        for path, estimator in kinds
        for d in DELAYS_S
    ]
    curved = [team(path, radio(delay_s=d), 2, both) for path in loss_integration.PATHS for d in DELAYS_S]
    runs = runner([*exact, *curved])
    table = np.array(runs[: len(exact)]).reshape(len(kinds), len(DELAYS_S), 2)  # of car2 and car3
    d, rows = np.array(DELAYS_S), []
    lines = {"straight": np.stack([V * d, V * d], axis=-1)}
    lines["circle"] = np.stack([2.0 * (R + side) * np.sin(W * d / 2.0) for side in (ASIDE, -ASIDE)], axis=-1)
    panels = []
    for path, closed in lines.items():
        hold, dr = (table[kinds.index((path, estimator))] for estimator in both)
        column = 2 if path == "circle" else 1
        for side, name in enumerate(("follower 1 (+30°)", "follower 2 (-30°)")[:column]):
            rows += [
                absolute(f"{path}, hold, {name}, delay {each:g} s: |z|, closed form, m", must, is_, 5e-4)
                for each, must, is_ in zip(DELAYS_S, closed[:, side], hold[:, side], strict=True)
            ]
        rows.append(absolute(f"{path}, dr, all delays: largest |z|, m", 0.0, dr.max(), 1e-4))
        curves = [Curve(d, closed[:, side], "closed form", 0, "dotted") for side in range(column)]
        curves += [Curve(d, hold[:, side], "hold", 1, "markers") for side in range(column)]
        curves.append(Curve(d, dr.max(axis=-1), "dr", 2, "markers"))
        panels.append(Panel(f"Leader on a {path.replace('straight', 'straight line')}", "delay [s]", "|z| [m]", curves))
    errors = [by_estimator(each) for each in runs[len(exact) :]]
    more, compared = _curved(errors, both)
    rows += compared
    return Figure("Formation error by delay (points: runs)", [*panels, *more], rows)


def estimators(runner: Runner) -> Figure:
    """RMS of |z| over a constant delay of all messages, for all estimators."""
    names = loss_integration.ESTIMATORS
    runs = runner([team(path, radio(delay_s=d), 2, names) for path in loss_integration.PATHS for d in DELAYS_S])
    panels, rows = _curved([by_estimator(each) for each in runs], names, log_y=True)
    return Figure("Estimators of the leader's present state, by delay (points: runs)", panels, rows)


def loss_delay(runner: Runner, followers: int = CELL_FOLLOWERS) -> Figure:
    """RMS of |z| on the slalom over loss and delay together: ``dr``, and its comparison with ``hold``."""
    both = ("hold", "dr")
    cells = [(p, d) for d in MAP_S for p in MAP_P]
    runs = runner([team("slalom", radio(p, d), followers * (1 + 3 * ((p, d) in NAMED)), both) for p, d in cells])
    measured = {cell: by_estimator(each) for cell, each in zip(cells, runs, strict=True)}
    exact = {cell: integrated("slalom", each) for cell, each in zip(cells, runs, strict=True)}
    rows: list[Row] = []
    for (p, d), must in NAMED.items():
        share = 0.2 if p >= 0.9 else 0.1
        for name, expected in zip(both, must, strict=True):
            case = f"slalom, {name}, p = {p:g}, delay {d:g} s: RMS |z|, m"
            rows.append(relative(case, expected, measured[p, d][name], share))
    grids = {}
    for name in both:
        grids[name] = np.array([measured[cell][name] for cell in cells]).reshape(len(MAP_S), len(MAP_P))
        off = max(abs(measured[cell][name] / exact[cell][name] - 1.0) for cell in cells)
        rows.append(absolute(f"map of {name}: largest share off an integration with the same losses", 0.0, off, 0.001))
    ratio = grids["dr"] / grids["hold"]
    rows.append(at_most("dr over hold, delay up to 0.5 s, p up to 0.8: largest", 0.6, ratio[:3, :5].max()))
    columns, lines = np.array(MAP_P), np.array(MAP_S)
    panels = [
        Panel("hold: RMS |z| [m]", "probability of loss", "delay [s]", heat=Heat(columns, lines, grids["hold"])),
        Panel("dr: RMS |z| [m]", "probability of loss", "delay [s]", heat=Heat(columns, lines, grids["dr"])),
        Panel("dr over hold", "probability of loss", "delay [s]", heat=Heat(columns, lines, ratio, style="about one")),
    ]
    return Figure("Formation error by loss and delay, leader on a slalom", panels, rows, columns=3)


def _curved(errors: list[dict[str, float]], names: tuple[str, ...], *, log_y: bool = False) -> tuple[list[Panel], list[Row]]:
    panels, rows = [], []
    for place, path in enumerate(loss_integration.PATHS):
        part = errors[place * len(DELAYS_S) :][: len(DELAYS_S)]
        curves = []
        for color, name in enumerate(names, 1):
            measured = np.array([each[name] for each in part])
            must = REFERENCE[path][name]
            curves += [
                Curve(np.array(DELAYS_S), measured, name, color, "markers"),
                Curve(np.array(DELAYS_S), _integrated(path, name), "", color),
            ]
            rows += [
                relative(f"{path}, {name}, delay {d:g} s: RMS |z|, m", expected, is_, 0.1)
                for d, expected, is_ in zip(DELAYS_S, must, measured, strict=True)
            ]
        rows += [
            at_most(f"{path}, delay {d:g} s: dr over hold", 0.6, each["dr"] / each["hold"])
            for d, each in zip(DELAYS_S, part, strict=True)
            if d <= 0.5
        ]
        panels.append(Panel(TITLES[path], "delay [s]", "RMS |z| [m]", curves, log_y=log_y))
    return panels, rows


def _integrated(path: str, name: str) -> Array:
    age = np.rint(np.array(DELAYS_S) / T).astype(int)
    return loss_integration.rms(path, name, np.zeros(len(age)), age, count=2)
