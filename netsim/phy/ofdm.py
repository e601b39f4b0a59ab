"""OFDM: time on the air of IEEE 802.11a and g."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Decibels
from vcmvsp.netsim.phy.noise import ThermalNoise
from vcmvsp.netsim.phy.standards import US, BitRate

if TYPE_CHECKING:  # error rates reckon with air times, and so know this module
    from vcmvsp.netsim.phy.error_rate import ErrorRate

RATES_BPS = (6e6, 9e6, 12e6, 18e6, 24e6, 36e6, 48e6, 54e6)


@dataclass(frozen=True)
class Ofdm:
    """IEEE 802.11a (``band`` 5GHz) or 802.11g (2.4GHz, no protection) in 20 MHz, at 6, 9, 12, 18, 24, 36, 48 or 54 Mbit/s.

    Air time (IEEE 802.11-2016, 17.4.3 and 18.5.3): preamble and header 20 us, then symbols of 4 us with 16 bits of service, the
    PSDU and 6 bits of tail, the last one filled up; at 2.4 GHz 6 us of silence end it (signal extension). The PSDU is the
    payload and 36 bytes: MAC header 24, FCS 4, LLC and SNAP 8.

    Power, sensitivity and noise are those of ns-3.44, as for `netsim.phy.standards.Dsss`: 16.0206 dBm, and -82 dBm for every
    rate. The standard asks for -82 dBm at 6 Mbit/s and -65 dBm at 54 (17.3.10.2); here the packet errors of ``error_model``
    see to that (`netsim.phy.error_rate_ofdm`, whose three models differ by up to 5 dB).
    """

    rate_bps: BitRate = 6e6  # 6e6, 9e6, 12e6, 18e6, 24e6, 36e6, 48e6 or 54e6
    band: Literal["2.4GHz", "5GHz"] = "2.4GHz"  # 802.11g or 802.11a
    tx_power_dbm: Decibels = 16.0206  # transmitted power
    sensitivity_dbm: Decibels = -82.0  # weakest level at which a frame is noticed
    noise_figure_db: Decibels = 7.0  # of the receiver, above the thermal noise in 20 MHz
    preamble_snr_db: Decibels = 4.0  # least ratio to noise and interference at which a frame is noticed
    error_model: Literal["table", "yans", "nist"] = "table"  # packet errors by SINR; they differ by up to 5 dB

    def __post_init__(self) -> None:
        if self.rate_bps not in RATES_BPS:
            allowed = ", ".join(f"{rate / 1e6:g}e6" for rate in RATES_BPS)
            raise ScenarioError(f"rate_bps = {self.rate_bps:g}: 802.11a and g send at {allowed} bit/s", key="rate_bps")

    @property
    def noise_dbm(self) -> float:
        """Thermal noise in 20 MHz."""
        return ThermalNoise(noise_figure_db=self.noise_figure_db).dbm

    @cached_property
    def errors(self) -> "ErrorRate":
        """Packet errors by SINR."""
        from vcmvsp.netsim.phy.error_rate_ofdm import OfdmErrors

        return OfdmErrors(self.rate_bps, self.band, self.error_model)

    def air_time_ns(self, size_bytes: int) -> int:
        """20 us + 4 us x ceil((22 + 8 PSDU) / (4 us x rate)), + 6 us at 2.4 GHz."""
        return 20 * US + self._payload_us(size_bytes) * US

    def payload_bits(self, size_bytes: int) -> int:
        """Rate x the time behind preamble and header: these bits an error rate counts, filling and extension included."""
        return int(self.rate_bps) // 1_000_000 * self._payload_us(size_bytes)

    def _payload_us(self, size_bytes: int) -> int:
        bits = 22 + 8 * (size_bytes + 36)
        symbols = -(-bits // (4 * int(self.rate_bps) // 1_000_000))
        return 4 * symbols + (6 if self.band == "2.4GHz" else 0)
