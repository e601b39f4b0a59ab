"""Air around aerial vehicles: wind with gusts, downwash of rotors."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import frozen
from vcmvsp.physics.world.world import Wind

Floats = NDArray[np.float64]

GUST_HZ = 60  # new values a second; in between the wind is constant

_BLOCK = 256  # values drawn at once; a run has the same values for any block size


class Gusts:
    """Wind at n vehicles from time 0 on: the mean wind, and gusts that depend only on the seed and a vehicle's name.

    A gust is a first-order Gauss-Markov (Ornstein-Uhlenbeck) process in each component: with correlation time T and standard
    deviation s, its values a time h apart obey exactly

        g(t + h) = exp(-h/T) g(t) + s sqrt(1 - exp(-2 h/T)) N(0, 1)

    which has standard deviation s at any time and the correlation exp(-h/T) for any h; its spectrum is that of Dryden's
    along-wind turbulence (MIL-F-8785C, 3.7.2) for an aircraft that stays in its place. Vertically, s is half as large.
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
        return self._block[:, place]


AIR_KG_M3 = 1.225  # at sea level, 15 degrees (ISO 2533)

_CORE = 6.0  # diameters along which the middle of a jet keeps its speed
_SPREAD = 0.094  # half width of a jet for each metre


def downwash(position: Floats, thrust: Floats, rotor_radius: Floats) -> Floats:
    """Downward airspeed, (n,) m/s, at each of n vehicles from the rotors of the others, which acts on it as wind.

    Vehicles at ``position`` (3, n) m, with the thrust (n,) N of all four rotors and radii (n,) m of one.

    Rotors that carry T on a disc area A move the air through them at v = sqrt(T / 2 rho A), and behind them at 2 v through a
    jet of half the area (momentum theory; Leishman, "Principles of Helicopter Aerodynamics", 2.2). Further down it is a
    turbulent round jet: at the distance x, with the diameter d, its middle moves at 2 v min(1, 6 d / x), and sideways that
    falls off like a Gauss curve which is half as high at max(d / 2, 0.094 x) (Pope, "Turbulent Flows", 5.1). Jets point
    straight down and add up.
    """
    area = 4.0 * math.pi * rotor_radius**2
    jet = 2.0 * np.sqrt(0.5 * thrust / (AIR_KG_M3 * area))
    diameter = np.sqrt(2.0 * area / math.pi)
    below = position[2, :, None] - position[2]  # (from, to)
    aside = (position[0, :, None] - position[0]) ** 2 + (position[1, :, None] - position[1]) ** 2
    under = below > 0.0
    half_width = np.maximum(0.5 * diameter[:, None], _SPREAD * below)
    middle = jet[:, None] * np.minimum(1.0, _CORE * diameter[:, None] / np.where(under, below, 1.0))
    return np.where(under, middle * np.exp2(-aside / half_width**2), 0.0).sum(axis=0)
