"""Figures of a study: each metric over the varied keys, with its band; a heat map for two varied numbers.

The summary (`cosim.studies.summary`) is their only input; the style is that of a run's figures.
"""

import contextlib
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from vcmvsp.cosim.metrics.catalogue import METRICS, split_unit
from vcmvsp.cosim.plots.style import MAP, marker_of, style
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util.documents import read_json
from vcmvsp.cosim.util.palette import color_of

MAP_COLORS = "cividis"  # stays ordered in grey and for common forms of colour blindness
ANNOTATED_CELLS = 60  # larger maps show no numbers in cells
MOST_WORDS = 48  # labels along a side of a map, which then stops growing
NAME_INCHES = 0.175  # height of a legend's row
DECADES = 30.0  # metrics whose means span a larger ratio have a logarithmic axis
_STATISTIC = re.compile(r"mean|max|min|rms|p\d+|final|peak|time_average")
_WORDS = {"probability": "{table} probability", "seconds": "{table}", "count": "{table} count", "kind": "{table}"}


class Table(NamedTuple):
    """A summary, and the roles of its columns."""

    columns: Mapping[str, list[Any]]
    numeric: tuple[str, ...]  # varied keys with two or more numbers
    named: tuple[str, ...]  # all other varied keys


def lines(summary: pa.Table, keys: Sequence[str], metrics: Sequence[str], title: str = "") -> Figure:
    """One panel per metric: mean and band over the first key with numbers, a line for each combination of the other keys.

    Without a key with numbers: points with error bars over the values of the first key.
    """
    table = _sorted(summary, keys)
    x_key = table.numeric[0] if table.numeric else next(iter(table.named), "")
    others = [key for key in (*table.named, *table.numeric) if key != x_key]
    with style():
        across = min(len(metrics), 2)
        down = math.ceil(len(metrics) / across)
        wide = 6.4 if across == 1 else 9.6
        figure = Figure(figsize=(wide, 0.9 + 3.1 * down), layout="constrained")
        panels = figure.subplots(down, across, squeeze=False, sharex=True).ravel()
        groups = _groups(table, others)
        for axes, metric in zip(panels, metrics, strict=False):
            for index, (label, rows) in enumerate(groups.items()):
                look = _look(index, len(groups), ordered=len(others) == 1 and others[0] in table.numeric)
                if table.numeric:
                    _line(axes, table, (x_key, metric), rows, {**look, "label": label})
                else:
                    spread = 0.5 * ((index + 0.5) / len(groups) - 0.5)
                    _bars(axes, table, (x_key, metric), rows, spread, {**look, "label": label})
            axes.set_ylabel(label_of(metric))
            _scale(axes, table, metric)
        _axis(panels, len(metrics), table, x_key)
        _legend(figure, panels[0], others)
        if title:
            figure.suptitle(title)
        return figure


def heat_map(summary: pa.Table, keys: Sequence[str], metric: str, title: str = "") -> Figure | None:
    """A metric over the first two keys with numbers, one panel per combination of the others; None without two such keys.

    All cells have the same size, independent of the steps between values; the number in a cell is the mean.
    """
    table = _sorted(summary, keys)
    if len(table.numeric) < 2:
        return None
    x_key, y_key = table.numeric[:2]
    groups = _groups(table, (*table.named, *table.numeric[2:]))
    xs, ys = (sorted(_distinct(table.columns[key])) for key in (x_key, y_key))
    with style(MAP):
        across = min(len(groups), 2)
        down = math.ceil(len(groups) / across)
        cell = 0.62 if len(xs) * len(ys) <= ANNOTATED_CELLS else 0.25
        wide, high = (cell * min(len(values), MOST_WORDS) for values in (xs, ys))
        size = (1.0 + across * (0.6 + max(3.0, wide)), 0.8 + down * (0.6 + max(2.2, 0.5 * high / 0.62)))
        figure = Figure(figsize=size, layout="constrained")
        panels = figure.subplots(down, across, squeeze=False, sharex=True, sharey=True)
        norm = _norm(table, metric)
        for axes, (label, rows) in zip(panels.ravel(), groups.items(), strict=False):
            image = axes.pcolormesh(
                np.arange(len(xs) + 1) - 0.5,
                np.arange(len(ys) + 1) - 0.5,
                _field(table, (x_key, y_key, metric), rows),
                cmap=MAP_COLORS,
                norm=norm,
                edgecolor="white",
                linewidth=0.8 if cell > 0.5 else 0.0,
            )
            if len(xs) * len(ys) <= ANNOTATED_CELLS:
                _numbers(axes, image, _field(table, (x_key, y_key, metric), rows))
            for axis, values in ((axes.xaxis, xs), (axes.yaxis, ys)):
                every = math.ceil(len(values) / MOST_WORDS)
                axis.set_ticks(range(0, len(values), every), _labels(values)[::every])
            axes.tick_params(length=0)
            axes.set_title(label)
        for axes in panels.ravel()[len(groups) :]:
            axes.set_visible(False)
        bar = figure.colorbar(image, ax=panels, label=label_of(metric), pad=0.02)
        if isinstance(norm, LogNorm):
            _name_decades(bar.ax.yaxis, *image.get_clim())
        figure.supxlabel(_axis_label(x_key), fontsize=9)
        figure.supylabel(_axis_label(y_key), fontsize=9)
        if title:
            figure.suptitle(title)
        return figure


def _line(axes: Axes, table: Table, quantities: tuple[str, str], rows: list[int], look: dict[str, Any]) -> None:
    x, mean, low, high = _values(table, *quantities, rows)
    axes.fill_between(x, low, high, color=look["color"], alpha=0.2, linewidth=0.0, zorder=2)
    axes.plot(x, mean, markersize=3.5, zorder=3, **look)


def _bars(axes: Axes, table: Table, quantities: tuple[str, str], rows: list[int], spread: float, look: dict[str, Any]) -> None:
    key, metric = quantities
    values = table.columns[key] if key else [""] * len(table.columns["n"])
    place_of = {value: place for place, value in enumerate(_distinct(values))}
    places = [place_of[values[row]] + spread for row in rows]
    _, mean, low, high = _values(table, "", metric, rows)
    error = np.nan_to_num(np.array([mean - low, high - mean]))
    axes.errorbar(places, mean, error, **{**look, "linestyle": ""}, capsize=3, markersize=5, zorder=3)


def _values(table: Table, key: str, metric: str, rows: list[int]) -> tuple[Array, Array, Array, Array]:
    parts = [table.columns[f"{metric}.{part}"] for part in ("mean", "low", "high")]
    mean, low, high = np.array(parts, float)[:, rows]
    x = np.array(table.columns[key], float)[rows] if key else np.zeros(len(rows))
    return x, mean, low, high


def _scale(axes: Axes, table: Table, metric: str) -> None:
    values = _means(table, metric)
    if not len(values):
        axes.annotate("no run has a value", (0.5, 0.5), xycoords="axes fraction", ha="center", color="0.4")
    elif values.min() > 0.0 and values.max() > DECADES * values.min():
        axes.set_yscale("log")
        _name_decades(axes.yaxis, values.min(), values.max())
    elif values.min() >= 0.0:
        axes.set_ylim(bottom=0.0)


def _axis(panels: Iterable[Axes], count: int, table: Table, key: str) -> None:
    columns = min(count, 2)
    for index, axes in enumerate(panels):
        axes.set_visible(index < count)
        if index + columns >= count:
            axes.set_xlabel(_axis_label(key) if key else "")
            axes.tick_params(labelbottom=True)
        if not table.numeric:
            names = _labels(_distinct(table.columns[key])) if key else ["all runs"]
            axes.set_xticks(range(len(names)), names)
            axes.set_xlim(-0.5, len(names) - 0.5)
            axes.grid(visible=False, axis="x")


def _legend(figure: Figure, axes: Axes, others: Sequence[str]) -> None:
    handles, labels = axes.get_legend_handles_labels()
    if not others:
        return
    title = ", ".join(label_of(key) for key in others)
    if len(labels) <= 6:
        figure.legend(handles, labels, loc="outside upper left", ncols=len(labels), title=title, alignment="left")
    else:
        room = int((figure.get_figheight() - 0.6) / NAME_INCHES)
        if len(labels) > room:
            handles = [*handles[: room - 1], Line2D([], [], linestyle="")]
            labels = [*labels[: room - 1], f"and {len(labels) - room + 1} more"]
        figure.legend(handles, labels, loc="outside right upper", title=title, alignment="left")


def _look(index: int, count: int, *, ordered: bool) -> dict[str, Any]:
    if ordered:
        shade = mpl.colormaps["viridis"](0.9 * index / max(1, count - 1))
        return {"color": shade, "marker": marker_of(index)}
    return {"color": color_of(index), "marker": marker_of(index)}


def _field(table: Table, quantities: tuple[str, str, str], rows: list[int]) -> Array:
    x_key, y_key, metric = quantities
    xs, ys = (sorted(_distinct(table.columns[key])) for key in (x_key, y_key))
    field = np.full((len(ys), len(xs)), np.nan)
    for row in rows:
        mean = table.columns[f"{metric}.mean"][row]
        field[ys.index(table.columns[y_key][row]), xs.index(table.columns[x_key][row])] = math.nan if mean is None else mean
    return field


def _name_decades(axis: Axis, low: float, high: float) -> None:
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 1e3 * low else (1.0,), numticks=12))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _means(table: Table, metric: str) -> Array:
    values = np.array(table.columns[f"{metric}.mean"], float)
    return np.asarray(values[np.isfinite(values)])


def _norm(table: Table, metric: str) -> Normalize:
    values = _means(table, metric)
    if not len(values):
        return Normalize(0.0, 1.0)
    if values.min() > 0.0 and values.max() > DECADES * values.min():
        return LogNorm(values.min(), values.max())
    return Normalize(min(0.0, values.min()), values.max() or 1.0)


def _numbers(axes: Axes, image: AxesImage, field: Array) -> None:
    for (row, column), value in np.ndenumerate(field):
        if np.isfinite(value):
            red, green, blue, _ = image.cmap(image.norm(value))
            dark = 0.299 * red + 0.587 * green + 0.114 * blue < 0.5
            color = "white" if dark else "black"
            axes.annotate(f"{value:.2g}", (column, row), ha="center", va="center", fontsize=7, color=color)


def _sorted(summary: pa.Table, keys: Sequence[str]) -> Table:
    """Sort the rows by all numbers and keep the order of names; drop keys with a single value."""
    columns = summary.to_pydict()
    varied = [key for key in keys if len(_distinct(columns[key])) > 1]
    numeric = tuple(key for key in varied if all(map(_is_number, columns[key])))
    order = sorted(range(summary.num_rows), key=lambda row: [columns[key][row] for key in numeric])
    names = {key: _distinct(columns[key]) for key in varied if key not in numeric}
    order.sort(key=lambda row: [names[key].index(columns[key][row]) for key in names])
    return Table(summary.take(pa.array(order, pa.int64())).to_pydict(), numeric, tuple(names))


def _groups(table: Table, others: Sequence[str]) -> dict[str, list[int]]:
    rows_of: dict[str, list[int]] = {}
    columns = [table.columns[key] for key in others]
    words = [dict(zip(values, _labels(values), strict=True)) for values in map(_distinct, columns)]
    for row in range(len(table.columns["n"])):
        rows_of.setdefault(", ".join(own[column[row]] for own, column in zip(words, columns, strict=True)), []).append(row)
    return rows_of


def _distinct(values: Sequence[Any]) -> list[Any]:
    return list(dict.fromkeys(values))


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _labels(values: Sequence[Any]) -> list[str]:
    """Labels of different values: tables by their kinds, numbers with six digits where those suffice."""
    kinds = [kind for value in values if isinstance(kind := _kind(value), str)]
    for names in (kinds, list(map(_short, values))):
        if len(set(names)) == len(values):
            return names
    return list(map(str, values))


def _kind(value: object) -> object:
    with contextlib.suppress(ValueError):  # a text may look like a table
        if isinstance(value, str) and value.startswith("{"):
            return read_json(value).get("kind")
    return None


def _short(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, int | float) else str(value)


def _axis_label(key: str) -> str:
    """Label of an axis: `label_of`, and for the delay a note that the wait for the next tick comes on top."""
    return "delay before the wait for the next tick [s]" if key == "radio.delay.seconds" else label_of(key)


def label_of(key: str) -> str:
    """Label of a key or metric, with the unit from its name: ``radio.delay.jitter_s`` is ``jitter [s]``."""
    *above, last = key.split(".")
    stem, unit = split_unit(last)
    words = _WORDS.get(stem, stem).format(table=above[-1] if above else "")
    of_what, its_unit = split_unit(above[-1]) if above else ("", "")
    if key in METRICS and METRICS[key].label:
        words, unit = METRICS[key].label, unit or its_unit
    elif above and (_STATISTIC.fullmatch(stem) or (its_unit and not unit)):
        words, unit = f"{of_what} {stem}", unit or its_unit
    elif above[:-1] == ["radio", "losses"] or above == ["radio", "losses"]:
        words = f"lost: {last}"
    return words.replace("_", " ") + (f" [{unit}]" if unit else "")
