"""From pairs of points to the paths between them."""

import itertools
from collections.abc import Iterable
from typing import Any, NamedTuple, get_type_hints

import numpy as np

from vcmvsp.cosim.compiled.machine_code import Core, available
from vcmvsp.netsim.interfaces.layers import Floats, Ints
from vcmvsp.netsim.propagation.rays import coefficients, field, search
from vcmvsp.netsim.propagation.rays.arrays import Complex, Work
from vcmvsp.netsim.propagation.rays.search import (
    BEAMS,
    CORNERS,
    FULL,
    LOOK,
    LOOK_FROM_SITES,
    NEXT,
    PASSES,
    PATHS,
    SOURCE,
    TRACE,
)
from vcmvsp.netsim.propagation.rays.world import RayWorld

CELL_M, STOREY_M = 8.0, 4.0  # size of the cells whose view is kept
CORE = (coefficients, field, search)
COMPILE_S = 10.0  # CPU time of interpreted search for which compiling pays
_CANDIDATE_S, _TARGET_S, _BEAM_S = 1.5e-5, 3e-5, 1e-6  # CPU time of one, interpreted
_PATHS, _BEAMS = 1 << 10, 1 << 14  # room at first
_MOST_PAIRS = 1 << 32  # of facets and what they may see, a byte each
_CORNERS = 8  # of regions and targets
_NUMBERS: dict[Any, type[np.float64]] = {Floats: np.float64}  # of the arrays of `Work`; others have integers

Cell = tuple[int, int, int]


class PathTable(NamedTuple):
    """n paths between pairs of points, with m passages through slabs; M is the greatest number of interactions."""

    pair: Ints  # (n,) never decreasing
    steps: Ints  # (n,) number of interactions: reflections and diffractions
    element: Ints  # (n, M) facets, and edges as ``-1 - edge``
    point: Floats  # (n, M, 3) m
    gain: Complex  # (n,) see `netsim.propagation.rays.field`
    length_m: Floats  # (n,)
    pass_path: Ints  # (m,) never decreasing
    pass_leg: Ints  # (m,)
    pass_facet: Ints  # (m,)
    pass_at: Floats  # (m,) share of the leg


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
        self._facets, self._edges = len(world.terrain.plane_at), len(world.terrain.angle)
        self._cells: dict[Cell, int] = {}  # numbers of the cells whose view is known
        self._views: list[Ints] = []  # of these: facets, and edges numbered behind all facets
        self._view_first, self._view_target = starts_and_items([])
        self._work = _new_work(world, reflections, diffraction=diffraction, transmission=transmission)
        self._core = Core(CORE, world.terrain, self._work)

    def prepare(self) -> None:
        """Compile the search now, if that is possible."""
        if available():
            _ = self._core.compiled

    def paths(self, a: Floats, b: Floats) -> PathTable:
        """All paths between points a (P, 3) m and b (P, 3) m, pair by pair; in a pair in the order of the search."""
        sites, of = np.unique(np.concatenate([a, b]), axis=0, return_inverse=True)
        cells = self._look_from_cells(sites)
        most = int(np.diff(self._view_first)[cells].sum())
        columns: dict[str, Any] = {f"site_{axis}": np.ascontiguousarray(sites[:, k]) for k, axis in enumerate("xyz")}
        s = self._work = self._work._replace(
            **columns,
            site_cell=cells,
            a=of.ravel()[: len(a)].copy(),
            b=of.ravel()[len(a) :].copy(),
            view_first=self._view_first,
            view_target=self._view_target,
            site_facet_first=np.zeros(len(sites) + 1, np.int64),
            site_facet=np.zeros(most, np.int64),
            site_edge_first=np.zeros(len(sites) + 1, np.int64),
            site_edge=np.zeros(most, np.int64),
        )
        self._core.chosen(_TARGET_S * most, COMPILE_S)(self.world.terrain, s, LOOK_FROM_SITES)
        if s.reflections and s.diffraction:
            s = self._find_beams(s)
        s.counts[[NEXT, PATHS, PASSES]] = 0
        run = self._core.chosen(self._work_s(s), COMPILE_S)
        while run(self.world.terrain, s, TRACE) == FULL:
            s = self._work = _doubled(s, [name for name in Work._fields if name.startswith(("path_", "pass_"))])
        return self._table(s)

    def _find_beams(self, s: Work) -> Work:
        """The work with the beams of all sites."""
        ends, others = np.concatenate([s.a, s.b]), np.concatenate([s.b, s.a])
        order = np.argsort(ends, kind="stable")
        partners = np.bincount(ends, minlength=len(s.site_x))
        facets, edges = np.diff(s.site_facet_first), np.diff(s.site_edge_first)
        expected = int((facets * np.bincount(ends, edges[others], len(facets)).clip(max=self._edges)).sum())
        s = self._work = s._replace(
            partner_first=np.concatenate([[0], np.cumsum(partners)]).astype(np.int64),
            partner=others[order],
            beam_first=np.zeros(int(s.site_facet_first[-1]) + 1, np.int64),
        )
        s.counts[NEXT] = 0
        run = self._core.chosen(_BEAM_S * expected, COMPILE_S)
        while run(self.world.terrain, s, BEAMS) == FULL:
            s = self._work = _doubled(s, ("beam_edge", "beam_at", "beam_apart"))
        return s

    def _work_s(self, s: Work) -> float:
        """Estimated CPU time of the interpreted search, s."""
        facets, edges = np.diff(s.site_facet_first).astype(float), np.diff(s.site_edge_first).astype(float)
        candidates = edges[s.a] + facets[s.a]
        if self.reflections > 0 and s.diffraction:
            beams = np.bincount(
                np.repeat(np.arange(len(facets)), np.diff(s.site_facet_first)), np.diff(s.beam_first), len(facets)
            )
            candidates = candidates + beams[s.a] + beams[s.b]
        if self.reflections > 1:
            candidates = candidates + facets[s.a] * facets[s.b]
        return _CANDIDATE_S * float(candidates.sum())

    def _table(self, s: Work) -> PathTable:
        n, m, most = int(s.counts[PATHS]), int(s.counts[PASSES]), max(self.reflections, 2)
        point = np.stack([each[: n * most].reshape(n, most) for each in (s.path_x, s.path_y, s.path_z)], axis=-1)
        element = s.path_element[: n * most].reshape(n, most).copy()
        gain = s.path_real[:n] + 1j * s.path_imag[:n]
        passes: list[Any] = [each[:m].copy() for each in (s.pass_path, s.pass_leg, s.pass_facet, s.pass_at)]
        return PathTable(
            s.path_pair[:n].copy(), s.path_count[:n].copy(), element, point, gain, s.path_length[:n].copy(), *passes
        )

    # --- views ---

    def _look_from_cells(self, sites: Floats) -> Ints:
        """The cell of each site, (n,); looks from all cells that are needed for the first time.

        A view is conservative: it leaves out only what no point of the cell can see.
        """
        numbers = np.floor(sites / (CELL_M, CELL_M, STOREY_M)).astype(np.int64)
        cells: list[Cell] = [(x, y, z) for x, y, z in numbers.tolist()]
        new = [cell for cell in dict.fromkeys(cells) if cell not in self._cells]
        for cell in new:
            self._cells[cell] = len(self._views)
            self._views.append(self._seen_from(_box_of(cell)))
        if new:
            self._view_first, self._view_target = starts_and_items(self._views)
        return np.array([self._cells[cell] for cell in cells], np.int64)

    def _seen_from(self, corners: Floats) -> Ints:
        """Facets and edges that may be seen from the hull of some corners."""
        s = self._work
        for each, column in zip((s.region_x, s.region_y, s.region_z), corners.T, strict=True):
            each[: len(column)] = column
        s.counts[[SOURCE, CORNERS]] = -1, len(corners)
        run = self._core.chosen(_TARGET_S * len(s.seen), COMPILE_S)
        run(self.world.terrain, s, LOOK)
        return np.flatnonzero(s.seen == search.SEEN)


def _doubled(s: Work, names: Iterable[str]) -> Work:
    """The work with these arrays twice as long."""
    larger: dict[str, Any] = {name: np.concatenate([getattr(s, name), np.zeros_like(getattr(s, name))]) for name in names}
    return s._replace(**larger)


def _box_of(cell: Cell) -> Floats:
    """Corners of a cell, (8, 3) m."""
    low = np.array(cell) * (CELL_M, CELL_M, STOREY_M)
    steps = np.array(list(itertools.product((0, 1), repeat=3)))
    return np.asarray(low + steps * (CELL_M, CELL_M, STOREY_M))


def starts_and_items(parts: list[Ints]) -> tuple[Ints, Ints]:
    """Parts one after another: where each begins, and the whole."""
    first = np.concatenate([[0], np.cumsum([len(part) for part in parts])]).astype(np.int64)
    return first, np.concatenate([np.zeros(0, np.int64), *parts])


def _new_work(world: RayWorld, reflections: int, *, diffraction: bool, transmission: bool) -> Work:
    facets, edges = len(world.terrain.plane_at), len(world.terrain.angle)
    row, most = facets + edges, max(reflections, 2)
    depth = most + 2
    lengths = (
        (10, "counts"),
        (6, "cell"),
        (5, "share"),
        (3, "wave"),
        (2, "end_x end_y end_z"),
        (depth, "chosen place element image_x image_y image_z point_x point_y point_z"),
        (_CORNERS, "region_x region_y region_z target_x target_y target_z beam_x beam_y beam_z"),
        (facets, "facet_mark facet_leg"),
        (edges, "edge_mark edge_at edge_apart"),
        (len(world.terrain.group_radius), "group_mark"),
        (len(world.terrain.bottom), "body_leg"),
        (row, "seen hider"),
        (max(_BEAMS, edges), "beam_edge beam_at beam_apart"),
        (_PATHS, "path_pair path_count path_real path_imag path_length pass_path pass_leg pass_facet pass_at"),
        (_PATHS * most, "path_element path_x path_y path_z"),
    )
    sizes = {name: size for size, names in lengths for name in names.split()}
    kinds = get_type_hints(Work).items()
    fields: dict[str, Any] = {name: np.zeros(sizes.get(name, 0), _NUMBERS.get(kind, np.int64)) for name, kind in kinds}
    is_small = facets * row <= _MOST_PAIRS
    sees = np.zeros(facets * row, np.uint8) if is_small else np.full(row, search.SEEN, np.uint8)  # zeros take no memory yet
    fields.update(sees=sees, sees_row=row * is_small, reflections=reflections)
    fields.update(diffraction=int(diffraction), transmission=int(transmission))
    return Work(**fields)
