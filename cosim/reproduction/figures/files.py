"""What a figure leaves: the points that are drawn, the pictures, and the rows of expected and measured numbers."""

import csv
from pathlib import Path

from vcmvsp.cosim.reproduction.figures.figure import Figure
from vcmvsp.cosim.util.files import replacing, to_json, write_whole, writing


def as_json(name: str, figure: Figure) -> str:
    """The rows of a figure: ``name`` and ``rows`` of ``case``, ``expected``, ``measured``, ``tolerance``, ``ok``."""
    return to_json({"name": name, "rows": [row.plain for row in figure.rows]})


def write(name: str, figure: Figure, folder: Path) -> list[Path]:
    """Write NAME.csv, NAME-expected.csv, NAME.json, NAME.png and NAME.svg; the answer is where they are."""
    from vcmvsp.cosim.plots import style
    from vcmvsp.cosim.reproduction.figures import drawing

    points, expected, rows = (folder / f"{name}{end}" for end in (".csv", "-expected.csv", ".json"))
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        _write_points(points, figure)
        _write_rows(expected, figure)
        write_whole(rows, as_json(name, figure))
        return [points, expected, rows, *style.save(drawing.draw(figure), folder / name)]


def table(figure: Figure) -> str:
    """The rows as lines of a text: what was expected, what came out, and whether that is within the tolerance."""
    lines: list[tuple[str, ...]] = [("case", "expected", "measured", "tolerance", "")]
    lines += [(*row.cells, "ok" if row.ok else "MISSED") for row in figure.rows]
    widths = [max(len(line[column]) for line in lines) for column in range(5)]
    text = [
        "  ".join([line[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(line[1:4], widths[1:4], strict=True))])
        + (f"  {line[4]}" if line[4] else "")
        for line in lines
    ]
    return "\n".join(text) + "\n"


def _write_points(path: Path, figure: Figure) -> None:
    """A line per point: panel, curve, x, y; of a map its value too."""
    with replacing(path) as place, place.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("panel", "curve", "x", "y", "value"))
        for panel in figure.panels:
            for curve in panel.curves:
                pairs = zip(curve.x, curve.y, strict=True)
                writer.writerows((panel.title, curve.label, float(x), float(y), "") for x, y in pairs)
            if (heat := panel.heat) is not None:
                cells = ((x, y, heat.values[i, j]) for i, y in enumerate(heat.y) for j, x in enumerate(heat.x))
                writer.writerows((panel.title, heat.label, float(x), float(y), float(value)) for x, y, value in cells)


def _write_rows(path: Path, figure: Figure) -> None:
    with replacing(path) as place, place.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("case", "expected", "measured", "tolerance", "ok"))
        writer.writerows((row.case, row.expected, row.measured, row.tolerance, str(row.ok).lower()) for row in figure.rows)
