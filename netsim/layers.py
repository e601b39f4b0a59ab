"""The seams of the channel: what each layer is given, and the one question it answers.

==========  =====================  ==========================================================
layer       verb                   question
==========  =====================  ==========================================================
path_loss   ``loss_db(paths)``     how much weaker is the signal at each receiver?
phy         ``air_time_ns(size)``  how long is the frame on the air? (also power, sensitivity)
loss        ``lost(frame, draw)``  which receivers lose the frame although it is strong enough?
delay       ``delay_ns(frame, draw)``  how long after its sending may it arrive at the earliest?
==========  =====================  ==========================================================

A layer is any object with that verb: no base class. It answers for all receivers at once, each receiver's answer depends on
that receiver alone, and the same arguments give the same answer: a layer that needs chance takes it from ``draw``.
"""

from collections.abc import Callable
from typing import Protocol, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

Draw = Callable[[], Floats]
"""Two independent uniforms in [0, 1) per receiver, shape (n, 2): this layer's own for this frame, equal at every call."""


class Paths(msgspec.Struct, frozen=True):
    """The straight lines from one transmitter to n receivers."""

    tx: Floats  # (3,) m, world
    rx: Floats  # (n, 3) m, world
    distance_m: Floats  # (n,) three-dimensional

    @classmethod
    def between(cls, tx: Floats, rx: Floats) -> Self:
        """Paths from the point ``tx`` (3,) to the points ``rx`` (n, 3)."""
        offset = rx - tx
        return cls(tx, rx, np.sqrt(np.einsum("ij,ij->i", offset, offset)))


class Frame(msgspec.Struct, frozen=True):
    """One frame as it reaches n receivers."""

    sent_ns: int  # handed to the radio
    start_ns: int  # begins on the air: later than ``sent_ns`` where the sender's last frame was still on it
    end_ns: int  # ends on the air
    size_bytes: int  # payload
    paths: Paths
    rssi_dbm: Floats  # (n,) received level


class PathLoss(Protocol):
    """What distance and whatever lies between take from a signal."""

    def loss_db(self, paths: Paths) -> Floats:
        """Loss of each path, (n,) dB: finite, and the same in both directions."""


class Phy(Protocol):
    """A radio standard at one bit rate."""

    @property
    def tx_power_dbm(self) -> float:
        """Transmitted power, antenna gains included."""

    @property
    def sensitivity_dbm(self) -> float:
        """The weakest level that is received."""

    def air_time_ns(self, size_bytes: int) -> int:
        """Time on the air of a frame with this payload; at least 1 ns, and never less for a longer payload."""


class Loss(Protocol):
    """What is lost at a level that is strong enough."""

    @property
    def cause(self) -> str:
        """What the recording says of such a frame."""

    def lost(self, frame: Frame, draw: Draw) -> Bools:
        """Which receivers lose the frame, (n,)."""


class Delay(Protocol):
    """What makes a frame late beyond its time on the air."""

    def delay_ns(self, frame: Frame, draw: Draw) -> Ints:
        """Earliest reception, counted from the sending, (n,) ns; before the frame's end it means: at its end."""
