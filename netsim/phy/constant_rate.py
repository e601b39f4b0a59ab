"""Radio standards: time on the air, transmitted power, noise, sensitivity, packet errors.

This module has noise, messages of several frames, and a constant bit rate without a standard; the standards are in
`netsim.phy.dsss`, `netsim.phy.ofdm` and `netsim.phy.ieee802154`. The payload is the agent's message (``Message.size_bytes``);
each standard adds its own headers. Air times are whole nanoseconds.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Self

import msgspec

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Decibels, Positive
from vcmvsp.netsim.interfaces.layers import BitRate

Overhead = Annotated[float, msgspec.Meta(ge=0.0, le=1e3)]  # s


@dataclass(frozen=True)
class ConstantRate:
    """A bit pipe: ``overhead_s`` and then the payload at ``rate_bps``; by default too quick to matter.

    For channels without bandwidth, like the Wireless Simulation Server, where the air time must only not be zero: 1 us + 1 ns a
    bit, 1.8 us for 100 bytes. With the default sensitivity, 1e-33 W, every frame is received.
    """

    rate_bps: BitRate = 1e9  # of the payload
    overhead_s: Overhead = 1e-6  # time on the air besides the payload
    tx_power_dbm: Decibels = 0.0  # transmitted power
    sensitivity_dbm: Decibels = -300.0  # weakest level at which a frame is noticed

    def air_time_ns(self, size_bytes: int) -> int:
        """Overhead and payload, rounded up to 1 ns; at least 1 ns."""
        payload_ns = math.ceil(8 * size_bytes * SECOND_NS / self.rate_bps)
        return max(1, round(self.overhead_s * SECOND_NS) + payload_ns)


BOLTZMANN = 1.380649e-23  # J/K (SI)
TEMPERATURE_K = 290.0  # of the standard definition of noise figure


@dataclass(frozen=True)
class ThermalNoise:
    """``N = k 290 K B F``: bandwidth B, noise figure F.

    The defaults, -93.965 dBm, are as in ns-3.44 for IEEE 802.11: 7 dB (``WifiPhy::RxNoiseFigure``) over 20 MHz, also for
    DSSS, whose error formulas assume it.
    """

    bandwidth_hz: Positive = 20e6
    noise_figure_db: float = 7.0

    @classmethod
    def ieee802154(cls, sensitivity_dbm: float = -85.0) -> Self:
        """The noise of an 802.15.4 receiver with this sensitivity.

        As in ns-3.44 (``LrWpanPhy::SetRxSensitivity``): over 5 MHz, with a figure that is 0 dB at a sensitivity of -106.58
        dBm. It is 0.406 dB below the sensitivity.
        """
        return cls(5e6, sensitivity_dbm + 106.58)

    @property
    def dbm(self) -> float:
        """Noise power."""
        watts = BOLTZMANN * TEMPERATURE_K * self.bandwidth_hz
        return 10.0 * math.log10(watts) + 30.0 + self.noise_figure_db


LARGEST_MSDU_BYTES = 2304 - 8  # IEEE 802.11-2016, 9.2.4.7.1: payload of an MSDU, without LLC and SNAP


def over_frames(size_bytes: int, largest_bytes: int, of_frame: Callable[[int], int], between: int = 0) -> int:
    """Sum over the frames of a message: full ones and the last.

    Args:
        size_bytes: of the message.
        largest_bytes: payload of one frame.
        of_frame: value of a frame with this payload.
        between: value of the space between two frames.
    """
    full = max(0, -(-size_bytes // largest_bytes) - 1)
    return full * (of_frame(largest_bytes) + between) + of_frame(size_bytes - full * largest_bytes)
