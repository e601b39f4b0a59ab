"""Figure 32: a leader that starts at once, and followers at rest."""

import math
from collections.abc import Mapping

import numpy as np

from vcmvsp.cosim.analysis import closed_forms
from vcmvsp.cosim.reproduction.figures.figure import Curve, Figure, Panel
from vcmvsp.cosim.reproduction.figures.scenarios import K1, T, V, fleet, settling_s, track
from vcmvsp.cosim.reproduction.row import absolute
from vcmvsp.cosim.reproduction.runner import Runner

BAND_M = 0.05
CASES: tuple[
    tuple[str, float, str, Mapping[str, float], tuple[float, float]], ...
] = (  # name, m behind the place, kind, its parameters, (lag s, acceleration m/s2)
    ("kinematic, in its place", 0.0, "kinematic", {}, (0.0, math.inf)),
    ("inertial, in its place", 0.0, "inertial", {}, (0.5, 0.3)),
    ("kinematic, 0.5 m behind", 0.5, "kinematic", {}, (0.0, math.inf)),
    ("inertial, 0.5 m behind", 0.5, "inertial", {}, (0.5, 0.3)),
    ("lag 1.0 s / 0.5 s, 0.5 m behind", 0.5, "lag", {"tau_v_s": 1.0, "tau_w_s": 0.5}, (1.0, math.inf)),
)
KNOWN_AT_ONCE_S = (0.0, 2.6, 2.8, 3.8, 5.9)


def fig_32(runner: Runner) -> Figure:
    """Settling to 5 cm, 10 Hz, leader at 0.3 m/s from the start.

    Were the leader known at once, it would take 0 / 2.6 s in the place and 2.8 / 3.8 / 5.9 s from 0.5 m behind. Here its
    first report is a tick old when it is used; what is expected counts that.
    """
    jobs = []
    for _, behind, kind, lags, _ in CASES:
        scenario = fleet(20.0, [{"pose": (-1.0 - behind, 0.0, 0.0)}], path="straight", kind=kind, vehicles=lags)
        scenario["vehicle"][0]["kind"] = "kinematic"
        jobs.append(track(scenario))
    curves, rows = [], []
    for color, ((name, behind, _, _, servo), each, at_once) in enumerate(
        zip(CASES, runner(jobs), KNOWN_AT_ONCE_S, strict=True)
    ):
        z = each.z[:, 0, 0]
        law = {"gain": K1, "speed": V, "period_s": T}
        at_first, counted = (closed_forms.start_up(behind, *servo, **law, first_tick=first) for first in (0, 1))
        times = T * np.arange(len(counted))
        settled = settling_s(times, counted, BAND_M)
        rows += [
            absolute(
                f"{name}: integration, leader known at once: settling, s", at_once, settling_s(times, at_first, BAND_M), 0.1001
            ),
            absolute(
                f"{name}: settling with the first report a tick old, s", settled, settling_s(each.time_s, z, BAND_M), 1e-6
            ),
            absolute(f"{name}: largest error with it, m", np.abs(counted).max(), np.abs(z).max(), 0.005),
        ]
        curves.append(Curve(each.time_s, z, name, color))
    panel = Panel(
        "Error along the heading", "time [s]", "z1 [m]", curves, levels={"5 cm": (-BAND_M, BAND_M)}, x_limits=(0.0, 10.0)
    )
    return Figure("Fig. 32: the leader starts at 0.3 m/s, followers at rest", [panel], rows)
