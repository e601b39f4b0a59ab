"""The map of a searching vehicle: own looks, received ones, and sure targets."""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from vcmvsp.agents.reconnaissance.exchange import Body, MapExchange
from vcmvsp.agents.reconnaissance.probability_map import TARGET, Grid, decisions, log_odds, probability
from vcmvsp.agents.reconnaissance.watch import WatchFrame
from vcmvsp.cosim.agent import Observation
from vcmvsp.cosim.types import Array, Looks, ProbabilityMap, frozen

Point = tuple[float, float]

OPEN = 0.1  # of the cells along a lane: at most this share is open after one pass
SAME_M, SAME_CELLS = 3.0, 2.0  # cells within the greater of both distances of a place belong to the target there


class Blob(NamedTuple):
    """Adjacent cells (by edge or corner) that count as targets: assumed to be one target."""

    cells: Array  # (n,) ascending
    middle: Point  # their centroid, m, world
    odds: float  # log-odds of the surest


class SearchMap:
    """A map with the cells of a grid, which is shared by an exchange."""

    def __init__(self, grid: Grid, mind: MapExchange) -> None:
        self.grid, self._mind = grid, mind
        self._seen = np.zeros(grid.rows * grid.columns, bool)
        self._same_m = max(SAME_M, SAME_CELLS * grid.cell)
        self._odds: Array | None = None
        self._blobs: Sequence[Blob] | None = None

    def hear(self, obs: Observation) -> None:
        """Merge maps from messages; other messages are ignored."""
        accepted = [self._mind.take(each.message.sender, each.message.body, obs.clock_ns) for each in obs.heard]
        if any(accepted):
            self._changed()

    def look(self, cells: Array, hits: Array, now_ns: int) -> None:
        """Add own looks: cells (n,), each at most once, and whether each look was a detection."""
        self._mind.look(cells, hits, now_ns)
        self._seen[cells] = True
        self._changed()

    def messages(self, now_ns: int, most: int) -> list[Body]:
        """Messages of the map to send now."""
        return self._mind.messages(now_ns, most)

    @property
    def odds(self) -> Array:
        """Log-odds of a target, (rows, columns)."""
        if self._odds is None:
            self._odds = self._mind.log_odds
        return self._odds

    @property
    def blobs(self) -> Sequence[Blob]:
        """All probable targets, the surest first."""
        if self._blobs is None:
            self._blobs = _blobs(self.grid, self.odds)
        return self._blobs

    def surest(self, apart: Iterable[Point]) -> tuple[float, Point | None]:
        """Probability of the surest cell away from some places, and the place of its target, if it counts as one."""
        places = tuple(apart)
        for blob in self.blobs:
            if not self.concerns(blob, places):
                return float(probability(np.array(blob.odds))), blob.middle
        open_ones = np.where(decisions(self.odds) == 1, -math.inf, self.odds).ravel()
        for x, y in places:
            open_ones[self.grid.within(x, y, self._same_m)] = -math.inf
        return float(probability(open_ones.max())), None

    def concerns(self, blob: Blob, places: Sequence[Point]) -> bool:
        """Whether one of these places is the target of a blob: it is near one of the cells."""
        if not places:
            return False
        offset = self.grid.centres(blob.cells)[:, None] - np.array(places, float)
        return bool((np.hypot(offset[..., 0], offset[..., 1]) <= self._same_m).any())

    def is_open(self, start: Point, end: Point, swath: float) -> bool:
        """Whether many cells within a distance of a line, m, are undecided."""
        (x0, y0), (x1, y1) = start, end
        length = math.dist(start, end)
        along = (1.0, 0.0) if length == 0.0 else ((x1 - x0) / length, (y1 - y0) / length)
        u, v = swath * along[0], swath * along[1]
        corners = [(x0 - u + v, y0 - v - u), (x1 + u + v, y1 + v - u), (x1 + u - v, y1 + v + u), (x0 - u - v, y0 - v + u)]
        cells = self.grid.inside(np.array(corners))
        return len(cells) > 0 and bool(np.mean(decisions(self.odds).ravel()[cells] == 0) > OPEN)

    def for_recording(self) -> ProbabilityMap:
        """The map as it is recorded."""
        area, shape = self.grid.area, (self.grid.rows, self.grid.columns)
        return ProbabilityMap(
            left=area.left,
            bottom=area.bottom,
            cell_m=self.grid.cell,
            probability=frozen(np.rint(255.0 * probability(self.odds)), np.uint8),
            seen=frozen(self._seen.reshape(shape)),
        )

    def _changed(self) -> None:
        self._odds = self._blobs = None


def of_reading(grid: Grid, looks: Looks) -> tuple[Array, Array]:
    """Cells of a detector's reading, (n,), and the results, (n,) bool; its cells must have the size of the map's cells."""
    if not math.isclose(looks.cell_m, grid.cell):
        raise ValueError(f"cell_m = {grid.cell:g} must equal the cell size of the sensor, {looks.cell_m:g} m")
    # Cell (0, 0) of the sensor has its middle in this column and row, which is the same step for all: no two become one.
    left, bottom = (math.floor(0.5 - edge / grid.cell) for edge in (grid.area.left, grid.area.bottom))
    columns, rows = looks.cells[:, 0].astype(np.intp) + left, looks.cells[:, 1].astype(np.intp) + bottom
    inside = (columns >= 0) & (columns < grid.columns) & (rows >= 0) & (rows < grid.rows)
    return (rows * grid.columns + columns)[inside], looks.hits[inside]


def of_picture(grid: Grid, frame: WatchFrame) -> tuple[Array, Array]:
    """Cells that a picture shows, (n,), and whether a target was recognised in each, (n,) bool."""
    cells = grid.inside(np.array(frame.footprint or (), float))
    target_cells = [cell for each in frame.sightings if (cell := grid.at(*each.place)) is not None]
    return cells, np.isin(cells, target_cells)


def swaths_m(frame: WatchFrame, height_m: float) -> Point | None:
    """Visible distance of a camera to both sides, along x and along y, from a height, m, world.

    Computed from a picture at another height; None: it shows no ground, or not the place below.
    """
    corners, nadir = frame.footprint, frame.nadir
    if corners is None:
        return None
    x, y, _ = nadir.position
    along_x, along_y = [], []
    for (a, b), (c, d) in zip(corners, (*corners[1:], corners[0]), strict=True):
        inwards = (c - a) * (y - b) - (d - b) * (x - a)  # > 0: on the left of this edge, as all that is seen
        if inwards <= 0.0:
            return None
        along_x += [inwards / abs(d - b)] if b != d else []  # to the line of this edge
        along_y += [inwards / abs(c - a)] if a != c else []
    share = (height_m - nadir.ground_m) / nadir.height_m
    return share * min(along_x), share * min(along_y)


def _blobs(grid: Grid, odds: Array) -> list[Blob]:
    """Connected sure cells, the surest first; of equal ones the south-western first."""
    held = odds > log_odds(TARGET)
    if not held.any():
        return []
    from scipy.ndimage import label  # takes long to load

    labels, count = label(held, structure=np.ones((3, 3)))
    cells, flat = np.flatnonzero(held), odds.ravel()
    cells = cells[np.argsort(labels.ravel()[cells], kind="stable")]
    ends = np.cumsum(np.bincount(labels.ravel(), minlength=count + 1)[1:])[:-1]
    blobs: list[Blob] = []
    for of_it in np.split(cells, ends):
        x, y = grid.centres(of_it).mean(axis=0).tolist()
        blobs.append(Blob(of_it, (x, y), float(flat[of_it].max())))
    return sorted(blobs, key=lambda blob: (-blob.odds, int(blob.cells[0])))
