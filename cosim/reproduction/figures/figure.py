"""Content of a figure: panels with curves, and rows that compare measured with expected values.

A figure is a function ``make(runner: Runner) -> Figure`` in a module, listed in `cosim.reproduction.figures.NAMES`. It builds
scenarios as mappings and gives them to the runner as jobs; `drawing` draws the result.
"""

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Literal

from vcmvsp.cosim.reproduction.row import Row
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util.files import to_json
from vcmvsp.cosim.util.text import aligned

# "dots": many small markers; "pose": a track with its two ends
Style = Literal["line", "dashed", "dotted", "thin", "markers", "dots", "hollow", "pose", "both"]


@dataclass(frozen=True)
class Curve:
    """A set of points (n,); the legend shows one of the curves with equal ``label`` in a panel."""

    x: Array
    y: Array
    label: str = ""
    color: int = 0  # of the palette: 0 black, 1 blue, 2 vermilion, 3 green, 4 purple, 5 orange, 6 sky blue
    style: Style = "line"


@dataclass(frozen=True)
class Heat:
    """Values over a grid: ``values[i, j]`` belongs to ``y[i]``, ``x[j]``; cells show their numbers, except in a map."""

    x: Array
    y: Array
    values: Array  # (len(y), len(x))
    label: str = ""
    # "about one": which side of 1 is shown by colour; "map": equal steps, values from 0 to 1, curves of the panel above it
    style: Literal["growing", "about one", "map"] = "growing"


@dataclass(frozen=True)
class Photo:
    """A picture, (h, w, 3) uint8, below the curves; the centre of its first pixel, at the top left, is (0, 0)."""

    pixels: Array


@dataclass(frozen=True)
class Panel:
    """A pair of axes with curves, or a `Heat`, or curves on a `Photo`."""

    title: str
    x_label: str
    y_label: str
    curves: Sequence[Curve] = ()
    _: KW_ONLY
    heat: Heat | None = None
    photo: Photo | None = None
    levels: Mapping[str, float | tuple[float, float]] = field(default_factory=dict)  # horizontal lines, by label
    log_x: bool = False
    log_y: bool = False
    equal: bool = False  # equal scale on both axes: a map
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


def table(figure: Figure) -> str:
    """The rows as an aligned text table, each marked ``ok`` or ``MISSED``."""
    lines: list[tuple[str, ...]] = [("case", "expected", "measured", "tolerance", "")]
    lines += [(*row.cells, ("MISSED", "ok")[row.ok]) for row in figure.rows]
    return "".join(f"{line}\n" for line in aligned(lines, range(1, 4)))
