"""Plane facets, edges and convex bodies of solids: what a radio wave is reflected, diffracted and stopped by.

A box thinner than a slab is one sheet in its middle plane. Other solids have the facets of their surface, and edges where two
of them meet in an angle of more than 180 degrees outside. Coplanar neighbours have no edge between them, nor has a part of an
edge that touches or lies inside another solid: two boxes side by side are one wall.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util.polygons import outward
from vcmvsp.cosim.util.surfaces import BODY, OPAQUE, SHEET, SKIN, Ints, Surfaces
from vcmvsp.physics.raycast.line_of_sight import SHEET_M, Sightline, is_closed
from vcmvsp.physics.world.solids import AnySolid, Box, Cylinder, Mesh, Prism, Upright

_TOUCH_M = 1e-6  # solids that are nearer than this touch
_FLAT = 0.005  # edges whose outer angle exceeds 180 degrees by less than this share are none


class SolidSurfaces:
    """The solids of a world, to be asked for their surfaces."""

    def __init__(self, solids: Sequence[AnySolid]) -> None:
        self._solids = solids

    @property
    def materials(self) -> tuple[str, ...]:
        """Material of each solid, (m,)."""
        return tuple([solid.material for solid in self._solids])

    @property
    def words(self) -> tuple[str, ...]:
        """Kind and place of each, for messages, (m,)."""
        return tuple([solid.words for solid in self._solids])

    def surfaces(self, slab_m: float, *, ground: bool) -> Surfaces:
        """Facets, edges and bodies of the solids, see `surfaces_of`."""
        return surfaces_of(self._solids, slab_m, ground=ground)


class _Facet(NamedTuple):
    corners: Array
    passage: int
    solid: int
    thickness_m: float


class _Edge(NamedTuple):
    ends: Array  # (2, 3)
    faces: tuple[int, int]
    tangent: Array
    angle: float
    solid: int


def surfaces_of(solids: Sequence[AnySolid], slab_m: float, *, ground: bool) -> Surfaces:
    """Facets, edges and bodies of solids.

    Args:
        solids: of the world.
        slab_m: solids thinner than this let waves pass.
        ground: whether the plane z = 0 is there: facets and edges in it, or below, are none.
    """
    thickness = Sightline(solids).thickness_m.tolist()
    facets: list[_Facet] = []
    edges: list[_Edge] = []
    bodies: list[tuple[Upright, int, bool]] = []
    for number, (solid, size_m) in enumerate(zip(solids, thickness, strict=True)):
        thin = size_m < slab_m
        bodies += [(piece, number, not thin) for piece in solid.uprights()]
        if isinstance(solid, Mesh):
            _add_mesh(solid, number, size_m, facets, edges, thin=thin)
        elif isinstance(solid, Box) and thin:
            _add_sheet(solid, number, size_m, facets, edges)
        else:
            _add_upright(solid, number, size_m if thin else math.inf, facets, edges)
    numbers = [k for k, facet in enumerate(facets) if not (ground and facet.corners[:, 2].max() <= _TOUCH_M)]
    edges = list(_exposed(edges, bodies, ground=ground))
    return _arrays([facets[k] for k in numbers], _renumbered(edges, numbers), bodies)


def _renumbered(edges: list[_Edge], numbers: list[int]) -> list[_Edge]:
    """Edges of kept facets, with their new numbers."""
    place = {facet: k for k, facet in enumerate(numbers)}
    left = [edge for edge in edges if edge.faces[0] in place and edge.faces[1] in place]
    return [edge._replace(faces=(place[edge.faces[0]], place[edge.faces[1]])) for edge in left]


def _arrays(facets: list[_Facet], edges: list[_Edge], bodies: list[tuple[Upright, int, bool]]) -> Surfaces:
    corners, passages, solids, thicknesses = _columns(_Facet, facets)
    all_ends, faces, tangents, angles, _ = _columns(_Edge, edges)
    outlines, bottoms, tops = _columns(Upright, [piece for piece, *_ in bodies])
    normals = np.array([_normal(each) for each in corners]).reshape(-1, 3)
    outwards = [(each, outward(each)) for each in outlines]
    sides = [np.column_stack([normal, (normal * each).sum(axis=1)]) for each, normal in outwards]
    ends = np.array(all_ends).reshape(-1, 2, 3)
    offsets = [normal @ each.mean(axis=0) for normal, each in zip(normals, corners, strict=True)]
    owners = [(solid, stops) for _, solid, stops in bodies]
    body_solids, stops = np.array(owners, np.int64).reshape(-1, 2).T.copy()
    return Surfaces(
        first=_starts(corners),
        corner=np.concatenate([np.empty((0, 3)), *corners]),
        normal=normals,
        offset=np.array(offsets),
        passage=np.array(passages, np.int64),
        solid=np.array(solids, np.int64),
        thickness_m=np.array(thicknesses),
        start=ends[:, 0],
        end=ends[:, 1],
        faces=np.array(faces, np.int64).reshape(-1, 2),
        tangent=np.array(tangents).reshape(-1, 3),
        angle=np.array(angles),
        side_first=_starts(sides),
        side=np.concatenate([np.empty((0, 3)), *sides]),
        bottom=np.array(bottoms),
        top=np.array(tops),
        body_solid=body_solids,
        stops=stops.astype(bool),
    )


def _columns(kind: Any, rows: Sequence[Any]) -> list[tuple[Any, ...]]:
    """The fields of named tuples of one kind, each for all of them."""
    return [*zip(*rows, strict=True)] or [()] * len(kind._fields)


def _starts(parts: Sequence[Array]) -> Ints:
    return np.concatenate([[0], np.cumsum([len(part) for part in parts])]).astype(np.int64)


def _normal(corners: Array) -> Array:
    """Unit normal of a plane polygon, by the sum of the cross products of its corners (M. E. Newell)."""
    spokes = corners - corners[0]
    total = np.cross(spokes[1:-1], spokes[2:]).sum(axis=0)
    return np.asarray(total / math.sqrt(total @ total))


def _add_sheet(box: Box, solid: int, thickness_m: float, facets: list[_Facet], edges: list[_Edge]) -> None:
    """The middle plane of a thin box, with its four edges."""
    cos, sin = math.cos(box.yaw_rad), math.sin(box.yaw_rad)
    axes = np.array([(cos, sin, 0.0), (-sin, cos, 0.0), (0.0, 0.0, 1.0)]) * 0.5 * np.array(box.size)[:, None]
    across = int(np.argmin(box.size))
    u, v = (axes[k] for k in range(3) if k != across)
    corners = np.array(box.center) + np.array([-u - v, u - v, u + v, v - u])
    facet = len(facets)
    facets.append(_Facet(corners, SHEET, solid, thickness_m))
    for k in range(4):
        ends = corners[[k, (k + 1) % 4]]
        edges.append(_Edge(ends, (facet, facet), _unit(corners.mean(axis=0) - ends.mean(axis=0)), 2.0, solid))


def _add_upright(
    solid: Box | Cylinder | Prism, number: int, thickness_m: float, facets: list[_Facet], edges: list[_Edge]
) -> None:
    """Sides, top and bottom of an upright solid, with upright and level edges."""
    passage = SKIN if thickness_m < math.inf else BODY
    pieces = solid.uprights()
    bottom, top = pieces[0].bottom, pieces[0].top
    rings = solid.rings() if isinstance(solid, Prism) else [pieces[0].corners]
    ceilings = [_Facet(_at(piece.corners, top), passage, number, thickness_m) for piece in pieces]
    floors = [_Facet(_at(piece.corners[::-1], bottom), passage, number, thickness_m) for piece in pieces]
    first_top, first_bottom = len(facets), len(facets) + len(pieces)
    facets += ceilings + floors
    for ring in rings:
        first, count = len(facets), len(ring)
        for k in range(count):
            a, b = ring[k], ring[(k + 1) % count]
            corners = np.array([(*a, bottom), (*b, bottom), (*b, top), (*a, top)])
            facets.append(_Facet(corners, passage, number, thickness_m))
            under, over = np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, 1.0])
            edges.append(_Edge(corners[2:], (first + k, first_top), under, 1.5, number))
            edges.append(_Edge(corners[:2], (first + k, first_bottom), over, 1.5, number))
        for k in range(count):
            before = (k - 1) % count
            tangent, other = (_unit(np.array([*(ring[each % count] - ring[k]), 0.0])) for each in (k - 1, k + 1))
            angle = _outer_angle(tangent, _normal(facets[first + before].corners), other)
            ends = np.array([(*ring[k], bottom), (*ring[k], top)])
            if angle > 1.0 + _FLAT:
                edges.append(_Edge(ends, (first + before, first + k), tangent, angle, number))


def _at(outline: Array, z: float) -> Array:
    return np.column_stack([outline, np.full(len(outline), z)])


def _add_mesh(mesh: Mesh, number: int, thickness_m: float, facets: list[_Facet], edges: list[_Edge], *, thin: bool) -> None:
    """Triangles of a mesh: a body if it is closed, else sheets; with edges where two, or one alone, end."""
    triangles = mesh.triangles
    area = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    triangles = triangles[(area * area).sum(axis=1) > 0.0]
    closed = is_closed(mesh.triangles)
    passage, size_m = SHEET, SHEET_M
    if closed:
        passage, size_m = (SKIN, thickness_m) if thin else (OPAQUE, math.inf)
    first = len(facets)
    facets += [_Facet(triangle, passage, number, size_m) for triangle in triangles]
    meeting: dict[tuple[tuple[float, ...], ...], list[int]] = {}
    for k, triangle in enumerate(triangles):
        for a, b in ((0, 1), (1, 2), (2, 0)):
            key = tuple(sorted((tuple(triangle[a].tolist()), tuple(triangle[b].tolist()))))
            meeting.setdefault(key, []).append(k)
    for key, owners in meeting.items():
        ends = np.array(key)
        tangents = [_into(triangles[k], ends) for k in owners]
        if not closed and len(owners) == 1:
            edges.append(_Edge(ends, (first + owners[0],) * 2, tangents[0], 2.0, number))
        elif closed and len(owners) == 2:
            angle = _outer_angle(tangents[0], _normal(triangles[owners[0]]), tangents[1])
            if angle > 1.0 + _FLAT:
                edges.append(_Edge(ends, (first + owners[0], first + owners[1]), tangents[0], angle, number))


def _into(triangle: Array, ends: Array) -> Array:
    """Unit vector in a triangle across one of its edges, away from it."""
    along = _unit(ends[1] - ends[0])
    inwards = triangle.mean(axis=0) - ends[0]
    return _unit(inwards - (inwards @ along) * along)


def _outer_angle(tangent: Array, normal: Array, other: Array) -> float:
    """Angle from one face, with its outward normal, through the outside to the other, in units of pi."""
    return math.atan2(float(other @ normal), float(other @ tangent)) % (2.0 * math.pi) / math.pi


def _unit(vector: Array) -> Array:
    return np.asarray(vector / math.sqrt(vector @ vector))


def _exposed(edges: list[_Edge], bodies: list[tuple[Upright, int, bool]], *, ground: bool) -> Iterator[_Edge]:
    """Parts of edges that touch no other solid, nor the ground along their length."""
    low = np.array([(*piece.corners.min(axis=0), piece.bottom) for piece, *_ in bodies]).reshape(-1, 3) - _TOUCH_M
    high = np.array([(*piece.corners.max(axis=0), piece.top) for piece, *_ in bodies]).reshape(-1, 3) + _TOUCH_M
    owner = np.array([solid for _, solid, _ in bodies], np.int64)
    for edge in edges:
        if ground and edge.ends[:, 2].max() <= _TOUCH_M:
            continue
        near = (edge.ends.min(axis=0) <= high).all(axis=1) & (edge.ends.max(axis=0) >= low).all(axis=1) & (owner != edge.solid)
        covered = [_within(edge.ends, bodies[k][0]) for k in np.flatnonzero(near).tolist()]
        if ground and edge.ends[:, 2].min() < 0.0:
            z = edge.ends[:, 2]
            level = z[0] / (z[0] - z[1])
            covered.append((0.0, level) if z[0] < 0.0 else (level, 1.0))
        length = math.dist(*edge.ends.tolist())
        for begin, finish in _gaps(covered):
            if (finish - begin) * length > _TOUCH_M:
                run = edge.ends[1] - edge.ends[0]
                yield edge._replace(ends=np.array([edge.ends[0] + begin * run, edge.ends[0] + finish * run]))


def _within(ends: Array, piece: Upright) -> tuple[float, float]:
    """Share of a line inside a body or touching it: from, to; to is less than from if none is."""
    normals = outward(piece.corners)
    sides = zip(normals, piece.corners, strict=True)
    planes = [(normal @ ends[0, :2], normal @ ends[1, :2], normal @ at) for normal, at in sides]
    planes += [(ends[0, 2], ends[1, 2], piece.top), (-ends[0, 2], -ends[1, 2], -piece.bottom)]
    begin, finish = 0.0, 1.0
    for a, b, limit in planes:
        out_a, out_b = a - limit - _TOUCH_M, b - limit - _TOUCH_M
        if out_a > 0.0 and out_b > 0.0:
            return 1.0, 0.0
        if out_a > 0.0:
            begin = max(begin, out_a / (out_a - out_b))
        elif out_b > 0.0:
            finish = min(finish, out_a / (out_a - out_b))
    return begin, finish


def _gaps(covered: list[tuple[float, float]]) -> Iterator[tuple[float, float]]:
    """What intervals leave of (0, 1)."""
    at = 0.0
    for begin, finish in sorted(each for each in covered if each[1] >= each[0]):
        if begin > at:
            yield at, begin
        at = max(at, finish)
    if at < 1.0:
        yield at, 1.0
