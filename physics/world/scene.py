"""True state of the world at one instant: the input of sensors."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.types import Array, Vec3
from vcmvsp.physics.world.solids import Hull
from vcmvsp.physics.world.world import World


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
    cache: dict[str, Any] = field(default_factory=dict)  # what sensors of one kind share at this instant; filled by them

    def rotation(self, row: int) -> Array:
        """world_from_body of a body, (3, 3)."""
        matrix: Array = self._rotations[row]
        return matrix

    def point(self, row: int, mount: Vec3) -> Array:
        """Position of a point of a body, (3,) m, world; ``mount`` in the body frame, from its reference point."""
        place: Array = self.position[row]
        return place + self.rotation(row) @ np.array(mount) if any(mount) else place

    @cached_property
    def _rotations(self) -> Array:
        return rotations(self.attitude)


def rotations(attitude: Array) -> Array:
    """Rotation matrices (n, 3, 3) of unit quaternions (n, 4) w, x, y, z."""
    return np.moveaxis(rotation_columns(attitude.T), -1, 0)


def pairs(*products: tuple[int, int]) -> NDArray[np.intp]:
    """Places of products of two components of a quaternion among all 16."""
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
