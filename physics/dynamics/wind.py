"""Wind at each vehicle: the mean wind of the world, and gusts of its own.

A gust is a first-order Gauss-Markov (Ornstein-Uhlenbeck) process in each component: with correlation time T and standard
deviation s, its values a time h apart obey exactly

    g(t + h) = exp(-h/T) g(t) + s sqrt(1 - exp(-2 h/T)) N(0, 1)

which has standard deviation s at any time and the correlation exp(-h/T) for any h; its spectrum is that of Dryden's along-wind
turbulence (MIL-F-8785C, 3.7.2) for an aircraft that stays in its place. Vertically, s is half as large.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import frozen
from vcmvsp.physics.world.world import Wind

GUST_HZ = 60  # new values a second; in between the wind is steady

_BLOCK = 256  # values drawn at once, of which a run uses the same whatever this is


class Gusts:
    """Wind at n vehicles from time 0 on, each with gusts that depend on nothing but the seed and its name.

    Args:
        wind: mean wind, and spread of the gusts.
        names: of the vehicles, a row each.
        seed: of the run.
    """

    def __init__(self, wind: Wind, names: Sequence[str], seed: int) -> None:
        n = len(names)
        self._mean = frozen(np.broadcast_to(np.asarray(wind.velocity, float), (n, 3)))
        self._steady = wind.gust == 0.0 or n == 0
        self._streams = [stream(seed, f"wind/{name}") for name in names]
        self._keep = math.exp(-1.0 / (GUST_HZ * wind.gust_time_s))
        self._sigma = wind.gust * np.array([1.0, 1.0, 0.5])
        self._fresh = self._sigma * math.sqrt(-math.expm1(-2.0 / (GUST_HZ * wind.gust_time_s)))
        self._tick = 0
        self._block = np.empty((n, 0, 3))
        self._gust: NDArray[np.float64] = np.zeros((n, 3)) if self._steady else self._sigma * self._draw()
        self._now = self._mean if self._steady else frozen(self._mean + self._gust)

    def advance(self, to_ns: int) -> NDArray[np.float64]:
        """Wind (n, 3) m/s, world, read-only, at a time not before that of the last call."""
        tick = ((to_ns + 1) * GUST_HZ - 1) // SECOND_NS  # times of ticks are whole ns too, rounded down
        if self._steady or tick <= self._tick:
            return self._now
        while self._tick < tick:
            self._tick += 1
            self._gust = self._keep * self._gust + self._fresh * self._draw()
        self._now = frozen(self._mean + self._gust)
        return self._now

    def _draw(self) -> NDArray[np.float64]:
        place = self._tick % _BLOCK
        if place == 0:
            self._block = np.array([each.standard_normal((_BLOCK, 3)) for each in self._streams])
        draw: NDArray[np.float64] = self._block[:, place]
        return draw
