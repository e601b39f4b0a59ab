"""Radio figures: maps of level and success of a coverage study, and a calibration's levels over distance."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import matplotlib.patheffects as effects
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from vcmvsp.cosim.plots.style import ABOVE, GREY, LEVEL, MAP, plain_numbers, style, styled
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util.palette import OKABE_ITO

if TYPE_CHECKING:
    from vcmvsp.cosim.analysis.coverage import Map

# Viridis and cividis stay ordered in grey and for common forms of colour blindness; both run from dark to light.
_LEVEL, _SUCCESS = "viridis", "cividis"
_WALLS = (OKABE_ITO[2], OKABE_ITO[4], OKABE_ITO[5], OKABE_ITO[6])  # colours that viridis and cividis lack
_WHITE: list[effects.AbstractPathEffect] = [effects.withStroke(linewidth=3.2, foreground="white")]
_BLUE, _RED = OKABE_ITO[1], OKABE_ITO[2]
_DEEPEST_DB = 15.0  # below the detection floor; weaker levels share one colour


def coverage(radio_map: "Map") -> Figure:
    """Two maps with common axes: mean level, with a contour at the detection floor, and share of frames received."""
    with style(MAP):
        width, height = np.ptp(radio_map.x), np.ptp(radio_map.y)
        wide = width > 1.6 * height
        size = (7.0, 1.6 + 12.0 * height / width) if wide else (10.5, 1.2 + 4.4 * height / width)
        figure = Figure(figsize=(size[0], min(size[1], 12.0)), layout="compressed")
        above, below = figure.subplots(*((2, 1) if wide else (1, 2)), sharex=True, sharey=True)
        top = max(float(radio_map.level_dbm.max()), radio_map.floor_dbm + 1.0)
        low = max(float(radio_map.level_dbm.min()), radio_map.floor_dbm - _DEEPEST_DB)
        _field(figure, above, radio_map, radio_map.level_dbm, (low, top), _LEVEL, "mean received level [dBm]")
        _contours(above, radio_map, radio_map.level_dbm, {radio_map.floor_dbm: f"{radio_map.floor_dbm:.0f} dBm"})
        label = f"received frames of {radio_map.size_bytes} bytes [%]"
        _field(figure, below, radio_map, 100.0 * radio_map.success, (0.0, 100.0), _SUCCESS, label)
        _contours(below, radio_map, 100.0 * radio_map.success, {50.0: "50 %"})
        for axes in (above, below):
            _scene(axes, radio_map)
        below.set_xlabel("x east [m]")
        above.set_xlabel("" if wide else "x east [m]")
        above.set_ylabel("y north [m]")
        below.set_ylabel("y north [m]" if wide else "")
        _titles(figure, above, radio_map)
        return figure


def _field(
    figure: Figure, axes: Axes, radio_map: "Map", values: Array, bounds: tuple[float, float], colors: str, label: str
) -> None:
    half = 0.5 * (radio_map.x[1] - radio_map.x[0])
    extent = (radio_map.x[0] - half, radio_map.x[-1] + half, radio_map.y[0] - half, radio_map.y[-1] + half)
    low, high = bounds
    image = axes.imshow(
        values, origin="lower", extent=extent, cmap=colors, vmin=low, vmax=high, interpolation="nearest", aspect="equal"
    )
    figure.colorbar(image, ax=axes, label=label, extend="min" if values.min() < low else "neither", pad=0.02)


def _contours(axes: Axes, radio_map: "Map", values: Array, words: dict[float, str]) -> None:
    levels = [level for level in words if values.min() < level < values.max()]
    if levels and min(values.shape) > 1:
        lines = axes.contour(
            radio_map.x, radio_map.y, values, levels=levels, colors="white", linewidths=1.1, linestyles="solid"
        )
        for text in axes.clabel(lines, fmt={level: words[level] for level in levels}, fontsize=7, inline_spacing=2):
            text.set_path_effects([effects.withStroke(linewidth=2.0, foreground="black")])


def _scene(axes: Axes, radio_map: "Map") -> None:
    materials = sorted({solid.material for solid in radio_map.solids})
    for solid in radio_map.solids:
        color = _color_of(materials, solid.material)
        for piece in solid.uprights():
            axes.fill(*piece.corners.T, facecolor=color, edgecolor=color, linewidth=2.0, zorder=3, path_effects=_WHITE)
    near_m, labelled = 0.07 * max(np.ptp(radio_map.x), np.ptp(radio_map.y)), list[tuple[float, float]]()
    # the sender first: its name, and its star, stay
    for name in sorted(radio_map.places, key=lambda name: name != radio_map.vehicle):
        x, y, _ = radio_map.places[name]
        sends = name == radio_map.vehicle
        shape: dict[str, Any] = {"marker": "*", "markersize": 12, "zorder": 6} if sends else {"marker": "o", "zorder": 5}
        axes.plot(x, y, color="white", markeredgecolor="black", **shape)
        if all(np.hypot(x - a, y - b) > near_m for a, b in labelled):
            labelled.append((x, y))
            note = axes.annotate(name, (x, y), xytext=(5, 5), textcoords="offset points", fontsize=8, zorder=7)
            note.set_path_effects(_WHITE)


def _titles(figure: Figure, axes: Axes, radio_map: "Map") -> None:
    share = 100.0 * float((radio_map.level_dbm >= radio_map.floor_dbm).mean())
    gap = "\n" if figure.get_figwidth() < 10.0 else " "
    figure.suptitle(
        f"{radio_map.scenario}: coverage of {radio_map.vehicle} ({radio_map.preset}, seed {radio_map.seed}, "
        f"receivers {radio_map.height_m:g} m high)\n"
        f"{share:.0f} % of the area hears it at {radio_map.floor_dbm:.1f} dBm or more;{gap}"
        f"{100.0 * radio_map.success.mean():.0f} % of the frames arrive, without random loss and collisions"
    )
    materials = sorted({solid.material for solid in radio_map.solids})
    if materials:
        lines = [Line2D([], [], color=_color_of(materials, each), linewidth=3) for each in materials]
        axes.legend(lines, materials, ncols=len(materials), **ABOVE)


def _color_of(materials: Sequence[str], material: str) -> str:
    if material == "concrete":
        return OKABE_ITO[0]
    return _WALLS[[each for each in materials if each != "concrete"].index(material) % len(_WALLS)]


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
    """Levels over distance (logarithmic), fitted line and +-sigma band; lost rows as ticks at the sensitivity.

    Below: correlation of the residuals of two rows over the distance that both ends moved, and its fit. The points tend to lie
    below the fit: a fitted line absorbs part of the field, and lost rows cut off its troughs.

    Args:
        distance_m: distance of each row, (n,).
        level_dbm: level of each row, (n,), without its walls; NaN where lost.
        line_m: distances of the fitted line, (l,), with ``line_dbm`` (l,).
        sigma_db: standard deviation of a single level about the line.
        sensitivity_dbm: level below which rows were lost; None without lost rows.
        walls: whether the levels include added wall losses.
        moved_m: centres of the displacement intervals, (k,), with ``correlation`` (k,); NaN where pairs are few.
        curve_m: displacements of the fitted correlation, (c,), with ``curve`` (c,).
        correlation_distance_m: distance of the fitted correlation; None where rows are independent.
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
    plain_numbers(axes.xaxis)
    axes.set_xlabel("distance [m]")
