"""Builds the scene of an instant for the sensors: vehicles, then movables and moving obstacles."""

from collections.abc import Sequence

import numpy as np

from vcmvsp.cosim.types import Pushed, Vec3, frozen
from vcmvsp.physics.dynamics.movables import on_time, start_of
from vcmvsp.physics.engine.interface import BodyMotion, Touch, still
from vcmvsp.physics.vehicles.specification import VehicleSpec
from vcmvsp.physics.world.scene import Scene
from vcmvsp.physics.world.world import Movable, Moving, World


class SceneBuilder:
    """Rows of bodies: vehicles in the scenario's order, then movables, then moving obstacles; with their ``names``."""

    def __init__(self, world: World, vehicles: Sequence[VehicleSpec], gravity: float) -> None:
        things: list[Movable | Moving] = [*world.movables, *world.moving]
        self._world, self._gravity = world, gravity
        self._vehicles = tuple(spec.name for spec in vehicles)
        vehicle_hulls = [spec.model.hull for spec in vehicles]
        self._hulls = (*vehicle_hulls, *[each.solid.hull for each in things])
        self.names = (*self._vehicles, *[each.name for each in things])
        self._standing = start_of(world.movables)  # where no engine can push movables
        self._published = self._standing.position, self._standing.attitude

    def put(self, number: int, place: Vec3, yaw: float) -> None:
        """Put a movable that no engine can push: its centre at ``place``, m, turned by ``yaw`` rad."""
        own = still(np.array([place]), np.array([yaw]))
        arrays = []
        for before, row in zip(self._standing, own, strict=True):
            arrays.append(np.concatenate([before[:number], row, before[number + 1 :]]))
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
        position, velocity, attitude, angular_velocity = bodies
        return Scene(
            now_ns=now_ns,
            world=self._world,
            vehicles=self._vehicles,
            hulls=self._hulls,
            position=position,
            velocity=velocity,
            attitude=attitude,
            angular_velocity=angular_velocity,
            acceleration=motion.acceleration,
            wheels=motion.wheels,
            touching=[(each.row, each.other, each.place) for each in touches],
            gravity=self._gravity,
        )
