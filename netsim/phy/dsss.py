"""IEEE 802.11b (DSSS and CCK): time on the air and packet errors."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Decibels
from vcmvsp.netsim.interfaces.layers import US, BitRate, Floats
from vcmvsp.netsim.phy.constant_rate import LARGEST_MSDU_BYTES, ThermalNoise, over_frames
from vcmvsp.netsim.phy.error_rate import ErrorRate, erfc, hazard_of


@dataclass(frozen=True)
class Dsss:
    """IEEE 802.11b at 1, 2, 5.5 or 11 Mbit/s with the long preamble.

    Air time (IEEE 802.11-2016, 15.2 and 16.2): preamble and header 192 us, then the PSDU, rounded up to 1 us. The PSDU is the
    payload and 36 bytes: MAC header 24, FCS 4, LLC and SNAP 8. An MSDU has 2304 bytes at most, 2296 of payload: a longer
    message crosses as several frames, SIFS (10 us) apart, and is received or lost as one.

    Power, sensitivity and noise are as in ns-3.44: 16.0206 dBm (40 mW; ``WifiPhy::TxPowerStart``); a preamble is detected
    from -82 dBm and 4 dB above noise and interference on (``ThresholdPreambleDetectionModel``), at every rate; the noise
    figure is 7 dB. So the spreading gain is not used: at -82 dBm the SNR is 12 dB, and 1 Mbit/s needs -5.
    """

    rate_bps: BitRate = 1e6  # 1e6, 2e6, 5.5e6 or 11e6
    tx_power_dbm: Decibels = 16.0206  # transmitted power
    sensitivity_dbm: Decibels = -82.0  # weakest level at which a frame is noticed
    noise_figure_db: Decibels = 7.0  # of the receiver, above the thermal noise in 20 MHz
    preamble_snr_db: Decibels = 4.0  # least ratio to noise and interference at which a frame is noticed

    def __post_init__(self) -> None:
        if self.rate_bps not in (1e6, 2e6, 5.5e6, 11e6):
            raise ScenarioError(f"must be 1e6, 2e6, 5.5e6 or 11e6 bit/s (802.11b), not {self.rate_bps:g}", key="rate_bps")

    @property
    def headers_bytes(self) -> int:
        """Bytes of a PSDU besides the payload."""
        return 36

    @property
    def noise_dbm(self) -> float:
        """Thermal noise in 20 MHz, as assumed by the error rates."""
        return ThermalNoise(noise_figure_db=self.noise_figure_db).dbm

    @cached_property
    def errors(self) -> ErrorRate:
        """Packet errors by SINR."""
        return DsssErrors(self.rate_bps)

    def air_time_ns(self, size_bytes: int) -> int:
        """192 us + 8 PSDU / rate, in whole microseconds, of each frame that the message needs, and the spaces between them."""
        return over_frames(size_bytes, LARGEST_MSDU_BYTES, lambda size: 192 + self._psdu_us(size), 10) * US

    def payload_bits(self, size_bytes: int) -> int:
        """Bits for the error rate: rate x time after preamble and header, over all frames."""
        return round(self.rate_bps * over_frames(size_bytes, LARGEST_MSDU_BYTES, self._psdu_us) / 1e6)

    def _psdu_us(self, size_bytes: int) -> int:
        bits = 8 * (size_bytes + self.headers_bytes)
        return -(-bits * 1_000_000 // int(self.rate_bps))


@dataclass(frozen=True)
class DsssErrors(ErrorRate):
    """IEEE 802.11b, x = SINR in the 20 MHz of the noise.

    ==========  =====================================================================================================
    Mbit/s      errors
    ==========  =====================================================================================================
    1           DBPSK, 11 chips a bit: pb = exp(-22 x) / 2
    2           DQPSK: pb = D(11 x), D(e) = (1 + sqrt 2) / sqrt(8 pi sqrt(2) e) exp(-(2 - sqrt 2) e)
    5.5         CCK, 4 bits a symbol, lost with ps = s(8 x)
    11          CCK, 8 bits a symbol, two halves: ps = 1 - (1 - s(4 x))^2
    ==========  =====================================================================================================

    ``s(e)`` is the error of 8 biorthogonal signals, `biorthogonal_error`. D is the large-signal bound of the DQPSK error
    (Ferrari and Corazza, Electronics Letters 40(20), 2004) and taken as 1 where it exceeds 1; CCK after Pursley and Royster
    (IEEE Trans. Communications 57(2), 2009). The same as ns-3.44 ``DsssErrorRateModel``.
    """

    rate_bps: BitRate = 1e6

    def __post_init__(self) -> None:
        Dsss(rate_bps=self.rate_bps)  # checks the rate

    def payload(self, size_bytes: int) -> tuple[ErrorRate, int]:
        """Error rate and number of bits of the payload: rate times the time behind the preamble, whole microseconds."""
        return self, Dsss(rate_bps=self.rate_bps).payload_bits(size_bytes)

    @property
    def header(self) -> tuple[ErrorRate, int]:
        """Error rate and number of bits of the header (signal, service, length, check): 48 bits at 1 Mbit/s."""
        return DsssErrors(1e6), 48

    def hazard(self, sinr: Floats) -> Floats:
        """Hazard of a bit error at SINRs (n,), as ratios, (n,) per bit; the class has the formulas."""
        if self.rate_bps == 1e6:
            return hazard_of(0.5 * np.exp(-22.0 * sinr))
        if self.rate_bps == 2e6:
            e = 11.0 * sinr
            root = math.sqrt(2.0)
            return hazard_of((1.0 + root) / np.sqrt(8.0 * math.pi * root * e) * np.exp(-(2.0 - root) * e))
        if self.rate_bps == 5.5e6:
            return hazard_of(biorthogonal_error(8.0 * sinr)) / 4.0
        return hazard_of(biorthogonal_error(4.0 * sinr)) / 4.0  # two halves in 8 bits


def biorthogonal_error(energy: Floats) -> Floats:
    """Symbol error of 8 biorthogonal signals in white noise, with e = symbol energy over noise density, (n,).

    ``1 - integral from -b to infinity of (2 Phi(t + b) - 1)^7 phi(t) dt``, b = sqrt(2 e) (Proakis, Digital Communications,
    4th edition, 5.2-34). With u = t + b it is the integral of ``w(u) phi(u - b)`` with w = 1 below 0 and
    ``1 - erf(u / sqrt 2)^7`` above: a sum of positive terms, exact in the tail. w has six derivatives at 0, so the
    trapezoidal rule is accurate there: with a step of 1/8 the result is right within 2e-11.
    """
    step = 0.125
    u = np.arange(-10.0, 39.0, step)
    miss = erfc(np.maximum(u, 0.0) / math.sqrt(2.0))  # 1 - erf; 1 below 0
    weight = np.ones(len(u))
    weight[miss < 1.0] = -np.expm1(7.0 * np.log1p(-miss[miss < 1.0]))
    b = np.sqrt(2.0 * energy)
    error = np.zeros(len(b))
    for centre, w in zip(u.tolist(), weight.tolist(), strict=True):  # so that no matrix of len(u) x n is needed
        error += w * step / math.sqrt(2.0 * math.pi) * np.exp(-0.5 * (centre - b) ** 2)
    return error
