"""Bodies in Bullet; start reading in `engine`. No other package imports PyBullet, and no motion without Bullet belongs here."""

import os
import sys

# Discard the greeting that PyBullet's C code prints to standard error during its import.
sys.stderr.flush()
_saved, _null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
os.dup2(_null, 2)
try:
    import pybullet as p
finally:
    os.dup2(_saved, 2)
    os.close(_saved)
    os.close(_null)

__all__ = ["FLOOR", "SOLID", "UPRIGHT", "WHEEL", "p", "turned"]

# Collision groups: two shapes meet if each one's group is in the other's mask.
FLOOR, SOLID, WHEEL = 1, 2, 4

UPRIGHT = (0.0, 0.0, 0.0, 1.0)  # x, y, z, w: Bullet's order, which stays inside this package


def turned(heading: float) -> tuple[float, float, float, float]:
    """Bullet's quaternion of a heading, rad."""
    return p.getQuaternionFromEuler((0.0, 0.0, heading))
