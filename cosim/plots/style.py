"""Style of all figures, independent of the user's matplotlibrc, and output as PNG, SVG and PDF.

Series differ in colour and in line style or marker, so that they can be told apart in grey. The colours are in
`cosim.util.palette`. Files contain no date, library version or global state: the same figure gives the same bytes.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import wraps
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any, ParamSpec

import matplotlib as mpl
import numpy as np
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.collections import Collection, QuadMesh
from matplotlib.figure import Figure
from matplotlib.layout_engine import PlaceHolderLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter

from vcmvsp.cosim.util.files import replacing, write_whole
from vcmvsp.cosim.util.palette import OKABE_ITO, color_of

DPI = 120
STYLE: dict[str, Any] = {
    "figure.dpi": DPI,
    "savefig.dpi": DPI,
    "font.size": 9,
    "axes.titlesize": 10,
    "figure.titlesize": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "0.9",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.2,
    "path.simplify": False,  # it turns circles into polygons
    "legend.frameon": False,
    "legend.fontsize": 8,
    "svg.fonttype": "none",  # text stays text
    "svg.hashsalt": "vcmvsp",  # deterministic identifiers
}
MAP = {"axes.grid": False, "axes.spines.top": True, "axes.spines.right": True}
"""Parameters for `style`: maps, which fill their axes."""
SVG = {"path.simplify": True, "path.simplify_threshold": 0.03, "savefig.dpi": 200}
"""Parameters for `style`: drawings. Curves may deviate by 0.03 pt, which is invisible; rasterised parts are fine enough."""
GREY = "0.55"
LEVEL: dict[str, Any] = {"color": GREY, "linestyle": "--", "linewidth": 0.9}
"""Style of a line at a fixed level: a limit, a threshold, a theoretical value."""
ABOVE: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "borderaxespad": 0.2, "columnspacing": 1.2}
"""Position of a legend above its axes, where it hides nothing."""
MARKERS = "osD^v*XP"
_DASHES: tuple[Any, ...] = ("-", (0, (5.0, 1.6)), (0, (1.2, 1.4)), (0, (6.0, 1.5, 1.2, 1.5)))
DENSE = 1000  # curves or collections with more parts become pictures within a drawing
FINE = 100  # grid cells; smaller cells would show seams
_PATH = re.compile(r'(<path [^>]*?\bd=")([^"]*)')
_NUMBER = re.compile(r"-?\d+\.\d{3,}")
P = ParamSpec("P")


@contextmanager
def style(more: Mapping[str, Any] | None = None) -> Iterator[None]:
    """Context with Matplotlib's defaults, `STYLE`, and ``more``."""
    with mpl.rc_context():
        mpl.rcdefaults()
        settings: dict[Any, Any] = {**STYLE, **(more or {})}  # the library's types list the names one by one
        mpl.rcParams.update(settings)
        yield


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Decorator: draw the figure in this style."""

    @wraps(draw)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with style():
            return draw(*args, **kwargs)

    return drawn


def marker_of(index: int) -> str:
    """Marker of series ``index``."""
    return MARKERS[index % len(MARKERS)]


def line_of(index: int) -> dict[str, Any]:
    """Colour, line style and sparse markers of series ``index``: each round of colours has its own dashes."""
    return {
        "color": color_of(index),
        "linestyle": _DASHES[index // len(OKABE_ITO) % len(_DASHES)],
        "marker": marker_of(index),
        "markersize": 4.0,
        "markevery": (0.03 + 0.02 * (index % len(OKABE_ITO)), 0.17),  # share of the axes' diagonal; different for neighbours
    }


def save_png(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG: the same bytes for the same figure."""
    write_whole(Path(path), png(figure))


def png(figure: Figure) -> bytes:
    """A figure as the content of a PNG file, without date and library version."""
    stream = BytesIO()
    with style():
        _laid_out(figure).print_png(stream, metadata={"Software": None})  # type: ignore[no-untyped-call]
    return stream.getvalue()


def save_svg(figure: Figure, path: str | Path) -> None:
    """Write a figure as SVG: the same bytes for the same figure."""
    write_whole(Path(path), svg(figure))


def save_pdf(figure: Figure, path: str | Path) -> None:
    """Write a figure as PDF, with its texts as text: the same bytes for the same figure."""
    from matplotlib.backends.backend_pdf import FigureCanvasPdf  # loads fontTools, a third of a second

    with style({**SVG, "pdf.fonttype": 42}):
        _laid_out(figure)
        _make_light(figure)
        with replacing(Path(path)) as place:
            canvas = FigureCanvasPdf(figure)
            canvas.print_pdf(str(place), metadata=dict.fromkeys(("Creator", "Producer", "CreationDate")))  # type: ignore[no-untyped-call]


SAVE: Mapping[str, Callable[[Figure, Path], None]] = {"png": save_png, "svg": save_svg, "pdf": save_pdf}
"""Writers of a figure, by the kind of file."""


def svg(figure: Figure) -> str:
    """A figure as SVG text, deterministic: text as text, dense parts as a picture."""
    with style(SVG):
        _laid_out(figure)
        _make_light(figure)
        stream = StringIO()
        dpi, figure.dpi = figure.dpi, SVG["savefig.dpi"]  # as savefig does, which draws everything twice
        canvas = FigureCanvasSVG(figure)
        canvas.print_svg(stream, metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))  # type: ignore[no-untyped-call]
        figure.dpi = dpi
    return _PATH.sub(_shorter, stream.getvalue())


def plain_numbers(axis: Axis) -> None:
    """Labels 0.1, 0.2, 0.5, 1 on a logarithmic axis of few decades."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def save(figure: Figure, stem: Path, kinds: Sequence[str] = tuple(SAVE)) -> list[Path]:
    """Write a figure as ``stem``.png, ``stem``.svg and ``stem``.pdf, or as some of these kinds; returns the files."""
    paths = [stem.with_name(f"{stem.name}.{kind}") for kind in kinds]
    for kind, path in zip(kinds, paths, strict=True):
        SAVE[kind](figure, path)
    return paths


def _laid_out(figure: Figure) -> FigureCanvasAgg:
    """Create a canvas and compute the layout once, in the current style, so that the output is deterministic."""
    canvas = FigureCanvasAgg(figure)
    engine = figure.get_layout_engine()
    if engine is not None and not isinstance(engine, PlaceHolderLayoutEngine):
        engine.execute(figure)
        figure.set_layout_engine("none")
        for axes in figure.axes:  # the last bit of a position varies between runs
            left, bottom, width, height = (round(edge, 6) for edge in axes.get_position().bounds)
            axes.set_position((left, bottom, width, height))
    for line in figure.findobj(Line2D):
        line.recache(always=True)
    return canvas


def _make_light(figure: Figure) -> None:
    for line in figure.findobj(Line2D):
        line.set_rasterized(np.size(line.get_xdata()) > DENSE and line.get_marker() not in ("", "None"))
    for collection in figure.findobj(Collection):
        most = FINE if isinstance(collection, QuadMesh) else DENSE
        collection.set_rasterized(len(collection.get_paths()) > most)


def _shorter(match: re.Match[str]) -> str:
    numbers = _NUMBER.sub(lambda number: f"{float(number[0]):.2f}".rstrip("0").rstrip("."), match[2])
    return f"{match[1]}{numbers}"
