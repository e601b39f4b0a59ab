"""What several sensors need: where they are mounted, and what stands between two places."""

import numpy as np

from cosim.types import Array, Vec3
from physics.scene import Scene
from physics.sightline import Sightline
from physics.world import World, made_once


def mounted(scene: Scene, row: int, mount: Vec3) -> Array:
    """Where a point of a body is, (3,) m, world; ``mount`` in the body frame, from its reference point."""
    place: Array = scene.position[row]
    return place + scene.rotation(row) @ np.array(mount) if any(mount) else place


def sightline(world: World) -> Sightline:
    """What stands between two places."""
    return made_once(world, _sightline)


def _sightline(world: World) -> Sightline:
    return Sightline(world.solids)
