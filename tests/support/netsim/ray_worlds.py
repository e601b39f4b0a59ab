"""Rays among solids, and their field."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vcmvsp.netsim.interfaces.layers import Floats
from vcmvsp.netsim.propagation.rays.arrays import Complex
from vcmvsp.netsim.propagation.rays.loss import Rays, Traced
from vcmvsp.physics.raycast.surfaces import SolidSurfaces
from vcmvsp.physics.world.solids import AnySolid


def rays_among(*solids: AnySolid, **keys: Any) -> Rays:
    """Rays among solids at 2.4 GHz, without a ground by default."""
    return Rays(SolidSurfaces(solids), **{"ground": "none", **keys})


def trace_paths(rays: Rays, a: Sequence[float] | Floats, b: Sequence[float] | Floats) -> Traced:
    """Paths between points, (3,) or (n, 3) m each."""
    here, there = np.broadcast_arrays(np.atleast_2d(np.array(a, float)), np.atleast_2d(np.array(b, float)))
    return rays.traced(here.copy(), there.copy())


def field(rays: Rays, a: Sequence[float] | Floats, b: Sequence[float] | Floats) -> Complex:
    """Sum of the waves of all paths of each pair, without paths over the roofs, (n,)."""
    found = trace_paths(rays, a, b)
    pairs = max(len(np.atleast_2d(a)), len(np.atleast_2d(b)))
    gain = found.table.gain
    real, imaginary = (np.bincount(found.table.pair, part, pairs) for part in (gain.real, gain.imag))
    return np.asarray(real + 1j * imaginary)


def kinds(found: Traced) -> list[str]:
    """Interactions of each path: S reflected, X diffracted."""
    table = found.table
    rows = zip(table.element.tolist(), table.steps.tolist(), strict=True)
    return ["".join("S" if element >= 0 else "X" for element in row[:count]) for row, count in rows]
