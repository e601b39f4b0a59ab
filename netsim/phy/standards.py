"""Radio standards: time on the air, transmitted power, noise, sensitivity, packet errors.

Payload is what the agent sends (``Message.size_bytes``); each standard adds its own headers. Air times are whole nanoseconds.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated

import msgspec

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Decibels
from vcmvsp.netsim.phy.noise import ThermalNoise

if TYPE_CHECKING:  # error rates reckon with air times, and so know this module
    from vcmvsp.netsim.phy.error_rate import ErrorRate

BitRate = Annotated[float, msgspec.Meta(ge=1.0, le=1e15)]  # bit/s
Overhead = Annotated[float, msgspec.Meta(ge=0.0, le=1e3)]  # s

US = 1_000  # ns


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


@dataclass(frozen=True)
class Dsss:
    """IEEE 802.11b at 1, 2, 5.5 or 11 Mbit/s with the long preamble.

    Air time (IEEE 802.11-2016, 15.2 and 16.2): preamble and header 192 us, then the PSDU, rounded up to 1 us. The PSDU is the
    payload and 36 bytes: MAC header 24, FCS 4, LLC and SNAP 8.

    Power, sensitivity and noise are those of ns-3.44: 16.0206 dBm (40 mW; ``WifiPhy::TxPowerStart``); a preamble is noticed
    from -82 dBm and 4 dB above noise and interference on (``ThresholdPreambleDetectionModel``), at every rate; the noise
    figure is 7 dB. With these the gain of spreading is out of reach: at -82 dBm the SNR is 12 dB, and 1 Mbit/s needs -5.
    """

    rate_bps: BitRate = 1e6  # 1e6, 2e6, 5.5e6 or 11e6
    tx_power_dbm: Decibels = 16.0206  # transmitted power
    sensitivity_dbm: Decibels = -82.0  # weakest level at which a frame is noticed
    noise_figure_db: Decibels = 7.0  # of the receiver, above the thermal noise in 20 MHz
    preamble_snr_db: Decibels = 4.0  # least ratio to noise and interference at which a frame is noticed

    def __post_init__(self) -> None:
        if self.rate_bps not in (1e6, 2e6, 5.5e6, 11e6):
            raise ScenarioError(f"rate_bps = {self.rate_bps:g}: 802.11b sends at 1e6, 2e6, 5.5e6 or 11e6 bit/s", key="rate_bps")

    @property
    def noise_dbm(self) -> float:
        """Thermal noise in the 20 MHz with which its error rates reckon."""
        return ThermalNoise(noise_figure_db=self.noise_figure_db).dbm

    @cached_property
    def errors(self) -> "ErrorRate":
        """Packet errors by SINR."""
        from vcmvsp.netsim.phy.error_rate import DsssErrors

        return DsssErrors(self.rate_bps)

    def air_time_ns(self, size_bytes: int) -> int:
        """192 us + 8 PSDU / rate, in whole microseconds."""
        bits = 8 * (size_bytes + 36)
        return (192 - (-bits * 1_000_000 // int(self.rate_bps))) * US


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
        """As in ns-3.44, 0.4 dB below the sensitivity (`netsim.phy.noise.ThermalNoise.ieee802154`)."""
        return ThermalNoise.ieee802154(self.sensitivity_dbm).dbm

    @cached_property
    def errors(self) -> "ErrorRate":
        """Packet errors by SINR."""
        from vcmvsp.netsim.phy.error_rate import OqpskErrors

        return OqpskErrors()

    def air_time_ns(self, size_bytes: int) -> int:
        """(6 + 11 + payload) x 32 us, of each frame that the message needs, and the spaces between them."""
        frames = max(1, -(-size_bytes // (127 - 11)))
        return ((size_bytes + frames * (6 + 11)) * 32 + (frames - 1) * 640) * US
