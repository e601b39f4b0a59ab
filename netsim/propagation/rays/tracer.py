"""From pairs of points to the paths between them."""

from typing import Any, NamedTuple, get_type_hints

import numpy as np

from vcmvsp.cosim.compiled.machine_code import Core
from vcmvsp.netsim.interfaces.layers import Floats, Ints
from vcmvsp.netsim.propagation.rays import search
from vcmvsp.netsim.propagation.rays.search import CORNERS, FULL, LOOK, LOOK_FROM_SITES, NEXT, PASSES, PATHS, SOURCE, TRACE, Work
from vcmvsp.netsim.propagation.rays.world import RayWorld

CELL_M, STOREY_M = 8.0, 4.0  # size of the cells whose view is kept
CORE = (search,)
COMPILE_S = 8.0  # CPU time of interpreted search for which compiling pays
_CANDIDATE_S, _TARGET_S = 1e-5, 3e-5  # CPU time of one, interpreted
_PATHS = 1 << 10  # room at first
_CORNERS = 8  # of regions and targets

Cell = tuple[int, int, int]


class PathTable(NamedTuple):
    """n paths between pairs of points, with m passages through slabs; M is the greatest number of interactions."""

    pair: Ints  # (n,) never decreasing
    count: Ints  # (n,) interactions: reflections and diffractions
    element: Ints  # (n, M) facets, and edges as ``-1 - edge``
    point: Floats  # (n, M, 3) m
    pass_path: Ints  # (m,) never decreasing
    pass_leg: Ints  # (m,)
    pass_facet: Ints  # (m,)
    pass_at: Floats  # (m,) share of the leg


class Views:
    """What may be seen from the cells of the world and from its facets, each looked up once.

    A view is conservative: it leaves out only what no point of the cell, or of the facet, can see.
    """

    def __init__(self, facets: int) -> None:
        self.number: dict[Cell, int] = {}
        self.of_cell: list[tuple[Ints, Ints]] = []  # facets and edges
        self.of_facet: list[Ints | None] = [None] * facets
        self.cell_facets = self.cell_edges = starts_and_items([])
        self.rows = starts_and_items([np.zeros(0, np.int64)] * facets)


class Tracer:
    """The paths among the solids of a world.

    Args:
        world: what rays meet.
        reflections: greatest number of reflections.
        diffraction: whether edges diffract.
        transmission: whether slabs let waves pass.
    """

    def __init__(self, world: RayWorld, reflections: int, *, diffraction: bool, transmission: bool) -> None:
        self.world, self.reflections = world, reflections
        self._facets, self._edges = len(world.normal), len(world.edge_angle)
        self._views = Views(self._facets)
        self._work = _new_work(world, reflections, diffraction=diffraction, transmission=transmission)
        self._core = Core(CORE, world.terrain, self._work)

    def paths(self, a: Floats, b: Floats) -> PathTable:
        """All paths between points a (P, 3) m and b (P, 3) m, pair by pair; in a pair in the order of the search."""
        sites, of = np.unique(np.concatenate([a, b]), axis=0, return_inverse=True)
        cells = self._look_from_cells(sites)
        views = self._views
        (facet_first, facets), (edge_first, edges) = views.cell_facets, views.cell_edges
        most_facets, most_edges = int(np.diff(facet_first)[cells].sum()), int(np.diff(edge_first)[cells].sum())
        columns = {f"site_{axis}": np.ascontiguousarray(sites[:, k]) for k, axis in enumerate("xyz")}
        s = self._work = self._work._replace(
            **columns,
            site_cell=cells,
            a=of.ravel()[: len(a)].copy(),
            b=of.ravel()[len(a) :].copy(),
            cell_facet_first=facet_first,
            cell_facet=facets,
            cell_edge_first=edge_first,
            cell_edge=edges,
            site_facet_first=np.zeros(len(sites) + 1, np.int64),
            site_facet=np.zeros(most_facets, np.int64),
            site_edge_first=np.zeros(len(sites) + 1, np.int64),
            site_edge=np.zeros(most_edges, np.int64),
            row_first=views.rows[0],
            row=views.rows[1],
        )
        s.counts[[NEXT, PATHS, PASSES]] = 0
        self._core.chosen(_TARGET_S * (most_facets + most_edges), COMPILE_S)(self.world.terrain, s, LOOK_FROM_SITES)
        run = self._core.chosen(self._work_s(s), COMPILE_S)
        while run(self.world.terrain, s, TRACE) == FULL:
            s = self._work = self._larger(s)
        return self._table(s)

    def _work_s(self, s: Work) -> float:
        """Estimated CPU time of the interpreted search, s."""
        facets, edges = np.diff(s.site_facet_first).astype(float), np.diff(s.site_edge_first).astype(float)
        candidates = edges[s.a]
        if self.reflections > 0:
            candidates = candidates + facets[s.a] + s.diffraction * (facets[s.a] * edges[s.b] + facets[s.b] * edges[s.a])
        if self.reflections > 1:
            candidates = candidates + facets[s.a] * facets[s.b]
        return _CANDIDATE_S * float(candidates.sum())

    def _larger(self, s: Work) -> Work:
        names = [name for name in Work._fields if name.startswith(("path_", "pass_"))]
        return s._replace(**{name: np.concatenate([getattr(s, name), np.zeros_like(getattr(s, name))]) for name in names})

    def _table(self, s: Work) -> PathTable:
        n, m, most = int(s.counts[PATHS]), int(s.counts[PASSES]), max(self.reflections, 2)
        point = np.stack([each[: n * most].reshape(n, most) for each in (s.path_x, s.path_y, s.path_z)], axis=-1)
        element = s.path_element[: n * most].reshape(n, most).copy()
        columns = [each[:m].copy() for each in (s.pass_path, s.pass_leg, s.pass_facet, s.pass_at)]
        order = np.lexsort((columns[3], columns[1], columns[0]))
        return PathTable(s.path_pair[:n].copy(), s.path_count[:n].copy(), element, point, *(each[order] for each in columns))

    # --- views ---

    def _look_from_cells(self, sites: Floats) -> Ints:
        """The cell of each site, (n,); looks from all cells, and facets, that are needed for the first time."""
        views = self._views
        numbers = np.floor(sites / (CELL_M, CELL_M, STOREY_M)).astype(np.int64)
        cells: list[Cell] = [(x, y, z) for x, y, z in numbers.tolist()]
        new = [cell for cell in dict.fromkeys(cells) if cell not in views.number]
        for cell in new:
            views.number[cell] = len(views.of_cell)
            views.of_cell.append(self._seen_from(_box_of(cell), -1))
        if new:
            views.cell_facets = starts_and_items([facets for facets, _ in views.of_cell])
            views.cell_edges = starts_and_items([edges for _, edges in views.of_cell])
            self._look_from_facets([facets for facets, _ in views.of_cell[-len(new) :]])
        return np.array([views.number[cell] for cell in cells], np.int64)

    def _look_from_facets(self, reached: list[Ints]) -> None:
        """Facets that may be seen from these facets, and so on up to the last but one reflection."""
        views = self._views
        for _ in range(self.reflections - 2):
            every = np.unique(np.concatenate(reached)) if reached else np.zeros(0, np.int64)
            reached = []
            for facet in [each for each in every.tolist() if views.of_facet[each] is None]:
                seen, _edges = self._seen_from(self._corners(facet), facet)
                views.of_facet[facet] = seen
                reached.append(seen)
        if self.reflections > 2:
            nothing = np.zeros(0, np.int64)
            views.rows = starts_and_items([nothing if each is None else each for each in views.of_facet])

    def _corners(self, facet: int) -> Floats:
        first = self.world.terrain.facet_first
        corner = np.stack([self.world.terrain.corner_x, self.world.terrain.corner_y, self.world.terrain.corner_z], axis=-1)
        found = corner[first[facet] : first[facet + 1]]
        if len(found) <= _CORNERS:
            return found
        return found[:0]  # of many corners, e.g. the top of a cylinder: as if it were everywhere

    def _seen_from(self, corners: Floats, facet: int) -> tuple[Ints, Ints]:
        """Facets and edges that may be seen from the hull of some corners."""
        s = self._work
        for each, column in zip((s.region_x, s.region_y, s.region_z), corners.T, strict=True):
            each[: len(column)] = column
        s.counts[[SOURCE, CORNERS]] = facet, len(corners)
        run = self._core.chosen(_TARGET_S * (self._facets + self._edges), COMPILE_S)
        run(self.world.terrain, s, LOOK)
        return np.flatnonzero(s.facet_seen), np.flatnonzero(s.edge_seen)


def _box_of(cell: Cell) -> Floats:
    """Corners of a cell, (8, 3) m."""
    low = np.array(cell) * (CELL_M, CELL_M, STOREY_M)
    steps = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    return np.asarray(low + steps * (CELL_M, CELL_M, STOREY_M))


def starts_and_items(parts: list[Ints]) -> tuple[Ints, Ints]:
    """Parts one after another: where each begins, and the whole."""
    first = np.concatenate([[0], np.cumsum([len(part) for part in parts])]).astype(np.int64)
    return first, np.concatenate([np.zeros(0, np.int64), *parts])


def _new_work(world: RayWorld, reflections: int, *, diffraction: bool, transmission: bool) -> Work:
    """A work with nothing to do yet."""
    facets, edges, bodies = len(world.normal), len(world.edge_angle), len(world.terrain.bottom)
    depth, most = max(reflections, 2) + 2, max(reflections, 2)
    sizes: dict[str, int] = {
        "counts": 8,
        "facet_mark": facets,
        "edge_mark": edges,
        "facet_leg": facets,
        "body_leg": bodies,
        "cell": 6,
        "share": 5,
        **{f"{name}_{axis}": size for name, size in (("end", 2), ("image", depth), ("point", depth)) for axis in "xyz"},
        **{f"{name}_{axis}": _CORNERS for name in ("region", "target") for axis in "xyz"},
        "side_x": 2,
        "side_y": 2,
        "chosen": depth,
        "place": depth,
        "facet_seen": facets,
        "edge_seen": edges,
        **dict.fromkeys(("path_pair", "path_count", "pass_path", "pass_leg", "pass_facet", "pass_at"), _PATHS),
        **dict.fromkeys(("path_element", "path_x", "path_y", "path_z"), _PATHS * most),
    }
    fields: dict[str, Any] = {
        name: np.zeros(sizes.get(name, 0), np.float64 if kind == Floats else np.int64)
        for name, kind in get_type_hints(Work).items()
    }
    return Work(
        **{**fields, "reflections": reflections, "diffraction": int(diffraction), "transmission": int(transmission)},
    )


def legs_of(table: PathTable, a: Floats, b: Floats) -> Floats:
    """Points of the paths with both ends, (n, M + 2, 3) m; behind the end it is repeated."""
    n, most = table.element.shape
    points = np.empty((n, most + 2, 3))
    points[:, 0] = a[table.pair]
    points[:, 1:-1] = table.point
    points[:, -1] = b[table.pair]
    for k in range(most):
        done = table.count <= k
        points[done, k + 1] = points[done, -1]
    return points


def lengths_of(points: Floats) -> Floats:
    """Lengths of the legs, (n, M + 1) m."""
    runs = np.diff(points, axis=1)
    return np.sqrt((runs * runs).sum(axis=2))
