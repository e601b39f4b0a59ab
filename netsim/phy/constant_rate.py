"""Radio standards: time on the air, transmitted power, noise, sensitivity, packet errors.

Here is the phy without a standard, a constant bit rate; the standards are in `netsim.phy.dsss`, `netsim.phy.ofdm` and
`netsim.phy.ieee802154`. Payload is what the agent sends (``Message.size_bytes``); each standard adds its own headers. Air
times are whole nanoseconds.
"""

import math
from dataclasses import dataclass
from typing import Annotated

import msgspec

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Decibels
from vcmvsp.netsim.interfaces.layers import BitRate

Overhead = Annotated[float, msgspec.Meta(ge=0.0, le=1e3)]  # s


@dataclass(frozen=True)
class ConstantRate:
    """A bit pipe: ``overhead_s`` and then the payload at ``rate_bps``; by default too quick to matter.

    For channels that have no bandwidth (the Wireless Simulation Server has none), where the air time must only not be zero:
    1 us + 1 ns a bit, 1.8 us for 100 bytes. The default sensitivity, 1e-33 W, hears everything.
    """

    rate_bps: BitRate = 1e9  # of the payload
    overhead_s: Overhead = 1e-6  # time on the air besides the payload
    tx_power_dbm: Decibels = 0.0  # transmitted power
    sensitivity_dbm: Decibels = -300.0  # weakest level at which a frame is noticed

    def air_time_ns(self, size_bytes: int) -> int:
        """Overhead and payload, rounded up to 1 ns; at least 1 ns."""
        payload_ns = math.ceil(8 * size_bytes * SECOND_NS / self.rate_bps)
        return max(1, round(self.overhead_s * SECOND_NS) + payload_ns)
