"""Figure 33: how often a follower decides, and the bound that this sets to its gain across the heading."""

import numpy as np

from vcmvsp.cosim.analysis import closed_forms
from vcmvsp.cosim.reproduction.figures.figure import Curve, Figure, Panel
from vcmvsp.cosim.reproduction.figures.scenarios import AHEAD, K1, Tracks, V, fleet, overshoot, settling_s, step_follower, track
from vcmvsp.cosim.reproduction.row import Row, absolute, relative
from vcmvsp.cosim.reproduction.runner import Job, Runner
from vcmvsp.cosim.types import Array

STEP_M, LAG_S, TINY_M = 0.5, 0.5, 1e-4
RATES_HZ = (10.0, 2.0, 1.0, 0.5)
BAND_M = 0.05 * STEP_M
Z1_SETTLING_S, Z2_OVERSHOOT = (3.6, 3.0, 2.0, 12.0), (0.0, 0.0, 0.0, 0.426)
BOUND_PERIODS_S, BOUND_COUNT = (0.1, 0.5, 1.0, 2.0), 30
BEFORE_S = 100.0


def fig_33(runner: Runner) -> Figure:
    """Steps of 0.5 m along and across the heading at 10 to 0.5 Hz, k1 = 0.8, k2 = 0.5 1/s; and growth next to the bound."""
    along = [_step(1.0 / rate, behind=STEP_M) for rate in RATES_HZ]
    across = [_step(1.0 / rate, left=STEP_M) for rate in RATES_HZ]
    servo = [_step(1.0 / rate, kind="lag", behind=STEP_M) for rate in RATES_HZ]
    bounds = [(period, share) for period in BOUND_PERIODS_S for share in (0.95, 1.05)]
    tiny = [_step(period, for_s=BOUND_COUNT * period, left=TINY_M, k2=share * _bound(period)) for period, share in bounds]
    components = [0] * 4 + [1] * 4 + [0] * 4 + [1] * 8  # z1 or z2
    runs = runner([*along, *across, *servo, *tiny])
    seen = [_response(each, component) for each, component in zip(runs, components, strict=True)]
    panels, rows = [], []
    names = ("z1, kinematic, 0.5 m behind", "z2, kinematic, 0.5 m to the left", "z1, servo lag 0.5 s, 0.5 m behind")
    for part, name in enumerate(names):
        curves = []
        for color, (rate, (time_s, z)) in enumerate(zip(RATES_HZ, seen[4 * part : 4 * part + 4], strict=True), 1):
            curves.append(Curve(time_s, z, f"{rate:g} Hz", color, "both" if rate < 10.0 else "line"))
            rows += _rows(name, rate, time_s, z, color - 1)
        panels.append(Panel(name, "time since the step [s]", f"{name[:2]} [m]", curves, x_limits=(0.0, 16.0)))
    growth = []
    for (period, share), (_, z) in zip(bounds, seen[12:], strict=True):
        exact = TINY_M * closed_forms.side_steps(share * _bound(period), period, AHEAD, V, len(z))
        case = (
            f"T = {period:g} s, {share:g} x the bound k2 = {_bound(period):.4f}: z2 after {BOUND_COUNT} periods over its start"
        )
        rows.append(relative(case, abs(exact[-1]) / TINY_M, abs(z[-1]) / TINY_M, 0.02))
        color = BOUND_PERIODS_S.index(period) + 1
        label = f"T = {period:g} s"
        growth.append(Curve(np.arange(len(z)), np.abs(z), label, color, "line" if share > 1 else "dashed"))
    title = "0.95 (dashed) and 1.05 of k2 = 2/T - v/l"
    panels.append(Panel(title, "periods since the step", "|z2| [m]", growth, log_y=True))
    return Figure("Fig. 33: rates of control", panels, rows)


def _rows(name: str, rate: float, time_s: Array, z: Array, number: int) -> list[Row]:
    case, over = f"{name}, {rate:g} Hz: overshoot, %", 100 * overshoot(z)
    if name.startswith("z2"):
        expected = 100 * Z2_OVERSHOOT[number]
        return [relative(case, expected, over, 0.05) if expected else absolute(case, 0.0, over, 0.1)]
    if "servo" in name:
        exact = closed_forms.servo_step(K1, 1.0 / rate, LAG_S, len(z))
        return [absolute(case, 100 * overshoot(exact), over, 0.05)]
    settled = settling_s(time_s, z, BAND_M)
    return [
        absolute(case, max(0.0, 100 * (K1 / rate - 1.0)), over, 0.05),
        absolute(f"{name}, {rate:g} Hz: settling to 5 %, s", Z1_SETTLING_S[number], settled, 1e-6),
    ]


def _bound(period_s: float) -> float:
    """Largest stable k2, 1/s."""
    return 2.0 / period_s - V / AHEAD


def _step(period_s: float, *, for_s: float = 20.0, kind: str = "kinematic", **step: float) -> Job:
    """A leader on a straight line, and one follower that steps; both at the same rate."""
    agents, record = {"period_s": period_s}, {"period_s": period_s}
    follower = step_follower(BEFORE_S, **step)
    return track(fleet(BEFORE_S + for_s, [follower], path="straight", kind=kind, agents=agents, record=record))


def _response(seen: Tracks, component: int) -> tuple[Array, Array]:
    """Times since the step, s, and one component of the error, m."""
    after = seen.time_s >= BEFORE_S - 1e-9
    return seen.time_s[after] - BEFORE_S, seen.z[after, 0, component]
