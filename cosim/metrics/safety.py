"""How near vehicles came to each other and to what stood or moved in their way, at recorded instants."""

from typing import Any, Protocol

import numpy as np

from vcmvsp.cosim.metrics.motion import Motion
from vcmvsp.cosim.types import Array


class WorldClearance(Protocol):
    """Obstacles of a run: `physics.world.world.World`."""

    def least_clearance_m(self, time_ns: Array, position: Array) -> float | None:
        """Smallest distance (m) of any place (3, m, n) m to an obstacle at the m instants."""


def safety_metrics(moved: Motion, collisions: int, world: WorldClearance | None) -> dict[str, Any]:
    """The ``safety`` part; ``world`` is what the vehicles moved in, None where that is not known."""
    least_clearance_m = None if world is None else world.least_clearance_m(moved.time_ns, moved.position)
    return {
        "collisions": collisions,
        "min_separation_m": min_separation_m(moved),
        "min_clearance_m": least_clearance_m,
    }


def min_separation_m(moved: Motion) -> float | None:
    """Smallest distance (m) between the centres of any two vehicles at any recorded instant."""
    best = np.inf
    for shift in range(1, len(moved.names)):  # column j against column j + shift: every pair once, whole blocks of memory
        apart = moved.position[:, :, shift:] - moved.position[:, :, :-shift]
        squared = np.einsum("kmn,kmn->mn", apart, apart)
        best = min(best, np.fmin.reduce(squared, axis=None, initial=np.inf))
    return float(np.sqrt(best)) if best < np.inf else None
