"""Content and files of a figure: panels with curves, and rows that compare measured with expected numbers.

A figure is a function ``make(runner: Runner) -> Figure`` in a module, listed in `cosim.reproduction.figures.NAMES`. It builds
scenarios as mappings and gives them to the runner as jobs; `drawing` draws the result.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from vcmvsp.cosim.reproduction.row import COLUMNS, Row, write_csv
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util.files import to_json, write_whole, writing

# "dots": many small markers; "pose": a track with its two ends
Style = Literal["line", "dashed", "dotted", "thin", "markers", "dots", "hollow", "pose", "both"]


@dataclass(frozen=True)
class Curve:
    """Points (n,) that belong together; of curves of equal ``label`` in a panel the legend shows one."""

    x: Array
    y: Array
    label: str = ""
    color: int = 0  # of the palette: 0 black, 1 blue, 2 vermilion, 3 green, 4 purple, 5 orange, 6 sky blue
    style: Style = "line"


@dataclass(frozen=True)
class Heat:
    """Values over a grid: ``values[i, j]`` belongs to ``y[i]``, ``x[j]``; every cell is drawn with its number, but in a map."""

    x: Array
    y: Array
    values: Array  # (len(y), len(x))
    label: str = ""
    # "about one": which side of 1 is shown by colour; "map": equal steps, values from 0 to 1, curves of the panel above it
    style: Literal["growing", "about one", "map"] = "growing"


@dataclass(frozen=True)
class Photo:
    """A picture, (h, w, 3) uint8, under the curves; the middle of its first pixel, at the top left, is (0, 0)."""

    pixels: Array


@dataclass(frozen=True)
class Panel:
    """A pair of axes; it shows curves, or a `Heat`, or curves on a `Photo`."""

    title: str
    x_label: str
    y_label: str
    curves: Sequence[Curve] = ()
    _: KW_ONLY
    heat: Heat | None = None
    photo: Photo | None = None
    levels: Mapping[str, float | tuple[float, float]] = field(default_factory=dict)  # horizontal lines, by their labels
    log_x: bool = False
    log_y: bool = False
    equal: bool = False  # the same scale on both axes: a map
    x_limits: tuple[float, float] | None = None
    y_limits: tuple[float, float] | None = None


@dataclass(frozen=True)
class Figure:
    """Content of a figure; ``columns`` of panels stand side by side."""

    title: str
    panels: Sequence[Panel]
    rows: Sequence[Row]
    columns: int = 2

    @property
    def ok(self) -> bool:
        """Whether all rows hold."""
        return all(row.ok for row in self.rows)


def as_json(name: str, figure: Figure) -> str:
    """The rows of a figure: ``name`` and ``rows`` of ``case``, ``expected``, ``measured``, ``tolerance``, ``ok``."""
    return to_json({"name": name, "rows": [row.plain for row in figure.rows]})


def write(name: str, figure: Figure, folder: Path) -> list[Path]:
    """Write NAME.csv, NAME-expected.csv, NAME.json, NAME.png and NAME.svg; returns their paths."""
    from vcmvsp.cosim.plots import style
    from vcmvsp.cosim.reproduction.figures import drawing

    points, expected, rows = (folder / f"{name}{end}" for end in (".csv", "-expected.csv", ".json"))
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        write_csv(points, ("panel", "curve", "x", "y", "value"), _points(figure))
        write_csv(expected, COLUMNS, (row.csv for row in figure.rows))
        write_whole(rows, as_json(name, figure))
        return [points, expected, rows, *style.save(drawing.draw(figure), folder / name)]


def table(figure: Figure) -> str:
    """The rows as an aligned text table, each marked ``ok`` or ``MISSED``."""
    lines: list[tuple[str, ...]] = [("case", "expected", "measured", "tolerance", "")]
    lines += [(*row.cells, "ok" if row.ok else "MISSED") for row in figure.rows]
    first, *widths, _ = (max(map(len, column)) for column in zip(*lines, strict=True))
    text = ""
    for case, *numbers, verdict in lines:
        cells = [case.ljust(first), *map(str.rjust, numbers, widths), verdict]
        text += "  ".join(cells).rstrip() + "\n"
    return text


def _points(figure: Figure) -> Iterator[tuple[str, str, float, float, float | str]]:
    """Panel, label of the curve, x, y; cells of a `Heat` also have a value."""
    for panel in figure.panels:
        for curve in panel.curves:
            for x, y in zip(curve.x, curve.y, strict=True):
                yield panel.title, curve.label, float(x), float(y), ""
        if (heat := panel.heat) is not None:
            for (row, column), value in np.ndenumerate(heat.values):
                yield panel.title, heat.label, float(heat.x[column]), float(heat.y[row]), float(value)
