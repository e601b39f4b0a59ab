"""How every figure looks: one set of sizes, colours and marks, whatever the user's own matplotlibrc says.

Series are told apart twice, by colour and by line style or marker, so that they stay apart in grey, too. The colours
themselves are in `cosim.util.palette`.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import wraps
from typing import Any, ParamSpec

import matplotlib as mpl
from matplotlib.figure import Figure

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
    "svg.hashsalt": "vcmvsp",  # the same names inside for the same figure
}
MAP = {"axes.grid": False, "axes.spines.top": True, "axes.spines.right": True}
"""For `style`: of maps, which fill their axes."""
SVG = {"path.simplify": True, "path.simplify_threshold": 0.03, "savefig.dpi": 200}
"""For `style`: of drawings. Curves may be 0.03 pt off, which no screen shows; what is rasterised in them is fine enough."""
GREY = "0.55"
LEVEL: dict[str, Any] = {"color": GREY, "linestyle": "--", "linewidth": 0.9}
"""Of a line that marks a level: a limit, a threshold, what theory says."""
ABOVE: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "borderaxespad": 0.2, "columnspacing": 1.2}
"""Of a legend above its axes, where it hides nothing."""
MARKERS = "osD^v*XP"
_DASHES: tuple[Any, ...] = ("-", (0, (5.0, 1.6)), (0, (1.2, 1.4)), (0, (6.0, 1.5, 1.2, 1.5)))
P = ParamSpec("P")


@contextmanager
def style(more: Mapping[str, Any] | None = None) -> Iterator[None]:
    """Matplotlib's own defaults, `STYLE`, and ``more``."""
    with mpl.rc_context():
        mpl.rcdefaults()
        wanted: dict[Any, Any] = {**STYLE, **(more or {})}  # names that the library lists one by one
        mpl.rcParams.update(wanted)
        yield


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """A function that draws in this style."""

    @wraps(draw)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with style():
            return draw(*args, **kwargs)

    return drawn


def marker_of(index: int) -> str:
    """Marker of series ``index``."""
    return MARKERS[index % len(MARKERS)]


def line_of(index: int) -> dict[str, Any]:
    """Colour and line style of series ``index``, with a marker here and there: each round of colours has its own dashes."""
    return {
        "color": color_of(index),
        "linestyle": _DASHES[index // len(OKABE_ITO) % len(_DASHES)],
        "marker": marker_of(index),
        "markersize": 4.0,
        "markevery": (0.03 + 0.02 * (index % len(OKABE_ITO)), 0.17),  # of the axes' diagonal: of neighbours not at one place
    }
