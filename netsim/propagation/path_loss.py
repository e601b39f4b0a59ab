"""Path loss: log-distance, free space (Friis) and flat ground (two-ray)."""

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from vcmvsp.cosim.types import Decibels, NonNegative, Positive
from vcmvsp.netsim.interfaces.layers import Floats, Paths, distance_of

SPEED_OF_LIGHT = 299_792_458.0  # m/s

Exponent = Annotated[float, msgspec.Meta(ge=0, le=100)]
Frequency = Annotated[float, msgspec.Meta(ge=1e6, le=1e12)]  # Hz: the bounds reject values in GHz

_TOUCHING_M = 1e-3  # least distance of two antennas, and least height above the ground


class NoPathLoss:
    """No path loss: every receiver receives the transmitted power."""

    by_distance: ClassVar[bool] = True

    def loss_db(self, paths: Paths | ArrayLike) -> Floats:
        """Zeros, (n,) dB."""
        return np.zeros(distance_of(paths).shape)


@dataclass(frozen=True)
class LogDistance:
    """Loss that grows with the logarithm of distance: ``L = L0 + 10 N log10(max(d, d0) / d0)``.

    Both usual conventions are this one. In ns-3 (``LogDistancePropagationLossModel``) L0 is ``ReferenceLoss`` and the level is
    ``Ptx - L``. The USARSim Wireless Simulation Server, and Toh 2012 section 6.2.3, give the received level at d0 instead,
    ``S = Pd0 - 10 N log10(d / d0)``: that is ``L0 = Ptx - Pd0``. Nearer than d0 the
    loss stays L0; without ``clamp`` it goes on falling, as it does there (down to 1 mm).

    The default loss is that of free space over 1 m at 2.4 GHz; the default exponent is ns-3's.
    """

    by_distance: ClassVar[bool] = True

    exponent: Exponent = 3.0  # N: 2 in free space, about 3 among obstacles
    reference_distance_m: Positive = 1.0  # d0: distance at which the loss is L0
    reference_loss_db: Decibels = 40.052  # L0: loss at d0
    clamp: bool = True  # true: constant loss below d0; false: the loss also falls below d0

    def loss_db(self, paths: Paths | ArrayLike) -> Floats:
        """Loss of each path, or over each distance in m, (n,) dB."""
        nearest = self.reference_distance_m if self.clamp else _TOUCHING_M
        ratio = np.maximum(distance_of(paths), nearest) / self.reference_distance_m
        return self.reference_loss_db + 10.0 * self.exponent * np.log10(ratio)


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
        return 20.0 * np.log10(np.maximum(factor * distance_of(paths), 1.0))


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
    antenna_height_m: NonNegative = 0.5  # height if only distances are known; vehicles have their own antenna heights

    def loss_db(self, paths: Paths | ArrayLike) -> Floats:
        """Loss of each path, or over each distance in m between two antennas of ``antenna_height_m``, (n,) dB."""
        tx_height_m = rx_height_m = np.array(self.antenna_height_m)
        if isinstance(paths, Paths):
            tx_height_m, rx_height_m = paths.tx[2], paths.rx[:, 2]
        product = np.maximum(tx_height_m, _TOUCHING_M) * np.maximum(rx_height_m, _TOUCHING_M)
        wave = 4.0 * math.pi * self.frequency_hz / SPEED_OF_LIGHT
        distance = np.maximum(distance_of(paths), _TOUCHING_M)
        near = 20.0 * np.log10(np.maximum(wave * distance, 1.0))
        far = 40.0 * np.log10(distance) - 20.0 * np.log10(product)
        return np.where(distance <= wave * product, near, far)
