"""The seam to contention: radios that share the air, simulated event by event.

A frame is offered to its sender's queue, waits there, contends for the air, is sent (a unicast one perhaps several times), and
is then decided: which radios received it, and what kept it from the others. Frames are offered at times that never decrease;
`Medium.advance` works off what happens up to a time, that time included, in order: what happens of itself before what is
offered at the same nanosecond. So it makes no difference in how many steps a medium is advanced.
"""

from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import Protocol, runtime_checkable

import msgspec
import numpy as np
from numpy.typing import NDArray

from vcmvsp.netsim.interfaces.layers import Floats

Codes = NDArray[np.uint8]

Renew = Callable[[int, int], tuple[Floats, Floats]]
"""Of an attempt (0, 1, ...) that begins at a time (ns): levels (n,) mW and patience (n,), see `Offered`."""

Answer = Callable[[int], float]
"""Of the acknowledgement that begins at a time (ns): its fading over that of the attempt last renewed, a ratio of powers."""


class Fate(IntEnum):
    """What became of a frame at one radio."""

    RECEIVED = 0
    UNDETECTED = 1  # too weak to be noticed, whatever else is on the air
    TRANSMITTING = 2  # the receiver was sending itself
    COLLISION = 3  # it would have been received, had nothing else been on the air
    ERROR = 4  # noise alone would have been enough to spoil it
    QUEUE_FULL = 5  # never sent
    EXPIRED = 6  # never sent: waited longer than its lifetime
    BUSY_CHANNEL = 7  # never sent: the air was never found free


class Offered(msgspec.Struct, frozen=True):
    """One frame, handed to its sender's queue."""

    number: int  # names the frame in `Decided`
    time_ns: int  # when it is handed over
    sender: int  # row of the radio that sends it
    to: int  # row of the radio it is meant for; -1: broadcast
    size_bytes: int  # payload
    priority: int  # a frame of a higher one overtakes those that wait
    power_mw: Floats | None  # (n,) its level at every radio, when nothing fades from attempt to attempt; else None
    patience: Floats | None  # (n,) exponential variates -log(1 - u): the frame survives while its hazard is less than this
    renew: Renew  # gives both for an attempt, where they are None or it is a retry
    answer: Answer | None = None  # of an attempt that was renewed; None: the acknowledgement fades as the frame does


class Decided(msgspec.Struct, frozen=True):
    """What became of a frame.

    A unicast frame is decided when it is received, even if its sender does not hear the acknowledgement and tries again; or
    when it is given up.
    """

    number: int
    start_ns: int  # began on the air (its last attempt); -1: never
    end_ns: int  # was decided: end of that attempt, or when it was given up
    attempts: int
    fate: Codes  # (n,) `Fate`; of a unicast frame at the row it is meant for
    least_sinr: Floats  # (n,) ratio of powers, the least while it was on the air (its last attempt)


@runtime_checkable
class Levelled(Protocol):
    """A medium that lets levels be set which no frame tells."""

    @property
    def levels(self) -> Floats:
        """Of acknowledgements, (n, n) mW: how strong each radio (row) is at each other (column)."""

    @property
    def sensitivity_mw(self) -> Floats:
        """The weakest level that each radio notices, (n,)."""


@runtime_checkable
class Powered(Protocol):
    """A medium whose radios answer at the level of what they received, each with a power of its own."""

    @property
    def power_mw(self) -> Floats:
        """Transmitted by each radio, (n,) mW; only their ratios count."""


@runtime_checkable
class Hastened(Protocol):
    """A medium that is quicker once it has been made ready for many frames."""

    def foresee(self, frames: int) -> None:
        """So many more frames will be offered, as it looks: what pays, and is at hand, is made ready. Changes no result."""


class Medium(Protocol):
    """The air that n radios share."""

    def expect(self, frames: int) -> None:
        """About so many frames will be offered: what pays for many only is made ready now, or never. Changes no result."""

    def offer(self, frame: Offered) -> None:
        """Hand over a frame; nothing happens yet."""

    def advance(self, until_ns: int) -> Sequence[Decided]:
        """Everything that is decided up to ``until_ns``, in the order of its time."""

    def next_ns(self) -> int | None:
        """When a frame will be decided next, as long as no other is offered; None: no frame is in a queue or on the air."""
