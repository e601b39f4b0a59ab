"""The world of the rays: facets, edges and bodies as arrays for `netsim.propagation.rays.search`, with a grid over the plan."""

import math
from typing import Any, NamedTuple, Protocol

import numpy as np

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.util.surfaces import SHEET, Surfaces
from vcmvsp.netsim.interfaces.layers import Bools, Floats, Ints
from vcmvsp.netsim.propagation.path_loss import SPEED_OF_LIGHT
from vcmvsp.netsim.propagation.rays.arrays import Terrain
from vcmvsp.netsim.propagation.rays.coefficients import MATERIALS, Echoes, faddeeva_numbers, permittivity
from vcmvsp.netsim.propagation.rays.search import GROUP

_MARGIN_M = 1e-3  # of the grid around what it holds
_PER_CELL = 1.0  # obstacles, about
_MOST_CELLS = 1 << 16


class Solids(Protocol):
    """The solids of the world."""

    @property
    def materials(self) -> tuple[str, ...]:
        """Material of each solid, (m,)."""

    @property
    def words(self) -> tuple[str, ...]:
        """Kind and place of each solid, for messages, (m,)."""

    def surfaces(self, slab_m: float, *, ground: bool) -> Surfaces:
        """Facets, edges and bodies of the solids; solids thinner than ``slab_m`` let waves pass."""


class RayWorld(NamedTuple):
    """What rays meet. The ground, if there is one, is the last of the F facets."""

    terrain: Terrain
    surfaces: Surfaces
    roofs: "Roofs"


class Wave(NamedTuple):
    """A carrier, and how the echoes in slabs add up."""

    frequency_hz: float
    echoes: Echoes

    @property
    def length_m(self) -> float:
        """Wavelength."""
        return SPEED_OF_LIGHT / self.frequency_hz


class Roofs(NamedTuple):
    """Upright convex bodies under the roofs that knife edges lead over; of a mesh its bounding box."""

    side_first: Ints  # (V + 1,)
    side: Floats  # (S, 3) as `Surfaces.side`
    top: Floats  # (V,) m
    thin: Bools  # (V,) whether it is a slab


def world_of(solids: Solids, wave: Wave, ground: str, slab_m: float, facet_limit: int) -> RayWorld:
    """The world of the rays of a wave.

    Raises:
        ScenarioError: a material without a permittivity, or more facets than ``facet_limit``.
    """
    on_ground = ground != "none"
    known = {material: permittivity(material, wave.frequency_hz) for material in {*solids.materials} & {*MATERIALS}}
    for material, words in zip(solids.materials, solids.words, strict=True):
        if material not in known:
            problem = f"{words} is of {material!r}, whose permittivity is not known"
            raise ScenarioError(f"{problem}: give the solid one of the materials {', '.join(MATERIALS)}", key="kind")
    etas = [known[material] for material in solids.materials]
    found = solids.surfaces(slab_m, ground=on_ground)
    facets = len(found.offset)
    if facets > facet_limit:
        problem = f"the world has {facets} facets, more than facet_limit = {facet_limit}"
        raise ScenarioError(f"{problem}: leave out meshes and cylinders, or raise the limit", key="facet_limit")
    normal = np.vstack([found.normal, (0.0, 0.0, 1.0)]) if on_ground else found.normal
    offset, passage = np.append(found.offset, [0.0] * on_ground), np.append(found.passage, [0] * on_ground)
    eta = np.array(etas, np.complex128)[found.solid]
    turns = found.thickness_m / wave.length_m
    if on_ground:
        eta, turns = np.append(eta, permittivity(ground, wave.frequency_hz)), np.append(turns, math.inf)
    matter = {
        "eta_real": eta.real.copy(),
        "eta_imag": eta.imag.copy(),
        "turns": turns,
        "averaged": int(wave.echoes == "averaged"),
        "wave_m": wave.length_m,
        "faddeeva": np.array(faddeeva_numbers()),
    }
    # Edges run along ``tangent x normal`` of the first face.
    first_normal = found.normal[found.faces[:, 0]].reshape(-1, 3)
    swapped = (np.cross(found.tangent, first_normal) * (found.end - found.start)).sum(axis=1) < 0.0
    start, end = np.where(swapped[:, None], found.end, found.start), np.where(swapped[:, None], found.start, found.end)
    return RayWorld(_terrain(found, normal, offset, passage, start, end, matter), found, _roofs(found))


def _roofs(found: Surfaces) -> Roofs:
    sides, tops, thin = [found.side], [found.top], [~found.stops]
    first = found.side_first
    for solid in np.unique(found.solid[~np.isin(found.solid, found.body_solid)]).tolist():
        facets = np.flatnonzero(found.solid == solid)
        corners = np.concatenate([found.corner[found.first[k] : found.first[k + 1]] for k in facets.tolist()])
        low, high = corners.min(axis=0), corners.max(axis=0)
        sides.append(np.array([(1.0, 0.0, high[0]), (0.0, 1.0, high[1]), (-1.0, 0.0, -low[0]), (0.0, -1.0, -low[1])]))
        tops.append(high[2:])
        thin.append(np.zeros(1, bool))
        first = np.append(first, first[-1] + 4)
    return Roofs(first, np.concatenate(sides), np.concatenate(tops), np.concatenate(thin))


def _terrain(
    found: Surfaces, normal: Floats, offset: Floats, passage: Ints, start: Floats, end: Floats, matter: dict[str, Any]
) -> Terrain:
    first = found.first if len(offset) == len(found.offset) else np.append(found.first, found.first[-1])
    facet = np.repeat(np.arange(len(found.offset)), np.diff(found.first))
    following = np.arange(1, len(found.corner) + 1)
    following[found.first[1:] - 1] = found.first[:-1]
    inwards = np.cross(normal[facet], found.corner[following] - found.corner).reshape(-1, 3)
    inwards /= np.sqrt((inwards * inwards).sum(axis=1))[:, None]
    cut_at = (inwards * found.corner).sum(axis=1)
    run = end - start
    length = np.sqrt((run * run).sum(axis=1))
    bodies = np.flatnonzero(found.stops)
    counts = np.diff(found.side_first)[bodies]
    sides = np.concatenate([np.empty(0, np.int64), *(np.arange(*found.side_first[k : k + 2]) for k in bodies.tolist())])
    obstacles = np.flatnonzero(found.passage > 0)
    boxes = _boxes(found, bodies, obstacles)
    items = np.concatenate([np.arange(len(bodies)), -1 - obstacles])
    return Terrain(
        facet_first=first,
        **_columns("corner", found.corner),
        **_columns("cut", inwards),
        cut_at=cut_at,
        **_columns("normal", normal),
        plane_at=offset,
        both_sides=(passage == SHEET).astype(np.int64),
        passage=passage.astype(np.int64),
        **matter,
        **_columns("start", start),
        **_columns("along", run / length[:, None]),
        length=length,
        **_columns("tangent", found.tangent),
        angle=found.angle,
        **_spheres(start, end),
        first_face=found.faces[:, 0].copy(),
        second_face=found.faces[:, 1].copy(),
        side_first=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        side_x=found.side[sides, 0],
        side_y=found.side[sides, 1],
        side_at=found.side[sides, 2],
        bottom=found.bottom[bodies],
        top=found.top[bodies],
        **_grid(boxes, items),
    )


def _spheres(start: Floats, end: Floats) -> dict[str, Any]:
    """Spheres round edges, `GROUP` of them each."""
    pairs = np.stack([start, end], axis=1)
    groups = [pairs[first : first + GROUP].reshape(-1, 3) for first in range(0, len(pairs), GROUP)]
    middle = np.array([0.5 * (group.min(axis=0) + group.max(axis=0)) for group in groups]).reshape(-1, 3)
    radii = [math.sqrt(((group - each) ** 2).sum(axis=1).max()) for group, each in zip(groups, middle, strict=True)]
    return {**_columns("group", middle), "group_radius": np.array(radii) + _MARGIN_M}


def _columns(name: str, table: Floats) -> dict[str, Any]:
    return {f"{name}_{axis}": table[:, k].copy() for k, axis in enumerate("xyz")}


def _boxes(found: Surfaces, bodies: Ints, facets: Ints) -> Floats:
    """West, south, east, north of bodies and facets, (n, 4) m."""
    outlines = [_plan(found.side[found.side_first[body] : found.side_first[body + 1]]) for body in bodies.tolist()]
    outlines += [found.corner[found.first[facet] : found.first[facet + 1], :2] for facet in facets.tolist()]
    return np.array([(*each.min(axis=0), *each.max(axis=0)) for each in outlines]).reshape(-1, 4)


def _plan(sides: Floats) -> Floats:
    """Corners of a convex outline from its sides in order, (k, 2) m."""
    before = np.roll(sides, 1, axis=0)
    corners = [np.linalg.solve(np.stack([p[:2], q[:2]]), [p[2], q[2]]) for p, q in zip(before, sides, strict=True)]
    return np.stack(corners)


def _grid(boxes: Floats, items: Ints) -> dict[str, Any]:
    """Which items lie over which square of the plan: squares about as many as items."""
    if not len(boxes):
        boxes = np.zeros((1, 4))
    west, south = boxes[:, :2].min(axis=0) - _MARGIN_M
    wide, high = boxes[:, 2:].max(axis=0) + _MARGIN_M - (west, south)
    cell_m = max(math.sqrt(wide * high / min(_MOST_CELLS, len(boxes) / _PER_CELL)), wide / 256.0, high / 256.0)
    columns, rows = math.ceil(wide / cell_m), math.ceil(high / cell_m)
    cells: list[list[int]] = [[] for _ in range(columns * rows)]
    low = np.floor((boxes[:, :2] - _MARGIN_M - (west, south)) / cell_m).astype(np.int64).clip(0)
    top = np.floor((boxes[:, 2:] + _MARGIN_M - (west, south)) / cell_m).astype(np.int64).clip(0, (columns - 1, rows - 1))
    for item, (column, row), (last_column, last_row) in zip(items.tolist(), low.tolist(), top.tolist(), strict=False):
        for y in range(row, last_row + 1):
            for x in range(column, last_column + 1):
                cells[y * columns + x].append(item)
    first = np.concatenate([[0], np.cumsum([len(cell) for cell in cells])]).astype(np.int64)
    every = np.array([item for cell in cells for item in cell], np.int64)
    return {
        "cell_first": first,
        "cell_item": every,
        "columns": columns,
        "rows": rows,
        "west": float(west),
        "south": float(south),
        "cell_m": float(cell_m),
    }


def holding(world: RayWorld, points: Floats) -> Ints:
    """The solid that each point is inside, (n,); -1: none."""
    found = world.surfaces
    holder = np.full(len(points), -1, np.int64)
    if not len(found.body_solid):
        return holder
    beyond = points[:, :2] @ found.side[:, :2].T - found.side[:, 2]
    within = np.maximum.reduceat(beyond, found.side_first[:-1], axis=1) < 0.0
    height = points[:, 2, None]
    row, body = np.nonzero(within & (height > found.bottom) & (height < found.top))
    holder[row] = found.body_solid[body]
    return holder
