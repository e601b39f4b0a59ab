"""The figure of a radio's calibration: levels over distance with the fitted line, and how alike neighbouring rows are."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from vcmvsp.cosim.plots.style import ABOVE, GREY, LEVEL, styled
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util.palette import OKABE_ITO

_BLUE, _RED = OKABE_ITO[1], OKABE_ITO[2]


@styled
def draw_calibration(
    *,
    distance_m: Array,
    level_dbm: Array,
    line_m: Array,
    line_dbm: Array,
    sigma_db: float,
    sensitivity_dbm: float | None,
    walls: bool,
    moved_m: Array,
    correlation: Array,
    curve_m: Array,
    curve: Array,
    correlation_distance_m: float | None,
) -> Figure:
    """Above: levels over distance (logarithmic), fitted line and +-sigma band, lost rows as ticks at the sensitivity.

    Below: correlation of the residuals of two rows over how far both ends moved between them, and the fitted one. The points
    tend to lie lower: a line that is fitted takes part of the field with it, and rows that are lost cut its troughs off.

    Args:
        distance_m: of each row, (n,).
        level_dbm: of each row, (n,), without its walls; NaN where lost.
        line_m: where the fitted line is drawn, (l,), with ``line_dbm`` (l,).
        sigma_db: standard deviation of a single level about the line.
        sensitivity_dbm: below which rows were lost; None where none was.
        walls: whether losses of walls were added to the levels.
        moved_m: middles of the intervals of displacement, (k,), with ``correlation`` (k,); NaN where there are few pairs.
        curve_m: where the fitted correlation is drawn, (c,), with ``curve`` (c,).
        correlation_distance_m: of the fitted correlation; None where rows are independent.
    """
    figure = Figure(figsize=(7.0, 6.2), layout="constrained")
    figure.suptitle("Levels over distance, and how alike neighbouring ones are")
    above, below = figure.subplots(2, 1, height_ratios=(3.0, 1.6))
    _draw_levels(above, distance_m, level_dbm, line_m, line_dbm, sigma_db)
    lost = np.isnan(level_dbm)
    if sensitivity_dbm is not None:
        above.axhline(sensitivity_dbm, **LEVEL, zorder=2, label="sensitivity")
        floor = np.full(int(lost.sum()), sensitivity_dbm)
        above.plot(distance_m[lost], floor, "v", color=_RED, markersize=4.0, alpha=0.5, zorder=4, label=f"lost ({floor.size})")
    above.set_ylabel("received level + walls [dBm]" if walls else "received level [dBm]")
    above.legend(ncols=5, **ABOVE)

    below.axhline(0.0, color=GREY, linewidth=0.8, zorder=1)
    below.plot(moved_m, correlation, "o", color="black", markersize=3.5, zorder=3, label="residuals of received rows")
    if correlation_distance_m is not None:
        name = f"fitted, exp(-$\\delta$ / {correlation_distance_m:.3g} m)"
        below.plot(curve_m, curve, color=_BLUE, zorder=2, label=name)
    below.set_xlim(left=0.0)
    below.set_ylim(-0.5, 1.05)
    below.set_xlabel("displacement of both ends together, $\\delta$ [m]")
    below.set_ylabel("correlation [1]")
    below.legend(ncols=2, **ABOVE)
    return figure


def _draw_levels(axes: Axes, distance_m: Array, level_dbm: Array, line_m: Array, line_dbm: Array, sigma_db: float) -> None:
    received = ~np.isnan(level_dbm)
    axes.plot(
        distance_m[received], level_dbm[received], ".", color="black", markersize=3.0, alpha=0.35, markeredgewidth=0.0, zorder=2
    )
    axes.plot(line_m, line_dbm, color=_BLUE, linewidth=1.6, zorder=3, label="fitted")
    low, high = line_dbm - sigma_db, line_dbm + sigma_db
    axes.fill_between(line_m, low, high, color=_BLUE, alpha=0.18, linewidth=0.0, zorder=1, label="$\\pm\\sigma$")
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("distance [m]")
