"""Shadowing: slow variations of the level by obstacles, as a random field over pairs of positions."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

import msgspec
import numpy as np

from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Positive, Spread
from vcmvsp.netsim.interfaces.layers import Floats, Paths

_BLOCK = 64  # receivers
Waves = Annotated[int, msgspec.Meta(ge=1, le=4096)]


@dataclass(frozen=True)
class Shadowing:
    """Normal variations of ``sigma_db``, alike where the ends of two links are near each other.

    When one end moves by delta the correlation is ``rho = exp(-delta / correlation_distance_m)``, when both move it is the
    product of both (M. Gudmundson, Correlation model for shadow fading in mobile radio systems, Electronics Letters 27, 1991;
    3GPP TR 38.901, 7.4.4). It depends on the positions and the seed alone, not on step, order of frames or number of vehicles;
    it is equal in both directions, and a vehicle that returns to a place has the same level there again.

    The field is a sum of M = ``waves`` cosines over both ends::

        g(a, b) = sigma sqrt(2 / M) sum_m cos(k_m . a + k'_m . b + phi_m)
        S(a, b) = (g(a, b) + g(b, a)) / sqrt(2 (1 + exp(-2 |a - b| / d)))

    with the spectrum of that correlation in three dimensions, the Cauchy distribution: its radii have the distribution function
    ``2 / pi (theta - sin theta cos theta)``, k = tan(theta) / d. The denominator keeps the standard deviation at sigma
    also where the two ends are near each other and both terms are alike.

    Usual values (3GPP TR 38.901, tables 7.4.1-1 and 7.5-6): street canyon in sight 4 dB and 10 m, out of sight 7.82 dB
    and 13 m.
    """

    sigma_db: Spread = 4.0  # standard deviation
    correlation_distance_m: Positive = 10.0  # when one end has moved so far, the correlation is 1/e
    waves: Waves = 256  # number of waves whose sum is the field

    @property
    def nothing(self) -> bool:
        """Whether the layer has no effect (``sigma_db`` is 0)."""
        return self.sigma_db == 0.0

    def loss_db(self, paths: Paths) -> Floats:
        """Loss of each path beyond the mean, (n,) dB, of either sign."""
        # Sums have the same operands in the same order for both directions, so that they agree to the last bit.
        start_waves, end_waves, phase = _waves(paths.seed, self.correlation_distance_m, self.waves)
        both = np.empty(len(paths.rx))
        for begin in range(0, len(both), _BLOCK):  # intermediate results stay in the cache
            block = slice(begin, begin + _BLOCK)
            tx, rx = paths.tx if paths.tx.ndim == 1 else paths.tx[block], paths.rx[block]
            forth = _cosines(_dot(tx, start_waves) + phase, _dot(rx, end_waves))
            both[block] = forth + _cosines(_dot(rx, start_waves) + phase, _dot(tx, end_waves))
        alike = np.exp(-2.0 / self.correlation_distance_m * paths.distance_m)
        return self.sigma_db / math.sqrt(self.waves) * both / np.sqrt(1.0 + alike)


def _dot(points: Floats, vectors: Floats) -> Floats:
    """Scalar products of points (n, 3) or (3,) with vectors (3, m), not by BLAS, whose last bit depends on the shape."""
    x, y, z = points[..., 0, None], points[..., 1, None], points[..., 2, None]
    return x * vectors[0] + y * vectors[1] + z * vectors[2]


def _cosines(a: Floats, b: Floats) -> Floats:
    """Sum of ``cos(2 pi (a + b))`` over the last axis, (n,); a and b: (n, m) or (m,)."""
    turns = a + b
    turns -= np.rint(turns)
    # Single precision is enough for a fraction of a turn (5e-6 dB), and four times as fast.
    waves = np.cos(turns.astype(np.float32) * np.float32(2.0 * math.pi))
    return waves.sum(axis=-1, dtype=np.float64)


@lru_cache(maxsize=16)
def _waves(seed: int, correlation_distance_m: float, count: int) -> tuple[Floats, Floats, Floats]:
    """Wave vectors for both ends, (3, count) turns/m each, and phases (count,), turns."""
    rng = stream(seed, "radio/shadowing")
    # Radii and two directions each: every one has a draw in each of ``count`` equal parts of its range, in random order (Latin
    # hypercube), so that one field comes nearer to the spectrum than with independent draws. Phases are independent: evenly
    # spread ones would cancel each other near the origin, in every world.
    parts = rng.permuted(np.tile(np.arange(count), (6, 1)), axis=1)
    u = (parts + rng.random((6, count))) / count
    theta = np.linspace(0.0, 0.5 * math.pi, 20_001)
    spread = 2.0 / math.pi * (theta - np.sin(theta) * np.cos(theta))
    radius = np.tan(np.interp(u[0:2], spread, theta)) / (2.0 * math.pi * correlation_distance_m)
    height, azimuth = 2.0 * u[2:4] - 1.0, 2.0 * math.pi * u[4:6]
    flat = np.sqrt(1.0 - height**2)
    vectors = radius * np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), height])
    return vectors[:, 0], vectors[:, 1], rng.random(count)
