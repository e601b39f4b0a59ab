"""Delays beyond the time on the air: relays, gateways, operating systems."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.types import Seconds
from vcmvsp.netsim.interfaces.layers import Draw, Floats, Frame, Ints


class NoDelay:
    """A frame is received when it ends."""

    nothing = True

    def delay_ns(self, frame: Frame, draw: Draw) -> Ints:
        """Zeros, (n,) ns: earlier than the end of any frame."""
        return np.zeros(frame.rssi_dbm.shape, np.int64)


@dataclass(frozen=True)
class FixedDelay:
    """A frame is received ``seconds`` after it was handed to the radio, give or take up to ``jitter_s``.

    The time on the air, and the wait for the sender's earlier frames, are part of ``seconds`` and not added to it; but no frame
    arrives before its last bit::

        received = max(end of the frame, sent + seconds + jitter)

    So agents at 10 Hz with ``seconds = 0.1`` hear each message exactly one period after it was sent. The jitter is uniform in
    [-jitter_s, +jitter_s], drawn for each frame and receiver; one that exceeds half the sending period lets frames overtake.
    """

    seconds: Seconds  # from sending to reception, time on the air included
    jitter_s: Seconds = 0.0  # uniform, give or take

    @property
    def nothing(self) -> bool:
        """Whether every frame is received when it ends."""
        return not (self._fixed_ns or self._jitter_ns)

    def delay_ns(self, frame: Frame, draw: Draw) -> Ints:
        """Earliest reception, counted from the sending, (n,) whole ns."""
        if not self._jitter_ns:
            return np.full(frame.rssi_dbm.shape, self._fixed_ns, np.int64)
        return self.delay_ns_by(draw())

    def delay_ns_by(self, draws: Floats) -> Ints:
        """The same of draws (..., n, 2), which is all it goes by."""
        jitter = (2.0 * draws[..., 0] - 1.0) * self._jitter_ns
        delay: Ints = self._fixed_ns + np.rint(jitter).astype(np.int64)
        return delay

    @cached_property
    def _fixed_ns(self) -> int:
        return seconds_to_ns(self.seconds)

    @cached_property
    def _jitter_ns(self) -> int:
        return seconds_to_ns(self.jitter_s)
