"""Consensus with delay: stability limit for four graphs; an error of one tick in the delay would be visible.

Members are integrators that compare their points with those in received messages at the same age. With L the Laplacian of the
graph, the mode of its eigenvalue lambda is finally multiplied in every tick by the largest root of
``z^(d+1) - z^d + kappa lambda T = 0``, where d is the age of reports in ticks; the fastest mode is stable if and only if
``kappa lambda_max T < 2 sin(pi / (2 (2 d + 1)))``, and for T -> 0 if the age is less than
``tau* = pi / (2 kappa lambda_max)`` (Olfati-Saber and Murray 2004).
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import numpy as np

from vcmvsp.cosim.metrics.motion import motion
from vcmvsp.cosim.reproduction.figures.figure import Curve, Figure, Panel
from vcmvsp.cosim.reproduction.figures.scenarios import lossy, scene
from vcmvsp.cosim.reproduction.row import Row, absolute, at_most, relative
from vcmvsp.cosim.reproduction.runner import Job, Runner
from vcmvsp.cosim.runs.api import Result
from vcmvsp.cosim.types import Array

GRAPHS: Mapping[str, int] = {"complete": 5, "star": 5, "ring": 6, "path": 5}  # graph -> members; kappa is 1 1/s throughout
T, FINE = 0.1, 1e-3  # s: period of the sweep, and a nearly continuous one
AGES = range(1, 7)  # ticks of T
LAST_STABLE = {"complete": 2, "star": 2, "ring": 3, "path": 3}  # largest stable age, ticks of T
LAMBDA_2 = {"complete": 5.0, "star": 1.0, "ring": 1.0, "path": 0.38197}
SHARES = (0.90, 0.98, 1.02, 1.10)  # of tau*
GROWTH = {  # per s, at all of these shares: from an independent simulation at 1 ms
    "complete": (0.771, 0.959, 1.045, 1.221),
    "star": (0.771, 0.959, 1.045, 1.221),
    "ring": (0.806, 0.967, 1.041, 1.171),
    "path": (0.825, 0.966, 1.035, 1.155),
}
START_M = 1e-6  # so small that a growing mode reaches no speed limit
SHOWN = "path"


def consensus_delay(runner: Runner, shares: Sequence[float] = SHARES) -> Figure:
    """Growth of the fastest mode over the age of reports, at 10 Hz and at 1 kHz, from the roots and from the platform.

    Args:
        runner: makes the runs.
        shares: ages at 1 kHz, as shares of tau*; some of `SHARES`.
    """
    swept = [(graph, age) for graph in GRAPHS for age in AGES]
    fine = [(graph, share) for graph in GRAPHS for share in shares]
    jobs = [_mode(graph, -1, 8.0, T, delay_s=age * T, own="delayed") for graph, age in swept]
    jobs += [_mode(graph, -1, 2.6, FINE, delay_s=_age(graph, share) * FINE, own="delayed") for graph, share in fine]
    jobs += [_mode(graph, 1, 2.0 / LAMBDA_2[graph], _short(graph), own="delayed") for graph in GRAPHS]
    jobs += [_mode(graph, -1, 60.0, T, delay_s=2.0, own="fresh") for graph in GRAPHS]
    answers = iter(runner(jobs))
    at_10_hz = {key: next(answers) for key in swept}
    at_1_khz = {key: next(answers) for key in fine}
    swings = {key: growth(y[20:], 3) ** (1.0 / T) for key, y in at_10_hz.items()}
    fast = {key: growth(y[1800:], 100) ** (1.0 / FINE) for key, y in at_1_khz.items()}  # other roots have died out by then
    rows = [row for graph in GRAPHS for row in _bounds(graph, swings)]
    for graph, share in fine:
        expected = GROWTH[graph][SHARES.index(share)]
        case = f"{graph} {GRAPHS[graph]}, 1 kHz, {share:.2f} tau*: growth per s"
        rows.append(relative(case, expected, fast[graph, share], 0.01))
    for graph in GRAPHS:
        y = next(answers)
        rate = math.log(y[100] / y[-1]) / ((len(y) - 101) * _short(graph))
        rows.append(relative(f"{graph} {GRAPHS[graph]}, no delay: decay kappa lambda_2, 1/s", LAMBDA_2[graph], rate, 0.01))
    for graph in GRAPHS:
        residual = float(np.abs(next(answers)[-40:]).max())
        rows.append(at_most(f"{graph} {GRAPHS[graph]}, own point fresh, age 20: share left after 60 s", 0.1, residual))
    panels = [_growths(swings), _plane(swings), _times(at_10_hz), _continuous(fast, shares)]
    return Figure("Consensus with delay: stable up to a bound that the graph sets, kappa = 1 1/s", panels, rows)


def laplacian(graph: str) -> Array:
    """Laplacian of a graph of `GRAPHS`, (n, n)."""
    count = GRAPHS[graph]
    chain = np.eye(count, k=1)
    edges = {
        "complete": np.triu(np.ones((count, count)), 1),
        "star": np.outer(np.arange(count) == 0, np.arange(count) > 0),
        "ring": chain + np.eye(count, k=count - 1),
        "path": chain,
    }[graph]
    matrix = 0.0 - edges - edges.T
    return matrix - np.diag(matrix.sum(axis=1))


def lambda_max(graph: str) -> float:
    """The largest eigenvalue of a graph's Laplacian."""
    return float(np.linalg.eigvalsh(laplacian(graph))[-1])


def root(step: float, age: int) -> float:
    """Absolute value of the dominant root of ``z^(age+1) - z^age + step = 0``, by Newton's method."""
    z = complex(np.exp(1j * step))
    for _ in range(100):
        z -= (z - 1.0 + step * z**-age) / (1.0 - age * step * z ** (-age - 1))
    return abs(z)


def continuous(share: Array) -> Array:
    """Growth of the dominant root of ``s = -lambda exp(-s tau)`` within one tau*, for tau = share tau*."""
    delay = np.asarray(share) * 0.5 * math.pi  # lambda tau
    s = np.full(delay.shape, 1j)  # in units of lambda
    for _ in range(100):
        s -= (s + np.exp(-s * delay)) / (1.0 - delay * np.exp(-s * delay))
    return np.asarray(np.exp(s.real * 0.5 * math.pi))


def growth(y: Array, step: int) -> float:
    """Growth per tick of a mode with one pair of roots z: ``y[n + 2 s] = a y[n + s] + b y[n]`` has ``b = -|z|^(2 s)``."""
    past = np.stack([y[step:-step], y[: -2 * step]], axis=1)
    _, b = np.linalg.lstsq(past, y[2 * step :], rcond=None)[0]
    return float(math.sqrt(-b) ** (1.0 / step))


def _mode(graph: str, number: int, duration_s: float, period_s: float, delay_s: float = 0.0, **agent: object) -> Job:
    """A run that starts in an eigenvector of the Laplacian and gives the remaining amplitude, (ticks + 1,)."""
    vector = np.linalg.eigh(laplacian(graph))[1][:, number]
    scenario = scene(
        "consensus",
        round(duration_s / period_s) * period_s,
        [{"name": f"v{i}", "position": (START_M * x, 0.0, 1.0), "agent": {}} for i, x in enumerate(vector.tolist())],
        radio=lossy(delay_s=round(delay_s, 9)),
        agents={"kind": "consensus", "graph": graph, "period_s": period_s, **agent},
        record={"period_s": period_s},
        vehicles={"kind": "point"},
    )
    return Job(scenario, partial(_share, vector=vector))


def _share(result: Result, vector: Array) -> Array:
    return np.asarray(motion(result.states).position[0] @ vector / START_M)


def _short(graph: str) -> float:
    """Period in which the fastest of the slow modes loses half a percent, so that an age of one tick is negligible."""
    return round(0.005 / LAMBDA_2[graph], 3)


def _age(graph: str, share: float) -> int:
    """Number of `FINE` ticks nearest to a share of tau*."""
    return round(share * math.pi / (2.0 * lambda_max(graph)) / FINE)


def _bounds(graph: str, swings: Mapping[tuple[str, int], float]) -> Iterator[Row]:
    name, last = f"{graph} {GRAPHS[graph]}, 10 Hz", LAST_STABLE[graph]
    stable = [age for age in AGES if swings[graph, age] < 1.0]
    unstable = [age for age in AGES if swings[graph, age] >= 1.0]
    yield absolute(f"{name}: last stable age, ticks", last, max(stable, default=0), 0.0)
    yield absolute(f"{name}: first unstable age, ticks", last + 1, min(unstable, default=0), 0.0)
    for age in (last, last + 1):
        expected = root(T * lambda_max(graph), age) ** (1 / T)
        yield relative(f"{name}, age {age}: growth per s", expected, swings[graph, age], 0.01)


def _colors() -> Mapping[str, int]:
    return {graph: number for number, graph in enumerate(GRAPHS, 1)}


def _growths(swings: Mapping[tuple[str, int], float]) -> Panel:
    """Lines: roots. Filled markers: measured and stable; hollow: unstable. Complete and star coincide."""
    curves = []
    ages = np.array(AGES)
    for graph, color in _colors().items():
        bound = np.array([root(T * lambda_max(graph), age) ** (1 / T) for age in AGES])
        measured = np.array([swings[graph, age] for age in AGES])
        curves.append(Curve(ages, bound, f"{graph} {GRAPHS[graph]}", color, "dashed" if graph == "star" else "line"))
        curves += _marked(ages, measured, measured < 1.0, color)
    return Panel(
        "10 Hz: lines by the roots, points measured",
        "age of reports [ticks]",
        "growth per s",
        curves,
        levels={"bound of stability": 1.0},
        log_y=True,
    )


def _plane(swings: Mapping[tuple[str, int], float]) -> Panel:
    ages = np.linspace(AGES[0], AGES[-1], 101)
    curves = [Curve(ages, 2.0 * np.sin(np.pi / (2.0 * (2.0 * ages + 1.0))), "2 sin(π / (2 (2 d + 1)))", 0)]
    for graph, color in _colors().items():
        stable = np.array([swings[graph, age] < 1.0 for age in AGES])
        height = np.full(len(stable), T * lambda_max(graph))
        curves += _marked(np.array(AGES), height, stable, color)
    return Panel("10 Hz: filled measured stable, hollow unstable", "age of reports d [ticks]", "kappa lambda_max T", curves)


def _times(at_10_hz: Mapping[tuple[str, int], Array]) -> Panel:
    last = LAST_STABLE[SHOWN]
    curves = []
    for color, age in enumerate((last - 1, last, last + 1), 1):
        y = at_10_hz[SHOWN, age]
        curves.append(Curve(T * np.arange(len(y)), y, f"age {age}", color))
    return Panel(
        f"{SHOWN} {GRAPHS[SHOWN]} at 10 Hz: fastest mode", "time [s]", "share of the start", curves, y_limits=(-2.0, 3.0)
    )


def _continuous(fast: Mapping[tuple[str, float], float], shares: Sequence[float]) -> Panel:
    line = np.linspace(0.85, 1.15, 61)
    curves = [Curve(line, continuous(line), "continuous time", 0)]
    for graph, color in _colors().items():
        within = np.array([fast[graph, share] for share in shares]) ** (math.pi / (2.0 * lambda_max(graph)))
        curves.append(
            Curve(np.array(shares), within, f"{graph} {GRAPHS[graph]}", color, "hollow" if graph == "star" else "markers")
        )
    return Panel(
        "1 kHz: points measured", "age of reports / tau*", "growth per tau*", curves, levels={"bound of stability": 1.0}
    )


def _marked(x: Array, y: Array, stable: Array, color: int) -> list[Curve]:
    parts = ((stable, "markers"), (~stable, "hollow"))
    return [Curve(x[chosen], y[chosen], "", color, style) for chosen, style in parts if chosen.any()]  # type: ignore[arg-type]
