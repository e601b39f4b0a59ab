"""Other vehicles, real or simulated, as obstacles."""

import msgspec
import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.hardware.safety.obstacle_distance import Obstacles, Stadiums


class Others(msgspec.Struct, frozen=True):
    """Other vehicles at one instant, a row each."""

    position: Array  # (n, 2) or (n, 3) m, world
    velocity: Array  # of the same shape, m/s, world
    radius: Array  # (n,) m, of a circle around the body

    def finite(self) -> bool:
        """Whether all numbers are finite."""
        return all(bool(np.isfinite(each).all()) for each in (self.position, self.velocity, self.radius))

    def around(self, x: float, y: float, margin: float) -> Obstacles:
        """The others as obstacles of a robot at (x, y); its centre stays ``margin`` m away from their bodies.

        Each counts with its speed of approach; receding adds no room.
        """
        position, velocity = _plane(self.position), _plane(self.velocity)
        to = position - (x, y)
        distance = np.hypot(to[:, 0], to[:, 1])
        approach = -np.einsum("ij,ij->i", to, velocity)
        closing = np.maximum(approach, 0.0) / np.where(distance > 0.0, distance, 1.0)
        return Stadiums(x, y, position, position, np.asarray(self.radius, float) + margin, closing)


def _plane(vectors: Array) -> Array:
    """East and north components, (n, 2)."""
    rows: Array = np.asarray(vectors, float)
    return rows[:, :2] if rows.size else np.empty((0, 2))
