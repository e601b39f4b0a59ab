"""Losses of frames that are strong enough to be received."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from vcmvsp.cosim.types import Probability
from vcmvsp.netsim.interfaces.layers import Bools, Draw, Floats, Frame


class NoLoss:
    """Nothing is lost."""

    nothing: ClassVar[bool] = True
    cause: ClassVar[str] = "none"

    def lost(self, frame: Frame, draw: Draw) -> Bools:
        """False for every receiver, (n,)."""
        return np.zeros(frame.rssi_dbm.shape, np.bool_)


@dataclass(frozen=True)
class Bernoulli:
    """Every frame is lost with the same probability on every link, each independently of all others."""

    probability: Probability  # of a message to be lost, whatever its size
    cause: ClassVar[str] = "random loss"

    @property
    def nothing(self) -> bool:
        """Whether nothing is ever lost."""
        return self.probability == 0.0

    def lost(self, frame: Frame, draw: Draw) -> Bools:
        """Which receivers lose the frame, (n,)."""
        return self.lost_by(draw())

    def lost_by(self, draws: Floats) -> Bools:
        """The same of draws (..., n, 2), which is all it goes by."""
        lost: Bools = draws[..., 0] < self.probability
        return lost
