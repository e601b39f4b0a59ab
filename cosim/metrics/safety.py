"""How near vehicles came to each other and to what stood or moved in their way, at recorded instants."""

from typing import Any

import numpy as np

from vcmvsp.cosim.config import registry
from vcmvsp.cosim.metrics.motion import Motion


def safety_metrics(moved: Motion, collisions: int, world: Any) -> dict[str, Any]:
    """The ``safety`` part; ``world`` is what the vehicles moved in, None where that is not known."""
    least_clearance_m = None if world is None else registry.piece("least clearance")(world, moved.time_ns, moved.position)
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
