"""Path loss over open ground: free space, and the ray that the ground reflects."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from vcmvsp.cosim.types import NonNegative
from vcmvsp.netsim.interfaces.layers import Floats, Paths, distance_of
from vcmvsp.netsim.propagation.path_loss import SPEED_OF_LIGHT, Frequency

_TOUCHING_M = 1e-3  # antennas and heights nearer than this to each other, or to the ground, are taken to be as near as this


@dataclass(frozen=True)
class Friis:
    """Free space between isotropic antennas: ``L = 20 log10(4 pi d / lambda)``, but never a gain (Friis 1946).

    ns-3: ``FriisPropagationLossModel`` with its ``Frequency``.
    """

    by_distance: ClassVar[bool] = True

    frequency_hz: Frequency = 2.4e9  # of the carrier

    def loss_db(self, paths: Paths | ArrayLike) -> Floats:
        """Loss of each path, or over each distance in m, (n,) dB."""
        factor = 4.0 * math.pi * self.frequency_hz / SPEED_OF_LIGHT
        loss: Floats = 20.0 * np.log10(np.maximum(factor * distance_of(paths), 1.0))
        return loss


@dataclass(frozen=True)
class TwoRayGround:
    """Flat ground, whose reflection meets the direct ray almost in opposite phase far away.

    Up to the crossover distance ``4 pi h1 h2 / lambda`` it is free space, beyond it (Rappaport, Wireless Communications, 2002,
    equation 4.52)::

        L = 10 log10(d^4 / (h1 h2)^2)

    where h is an antenna's height above z = 0; where only distances are given, ``antenna_height_m``. Both agree at the
    crossover. ns-3: ``TwoRayGroundPropagationLossModel``, where the height is ``HeightAboveZ``. That one loses nothing nearer
    than its ``MinDistance``, 0.5 m; here it is free space down to contact.
    """

    frequency_hz: Frequency = 2.4e9  # of the carrier
    antenna_height_m: NonNegative = 0.5  # where only distances are known; vehicles have antennas of their own

    def loss_db(self, paths: Paths | ArrayLike) -> Floats:
        """Loss of each path, or over each distance in m between two antennas of ``antenna_height_m``, (n,) dB."""
        here = there = np.array(self.antenna_height_m)
        if isinstance(paths, Paths):
            here, there = paths.tx[2], paths.rx[:, 2]
        product = np.maximum(here, _TOUCHING_M) * np.maximum(there, _TOUCHING_M)
        wave = 4.0 * math.pi * self.frequency_hz / SPEED_OF_LIGHT
        distance = np.maximum(distance_of(paths), _TOUCHING_M)
        near = 20.0 * np.log10(np.maximum(wave * distance, 1.0))
        far = 40.0 * np.log10(distance) - 20.0 * np.log10(product)
        loss: Floats = np.where(distance <= wave * product, near, far)
        return loss
