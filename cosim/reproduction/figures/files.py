"""Files of a figure: drawn points, pictures, rows of expected and measured numbers."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from vcmvsp.cosim.reproduction.figures.figure import Figure
from vcmvsp.cosim.reproduction.row import COLUMNS, write_csv
from vcmvsp.cosim.util.files import to_json, write_whole, writing


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
