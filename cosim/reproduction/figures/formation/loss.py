"""What loss of messages does to the triangle, and what estimating the leader's present state makes of it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from vcmvsp.cosim.analysis import closed_forms
from vcmvsp.cosim.reproduction.figures.figure import Curve, Figure, Panel
from vcmvsp.cosim.reproduction.figures.formation import loss_integration
from vcmvsp.cosim.reproduction.figures.scenarios import K1, LEFT_BEHIND, RIGHT_BEHIND, UNLIMITED, T, V, errors_from, fleet, rms
from vcmvsp.cosim.reproduction.figures.scenarios import lossy as radio
from vcmvsp.cosim.reproduction.row import Row, at_most, relative
from vcmvsp.cosim.reproduction.runner import Job, Runner
from vcmvsp.cosim.runs.api import Result
from vcmvsp.cosim.tables.columns import names_of, numbers
from vcmvsp.cosim.types import Array

PROBABILITIES = (0.0, 0.1, 0.3, 0.5, 0.7, 0.8, 0.9)
FOLLOWERS = 40  # of each estimator, half of them on either side; they share the leader and lose messages on their own
MANY = 500  # followers behind each point of the lines in the picture
RARE = 0.7  # from this loss on, the closed form takes twice as many: errors last longer and scatter more
TITLES = {"slalom": "Leader on a slalom", "random": "Leader on a random path"}


def loss(
    runner: Runner, followers: int = FOLLOWERS, probabilities: tuple[float, ...] = PROBABILITIES, straight: int = FOLLOWERS
) -> Figure:
    """RMS of |z| over the probability of loss: closed form on a straight line, plain integration on two other paths.

    The reports of the platform are one tick old when they are used, without any loss; what is expected counts that tick. The
    rows integrate with the very losses of the run, the lines in the picture with many others.

    Args:
        runner: makes the runs.
        followers: of each estimator on the two paths; what is expected knows their losses, however few they are.
        probabilities: of loss.
        straight: followers on the straight line; what is expected is a mean, which they must be enough for.
    """
    cases = [
        (path, p, estimator)
        for path in loss_integration.PATHS
        for p in probabilities
        for estimator in loss_integration.ESTIMATORS
    ]
    curved = [team(path, radio(p), followers if p else 2, (estimator,)) for path, p, estimator in cases]
    runs = runner([*curved, *(_straight(p, straight * (1 + (p >= RARE)) if p else 2) for p in probabilities)])
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
        rows += [_better(path, each, measured) for each in probabilities if 0.3 <= each <= 0.8]
        panels.append(Panel(TITLES[path], "probability of loss", "RMS |z| [m]", curves, log_y=True))
    lags = np.array([root_mean_square(each) for each in runs[len(cases) :]])
    closed = np.array([closed_forms.lag_behind(V, K1, T, T, each)[1] for each in probabilities])
    rows += [
        relative(f"straight, hold, p = {each:g}: RMS |z|, closed form, m", must, is_, 0.05 if each >= 0.9 else 0.03)
        for each, must, is_ in zip(probabilities, closed, lags, strict=True)
    ]
    line = [Curve(p, lags, "hold", 1, "markers"), Curve(p, closed, "", 1)]
    panels.append(Panel("Leader on a straight line, closed form", "probability of loss", "RMS |z| [m]", line, log_y=True))
    return Figure("Formation error by loss (points: runs; lines: integration, other losses)", panels, rows, columns=3)


@dataclass(frozen=True)
class TeamRun:
    """What is read of a run of `team`."""

    estimators: tuple[str, ...]
    rms: Array  # (followers,) m, from 20 s on
    missed: Array  # (ticks, followers): which reports were lost
    age: int  # of the others when they were first used, ticks


def team(path: str, air: dict[str, Any], count: int, estimators: tuple[str, ...]) -> Job:
    """A run of 120 s with ``count`` followers of each estimator, that gives a `TeamRun`."""
    places = (RIGHT_BEHIND, LEFT_BEHIND)
    followers = [{**places[i % 2], "estimator": each} for each in estimators for i in range(count)]
    needs = [need for need, user in (("a", "acc"), ("plan", "plan")) if user in estimators]
    scenario = fleet(120.0, followers, path=path, leader={"tell": needs}, radio=air)
    return Job(scenario, partial(_read, scenario=scenario, estimators=estimators), seed=1)


def by_estimator(each: TeamRun) -> dict[str, float]:
    """The errors of a team, put together."""
    parts = np.split(each.rms, len(each.estimators))
    return {name: root_mean_square(part) for name, part in zip(each.estimators, parts, strict=True)}


def integrated(path: str, each: TeamRun) -> dict[str, float]:
    """What they must be, given the losses."""
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
    """Of several root mean squares over equal times."""
    return float(np.sqrt((each**2).mean()))


def _straight(p: float, count: int) -> Job:
    """The lag on a straight line, of followers that never give their leader up; 300 s of each."""
    followers = [{**UNLIMITED, "estimator": "hold"}] * count
    return rms(fleet(300.0, followers, path="straight", radio=radio(p)), seed=1)


def _better(path: str, p: float, measured: dict[tuple[str, float, str], float]) -> Row:
    return at_most(f"{path}, p = {p:g}: dr over hold", 0.6, measured[path, p, "dr"] / measured[path, p, "hold"])
