"""Solids: boxes, cylinders, prisms, meshes.

Collisions, range scanners, cameras, the radio and pictures all use the same pieces: convex prisms with a vertical axis
(`Upright`), and the triangles of meshes. A cylinder is a regular polygon for all of them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Literal, NamedTuple

import msgspec
import numpy as np

from vcmvsp.cosim.types import Array, Positive, Vec3
from vcmvsp.cosim.util.polygons import area_m2, convex_parts, problem_of

_Level = Annotated[int, msgspec.Meta(ge=0, le=255)]
Color = tuple[_Level, _Level, _Level]  # red, green, blue
Point2 = tuple[float, float]

_SAGITTA_M = 0.002  # greatest distance of a cylinder's polygon inside its circle, if 64 corners are enough
_FEWEST, _MOST = 16, 64

MATERIAL_COLORS: dict[str, Color] = {
    "concrete": (168, 166, 160),
    "brick": (164, 84, 66),
    "plasterboard": (232, 228, 218),
    "wood": (176, 128, 80),
    "glass": (150, 190, 205),
    "metal": (130, 136, 144),
    "stone": (140, 134, 122),
}
"""Colours of solids without a colour of their own, by material."""

_PLAIN: Color = (176, 176, 176)  # of an unlisted material
_BROWN: Color = (120, 100, 80)  # of bodies without a colour


class Upright(NamedTuple):
    """A convex prism with a vertical axis."""

    corners: Array  # (k, 2) m, counter-clockwise seen from above
    bottom: float  # m
    top: float


class Hull(NamedTuple):
    """Outer shape of a body: a box or a cylinder around the body's z axis."""

    size: Vec3  # length (x), width (y), height (z), m; a cylinder has its diameter twice
    offset: Vec3 = (0.0, 0.0, 0.0)  # its centre from the body's reference point, m, body frame
    kind: Literal["box", "cylinder"] = "box"
    color: Color = (60, 60, 60)


class Solid(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of all solids."""

    material: str = "concrete"  # what it is made of, a name for the radio's obstruction loss
    color: Color | None = None  # red, green, blue, 0 to 255; default: that of its material


class Box(Solid, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="box"):
    """A wall, a table, a building. Where it may be a cylinder as well: ``kind = "box"``."""

    center: Vec3  # of the box, m, world; a box on the floor has its centre at half its height
    size: Vec3  # length, width and height, m, before it is turned
    yaw_rad: float = 0.0  # turned by this about the vertical through its centre

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (*self.center, *self.size, self.yaw_rad))) or min(self.size) <= 0.0:
            raise ValueError(f"a box needs finite numbers and three positive sizes, not center {self.center}, size {self.size}")

    @property
    def words(self) -> str:
        """Kind and place of the box, for messages."""
        return f"the box at {self.center}, size {self.size}"

    @property
    def hull(self) -> Hull:
        """Hull of a body of this shape, about its centre."""
        return Hull(self.size, color=self.color or _BROWN)

    def uprights(self) -> list[Upright]:
        """The box as one prism."""
        (x, y, z), (length, width, height) = self.center, self.size
        corners = rectangle(x, y, 0.5 * length, 0.5 * width, self.yaw_rad)
        return [Upright(corners, z - 0.5 * height, z + 0.5 * height)]


class Cylinder(Solid, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="cylinder"):
    """A pillar, a tree trunk, a tank. Where it may be a box as well: ``kind = "cylinder"``."""

    center: Vec3  # of the cylinder, m, world
    radius: Positive  # of the cylinder, m
    height: Positive  # of the cylinder, m

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (*self.center, self.radius, self.height))) or min(self.radius, self.height) <= 0.0:
            sizes = f"radius {self.radius}, height {self.height}"
            raise ValueError(f"a cylinder needs finite numbers, and positive sizes, not center {self.center}, {sizes}")

    @property
    def words(self) -> str:
        """Kind and place of the cylinder, for messages."""
        return f"the cylinder at {self.center}, radius {self.radius:g}, height {self.height:g}"

    @property
    def hull(self) -> Hull:
        """Hull of a body of this shape, about its centre."""
        return Hull((2.0 * self.radius, 2.0 * self.radius, self.height), kind="cylinder", color=self.color or _BROWN)

    def uprights(self) -> list[Upright]:
        """Prism over a regular polygon inside the circle."""
        x, y, z = self.center
        sides = max(_FEWEST, min(math.ceil(math.pi / math.acos(1.0 - min(_SAGITTA_M / self.radius, 0.5))), _MOST))
        angles = math.tau * np.arange(sides) / sides
        corners = np.column_stack([x + self.radius * np.cos(angles), y + self.radius * np.sin(angles)])
        return [Upright(corners, z - 0.5 * self.height, z + 0.5 * self.height)]


class Prism(Solid, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Any outline, raised: a building of many corners, the outer wall of a room."""

    outline: tuple[Point2, ...]  # corners, m, world, either way round, not crossing itself; it need not be convex
    height: Positive  # from bottom to top, m
    bottom: float = 0.0  # above the floor, m
    holes: tuple[tuple[Point2, ...], ...] = ()  # outlines within it that are left open: courtyards

    def __post_init__(self) -> None:
        if problem := problem_of(self.outline, self.holes):
            raise ValueError(f"the outline of a prism {problem}")
        if not math.isfinite(self.bottom) or not math.isfinite(self.height) or self.height <= 0.0:
            raise ValueError(f"a prism needs a finite bottom and a positive height, not {self.bottom} and {self.height}")

    @property
    def words(self) -> str:
        """Kind and place of the prism, for messages."""
        return f"the prism of {len(self.outline)} corners, the first at {self.outline[0]}"

    def rings(self) -> list[Array]:
        """Outline counter-clockwise and holes clockwise, (k, 2) m each: the solid is on the left."""
        rings = [np.array(ring, float) for ring in (self.outline, *self.holes)]
        for k, ring in enumerate(rings):
            if (area_m2(ring) > 0.0) != (k == 0):
                rings[k] = ring[::-1]
        return rings

    def uprights(self) -> list[Upright]:
        """Convex parts of the prism."""
        return [Upright(part, self.bottom, self.bottom + self.height) for part in convex_parts(self.outline, self.holes)]


@dataclass(frozen=True, kw_only=True, eq=False)
class Mesh:
    """Triangles, closed or not, e.g. from a file."""

    triangles: Array  # (t, 3, 3) m, world; counter-clockwise seen from outside. Finite
    material: str = "concrete"  # as `Solid`
    color: Color | None = None  # as `Solid`

    def __post_init__(self) -> None:
        if self.triangles.ndim != 3 or self.triangles.shape[1:] != (3, 3):
            raise ValueError(f"a mesh needs triangles of shape (t, 3, 3), not {self.triangles.shape}")
        if not np.isfinite(self.triangles).all():
            (bad,) = np.nonzero(~np.isfinite(self.triangles).all(axis=(1, 2)))
            raise ValueError(f"triangle {bad[0]} of a mesh has a corner that is not finite")

    @property
    def words(self) -> str:
        """Kind and size of the mesh, for messages."""
        return f"the mesh of {len(self.triangles)} triangles"

    def uprights(self) -> list[Upright]:
        """No prisms: a mesh has triangles."""
        return []


AnySolid = Box | Cylinder | Prism | Mesh


def color_of(solid: AnySolid) -> Color:
    """The solid's own colour, or that of its material."""
    return solid.color or MATERIAL_COLORS.get(solid.material, _PLAIN)


def heading_of(solid: Box | Cylinder) -> float:
    """Yaw of a solid, rad."""
    return solid.yaw_rad if isinstance(solid, Box) else 0.0


def rectangle(x: float, y: float, half_length: float, half_width: float, yaw: float) -> Array:
    """Corners of a rectangle around (x, y), (4, 2) m, counter-clockwise from the upper right; length along ``yaw``, rad."""
    c, s, a, b = math.cos(yaw), math.sin(yaw), half_length, half_width
    return np.array([(x + c * u - s * v, y + s * u + c * v) for u, v in ((a, b), (-a, b), (-a, -b), (a, -b))])


class Group(NamedTuple):
    """Upright convex prisms with the same number of corners."""

    corners: Array  # (m, k, 2) m, counter-clockwise
    bottom: Array  # (m,) m
    top: Array  # (m,) m
    solid: Array  # (m,) int64, which solid of the world each belongs to

    def points(self) -> Array:
        """Corners (m, 2 k, 3) m of the prisms, the lower ones first."""
        m, k, _ = self.corners.shape
        ends = [np.broadcast_to(z[:, None, None], (m, k, 1)) for z in (self.bottom, self.top)]
        return np.concatenate([np.concatenate([self.corners, z], axis=2) for z in ends], axis=1)


class Shapes(NamedTuple):
    """All solids in pieces: prisms by their number of corners, and the triangles of meshes."""

    groups: tuple[Group, ...]
    triangles: Array  # (t, 3, 3) m
    triangle_solid: Array  # (t,) int64

    def mesh(self) -> tuple[Array, Array]:
        """Vertices (v, 3) m and triangles (t, 3) int, counter-clockwise seen from outside."""
        vertices, triangles, first = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0
        for group in self.groups:
            points = group.points()
            m, corners, _ = points.shape
            prism, _ = prism_triangles(corners // 2)
            vertices.append(points.reshape(-1, 3))
            triangles.append((first + corners * np.arange(m)[:, None, None] + prism).reshape(-1, 3))
            first += m * corners
        vertices.append(self.triangles.reshape(-1, 3))
        triangles.append(first + np.arange(3 * len(self.triangles)).reshape(-1, 3))
        return np.concatenate(vertices), np.concatenate(triangles)


@cache
def prism_triangles(k: int) -> tuple[Array, Array]:
    """Triangles (4 k - 4, 3) of a prism by its k lower and then its k upper corners, and the face of each, (4 k - 4,)."""
    i, fan = np.arange(k), np.arange(1, k - 1)
    j = (i + 1) % k
    top, bottom = np.full(k - 2, k), np.zeros(k - 2, int)
    numbers = [(i, j, k + j), (i, k + j, k + i), (top, k + fan, k + fan + 1), (bottom, fan + 1, fan)]
    return np.concatenate([np.column_stack(each) for each in numbers]), np.concatenate([i, i, top, top + 1])


def shapes_of(solids: Sequence[AnySolid]) -> Shapes:
    """Solids in pieces."""
    by_corners: dict[int, list[tuple[Array, float, float, int]]] = {}
    for number, solid in enumerate(solids):
        for piece in solid.uprights():
            by_corners.setdefault(len(piece.corners), []).append((*piece, number))
    groups = []
    for _, pieces in sorted(by_corners.items()):
        corners, bottom, top, solid_numbers = zip(*pieces, strict=True)
        groups.append(Group(np.array(corners), np.array(bottom), np.array(top), np.array(solid_numbers)))
    meshes = {number: solid.triangles for number, solid in enumerate(solids) if isinstance(solid, Mesh)}
    triangles = np.concatenate([np.empty((0, 3, 3)), *meshes.values()])
    of = np.repeat(np.array(list(meshes), np.int64), [len(each) for each in meshes.values()])
    return Shapes(tuple(groups), triangles, of)
