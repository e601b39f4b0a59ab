"""Losses in bursts, given by their share and mean length: the channel of `netsim.impairments.gilbert_elliott` by statistics."""

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, ClassVar

import msgspec

from vcmvsp.netsim.impairments.gilbert_elliott import GilbertElliott
from vcmvsp.netsim.interfaces.layers import Bools, Draw, Frame

Share = Annotated[float, msgspec.Meta(ge=0.001, le=0.999)]
Length = Annotated[float, msgspec.Meta(ge=1e-3, le=1e3)]  # s


@dataclass(frozen=True)
class Bursts:
    """Stretches of time in which all frames are lost, and others in which none is; how long they are does not change the share.

    A `GilbertElliott` of ``bad_loss`` 1 and ``good_loss`` 0 with, per second::

        r = 1 / mean_burst_s,    p = r probability / (1 - probability)

    Its bad and good times last exponentially long. Of frames T s apart, the mean row of losses is
    ``1 / ((1 - probability) (1 - exp(-(p + r) T)))`` frames: of very short bursts it is that of independent losses.
    """

    probability: Share = 0.2  # share of the frames that are lost
    mean_burst_s: Length = 1.0  # mean length of a burst
    cause: ClassVar[str] = "burst"

    def lost(self, frame: Frame, draw: Draw) -> Bools:
        """Which receivers lose the frame, (n,)."""
        return self._states.lost(frame, draw)

    @cached_property
    def _states(self) -> GilbertElliott:
        to_good = 1.0 / self.mean_burst_s
        return GilbertElliott(to_good * self.probability / (1.0 - self.probability), to_good)
