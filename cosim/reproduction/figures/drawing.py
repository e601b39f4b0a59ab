"""Draws a figure of `cosim.reproduction.figures`: panels of curves, or maps; as PNG and SVG, the same bytes each time."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, TwoSlopeNorm
from matplotlib.figure import Figure as Canvas
from matplotlib.transforms import offset_copy

from vcmvsp.cosim.plots.run_plots import draw_vehicle
from vcmvsp.cosim.plots.style import LEVEL, MAP, line_of, marker_of, plain_numbers, save, style, styled
from vcmvsp.cosim.reproduction.figures.figure import Curve, Figure, Heat, Panel, as_json
from vcmvsp.cosim.reproduction.row import COLUMNS, write_csv
from vcmvsp.cosim.util.files import write_whole, writing
from vcmvsp.cosim.util.palette import OKABE_ITO, PROBABILITY, color_of

# Styles that distinguish kinds of curves; curves with markers take the marker of their colour.
LINES: dict[str, dict[str, Any]] = {
    "line": {},
    "pose": {},
    "dashed": {"linestyle": "--"},
    "dotted": {"linestyle": ":"},
    "thin": {"linewidth": 0.6, "alpha": 0.45},
    "markers": {"linestyle": "none", "markersize": 3.8},
    "dots": {"linestyle": "none", "marker": ".", "markersize": 3.0, "alpha": 0.5},
    "hollow": {"linestyle": "none", "markersize": 6.0, "markerfacecolor": "none"},
    "both": {"markersize": 3.5},
}
MARKED = {"markers", "hollow", "both"}
PANEL_INCHES = (4.7, 3.5)
MAP_INCHES = (3.4, 3.3)
LEGEND_POINTS = 30.0  # below the axes: room for tick labels and axis label
ROW_INCHES = 0.17  # height of a legend's row
GROWING = LinearSegmentedColormap.from_list("growing", ["#ffffff", OKABE_ITO[1], "#00304f"])
ABOUT_ONE = LinearSegmentedColormap.from_list("about one", [OKABE_ITO[1], "#ffffff", OKABE_ITO[2]])
CHANCE = LinearSegmentedColormap.from_list("probability", PROBABILITY)


def write(name: str, figure: Figure, folder: Path) -> list[Path]:
    """Write NAME.csv, NAME-expected.csv, NAME.json, NAME.png and NAME.svg; returns their paths."""
    points, expected, rows = (folder / f"{name}{end}" for end in (".csv", "-expected.csv", ".json"))
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        write_csv(points, ("panel", "curve", "x", "y", "value"), _points(figure))
        write_csv(expected, COLUMNS, (row.csv for row in figure.rows))
        write_whole(rows, as_json(name, figure))
        return [points, expected, rows, *save(draw(figure), folder / name)]


@styled
def draw(figure: Figure) -> Canvas:
    """Draw all panels of a figure, ``columns`` side by side, with legends below."""
    columns = min(figure.columns, len(figure.panels))
    rows = -(-len(figure.panels) // columns)
    maps = [panel.heat for panel in figure.panels if panel.heat is not None and panel.heat.style == "map"]
    width, height = MAP_INCHES if len(maps) == len(figure.panels) else PANEL_INCHES
    canvas = Canvas(figsize=(width * columns, height * rows + 0.3), layout="constrained")
    canvas.suptitle(figure.title)
    deepest = 0
    for number, panel in enumerate(figure.panels, 1):
        with style(MAP if _is_map(panel) or panel.photo is not None else None):
            axes = canvas.add_subplot(rows, columns, number)
        deepest = max(deepest, _draw_panel(axes, panel))
    canvas.set_figheight((height + ROW_INCHES * deepest) * rows + 0.3)
    if maps:
        image = next(axes.images[0] for axes in canvas.axes if axes.images)
        canvas.colorbar(image, ax=canvas.axes, label=maps[0].label, shrink=0.6, pad=0.01)
    return canvas


def _is_map(panel: Panel) -> bool:
    return panel.heat is not None and panel.heat.style == "map"


def _draw_panel(axes: Axes, panel: Panel) -> int:
    axes.set_title(panel.title, loc="left")
    axes.set_xlabel(panel.x_label)
    axes.set_ylabel(panel.y_label)
    if panel.heat is not None:
        _draw_heat(axes, panel.heat)
    if panel.photo is not None:
        axes.imshow(panel.photo.pixels, interpolation="antialiased")
    if panel.heat is None or _is_map(panel):
        _draw_curves(axes, panel)
    return _draw_legend(axes)


def _draw_curves(axes: Axes, panel: Panel) -> None:
    labels: set[str] = set()
    lines = {curve.color for curve in panel.curves if curve.label and curve.style == "line"}
    plain = panel.photo is None and panel.heat is None
    for curve in panel.curves:
        label = curve.label if curve.label not in labels else ""
        labels.add(curve.label)
        _draw_curve(axes, curve, label, marked=plain and len(lines) > 1, shaped=plain)
    for label, level in panel.levels.items():
        for number, each in enumerate(np.atleast_1d(level)):
            axes.axhline(each, **LEVEL, zorder=1, label="_" if number else label)
    _set_scales(axes, panel)


def _draw_legend(axes: Axes) -> int:
    handles, labels = axes.get_legend_handles_labels()
    if not labels:
        return 0
    across = max(1, int(58 // (6 + max(map(len, labels)))))
    below = offset_copy(axes.transAxes, axes.get_figure(root=True), y=-LEGEND_POINTS, units="points")
    look: dict[str, Any] = {"ncols": across, "handlelength": 1.8, "columnspacing": 1.2, "borderaxespad": 0.0}
    axes.legend(handles, labels, loc="upper left", bbox_to_anchor=(0.0, 0.0), bbox_transform=below, **look)
    return -(-len(labels) // across)


def _set_scales(axes: Axes, panel: Panel) -> None:
    if panel.log_x:
        axes.set_xscale("log")
        plain_numbers(axes.xaxis)
    if panel.log_y:
        axes.set_yscale("log")
        low, high = panel.y_limits or axes.get_ylim()
        if high < 1000.0 * low:
            plain_numbers(axes.yaxis)
    if panel.equal:
        axes.set_aspect("equal", adjustable="datalim")
    if panel.x_limits:
        axes.set_xlim(*panel.x_limits)
    if panel.y_limits:
        axes.set_ylim(*panel.y_limits)


def _draw_curve(axes: Axes, curve: Curve, label: str, *, marked: bool, shaped: bool) -> None:
    """Draw a curve; ``marked`` adds sparse markers, ``shaped`` uses the marker shape of its colour."""
    color = color_of(curve.color)
    look: dict[str, Any] = {"color": color, **LINES[curve.style]}
    if curve.style in MARKED:
        look["marker"] = marker_of(curve.color) if shaped else "o"
    elif curve.style == "pose":
        look |= {"marker": marker_of(curve.color), "markevery": [0], "markersize": 4.5}
    elif curve.style == "line" and marked and curve.label and curve.color:  # black, often a wall, is distinct in grey, too
        look |= {**line_of(curve.color), "markersize": 3.5}
    axes.plot(curve.x, curve.y, label=label or "_", zorder=3, **look)
    if curve.style == "pose":
        ahead = np.arctan2(curve.y[-1] - curve.y[-2], curve.x[-1] - curve.x[-2])
        draw_vehicle(axes, (curve.x[-1], curve.y[-1], float(ahead)), color, 13.0)


def _draw_heat(axes: Axes, heat: Heat) -> None:
    """Draw one evenly spaced cell per pair of values, with its number; a map is drawn to scale."""
    values = np.asarray(heat.values)
    axes.grid(visible=False)
    if heat.style == "map":
        ends = [(0.5 * (3 * at[0] - at[1]), 0.5 * (3 * at[-1] - at[-2])) for at in (heat.x, heat.y)]
        axes.imshow(values, origin="lower", extent=(*ends[0], *ends[1]), cmap=CHANCE, vmin=0.0, vmax=1.0)
        return
    axes.set_title(heat.label, loc="right", fontsize=8)
    if heat.style == "growing":
        levels, norm, colors = values, None, GROWING
    else:
        furthest = max(float(np.abs(np.log(values)).max()), 1e-3)
        levels, norm, colors = np.log(values), TwoSlopeNorm(0.0, -furthest, furthest), ABOUT_ONE
    picture = axes.imshow(levels, origin="lower", aspect="auto", cmap=colors, norm=norm)
    axes.set_xticks(range(len(heat.x)), [f"{x:g}" for x in heat.x])
    axes.set_yticks(range(len(heat.y)), [f"{y:g}" for y in heat.y])
    for (row, column), value in np.ndenumerate(values):
        red, green, blue, _ = picture.to_rgba(levels[row, column])
        dark = 0.299 * red + 0.587 * green + 0.114 * blue < 0.55
        axes.text(column, row, f"{value:.2g}", ha="center", va="center", fontsize=7, color="white" if dark else "black")


def _points(figure: Figure) -> Iterator[tuple[str, str, float, float, float | str]]:
    """All points as panel, label of the curve, x, y; cells of a `Heat` also have a value."""
    for panel in figure.panels:
        for curve in panel.curves:
            for x, y in zip(curve.x, curve.y, strict=True):
                yield panel.title, curve.label, float(x), float(y), ""
        if (heat := panel.heat) is not None:
            for (row, column), value in np.ndenumerate(heat.values):
                yield panel.title, heat.label, float(heat.x[column]), float(heat.y[row]), float(value)
