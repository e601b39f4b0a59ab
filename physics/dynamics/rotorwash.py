"""Effects of rotors on the air, for models that ask for them: more lift above the floor, wind below.

Ground effect: the air under a rotor of radius R at height z cannot flow off freely, which gives it 1 / (1 - (R / 4z)^2) times
the thrust (Cheeseman and Bennett, "The effect of the ground on a helicopter rotor in forward flight", ARC R&M 3021, 1955);
below z = R/2 the factor is constant. Only the floor counts (z = 0), not roofs and tables.

Downwash: rotors that carry T on a disc area A move the air through them at v = sqrt(T / 2 rho A), and behind them at 2 v
through a jet of half the area (momentum theory; Leishman, "Principles of Helicopter Aerodynamics", 2.2). Further down it is a
turbulent round jet: at the distance x, with the diameter d, its middle moves at 2 v min(1, 6 d / x), and sideways that falls
off like a Gauss curve which is half as high at max(d / 2, 0.094 x) (Pope, "Turbulent Flows", 5.1). Jets point straight down
and add up. They act on a vehicle as wind, by its drag.
"""

import math
from collections.abc import Sequence

import numpy as np

from vcmvsp.physics.dynamics.rigid_body import Floats, column
from vcmvsp.physics.vehicles.quadrotor import Quadrotor

AIR_KG_M3 = 1.225  # at sea level, 15 degrees (ISO 2533)

_CORE = 6.0  # diameters that the middle of a jet keeps its speed for
_SPREAD = 0.094  # half width of a jet for each metre
_NEAREST = 0.5  # rotor radii


def ground_effect(height: Floats, rotor_radius: Floats) -> Floats:
    """Factors of the thrust at these heights above the floor, m."""
    quarter = 0.25 * rotor_radius / np.maximum(height, _NEAREST * rotor_radius)
    factors: Floats = 1.0 / (1.0 - quarter * quarter)
    return factors


def downwash(position: Floats, thrust: Floats, rotor_radius: Floats) -> Floats:
    """Downward airspeed, (n,) m/s, at each of n vehicles from the rotors of the others.

    Args:
        position: (3, n) m.
        thrust: (n,) N, of all four rotors.
        rotor_radius: (n,) m.
    """
    area = 4.0 * math.pi * rotor_radius**2
    jet = 2.0 * np.sqrt(0.5 * thrust / (AIR_KG_M3 * area))
    diameter = np.sqrt(2.0 * area / math.pi)
    below = position[2, :, None] - position[2]  # (from, to)
    aside = (position[0, :, None] - position[0]) ** 2 + (position[1, :, None] - position[1]) ** 2
    under = below > 0.0
    half_width = np.maximum(0.5 * diameter[:, None], _SPREAD * below)
    middle = jet[:, None] * np.minimum(1.0, _CORE * diameter[:, None] / np.where(under, below, 1.0))
    speeds: Floats = np.where(under, middle * np.exp2(-aside / half_width**2), 0.0).sum(axis=0)
    return speeds


class Rotorwash:
    """Ground effect and downwash of the vehicles with these models."""

    def __init__(self, models: Sequence[Quadrotor]) -> None:
        self._radius = column(models, "rotor_radius_m")
        self._near_ground = np.array([model.ground_effect for model in models], bool)
        self._blown = np.array([model.downwash for model in models], bool)

    def act(self, position: Floats, thrust: Floats, air: Floats) -> None:
        """Change, in place, the thrust (4, n) N of the rotors and the velocity against the air (3, n) m/s, world."""
        if self._near_ground.any():
            thrust *= np.where(self._near_ground, ground_effect(position[2], self._radius), 1.0)
        if self._blown.any():
            air[2] += np.where(self._blown, downwash(position, thrust.sum(axis=0), self._radius), 0.0)


def of(models: Sequence[Quadrotor]) -> Rotorwash | None:
    """Rotorwash of a fleet; None if no model asks for it."""
    if any(model.ground_effect or model.downwash for model in models):
        return Rotorwash(models)
    return None
