"""The picture of a coverage map: level and success seen from above, with walls and vehicles."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import matplotlib.patheffects as effects
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from vcmvsp.cosim.plots.style import ABOVE, MAP, style
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util.palette import OKABE_ITO

if TYPE_CHECKING:
    from vcmvsp.cosim.analysis.coverage import Map

# Viridis and cividis keep their order in grey and under every common form of colour blindness; both run from dark to light.
_LEVEL, _SUCCESS = "viridis", "cividis"
_WALLS = (OKABE_ITO[2], OKABE_ITO[4], OKABE_ITO[5], OKABE_ITO[6])  # those that viridis and cividis do not have
_WHITE: list[effects.AbstractPathEffect] = [effects.withStroke(linewidth=3.2, foreground="white")]
_DEEPEST_DB = 15.0  # below what is noticed: weaker levels all look alike


def coverage(found: "Map") -> Figure:
    """Two maps with the same axes: the mean level, with a contour where it is just noticed, and the share of frames."""
    with style(MAP):
        width, height = np.ptp(found.x), np.ptp(found.y)
        wide = width > 1.6 * height
        size = (7.0, 1.6 + 12.0 * height / width) if wide else (10.5, 1.2 + 4.4 * height / width)
        figure = Figure(figsize=(size[0], min(size[1], 12.0)), layout="compressed")
        above, below = figure.subplots(*((2, 1) if wide else (1, 2)), sharex=True, sharey=True)
        top = max(float(found.level_dbm.max()), found.floor_dbm + 1.0)
        low = max(float(found.level_dbm.min()), found.floor_dbm - _DEEPEST_DB)
        _field(figure, above, found, found.level_dbm, (low, top), _LEVEL, "mean received level [dBm]")
        _contours(above, found, found.level_dbm, {found.floor_dbm: f"{found.floor_dbm:.0f} dBm"})
        label = f"received frames of {found.size_bytes} bytes [%]"
        _field(figure, below, found, 100.0 * found.success, (0.0, 100.0), _SUCCESS, label)
        _contours(below, found, 100.0 * found.success, {50.0: "50 %"})
        for axes in (above, below):
            _scene(axes, found)
        below.set_xlabel("x east [m]")
        above.set_xlabel("" if wide else "x east [m]")
        above.set_ylabel("y north [m]")
        below.set_ylabel("y north [m]" if wide else "")
        _titles(figure, above, found)
        return figure


def _field(
    figure: Figure, axes: Axes, found: "Map", values: Array, bounds: tuple[float, float], colors: str, label: str
) -> None:
    """Values as a coloured grid, each place the middle of its square."""
    half = 0.5 * (found.x[1] - found.x[0])
    extent = (found.x[0] - half, found.x[-1] + half, found.y[0] - half, found.y[-1] + half)
    low, high = bounds
    image = axes.imshow(
        values, origin="lower", extent=extent, cmap=colors, vmin=low, vmax=high, interpolation="nearest", aspect="equal"
    )
    beyond = "both" if values.max() > high and values.min() < low else "min" if values.min() < low else "neither"
    figure.colorbar(image, ax=axes, label=label, extend=beyond, pad=0.02)


def _contours(axes: Axes, found: "Map", values: Array, words: dict[float, str]) -> None:
    levels = [level for level in words if values.min() < level < values.max()]
    if levels and min(values.shape) > 1:
        lines = axes.contour(found.x, found.y, values, levels=levels, colors="white", linewidths=1.1, linestyles="solid")
        for text in axes.clabel(lines, fmt={level: words[level] for level in levels}, fontsize=7, inline_spacing=2):
            text.set_path_effects([effects.withStroke(linewidth=2.0, foreground="black")])


def _scene(axes: Axes, found: "Map") -> None:
    materials = sorted({solid.material for solid in found.solids})
    for solid in found.solids:
        color = _color_of(materials, solid.material)
        for piece in solid.uprights():
            axes.fill(*piece.corners.T, facecolor=color, edgecolor=color, linewidth=2.0, zorder=3, path_effects=_WHITE)
    near_m, named = 0.03 * max(np.ptp(found.x), np.ptp(found.y)), list[tuple[float, float]]()
    for name in sorted(found.places, key=lambda name: name != found.vehicle):  # the sender first: its name, and its star, stay
        x, y, _ = found.places[name]
        sends = name == found.vehicle
        shape: dict[str, Any] = {"marker": "*", "markersize": 12, "zorder": 6} if sends else {"marker": "o", "zorder": 5}
        axes.plot(x, y, color="white", markeredgecolor="black", **shape)
        if all(np.hypot(x - a, y - b) > near_m for a, b in named):
            named.append((x, y))
            note = axes.annotate(name, (x, y), xytext=(5, 5), textcoords="offset points", fontsize=8, zorder=7)
            note.set_path_effects(_WHITE)


def _titles(figure: Figure, axes: Axes, found: "Map") -> None:
    share = 100.0 * float((found.level_dbm >= found.floor_dbm).mean())
    gap = "\n" if figure.get_figwidth() < 10.0 else " "
    figure.suptitle(
        f"{found.scenario}: coverage of {found.vehicle} ({found.preset}, seed {found.seed}, "
        f"receivers {found.height_m:g} m high)\n"
        f"{share:.0f} % of the area hears it at {found.floor_dbm:.1f} dBm or more;{gap}"
        f"{100.0 * found.success.mean():.0f} % of the frames arrive, all places taken together"
    )
    materials = sorted({solid.material for solid in found.solids})
    if materials:
        lines = [Line2D([], [], color=_color_of(materials, each), linewidth=3) for each in materials]
        axes.legend(lines, materials, ncols=len(materials), **ABOVE)


def _color_of(materials: Sequence[str], material: str) -> str:
    """Concrete is black where there is any; the others follow in the order of their names."""
    if material == "concrete":
        return OKABE_ITO[0]
    return _WALLS[[each for each in materials if each != "concrete"].index(material) % len(_WALLS)]
