"""LoRa as in Semtech's SX1276/77/78/79: time on the air, sensitivity, capture."""

from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Annotated

import msgspec

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Decibels
from vcmvsp.netsim.phy.constant_rate import ThermalNoise, over_frames

LARGEST_BYTES = 255  # payload of a frame
LEAST_SNR_DB = {7: -7.5, 8: -10.0, 9: -12.5, 10: -15.0, 11: -17.5, 12: -20.0}
"""Least ratio of signal to noise by spreading factor (SX1276/77/78/79 data sheet, table 13)."""
SLOW_SYMBOL_S = Fraction(16, 1000)  # symbols from here on need the low data rate optimisation (data sheet, 4.1.1.6)


@dataclass(frozen=True)
class Lora:
    """LoRa of the SX127x, below 1 GHz: long range at low rates. Its access is ``aloha``.

    Air time (data sheet 4.1.1.7; AN1200.13) with symbols of ``2^SF / bandwidth``: preamble ``preamble_symbols + 4.25``, then
    ``8 + max(ceil((8 payload - 4 SF + 28 + 16 crc - 20 implicit) / (4 (SF - 2 slow))) (coding_rate + 4), 0)`` symbols. A
    payload has at most 255 bytes: a longer message crosses as several frames in succession, and is received or lost as one.

    A frame is received where its ratio to thermal noise is at least that of its spreading factor, and its ratio to the sum of
    all frames that overlap it is always at least ``capture_db``. All radios have the same spreading factor.
    """

    spreading_factor: Annotated[int, msgspec.Meta(ge=7, le=12)] = 7  # bits in a symbol
    bandwidth_hz: Annotated[float, msgspec.Meta(ge=7800.0, le=500e3)] = 125e3  # of the signal
    coding_rate: Annotated[int, msgspec.Meta(ge=1, le=4)] = 1  # 1: 4/5, 2: 4/6, 3: 4/7, 4: 4/8
    preamble_symbols: Annotated[int, msgspec.Meta(ge=6, le=65535)] = 8  # without the 4.25 that the modem adds
    explicit_header: bool = True  # each frame has a header with its length and coding rate
    crc: bool = True  # each payload has a checksum
    low_data_rate: bool | None = None  # low data rate optimisation; None: with symbols of 16 ms or more
    tx_power_dbm: Decibels = 14.0  # transmitted power; the limit of the European band of 868 MHz
    noise_figure_db: float = 6.0  # of the receiver; the data sheet's sensitivities are those of about 6 dB
    capture_db: Decibels = 6.0  # least ratio of a frame to overlapping frames; 6 as in M. Bor et al., MSWiM 2016 (LoRaSim)

    @property
    def noise_dbm(self) -> float:
        """Thermal noise in the bandwidth."""
        return ThermalNoise(self.bandwidth_hz, self.noise_figure_db).dbm

    @property
    def preamble_snr_db(self) -> float:
        """Least ratio of signal to noise."""
        return LEAST_SNR_DB[self.spreading_factor]

    @property
    def sensitivity_dbm(self) -> float:
        """Noise and that ratio."""
        return self.noise_dbm + self.preamble_snr_db

    def air_time_ns(self, size_bytes: int) -> int:
        """Air time of all frames of a message, rounded up to 1 ns."""
        quarters = 4 * self.preamble_symbols + 17  # of symbols, in the preamble
        total = over_frames(size_bytes, LARGEST_BYTES, lambda size: quarters + 4 * self._payload_symbols(size))
        quarter_ns = self._quarter_ns
        return -(-total * quarter_ns.numerator // quarter_ns.denominator)

    def _payload_symbols(self, size_bytes: int) -> int:
        bits = 8 * size_bytes - 4 * self.spreading_factor + 28 + 16 * self.crc - 20 * (not self.explicit_header)
        return 8 + max(-(-bits // self._block_bits) * (self.coding_rate + 4), 0)

    @cached_property
    def _quarter_ns(self) -> Fraction:
        """A quarter of a symbol."""
        return 2**self.spreading_factor / Fraction(self.bandwidth_hz) / 4 * SECOND_NS

    @cached_property
    def _block_bits(self) -> int:
        """Bits that the coding rate applies to at once."""
        slow = self.low_data_rate
        if slow is None:
            slow = 4 * self._quarter_ns >= SLOW_SYMBOL_S * SECOND_NS
        return 4 * (self.spreading_factor - 2 * slow)
