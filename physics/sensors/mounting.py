"""What several sensors need: where they are mounted, and what stands between two places."""

import numpy as np

from vcmvsp.cosim.types import Array, Vec3
from vcmvsp.physics.line_of_sight.sightline import Sightline
from vcmvsp.physics.world.scene import Scene
from vcmvsp.physics.world.world import World, made_once


def mounted(scene: Scene, row: int, mount: Vec3) -> Array:
    """Where a point of a body is, (3,) m, world; ``mount`` in the body frame, from its reference point."""
    place: Array = scene.position[row]
    return place + scene.rotation(row) @ np.array(mount) if any(mount) else place


def sightline(world: World) -> Sightline:
    """What stands between two places."""
    return made_once(world, _sightline)


def _sightline(world: World) -> Sightline:
    return Sightline(world.solids)
