"""World of the vehicles: a flat floor, solids on it, moving bodies, wind and light.

One description serves all: Bullet collides with its triangles (`World.mesh`); scanners, cameras and the radio use its pieces
(`World.shapes`).
"""

import math
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

import msgspec
import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Array, NonNegative, Positive, Probability, Vec3
from vcmvsp.physics.world.clearance import Clearance
from vcmvsp.physics.world.floor import GroundPicture
from vcmvsp.physics.world.overlap import Blocking
from vcmvsp.physics.world.solids import AnySolid, Box, Color, Cylinder, Shapes, color_of, heading_of, shapes_of
from vcmvsp.physics.world.targets import PlacedTarget

__all__ = ["GroundPicture", "Light", "Movable", "Moving", "Wind", "World", "Zone", "made_once"]

T = TypeVar("T")


class Zone(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A rectangle of the floor with a friction of its own for robots: ice, mud. Where zones overlap, the last one counts."""

    center: tuple[float, float]  # x, y, m
    size: tuple[float, float]  # length and width, m, before it is turned
    yaw_rad: float = 0.0  # turned by this
    # multiplies that of robots on it, in place of the floor's; movables and quadrotors keep to the floor's
    friction: NonNegative
    color: Color | None = None  # it is painted in, if at all

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (*self.center, *self.size, self.yaw_rad))) or min(self.size) <= 0.0:
            raise ValueError(f"a zone needs finite numbers and two positive sizes, not center {self.center}, size {self.size}")


class Wind(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Air that moves: the same everywhere, steady or in gusts."""

    velocity: Vec3 = (0.0, 0.0, 0.0)  # of the mean wind, m/s, world
    gust: NonNegative = 0.0  # standard deviation of what is added to each horizontal component, m/s (half of it vertically)
    gust_time_s: Positive = 2.0  # correlation time of the gusts


class Light(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A sun without shadows: how bright a face is depends on its direction."""

    direction: Vec3 = (0.3, 0.2, 1.0)  # from the world to the sun, any length
    ambient: Probability = 0.6  # brightness of faces turned away from it; faces turned to it have 1

    def __post_init__(self) -> None:
        if not any(self.direction) or not all(map(math.isfinite, self.direction)):
            raise ValueError(f"light needs a direction of some length, not {self.direction}")


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
    solid: Box | Cylinder  # a `Box` or a `Cylinder`; where it says it is does not matter
    times_s: tuple[float, ...]  # increasing
    way: tuple[tuple[float, float, float, float], ...]  # centre of the solid, x, y, z m, and its yaw, rad, at each of the times
    loop: bool = False  # begin again after the last time; else it stays there

    def __post_init__(self) -> None:
        rising = all(a < b for a, b in zip(self.times_s, self.times_s[1:], strict=False))
        numbers = (*self.times_s, *(value for place in self.way for value in place))
        if not rising or len(self.times_s) != len(self.way) or not self.way or not all(map(math.isfinite, numbers)):
            raise ValueError(f"the moving obstacle {self.name!r} needs as many finite places in way as increasing times_s")

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
        x, y, z, yaw = ((there - here) / span_s for here, there in zip(self.way[k - 1], self.way[k], strict=True))
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
        distances: Array = np.sqrt(sum(np.maximum(each, 0.0) ** 2 for each in beyond))
        return distances

    def _in_table(self, time_s: float) -> float:
        first, last = self.times_s[0], self.times_s[-1]
        return first + (time_s - first) % (last - first) if self.loop and last > first else time_s


@dataclass(frozen=True, kw_only=True)
class World:
    """A flat floor at z = 0 with everything on and above it."""

    solids: tuple[AnySolid, ...] = ()  # what stands still
    movables: tuple[Movable, ...] = ()  # bodies that can be pushed
    moving: tuple[Moving, ...] = ()  # obstacles that keep to a time-table
    targets: tuple[PlacedTarget, ...] = ()  # flat things on the floor that somebody is to find
    floor_friction: NonNegative = 1.0  # multiplies the friction of what rolls or slides on it
    zones: tuple[Zone, ...] = ()  # parts of the floor with another friction
    ground: GroundPicture = field(default_factory=GroundPicture)  # how the floor looks
    wind: Wind = field(default_factory=Wind)  # see `Wind`
    light: Light = field(default_factory=Light)  # see `Light`
    # west, south, east and north end, m: vehicles start inside. None: no end
    bounds: tuple[float, float, float, float] | None = None
    name: str = "world"  # for titles and messages

    @cached_property
    def shapes(self) -> Shapes:
        """Its solids in pieces."""
        return shapes_of(self.solids)

    def mesh(self) -> tuple[Array, Array]:
        """All solids as one mesh: vertices (v, 3) m, and triangles (t, 3) int, counter-clockwise seen from outside."""
        return self.shapes.mesh()

    def mesh_colors(self) -> Array:
        """Red, green and blue of the triangles of `mesh`, (t, 3) uint8, without light."""
        prisms = [np.repeat(group.solid, 4 * group.corners.shape[1] - 4) for group in self.shapes.groups]  # sides, top, bottom
        solid = np.concatenate([*prisms, self.shapes.triangle_solid])
        colors: Array = np.array([color_of(each) for each in self.solids], np.uint8).reshape(-1, 3)[solid]
        return colors

    @cached_property
    def clearance(self) -> Clearance:
        """Distances to its solids."""
        return Clearance(self.shapes)

    def least_clearance_m(self, time_ns: Array, position: Array) -> float | None:
        """Smallest distance of vehicles to solids and moving obstacles, m, without floor and movables.

        Args:
            time_ns: (m,) instants.
            position: (3, m, n) m, world, of n vehicles; NaN while a vehicle is absent.

        Returns:
            None: the world has no obstacle, or there was no vehicle.
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

        Args:
            corners: convex outline of the body from above, (k, 2) m, counter-clockwise.
            bottom: m.
            top: m.
        """
        deepest = made_once(self, _blocking).deepest(corners, bottom, top)
        return None if deepest is None else (self.solids[deepest[0]], deepest[1])


def _blocking(world: World) -> Blocking:
    return Blocking(world.shapes)


def made_once(world: World, make: Callable[[World], T]) -> T:
    """The result of ``make(world)``, computed once for each world: worlds never change."""
    cache: dict[str, Any] = vars(world)  # as a cached property does
    name = f"_{make.__module__}.{make.__qualname__}"
    if name not in cache:
        cache[name] = make(world)
    result: T = cache[name]
    return result
