"""What delay of messages does to the triangle; and loss and delay together."""

import numpy as np

from vcmvsp.cosim.reproduction.figures.figure import Curve, Figure, Heat, Panel
from vcmvsp.cosim.reproduction.figures.formation import loss_integration
from vcmvsp.cosim.reproduction.figures.formation.loss import TITLES, by_estimator, integrated, team
from vcmvsp.cosim.reproduction.figures.scenarios import ASIDE, TRIANGLE, R, T, V, W, fleet, rms
from vcmvsp.cosim.reproduction.figures.scenarios import lossy as radio
from vcmvsp.cosim.reproduction.row import Row, absolute, at_most, relative
from vcmvsp.cosim.reproduction.runner import Runner
from vcmvsp.cosim.types import Array

DELAYS_S = (0.1, 0.3, 0.5, 1.0, 1.5, 2.0)
# RMS of |z|, m, over DELAYS_S: an integration of the same set-up that knows nothing of the platform.
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
FOLLOWERS = 20  # of each estimator in each cell of the map
NAMED = {(0.6, 0.5): (0.219, 0.057), (0.9, 2.0): (0.94, 0.55)}  # (p, delay s) -> RMS |z| m of hold and dr, as above


def delay(runner: Runner) -> Figure:
    """RMS of |z| over the delay of all messages, without loss: closed forms, and two paths without any.

    On a straight line ``hold`` lags by ``v d``; on a circle its error is ``2 (R + L') sin(w d / 2)``; there ``dr`` is exact.
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
    more, compared = _curved(errors, both, "closed forms")
    rows += compared
    return Figure("Formation error by delay (points: runs)", [*panels, *more], rows)


def estimators(runner: Runner) -> Figure:
    """RMS of |z| over the delay of all messages, for all estimators."""
    names = loss_integration.ESTIMATORS
    runs = runner([team(path, radio(delay_s=d), 2, names) for path in loss_integration.PATHS for d in DELAYS_S])
    panels, rows = _curved([by_estimator(each) for each in runs], names, "log")
    return Figure("Estimators of the leader's present state, by delay (points: runs)", panels, rows)


def loss_delay(runner: Runner, followers: int = FOLLOWERS) -> Figure:
    """RMS of |z| on the slalom over loss and delay together: ``dr``, and how it compares with ``hold``."""
    both = ("hold", "dr")
    cells = [(p, d) for d in MAP_S for p in MAP_P]
    runs = runner([team("slalom", radio(p, d), followers * (1 + 3 * ((p, d) in NAMED)), both) for p, d in cells])
    measured = {cell: by_estimator(each) for cell, each in zip(cells, runs, strict=True)}
    exact = {cell: integrated("slalom", each) for cell, each in zip(cells, runs, strict=True)}
    rows: list[Row] = []
    for (p, d), must in NAMED.items():
        rows += [
            relative(
                f"slalom, {name}, p = {p:g}, delay {d:g} s: RMS |z|, m",
                expected,
                measured[p, d][name],
                0.2 if p >= 0.9 else 0.1,
            )
            for name, expected in zip(both, must, strict=True)
        ]
    grids = {name: np.array([measured[cell][name] for cell in cells]).reshape(len(MAP_S), len(MAP_P)) for name in both}
    for name in both:
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


def _curved(errors: list[dict[str, float]], names: tuple[str, ...], scale: str) -> tuple[list[Panel], list[Row]]:
    """Panels and rows of the slalom and the random path; ``errors`` by path and delay."""
    panels, rows = [], []
    parts = [errors[: len(DELAYS_S)], errors[len(DELAYS_S) :]]
    for path, part in zip(loss_integration.PATHS, parts, strict=True):
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
        panels.append(Panel(TITLES[path], "delay [s]", "RMS |z| [m]", curves, log_y=scale == "log"))
    return panels, rows


def _integrated(path: str, name: str) -> Array:
    age = np.rint(np.array(DELAYS_S) / T).astype(int)
    return loss_integration.rms(path, name, np.zeros(len(age)), age, count=2)
