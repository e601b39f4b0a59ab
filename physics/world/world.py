"""World of the vehicles: a flat floor, solids on it, moving bodies, wind and light; and its state at one instant.

One description serves all: Bullet collides with its triangles (`World.mesh`); scanners, cameras and the radio use its pieces
(`World.shapes`).
"""

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, wraps
from typing import Any, NamedTuple, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Array, NonNegative, Positive, Probability, Vec3
from vcmvsp.physics.world.floor import GroundPicture, PlacedTarget
from vcmvsp.physics.world.proximity import Blocking, Clearance
from vcmvsp.physics.world.solids import AnySolid, Box, Color, Cylinder, Hull, Shapes, color_of, heading_of, shapes_of

T = TypeVar("T")


class Zone(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A rectangle of the floor with a friction of its own for robots: ice, mud. Where zones overlap, the last one counts."""

    center: tuple[float, float]  # x, y, m
    size: tuple[float, float]  # length and width, m, before it is turned
    yaw_rad: float = 0.0  # turned by this
    # factor on the friction of robots on it, instead of the floor's; not for movables and quadrotors
    friction: NonNegative
    color: Color | None = None  # colour; default: not painted

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (*self.center, *self.size, self.yaw_rad))) or min(self.size) <= 0.0:
            raise ValueError(f"a zone needs finite numbers and two positive sizes, not center {self.center}, size {self.size}")

    def holds(self, x: float, y: float) -> bool:
        """Whether a place, m, lies in it."""
        dx, dy = x - self.center[0], y - self.center[1]
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return abs(cos * dx + sin * dy) <= 0.5 * self.size[0] and abs(cos * dy - sin * dx) <= 0.5 * self.size[1]


class Wind(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Wind, uniform in space, steady or in gusts."""

    velocity: Vec3 = (0.0, 0.0, 0.0)  # of the mean wind, m/s, world
    gust: NonNegative = 0.0  # standard deviation of each horizontal component, m/s (half of it for the vertical one)
    gust_time_s: Positive = 2.0  # correlation time of the gusts


class Light(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A sun without shadows: how bright a face is depends on its direction."""

    direction: Vec3 = (0.3, 0.2, 1.0)  # from the world to the sun, any length
    ambient: Probability = 0.6  # brightness of faces turned away from it; faces turned to it have 1

    def __post_init__(self) -> None:
        if not any(self.direction) or not all(map(math.isfinite, self.direction)):
            raise ValueError(f"the direction of light must be finite and not zero, not {self.direction}")


class Movable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A body that can be pushed, with the shape and place of ``solid`` at the start."""

    name: str  # unique in the world
    solid: Box | Cylinder  # a `Box` or a `Cylinder`: ``{ kind = "box", center = [2, 0, 0.2], size = [0.4, 0.4, 0.4] }``
    mass_kg: Positive  # evenly distributed
    friction: NonNegative = 0.5  # of its faces

    def pose(self, time_s: float) -> tuple[float, float, float, float]:
        """Centre, x, y, z m, and yaw, rad, at the start, at any time."""
        return (*self.solid.center, heading_of(self.solid))


class Moving(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An obstacle that follows a time-table regardless of other bodies: at ``way[i]`` at ``times_s[i]``, straight between."""

    name: str  # unique in the world
    solid: Box | Cylinder  # a `Box` or a `Cylinder`; its own place is ignored
    times_s: tuple[float, ...]  # increasing
    way: tuple[tuple[float, float, float, float], ...]  # centre of the solid, x, y, z m, and its yaw, rad, at each of the times
    loop: bool = False  # true: repeat after the last time; false: it stays there

    def __post_init__(self) -> None:
        rising = all(a < b for a, b in zip(self.times_s, self.times_s[1:], strict=False))
        numbers = (*self.times_s, *(value for place in self.way for value in place))
        if not rising or len(self.times_s) != len(self.way) or not self.way or not all(map(math.isfinite, numbers)):
            raise ValueError(f"the moving obstacle {self.name!r} needs increasing times_s and, for each, a finite place in way")

    def pose(self, time_s: float) -> tuple[float, float, float, float]:
        """Centre, x, y, z m, and yaw, rad, at a time."""
        time_s = self._in_table(time_s)
        columns = zip(*self.way, strict=True)
        x, y, z, yaw = (float(np.interp(time_s, self.times_s, column)) for column in columns)
        return x, y, z, yaw

    def rates(self, time_s: float) -> tuple[float, float, float, float]:
        """Velocity of the centre, m/s, and yaw rate, rad/s; without the jump back to the first place."""
        time_s = self._in_table(time_s)
        k = bisect_right(self.times_s, time_s)
        if k in (0, len(self.times_s)):
            return 0.0, 0.0, 0.0, 0.0
        span_s = self.times_s[k] - self.times_s[k - 1]
        x, y, z, yaw = ((end - start) / span_s for start, end in zip(self.way[k - 1], self.way[k], strict=True))
        return x, y, z, yaw

    def distances_m(self, time_ns: Array, position: Array) -> Array:
        """Distances (m, n) m from places (3, m, n) m, world, at the m instants."""
        x, y, z, yaw = np.array([self.pose(now_ns / SECOND_NS) for now_ns in time_ns.tolist()]).reshape(-1, 4).T[:, :, None]
        dx, dy, dz = position[0] - x, position[1] - y, position[2] - z
        if isinstance(self.solid, Cylinder):
            beyond = [np.hypot(dx, dy) - self.solid.radius, np.abs(dz) - 0.5 * self.solid.height]
        else:
            cos, sin, half = np.cos(yaw), np.sin(yaw), 0.5 * np.array(self.solid.size)
            local = (cos * dx + sin * dy, cos * dy - sin * dx, dz)
            beyond = [np.abs(each) - reach for each, reach in zip(local, half, strict=True)]
        return np.asarray(np.sqrt(sum(np.maximum(each, 0.0) ** 2 for each in beyond)))

    def _in_table(self, time_s: float) -> float:
        first, last = self.times_s[0], self.times_s[-1]
        return first + (time_s - first) % (last - first) if self.loop and last > first else time_s


@dataclass(frozen=True, kw_only=True)
class World:
    """A flat floor at z = 0 with everything on and above it."""

    solids: tuple[AnySolid, ...] = ()  # what stands still
    movables: tuple[Movable, ...] = ()  # bodies that can be pushed
    moving: tuple[Moving, ...] = ()  # obstacles that move by a timetable
    targets: tuple[PlacedTarget, ...] = ()  # flat objects on the floor, to be found
    floor_friction: NonNegative = 1.0  # multiplies the friction of what rolls or slides on it
    zones: tuple[Zone, ...] = ()  # parts of the floor with another friction
    ground: GroundPicture = field(default_factory=GroundPicture)  # how the floor looks
    wind: Wind = field(default_factory=Wind)  # see `Wind`
    light: Light = field(default_factory=Light)  # see `Light`
    # west, south, east and north end, m: vehicles start inside. None: no end
    bounds: tuple[float, float, float, float] | None = None
    name: str = "world"  # for titles and messages

    def friction_at(self, x: float, y: float, elsewhere: float | None = None) -> float:
        """Friction under a robot at a place, m: of the zone, or ``elsewhere``; None: of the floor."""
        floor = self.floor_friction if elsewhere is None else elsewhere
        return next((zone.friction for zone in reversed(self.zones) if zone.holds(x, y)), floor)

    @cached_property
    def shapes(self) -> Shapes:
        """Solids of the world in pieces."""
        return shapes_of(self.solids)

    def mesh(self) -> tuple[Array, Array]:
        """All solids as one mesh: vertices (v, 3) m, and triangles (t, 3) int, counter-clockwise seen from outside."""
        return self.shapes.mesh()

    def mesh_colors(self) -> Array:
        """Red, green and blue of the triangles of `mesh`, (t, 3) uint8, without light."""
        prisms = [np.repeat(group.solid, 4 * group.corners.shape[1] - 4) for group in self.shapes.groups]  # sides, top, bottom
        solid = np.concatenate([*prisms, self.shapes.triangle_solid])
        return np.asarray(np.array([color_of(each) for each in self.solids], np.uint8).reshape(-1, 3)[solid])

    @cached_property
    def clearance(self) -> Clearance:
        """Distances to the solids of the world."""
        return Clearance(self.shapes)

    @cached_property
    def _blocking(self) -> Blocking:
        return Blocking(self.shapes)

    def least_clearance_m(self, time_ns: Array, position: Array) -> float | None:
        """Smallest distance of n vehicles to solids and moving obstacles, m, without floor and movables.

        ``position`` (3, m, n) m, world, is that at the m instants; NaN while a vehicle is absent. None: the world has no
        obstacle, or there was no vehicle.
        """
        least = math.inf
        for way in position.transpose(2, 1, 0):
            least = self.clearance.least_m(way[np.isfinite(way).all(axis=1)], least)
        for each in self.moving:
            least = float(np.fmin.reduce(each.distances_m(time_ns, position), axis=None, initial=least))
        return least if least < math.inf else None

    def outside(self, x: float, y: float) -> float:
        """Distance of a place beyond the bounds, m; 0: inside, or without bounds."""
        if self.bounds is None:
            return 0.0
        west, south, east, north = self.bounds
        return float(np.hypot(max(west - x, 0.0, x - east), max(south - y, 0.0, y - north)))

    def blocking(self, corners: Array, bottom: float, top: float) -> tuple[AnySolid, float] | None:
        """The solid that a body overlaps most, and the way out of it, m; None: no overlap.

        ``corners`` (k, 2) m of its convex outline from above, counter-clockwise; ``bottom`` and ``top`` m.
        """
        deepest = self._blocking.deepest(corners, bottom, top)
        return None if deepest is None else (self.solids[deepest[0]], deepest[1])


def cached_on_world(make: Callable[[World], T]) -> Callable[[World], T]:
    """Decorator of a function of a world: its result is computed once for each world, since worlds never change."""
    name = f"_{make.__module__}.{make.__qualname__}"

    @wraps(make)
    def cached(world: World) -> T:
        cache: dict[str, Any] = vars(world)  # like a cached property
        if name not in cache:
            cache[name] = make(world)
        return cache[name]

    return cached


class Hulls(NamedTuple):
    """Hulls of all b bodies of a scene, in the world."""

    centre: Array  # (b, 3) m, world
    rotation: Array  # (3, 3, b), world_from_body
    half: Array  # (3, b) m, half the size
    round: Array  # (b,) bool, whether it is a cylinder
    radius: Array  # (b,) m, of a sphere around it


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """All vehicles and other moving bodies at one instant. Rows: the n vehicles first, then the other bodies.

    Arrays are read-only and never change: a scene may be used later.
    """

    now_ns: int  # the instant
    world: World  # what stands still
    vehicles: tuple[str, ...]  # names of the n vehicles
    hulls: tuple[Hull, ...]  # of all b bodies
    position: Array  # (b, 3) m, world, of the reference points
    velocity: Array  # (b, 3) m/s, world
    attitude: Array  # (b, 4) w, x, y, z; world_from_body
    angular_velocity: Array  # (b, 3) rad/s, body
    acceleration: Array  # (n, 3) m/s2, world, mean over the last step of physics; without gravity taken off or added
    wheels: Array  # (n, 2) rad, how far the left and right wheel have turned; NaN where there are none
    # pairs of rows that touch; None stands for the world. With the place of the contact, m, world
    touching: Sequence[tuple[int, int | None, Vec3]] = ()
    gravity: float = 9.81  # m/s2

    @cached_property
    def row_of(self) -> dict[str, int]:
        """Rows of the vehicles by name."""
        return {name: row for row, name in enumerate(self.vehicles)}

    def rotation(self, row: int) -> Array:
        """world_from_body of a body, (3, 3)."""
        return np.asarray(self._rotations[row])

    def point(self, row: int, mount: Vec3) -> Array:
        """Position of a point of a body, (3,) m, world; ``mount`` in the body frame, from its reference point."""
        place: Array = self.position[row]
        return place + self.rotation(row) @ np.array(mount) if any(mount) else place

    @cached_property
    def _rotations(self) -> Array:
        return rotations(self.attitude)

    @cached_property
    def placed_hulls(self) -> Hulls:
        """Hulls of all bodies, in the world frame."""
        half, offset, around, radius = _sizes(self.hulls)
        rotation = rotation_columns(self.attitude.T)
        centre = self.position + (rotation * offset).sum(axis=1).T
        return Hulls(centre, rotation, half, around, radius)


@lru_cache(maxsize=1)
def _sizes(hulls: tuple[Hull, ...]) -> tuple[Array, Array, Array, Array]:
    """Half sizes and offsets (3, b) m, cylinders (b,) bool, radii (b,) m; cached: the bodies of a run stay the same."""
    size = np.array([hull.size for hull in hulls]).reshape(-1, 3).T
    offset = np.array([hull.offset for hull in hulls]).reshape(-1, 3).T
    around = np.array([hull.kind == "cylinder" for hull in hulls], bool)
    across = np.where(around, size[0] ** 2, size[0] ** 2 + size[1] ** 2)
    return 0.5 * size, offset, around, 0.5 * np.sqrt(across + size[2] ** 2)


def rotations(attitude: Array) -> Array:
    """Rotation matrices (n, 3, 3) of unit quaternions (n, 4) w, x, y, z."""
    return np.moveaxis(rotation_columns(attitude.T), -1, 0)


def pairs(*products: tuple[int, int]) -> NDArray[np.intp]:
    """Numbers of products of two components of a quaternion (w, x, y, z), among all 16 row by row."""
    return np.array([4 * a + b for a, b in products])


_W, _X, _Y, _Z = range(4)
# Half of each entry of a rotation matrix, row by row: the first of these products plus or minus the second; on the diagonal,
# half of 1 less the entry.
_FIRST = pairs((_Y, _Y), (_X, _Y), (_X, _Z), (_X, _Y), (_X, _X), (_Y, _Z), (_X, _Z), (_Y, _Z), (_X, _X))
_SECOND = pairs((_Z, _Z), (_W, _Z), (_W, _Y), (_W, _Z), (_Z, _Z), (_W, _X), (_W, _Y), (_W, _X), (_Y, _Y))
_SIGN = np.array([1.0, -1.0, 1.0, 1.0, 1.0, -1.0, -1.0, 1.0, 1.0])[:, None]


def rotation_columns(attitude: Array) -> Array:
    """Rotation matrices (3, 3, n) of unit quaternions (4, n) w, x, y, z."""
    products = (attitude[:, None] * attitude).reshape(16, -1)
    entries: Array = 2.0 * (products.take(_FIRST, axis=0) + _SIGN * products.take(_SECOND, axis=0))
    entries[::4] = 1.0 - entries[::4]
    return entries.reshape(3, 3, -1)
