"""Path loss: how a signal weakens on its way."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from vcmvsp.cosim.types import Decibels, Positive
from vcmvsp.netsim.interfaces.layers import Floats, Paths, distance_of

SPEED_OF_LIGHT = 299_792_458.0  # m/s

Exponent = Annotated[float, msgspec.Meta(ge=0, le=100)]
Frequency = Annotated[float, msgspec.Meta(ge=1e6, le=1e12)]  # Hz: gigahertz are a slip that would pass for a number

_TOUCHING_M = 1e-3


class NoPathLoss:
    """Every receiver hears the transmitted power."""

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
    reference_distance_m: Positive = 1.0  # d0: nearer than that, the loss stays what it is there
    reference_loss_db: Decibels = 40.052  # L0: loss at d0
    clamp: bool = True  # false: nearer than d0 the loss goes on falling

    def loss_db(self, paths: Paths | ArrayLike) -> Floats:
        """Loss of each path, or over each distance in m, (n,) dB."""
        nearest = self.reference_distance_m if self.clamp else _TOUCHING_M
        ratio = np.maximum(distance_of(paths), nearest) / self.reference_distance_m
        loss: Floats = self.reference_loss_db + 10.0 * self.exponent * np.log10(ratio)
        return loss
