"""Bodies in Bullet. Only here is PyBullet imported; the other modules of this package take it from here.

`engine` is the way in; `ground_robots` drive, `quadrotors` fly, `world_bodies` stand, can be pushed or move by a time-table.
No motion without Bullet belongs here.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def _silent_stderr() -> Iterator[None]:
    """PyBullet's C code greets on standard error when it is imported; the file descriptor leads nowhere meanwhile."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


with _silent_stderr():
    import pybullet as p

__all__ = ["FLOOR", "SOLID", "UPRIGHT", "WHEEL", "p", "turned"]

# Collision groups: two shapes meet if each one's group is in the other's mask.
FLOOR, SOLID, WHEEL = 1, 2, 4

UPRIGHT = (0.0, 0.0, 0.0, 1.0)  # x, y, z, w: Bullet's order, which stays inside this package


def turned(heading: float) -> tuple[float, float, float, float]:
    """Bullet's quaternion of a heading, rad."""
    quaternion: tuple[float, float, float, float] = p.getQuaternionFromEuler((0.0, 0.0, heading))
    return quaternion
