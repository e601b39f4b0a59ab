"""IEEE 802.15.4 at 2.4 GHz (O-QPSK): time on the air and packet errors."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from vcmvsp.cosim.types import Decibels
from vcmvsp.netsim.interfaces.layers import US, Floats
from vcmvsp.netsim.phy.constant_rate import ThermalNoise, over_frames
from vcmvsp.netsim.phy.error_rate import ErrorRate, hazard_of

LARGEST_BYTES = 127 - 11  # payload of a frame


@dataclass(frozen=True)
class Ieee802154:
    """IEEE 802.15.4 at 2.4 GHz, 250 kbit/s, O-QPSK: what ZigBee is built on.

    Air time (IEEE 802.15.4-2006, 6.3 and 6.5): 32 us a byte; 6 bytes of preamble, delimiter and length come before the PSDU,
    which is the payload and 11 bytes: MAC header with short addresses 9, FCS 2. A PSDU has at most 127 bytes: a longer message
    crosses as several frames, 640 us (LIFS, 40 symbols) apart, and is received or lost as one.

    Sensitivity is the standard's -85 dBm (6.5.3.3). It asks for at least -3 dBm of power (6.9.5); 0 dBm, the full power of
    a typical transceiver (TI CC2420 data sheet), is the default.
    """

    tx_power_dbm: Decibels = 0.0  # transmitted power
    # sets the noise, 0.4 dB below it; weakest level at which a frame is noticed, but not with mac csma154
    sensitivity_dbm: Decibels = -85.0

    @property
    def noise_dbm(self) -> float:
        """Thermal noise as in ns-3.44, 0.4 dB below the sensitivity (`netsim.phy.constant_rate.ThermalNoise.ieee802154`)."""
        return ThermalNoise.ieee802154(self.sensitivity_dbm).dbm

    @cached_property
    def errors(self) -> ErrorRate:
        """Packet errors by SINR."""
        return OqpskErrors()

    def air_time_ns(self, size_bytes: int) -> int:
        """(6 + 11 + payload) x 32 us, of each frame that the message needs, and the spaces between them."""
        return over_frames(size_bytes, LARGEST_BYTES, lambda size: (6 + 11 + size) * 32, 640) * US


@dataclass(frozen=True)
class OqpskErrors(ErrorRate):
    """IEEE 802.15.4 at 2.4 GHz: 16 nearly orthogonal sequences (IEEE 802.15.4-2006, Annex E.4.1.8).

    ``pb = 8/15 1/16 sum_(k=2..16) (-1)^k C(16, k) exp(20 x (1/k - 1))``; the same as ns-3.44 ``LrWpanErrorModel``.
    """

    def payload(self, size_bytes: int) -> tuple[ErrorRate, int]:
        """250 kbit/s x the air time of all its frames: preamble, delimiter and length have to survive too."""
        return self, over_frames(size_bytes, LARGEST_BYTES, lambda size: 8 * (6 + 11 + size))

    @property
    def header(self) -> tuple[ErrorRate, int]:
        """No bits: the payload's begin with the preamble."""
        return self, 0

    def hazard(self, sinr: Floats) -> Floats:
        """Hazard of a bit by SINR, (n,). The terms of its sum nearly cancel at low SINR, but 12 digits remain."""
        terms = [(-1) ** k * math.comb(16, k) * np.exp(20.0 * sinr * (1.0 / k - 1.0)) for k in range(2, 17)]
        return hazard_of(8.0 / 15.0 / 16.0 * np.sum(terms, axis=0))
