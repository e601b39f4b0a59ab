"""Figures as PNG and SVG files, without date, library version or global state: the same figure gives the same bytes."""

import re
from io import StringIO
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.collections import Collection, QuadMesh
from matplotlib.figure import Figure
from matplotlib.layout_engine import PlaceHolderLayoutEngine
from matplotlib.lines import Line2D

from vcmvsp.cosim.plots.style import SVG, style

DENSE = 1000  # marks of a curve, or pieces of a collection: more than this are a picture within a drawing
FINE = 100  # cells of a grid, likewise: between finer ones seams would show


def save_png(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG: no date, no library version inside."""
    with style():
        canvas = _laid_out(figure)
        canvas.print_png(str(path), metadata={"Software": None})  # type: ignore[no-untyped-call]


def save_svg(figure: Figure, path: str | Path) -> None:
    """Write a figure as SVG: the same bytes for the same figure."""
    Path(path).write_text(svg(figure), "utf-8")


def svg(figure: Figure) -> str:
    """A figure as the text of an SVG file: the same for the same figure, text as text, of dense parts a picture."""
    with style(SVG):
        _laid_out(figure)
        _make_light(figure)
        stream = StringIO()
        dpi, figure.dpi = figure.dpi, SVG["savefig.dpi"]  # as savefig does, which draws everything twice
        canvas = FigureCanvasSVG(figure)
        canvas.print_svg(stream, metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))  # type: ignore[no-untyped-call]
        figure.dpi = dpi
    return _PATH.sub(_shorter, stream.getvalue())


def save(figure: Figure, stem: Path) -> list[Path]:
    """Write ``stem``.png and ``stem``.svg."""
    png, drawing = (stem.with_name(f"{stem.name}.{kind}") for kind in ("png", "svg"))
    save_png(figure, png)
    save_svg(figure, drawing)
    return [png, drawing]


def _laid_out(figure: Figure) -> FigureCanvasAgg:
    """A canvas for a figure that is drawn in the style of now, its layout worked out once: then nothing is left to chance."""
    canvas = FigureCanvasAgg(figure)
    engine = figure.get_layout_engine()
    if engine is not None and not isinstance(engine, PlaceHolderLayoutEngine):
        engine.execute(figure)
        figure.set_layout_engine("none")
        for axes in figure.axes:  # the last bit of a position differs from time to time
            left, bottom, width, height = (round(edge, 6) for edge in axes.get_position().bounds)
            axes.set_position((left, bottom, width, height))
    for line in figure.findobj(Line2D):
        line.recache(always=True)
    return canvas


def _make_light(figure: Figure) -> None:
    """Let what is dense be a picture within a drawing."""
    for line in figure.findobj(Line2D):
        line.set_rasterized(np.size(line.get_xdata()) > DENSE and line.get_marker() not in ("", "None"))
    for collection in figure.findobj(Collection):
        most = FINE if isinstance(collection, QuadMesh) else DENSE
        collection.set_rasterized(len(collection.get_paths()) > most)


_PATH = re.compile(r'(<path [^>]*?\bd=")([^"]*)')
_NUMBER = re.compile(r"-?\d+\.\d{3,}")


def _shorter(found: re.Match[str]) -> str:
    """A path with coordinates to the hundredth of a point."""
    numbers = _NUMBER.sub(lambda number: f"{float(number[0]):.2f}".rstrip("0").rstrip("."), found[2])
    return f"{found[1]}{numbers}"
