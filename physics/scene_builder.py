"""What sensors see of an instant: the vehicles, and the other bodies of the world behind them."""

from collections.abc import Sequence

import numpy as np

from vcmvsp.cosim.types import Pushed, Vec3, frozen
from vcmvsp.physics.dynamics.movables import on_time, start_of
from vcmvsp.physics.engine.interface import Motion, Touch, still
from vcmvsp.physics.vehicles.specification import VehicleSpec
from vcmvsp.physics.world.scene import Scene
from vcmvsp.physics.world.world import Movable, Moving, World


class Stage:
    """Rows of bodies: vehicles in the scenario's order, then movables, then moving obstacles; with their ``names``."""

    def __init__(self, world: World, vehicles: Sequence[VehicleSpec], gravity: float) -> None:
        things: list[Movable | Moving] = [*world.movables, *world.moving]
        self._world, self._gravity = world, gravity
        self._vehicles = tuple(spec.name for spec in vehicles)
        self._hulls = (*(spec.model.hull for spec in vehicles), *(each.solid.hull for each in things))
        self.names = (*self._vehicles, *(each.name for each in things))
        self._standing = start_of(world.movables)
        self._told = self._standing.position, self._standing.attitude

    def put(self, number: int, place: Vec3, yaw: float) -> None:
        """Let a movable stand with its centre there, m, turned by ``yaw`` rad, where nothing can push it."""
        own = still(np.array([place]), np.array([yaw]))
        before = self._standing
        self._standing = Motion(*(np.concatenate([a[:number], b, a[number + 1 :]]) for a, b in zip(before, own, strict=True)))

    def pushed(self, movables: Motion | None) -> Pushed | None:
        """Where movables are, in an engine or else here; None: where they were when this was asked before, or at the start."""
        now = self._standing if movables is None else movables
        if all(map(np.array_equal, (now.position, now.attitude), self._told)):
            return None
        position, attitude = self._told = frozen(now.position), frozen(now.attitude)
        return Pushed(names=tuple(each.name for each in self._world.movables), position=position, attitude=attitude)

    def scene(self, now_ns: int, motion: Motion, movables: Motion | None, touches: Sequence[Touch]) -> Scene:
        """The scene of an instant: how vehicles move, and movables if they do; obstacles keep to their time-tables."""
        bodies = [*motion[:4]]
        if len(self.names) > len(self._vehicles):
            things = (self._standing if movables is None else movables, on_time(self._world.moving, now_ns))
            bodies = [np.concatenate(each) for each in zip(bodies, *(each[:4] for each in things), strict=True)]
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
