"""What several sensors need: where they are mounted, and what is made once of a world and kept with it."""

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from cosim.types import Array, Vec3
from physics.scene import Scene, rotations
from physics.sightline import Sightline
from physics.world import World

T = TypeVar("T")


def rotation(scene: Scene, row: int) -> Array:
    """world_from_body of a body, (3, 3); those of all are worked out together, once an instant."""
    if "rotations" not in scene.cache:
        scene.cache["rotations"] = rotations(scene.attitude)
    matrix: Array = scene.cache["rotations"][row]
    return matrix


def mounted(scene: Scene, row: int, mount: Vec3) -> Array:
    """Where a point of a body is, (3,) m, world; ``mount`` in the body frame, from its reference point."""
    place: Array = scene.position[row]
    return place + rotation(scene, row) @ np.array(mount) if any(mount) else place


def made_once(world: World, make: Callable[[World], T]) -> T:
    """What ``make`` makes of a world, kept as long as the world is: worlds never change."""
    kept: dict[str, Any] = vars(world)  # where a cached property keeps its value
    name = f"_{make.__module__}.{make.__qualname__}"
    if name not in kept:
        kept[name] = make(world)
    made: T = kept[name]
    return made


def sightline(world: World) -> Sightline:
    """What stands between two places."""
    return made_once(world, _sightline)


def _sightline(world: World) -> Sightline:
    return Sightline(world.solids)
