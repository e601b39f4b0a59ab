"""What surrounds the vehicles: a flat floor and boxes on it, and the footprints that tell what overlaps.

One description serves every engine: Bullet collides with its triangles (`World.mesh`), and other parts may look at its boxes.
"""

import math
from dataclasses import dataclass

import msgspec

from cosim.types import NonNegative, Vec3

Triangle = tuple[int, int, int]


@dataclass(frozen=True, kw_only=True)
class Footprint:
    """A rectangle seen from above: centre and half lengths in m, yaw of its long axis in rad."""

    x: float
    y: float
    half_length: float
    half_width: float
    yaw: float

    def corners(self) -> list[tuple[float, float]]:
        """The four corners, counter-clockwise, m."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        a, b = self.half_length, self.half_width
        return [(self.x + c * u - s * v, self.y + s * u + c * v) for u, v in ((a, b), (-a, b), (-a, -b), (a, -b))]

    def overlaps(self, other: "Footprint") -> bool:
        """Whether two rectangles share area: true unless one of their four edge directions separates them."""
        mine, theirs = self.corners(), other.corners()
        for yaw in (self.yaw, self.yaw + 0.5 * math.pi, other.yaw, other.yaw + 0.5 * math.pi):
            c, s = math.cos(yaw), math.sin(yaw)
            a = [c * x + s * y for x, y in mine]
            b = [c * x + s * y for x, y in theirs]
            if max(a) <= min(b) or max(b) <= min(a):
                return False
        return True


class Box(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A box that stands still: a wall, a table, a building.

    Args:
        center: of the box, m, world; a box on the floor has its centre at half its height.
        size: length, width and height, m, before it is turned.
        yaw_rad: turned by this about the vertical through its centre.
        material: what it is made of, a name for the radio's obstruction loss.
    """

    center: Vec3
    size: Vec3
    yaw_rad: float = 0.0
    material: str = "concrete"

    def __post_init__(self) -> None:
        if not all(math.isfinite(value) for value in (*self.center, *self.size, self.yaw_rad)) or min(self.size) <= 0.0:
            raise ValueError(f"a box needs finite numbers and three positive sizes, not center {self.center}, size {self.size}")

    @property
    def footprint(self) -> Footprint:
        """The box seen from above."""
        (x, y, _), (length, width, _) = self.center, self.size
        return Footprint(x=x, y=y, half_length=0.5 * length, half_width=0.5 * width, yaw=self.yaw_rad)

    def blocks(self, footprint: Footprint, height_m: float) -> bool:
        """Whether a body that stands on the floor over ``footprint`` and is ``height_m`` high would be inside the box."""
        bottom, top = self.center[2] - 0.5 * self.size[2], self.center[2] + 0.5 * self.size[2]
        return bottom < height_m and top > 0.0 and self.footprint.overlaps(footprint)


# The corners of a box are numbered 0-3 round its bottom and 4-7 above them; two triangles to a side, normals outwards.
_TRIANGLES: tuple[Triangle, ...] = (
    *((0, 2, 1), (0, 3, 2), (4, 5, 6), (4, 6, 7), (0, 1, 5), (0, 5, 4)),
    *((1, 2, 6), (1, 6, 5), (2, 3, 7), (2, 7, 6), (3, 0, 4), (3, 4, 7)),
)


@dataclass(frozen=True, kw_only=True)
class World:
    """A flat floor at z = 0 and boxes. ``floor_friction`` multiplies the friction of what rolls or slides on it."""

    boxes: tuple[Box, ...] = ()
    floor_friction: NonNegative = 1.0

    def mesh(self) -> tuple[list[Vec3], list[int]]:
        """All boxes as one mesh: vertices in m, and three vertex numbers to a triangle, one after the other."""
        vertices: list[Vec3] = []
        indices: list[int] = []
        for box in self.boxes:
            first, half = len(vertices), 0.5 * box.size[2]
            vertices += [(x, y, box.center[2] + z) for z in (-half, half) for x, y in box.footprint.corners()]
            indices += [first + corner for triangle in _TRIANGLES for corner in triangle]
        return vertices, indices
