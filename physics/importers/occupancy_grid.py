"""Occupancy grids of ROS (`map_server`): a picture of a floor plan and a YAML file beside it, raised to walls."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.frames import rotate2
from vcmvsp.cosim.types import Array, FileName, Positive
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.util.documents import DEEPEST
from vcmvsp.physics.importers.files import library, require_file, text_of
from vcmvsp.physics.world.floor import read_picture
from vcmvsp.physics.world.solids import Box, Color
from vcmvsp.physics.world.world import World
from vcmvsp.physics.worlds.surroundings import Bounds, Surroundings

_MOST_M = 1e9  # limit of coordinates of a map, and of the size of its cells

Block = tuple[int, int, int, int]  # first row, end row, first column, end column


@dataclass(frozen=True, kw_only=True)
class Map(Surroundings):
    """Walls from an occupancy grid of ROS (kind ``map``): its ``map.yaml`` names the picture, PGM or PNG.

    A cell is a wall if its occupancy, ``(255 - v) / 255`` of the grey value v or, with ``negate``, ``v / 255``, exceeds
    ``occupied_thresh`` (http://wiki.ros.org/map_server). Walls become few boxes, each an obstacle to the radio.
    """

    path: FileName  # of the YAML file
    height: Positive = 2.0  # of the walls, m
    material: str = "concrete"  # of the walls
    color: Color | None = None  # of the walls; None: that of the material

    def __post_init__(self) -> None:
        super().__post_init__()
        require_file(self.path)

    def files(self) -> tuple[Path, ...]:
        """The picture that the YAML file names."""
        return (_read_yaml(Path(self.path))["image"],)

    def build(self) -> World:
        """Build the world from the map.

        Raises:
            ScenarioError: with the file that is wrong.
        """
        path = Path(self.path)
        about = _read_yaml(path)
        cells = occupied_cells(about, path)
        resolution, (x, y, yaw) = about["resolution"], about["origin"]
        rows, columns = cells.shape

        def place(east: float, north: float) -> tuple[float, float]:
            """Transform from the picture's lower left corner to the world."""
            u, v = rotate2(east, north, yaw)
            return x + u, y + v

        solids, look = [], {"yaw_rad": yaw, "material": self.material, "color": self.color}
        for top, bottom, left, right in blocks_of(cells):
            center = place(0.5 * (left + right) * resolution, (rows - 0.5 * (top + bottom)) * resolution)
            size = ((right - left) * resolution, (bottom - top) * resolution, self.height)
            solids.append(Box(center=(*center, 0.5 * self.height), size=size, **look))
        corners = [place(u * columns * resolution, v * rows * resolution) for u in (0, 1) for v in (0, 1)]
        bounds: Bounds = (*map(min, zip(*corners, strict=True)), *map(max, zip(*corners, strict=True)))
        return self.complete(path.stem, solids=solids, bounds=bounds)


def _read_yaml(path: Path) -> dict[str, Any]:
    yaml = library("yaml", str(path), "pyyaml")
    try:
        text = text_of(path)
        _check_yaml(text, yaml)
        content = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError) as error:  # the latter for impossible dates
        raise ScenarioError(f"is not YAML: {error}", source=str(path)) from error
    if not isinstance(content, dict):
        raise ScenarioError("is not a map: it needs image, resolution and origin", source=str(path))

    def number(key: str, default: float | None, low: float, high: float) -> float:
        value = content.get(key, default)
        if isinstance(value, bool) and key == "negate":
            value = int(value)
        if isinstance(value, bool) or not isinstance(value, int | float) or not low < value < high:
            raise ScenarioError(f"must be a number above {low:g} and below {high:g}, not {value!r}", key=key, source=str(path))
        return float(value)

    origin = content.get("origin")
    numbers = isinstance(origin, list) and len(origin) == 3 and all(isinstance(each, int | float) for each in origin)
    if not numbers or not all(abs(each) < _MOST_M for each in origin or ()):
        problem = f"must be [x m, y m, yaw rad] of the lower left corner, not {origin!r}"
        raise ScenarioError(problem, key="origin", source=str(path))
    if not isinstance(content.get("image"), str):
        raise ScenarioError("must be the name of the picture file", key="image", source=str(path))
    if content.get("mode", "trinary") not in ("trinary", "scale"):
        raise ScenarioError(f"must be trinary or scale, not {content['mode']!r}", key="mode", source=str(path))
    return {
        "image": path.parent / content["image"],
        "resolution": number("resolution", None, 0.0, _MOST_M),
        "origin": tuple(map(float, origin or ())),
        "negate": number("negate", 0, -1.0, 2.0) != 0.0,
        "occupied_thresh": number("occupied_thresh", 0.65, -1e-9, 1.0 + 1e-9),
    }


def _check_yaml(text: str, yaml: Any) -> None:
    """Refuse (`ValueError`) YAML that is slow to parse, and aliases, which may expand to gigabytes."""
    limits.within(len(text), limits.YAML_BYTES, "characters of YAML")
    depth = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > DEEPEST or isinstance(event, yaml.AliasEvent):
            raise ValueError("nested too deeply, or with an alias")


def occupied_cells(about: dict[str, Any], path: Path) -> Array:
    """Whether each cell is a wall, (rows, columns) bool; row 0 is at the top of the picture.

    Raises:
        ScenarioError: the picture cannot be read.
    """
    try:
        picture = read_picture(str(about["image"]))
    except ValueError as error:
        raise ScenarioError(str(error), key="image", source=str(path)) from error
    cells: Array = np.empty(picture.shape[:2], bool)
    for row, pixels in zip(cells, picture, strict=True):  # row by row: all floats of a large picture would fill the memory
        grey = pixels.mean(axis=1)
        row[:] = (grey if about["negate"] else 255.0 - grey) / 255.0 > about["occupied_thresh"]
    return cells


def blocks_of(cells: Array) -> list[Block]:
    """Cover of all true cells by few disjoint rectangles: equal runs of consecutive rows, or of columns."""
    by_rows, by_columns = list(_runs(cells)), list(_runs(cells.T))
    turned = [(top, bottom, left, right) for left, right, top, bottom in by_columns]
    return by_rows if len(by_rows) <= len(by_columns) else turned


def _runs(cells: Array) -> Iterator[Block]:
    open_: dict[tuple[int, int], int] = {}  # run of columns -> the row where it began
    edges = np.diff(np.pad(cells.astype(np.int8), ((0, 1), (1, 1))), axis=1)
    for row, edge in enumerate(edges):
        if 0 < row < len(cells) and np.array_equal(edge, edges[row - 1]):
            continue
        runs = dict.fromkeys(zip(np.flatnonzero(edge > 0).tolist(), np.flatnonzero(edge < 0).tolist(), strict=True))
        for run in [run for run in open_ if run not in runs]:
            yield open_.pop(run), row, *run
        for run in runs:
            open_.setdefault(run, row)
