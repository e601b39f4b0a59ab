"""Medium access: its protocol, and ideal access without contention.

Contended media are simulated event by event.

A frame is offered to its sender's queue, waits there, contends, is sent (a unicast one perhaps several times) and is then
decided: its `Fate` at every radio. Frames are offered at times that never decrease. `Medium.advance` processes all events up to
a time, inclusive, in order; events of the medium precede offers of the same nanosecond. So the number of steps has no effect.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from vcmvsp.netsim.interfaces.layers import Floats, Ints, Keys, Phy

Codes = NDArray[np.uint8]

Renew = Callable[[int, int], tuple[Floats, Floats]]
"""Gives levels (n,) mW and patience (n,), see `Offered`, of an attempt (0, 1, ...) that begins at a time (ns)."""

Answer = Callable[[int], float]
"""Gives the fading of the acknowledgement that begins at a time (ns) over that of the attempt renewed last, as a ratio."""


class Fate(IntEnum):
    """Outcome of a frame on the medium at one radio."""

    RECEIVED = 0
    UNDETECTED = 1  # too weak even without interference
    TRANSMITTING = 2  # the receiver was sending
    COLLISION = 3  # received without interference
    ERROR = 4  # lost by noise alone
    QUEUE_FULL = 5  # never sent
    EXPIRED = 6  # never sent: waited longer than its lifetime
    BUSY_CHANNEL = 7  # never sent: the medium was always busy


class Offered(msgspec.Struct, frozen=True):
    """One frame, handed to its sender's queue."""

    number: int  # of the frame, for `Decided`
    time_ns: int  # of the offer
    sender: int  # row of the radio
    to: int  # row of the destination; -1: broadcast
    size_bytes: int  # payload
    priority: int  # a frame overtakes waiting frames of lower priority
    power_mw: Floats | None  # (n,) its level at every radio; None: changes from attempt to attempt
    patience: Floats | None  # (n,) exponential variates -log(1 - u): the frame survives while its hazard is less than this
    renew: Renew  # gives both for a retry, or if they are None
    answer: Answer | None = None  # fading of the acknowledgement; None: it fades as the frame does


class Decided(msgspec.Struct, frozen=True):
    """Decision of a frame.

    A unicast frame is decided at its first reception, even if the acknowledgement is lost and the sender retries, or when it is
    given up.
    """

    number: int
    start_ns: int  # of the last attempt; -1: never sent
    end_ns: int  # of that attempt, or the time at which it was given up
    attempts: int
    fate: Codes  # (n,) `Fate`; of a unicast frame valid at its destination
    least_sinr: Floats  # (n,) minimum ratio of powers during the last attempt


class DecidedFrames(NamedTuple):
    """Decisions of m frames at n radios, in the order of time; fields: see `Decided`."""

    number: Ints  # (m,)
    start_ns: Ints  # (m,)
    end_ns: Ints  # (m,)
    attempts: Ints  # (m,)
    fate: Codes  # (m, n)
    least_sinr: Floats  # (m, n)

    @classmethod
    def of(cls, decided: Sequence[Decided]) -> "DecidedFrames":
        """Decisions of several frames."""
        return cls._make(np.array([getattr(each, name) for each in decided]) for name in cls._fields)

    def frames(self) -> Iterator[Decided]:
        """The decisions one by one."""
        columns = (column.tolist() for column in self[:4])
        for k, (number, start_ns, end_ns, attempts) in enumerate(zip(*columns, strict=True)):
            yield Decided(number, start_ns, end_ns, attempts, self.fate[k], self.least_sinr[k])


class Medium(Protocol):
    """The shared medium of n radios.

    Optional attributes: ``levels`` (n, n) mW of acknowledgements, sender by row, and ``sensitivity_mw`` (n,) of the radios,
    which the channel sets; ``power_mw`` (n,) of the radios, by which a medium without ``levels`` scales acknowledgements;
    ``foresee(frames)``, a hint of the number of further frames; ``advance_many``, all decisions as arrays, and ``offer_many``,
    arrays of broadcasts, see `netsim.mac.dcf.medium.DcfMedium`.
    """

    def expect(self, frames: int) -> None:
        """Hint of the expected number of frames; decides now whether to compile. Changes no result."""

    def offer(self, frame: Offered) -> None:
        """Hand over a frame; nothing happens yet."""

    def advance(self, until_ns: int) -> Sequence[Decided]:
        """All decisions up to ``until_ns``, in order of time."""

    def next_ns(self) -> int | None:
        """Earliest time of the next decision if no other frame is offered; None: no frame is in a queue or on the air."""


class Mac(Protocol):
    """A rule of medium access."""

    def open(self, phy: Phy, count: int, keys: Keys, noise_mw: float) -> Medium | None:
        """The medium of ``count`` radios with random keys (count,); None: no contention."""


def thresholds(mac: Mac, phy: Phy) -> tuple[float, float]:
    """Least level, dBm, and least SINR, dB, at which a frame is noticed; a mac with ``needs_snr_db`` uses the SINR alone."""
    own: float | None = getattr(mac, "needs_snr_db", None)
    if own is not None:
        return -math.inf, own
    return phy.sensitivity_dbm, getattr(phy, "preamble_snr_db", -math.inf)


@dataclass(frozen=True)
class Ideal:
    """No contention: frames wait for earlier frames of the same radio only.

    No collisions, no interframe spaces; radios receive while they send. The queue is unbounded.
    """

    def open(self, phy: Phy, count: int, keys: Keys, noise_mw: float) -> Medium | None:
        """None: no contention."""
        return None
