"""What is true at one instant: what sensors measure."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from vcmvsp.cosim.types import Array, Vec3
from vcmvsp.physics.world.solids import Hull
from vcmvsp.physics.world.world import World


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """All vehicles and everything else that moves, at one instant. Rows: the n vehicles first, then the other bodies.

    Arrays are read-only and never change: a scene may be kept and looked at later.

    Args:
        now_ns: the instant.
        world: what stands still.
        vehicles: names of the n vehicles.
        hulls: of all b bodies.
        position: (b, 3) m, world, of the reference points.
        velocity: (b, 3) m/s, world.
        attitude: (b, 4) w, x, y, z; world_from_body.
        angular_velocity: (b, 3) rad/s, body.
        acceleration: (n, 3) m/s2, world, mean over the last step of physics; without gravity taken off or added.
        wheels: (n, 2) rad, how far the left and right wheel have turned; NaN where there are none.
        touching: pairs of rows that touch; None stands for the world. With the place of the contact, m, world.
        gravity: m/s2.
        cache: what sensors of one kind share at this instant; filled by them.
    """

    now_ns: int
    world: World
    vehicles: tuple[str, ...]
    hulls: tuple[Hull, ...]
    position: Array
    velocity: Array
    attitude: Array
    angular_velocity: Array
    acceleration: Array
    wheels: Array
    touching: Sequence[tuple[int, int | None, Vec3]] = ()
    gravity: float = 9.81
    cache: dict[str, Any] = field(default_factory=dict)

    def rotation(self, row: int) -> Array:
        """world_from_body of a body, (3, 3); those of all are worked out together, when the first is asked for."""
        matrix: Array = self._rotations[row]
        return matrix

    def point(self, row: int, mount: Vec3) -> Array:
        """Where a point of a body is, (3,) m, world; ``mount`` in the body frame, from its reference point."""
        place: Array = self.position[row]
        return place + self.rotation(row) @ np.array(mount) if any(mount) else place

    @cached_property
    def _rotations(self) -> Array:
        return rotations(self.attitude)


def rotations(attitude: Array) -> Array:
    """Rotation matrices (n, 3, 3) of unit quaternions (n, 4) w, x, y, z."""
    w, x, y, z = attitude.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrices: Array = np.moveaxis(np.array(rows), -1, 0)
    return matrices
