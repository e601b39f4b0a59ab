"""Bodies other than vehicles, and the scene of an instant for the sensors."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vcmvsp.cosim.types import Array, Pushed, Vec3, frozen
from vcmvsp.cosim.util.polygons import overlap_m
from vcmvsp.physics.dynamics.engine import BodyMotion, Touch, on_time, still
from vcmvsp.physics.vehicles.specification import VehicleSpec
from vcmvsp.physics.vehicles.station import NO_HULL, FixedStation
from vcmvsp.physics.world.solids import Hull, rectangle
from vcmvsp.physics.world.world import Movable, Moving, Scene, World


class SceneBuilder:
    """Rows of bodies: vehicles in the scenario's order, then movables, then moving obstacles; with their ``names``."""

    def __init__(self, world: World, vehicles: Sequence[VehicleSpec], gravity: float) -> None:
        things: list[Movable | Moving] = [*world.movables, *world.moving]
        self._world, self._gravity = world, gravity
        self._vehicles = tuple(spec.name for spec in vehicles)
        self._hulls = (*map(_hull, vehicles), *(each.solid.hull for each in things))
        self.names = (*self._vehicles, *[each.name for each in things])
        self._standing = start_of(world.movables)  # if no engine can push movables
        self._published = self._standing.position, self._standing.attitude

    def put(self, number: int, place: Vec3, yaw: float) -> None:
        """Put a movable that no engine can push: its centre at ``place``, m, turned by ``yaw`` rad."""
        both = zip(self._standing, still(np.array([place]), np.array([yaw])), strict=True)
        arrays = [np.concatenate([before[:number], row, before[number + 1 :]]) for before, row in both]
        self._standing = BodyMotion(*arrays)

    def pushed(self, movables: BodyMotion | None) -> Pushed | None:
        """Poses of the movables if they changed since the last call, or since the start."""
        now = self._standing if movables is None else movables
        if all(map(np.array_equal, (now.position, now.attitude), self._published)):
            return None
        position, attitude = self._published = frozen(now.position), frozen(now.attitude)
        return Pushed(names=tuple(each.name for each in self._world.movables), position=position, attitude=attitude)

    def scene(self, now_ns: int, motion: BodyMotion, movables: BodyMotion | None, touches: Sequence[Touch]) -> Scene:
        """The scene of an instant. ``movables`` None: at rest."""
        bodies = [*motion[:4]]
        if len(self.names) > len(self._vehicles):
            pushed, obstacles = self._standing if movables is None else movables, on_time(self._world.moving, now_ns)
            bodies = [np.concatenate(each) for each in zip(bodies, pushed[:4], obstacles[:4], strict=True)]
            for each in bodies:
                each.flags.writeable = False
        arrays: dict[str, Any] = dict(zip(("position", "velocity", "attitude", "angular_velocity"), bodies, strict=True))
        arrays |= {"acceleration": motion.acceleration, "wheels": motion.wheels}
        arguments: dict[str, Any] = {"world": self._world, "vehicles": self._vehicles, "hulls": self._hulls}
        return Scene(now_ns=now_ns, touching=touches, gravity=self._gravity, **arguments, **arrays)


TOUCHES_M = 1e-9  # bodies that only touch do not overlap

_SIDES = 16  # of the polygon in place of a circle when outlines are compared


def _hull(spec: VehicleSpec) -> Hull:
    return NO_HULL if isinstance(spec.model, FixedStation) else spec.model.hull


def start_of(movables: Sequence[Movable]) -> BodyMotion:
    """Movables at their places in the world, at rest."""
    places = np.array([each.pose(0.0) for each in movables], float).reshape(-1, 4)
    return still(places[:, :3], places[:, 3])


def outline(hull: Hull, position: Vec3, heading: float) -> tuple[Array, float, float]:
    """A level hull from above: corners (k, 2) m, counter-clockwise, lowest and highest point, m."""
    (length, width, height), (dx, dy, dz) = hull.size, hull.offset
    cos, sin = np.cos(heading), np.sin(heading)
    x, y = position[0] + cos * dx - sin * dy, position[1] + sin * dx + cos * dy
    if hull.kind == "cylinder":
        angles = heading + np.arange(_SIDES) * (2.0 * np.pi / _SIDES)
        corners = np.column_stack([x + 0.5 * length * np.cos(angles), y + 0.5 * width * np.sin(angles)])
    else:
        corners = rectangle(float(x), float(y), 0.5 * length, 0.5 * width, heading)
    middle = position[2] + dz
    return corners, middle - 0.5 * height, middle + 0.5 * height


def depth_m(a: tuple[Array, float, float], b: tuple[Array, float, float]) -> float:
    """Depth, m, by which two level hulls of `outline` overlap; 0 or less: they are apart."""
    return min(overlap_m(a[0], b[0]), min(a[2], b[2]) - max(a[1], b[1]))
