"""Draws what a figure of `cosim.figures` consists of: panels of curves, or maps; as PNG and SVG, the same bytes each time."""

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import LinearSegmentedColormap, TwoSlopeNorm
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import LogLocator, NullFormatter

from cosim.record.palette import OKABE_ITO, color_of
from cosim.record.plots import GREY, draw_vehicle, styled

if TYPE_CHECKING:
    from cosim.figures.kit import Curve, Figure, Heat, Panel

LINES: dict[str, dict[str, Any]] = {
    "line": {},
    "dashed": {"linestyle": "--"},
    "dotted": {"linestyle": ":"},
    "thin": {"linewidth": 0.6, "alpha": 0.45},
    "markers": {"linestyle": "none", "marker": "o", "markersize": 4.5},
    "dots": {"linestyle": "none", "marker": ".", "markersize": 3.0, "alpha": 0.5},
    "hollow": {"linestyle": "none", "marker": "o", "markersize": 6.0, "markerfacecolor": "none"},
    "both": {"marker": "o", "markersize": 3.5},
}
PANEL_INCHES = (4.7, 3.5)
GROWING = LinearSegmentedColormap.from_list("growing", ["#ffffff", OKABE_ITO[1], "#00304f"])
ABOUT_ONE = LinearSegmentedColormap.from_list("about one", [OKABE_ITO[1], "#ffffff", OKABE_ITO[2]])


@styled
def draw(figure: "Figure") -> Canvas:
    """All panels of a figure, ``columns`` of them side by side."""
    columns = min(figure.columns, len(figure.panels))
    rows = -(-len(figure.panels) // columns)
    width, height = PANEL_INCHES
    canvas = Canvas(figsize=(width * columns, height * rows + 0.3), layout="constrained")
    canvas.suptitle(figure.title, fontsize=11)
    for number, panel in enumerate(figure.panels, 1):
        axes = canvas.add_subplot(rows, columns, number)
        axes.set_title(panel.title, loc="left")
        axes.set_xlabel(panel.x_label)
        axes.set_ylabel(panel.y_label)
        if panel.heat is not None:
            _draw_heat(axes, panel.heat)
        if panel.photo is not None:
            axes.imshow(panel.photo.pixels, interpolation="antialiased")
            axes.grid(visible=False)
        if panel.heat is None or panel.heat.style == "map":
            _draw_curves(axes, panel)
    return canvas


def _draw_curves(axes: Axes, panel: "Panel") -> None:
    named: set[str] = set()
    for curve in panel.curves:
        label = curve.label if curve.label not in named else ""
        named.add(curve.label)
        _draw_curve(axes, curve, label)
    for label, level in panel.levels.items():
        for number, each in enumerate(np.atleast_1d(level)):
            axes.axhline(each, color=GREY, linestyle="--", linewidth=0.9, zorder=1, label="_" if number else label)
    _set_scales(axes, panel)
    if axes.get_legend_handles_labels()[1]:
        on_picture = panel.photo is not None or panel.heat is not None
        fixed = panel.equal or on_picture
        axes.legend(loc="upper right" if fixed else "best", handlelength=1.8, frameon=on_picture, framealpha=0.85)


def _set_scales(axes: Axes, panel: "Panel") -> None:
    if panel.log_x:
        axes.set_xscale("log")
        _plain_numbers(axes.xaxis)
    if panel.log_y:
        axes.set_yscale("log")
        low, high = panel.y_limits or axes.get_ylim()
        if high < 1000.0 * low:
            _plain_numbers(axes.yaxis)
    if panel.equal:
        axes.set_aspect("equal", adjustable="datalim")
    if panel.x_limits:
        axes.set_xlim(*panel.x_limits)
    if panel.y_limits:
        axes.set_ylim(*panel.y_limits)


def _plain_numbers(axis: Axis) -> None:
    """0.1, 0.2, 0.5, 1 along a logarithmic axis that spans few decades."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def _draw_curve(axes: Axes, curve: "Curve", label: str) -> None:
    color = color_of(curve.color)
    if curve.style != "pose":
        axes.plot(curve.x, curve.y, color=color, label=label or "_", zorder=3, **LINES[curve.style])
        return
    axes.plot(curve.x, curve.y, color=color, label=label or "_", zorder=3)
    axes.plot(curve.x[:1], curve.y[:1], "o", color=color, markersize=4.5, zorder=4)
    ahead = np.arctan2(curve.y[-1] - curve.y[-2], curve.x[-1] - curve.x[-2])
    draw_vehicle(axes, (curve.x[-1], curve.y[-1], float(ahead)), color, 13.0)


def _draw_heat(axes: Axes, heat: "Heat") -> None:
    """One cell for every pair of values, whatever the steps between them, with its number; a map is as large as it is."""
    values = np.asarray(heat.values)
    axes.set_title(heat.label, loc="right", fontsize=8)
    axes.grid(visible=False)
    if heat.style == "map":
        ends = [(0.5 * (3 * at[0] - at[1]), 0.5 * (3 * at[-1] - at[-2])) for at in (heat.x, heat.y)]
        axes.imshow(values, origin="lower", extent=(*ends[0], *ends[1]), cmap=GROWING, vmin=0.0, vmax=1.0)
        return
    if heat.style == "growing":
        shown, norm, colors = values, None, GROWING
    else:
        furthest = max(float(np.abs(np.log(values)).max()), 1e-3)
        shown, norm, colors = np.log(values), TwoSlopeNorm(0.0, -furthest, furthest), ABOUT_ONE
    picture = axes.imshow(shown, origin="lower", aspect="auto", cmap=colors, norm=norm)
    axes.set_xticks(range(len(heat.x)), [f"{x:g}" for x in heat.x])
    axes.set_yticks(range(len(heat.y)), [f"{y:g}" for y in heat.y])
    for (row, column), value in np.ndenumerate(values):
        red, green, blue, _ = picture.to_rgba(shown[row, column])
        dark = 0.299 * red + 0.587 * green + 0.114 * blue < 0.55
        axes.text(column, row, f"{value:.2g}", ha="center", va="center", fontsize=7, color="white" if dark else "black")
