"""OFDM (IEEE 802.11a, g, n and ax): time on the air and packet errors, 6 to 143 Mbit/s.

There are three models of packet errors, which differ by up to 5 dB:

========  ====================================================  =============================================
model     what it is                                            50 % success of 128 bytes at 6, 54 Mbit/s
========  ====================================================  =============================================
yans      first terms of the union bound                        -1.24, 17.16 dB
table     yans, moved and stretched onto link simulations       -0.59, 16.32 dB
nist      Chernoff bound of the union bound, hard decisions     2.71, 21.15 dB
========  ====================================================  =============================================

All send the code's bits over an additive white Gaussian channel of 20 MHz, x = SINR in it: no multipath.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Decibels
from vcmvsp.netsim.interfaces.layers import US, BitRate, Floats
from vcmvsp.netsim.phy.constant_rate import LARGEST_MSDU_BYTES, ThermalNoise, over_frames
from vcmvsp.netsim.phy.error_rate import ErrorRate, erfc, hazard_of

# Modulation points M and code rate of each bit rate (IEEE 802.11-2016, table 17-4).
MODES = {
    6e6: (2, "1/2"),
    9e6: (2, "3/4"),
    12e6: (4, "1/2"),
    18e6: (4, "3/4"),
    24e6: (16, "1/2"),
    36e6: (16, "3/4"),
    48e6: (64, "2/3"),
    54e6: (64, "3/4"),
}
# The same of MCS 0 to 11 of HT and HE: one stream in 20 MHz, guard interval 800 ns (IEEE 802.11-2016, table 19-27, and
# IEEE 802.11ax-2021, table 27-55).
MCS = (
    (2, "1/2"),
    (4, "1/2"),
    (4, "3/4"),
    (16, "1/2"),
    (16, "3/4"),
    (64, "2/3"),
    (64, "3/4"),
    (64, "5/6"),
    (256, "3/4"),
    (256, "5/6"),
    (1024, "3/4"),
    (1024, "5/6"),
)
HT_MODES = dict(zip((6.5e6, 13e6, 19.5e6, 26e6, 39e6, 52e6, 58.5e6, 65e6), MCS, strict=False))
HE_RATES_BPS = 8.6e6, 17.2e6, 25.8e6, 34.4e6, 51.6e6, 68.8e6, 77.4e6, 86e6, 103.2e6, 114.7e6, 129e6, 143.4e6
HE_MODES = dict(zip(HE_RATES_BPS, MCS, strict=True))
HE_SUBCARRIERS = 234  # with data, in 20 MHz


class Standard(NamedTuple):
    """What all rates of one standard have in common."""

    modes: Mapping[float, tuple[int, str]]  # points of the constellation and code rate, by bit rate in bit/s
    headers_bytes: int  # of a PSDU besides the payload
    head_us: int  # preamble and header

    @property
    def rates(self) -> str:
        """Its rates, in words."""
        return ", ".join(f"{rate / 1e6:g}e6" for rate in self.modes)


LEGACY, HT, HE = Standard(MODES, 36, 20), Standard(HT_MODES, 38, 36), Standard(HE_MODES, 42, 44)
STANDARD_OF = {rate_bps: each for each in (LEGACY, HT, HE) for rate_bps in each.modes}
ALL_MODES = MODES | HT_MODES | HE_MODES
CODE_RATES = {"1/2": 1.0 / 2.0, "2/3": 2.0 / 3.0, "3/4": 3.0 / 4.0, "5/6": 5.0 / 6.0}

# Lightest error events of the standard's code (generators 133, 171): (free distance d, bit errors at d, and at d + 1).
LIGHTEST = {"1/2": (10, 11, 0), "2/3": (6, 1, 16), "3/4": (5, 8, 31), "5/6": (4, 14, 69)}

# For the model "table", of frames below LONG_BITS and of longer ones: (a, b, c, d). At a SINR of a + x dB it has the errors of
# yans at b + c x + d sqrt(x^2 + 1) dB, a straight line that bends at a. Fitted to the SINR at which ns-3.44
# TableBasedErrorRateModel delivers 10 to 90 % of frames of 13 sizes from 14 to 399 bytes, and of 9 from 400 to 2304, so that
# the largest difference is smallest: 0.08 and 0.10 dB (where 5 % arrive 0.24, where 1 % do 0.7). It has two tables, of frames
# of 32 and of 1458 bytes, and takes other sizes as powers of those; none for 9 Mbit/s, where it takes yans. HT has the same
# tables by modulation and code, and its own at 65 Mbit/s (0.08 and 0.10 dB). HE has those of HT, and its own at 103.2 and 114.7
# Mbit/s (0.07 and 0.09 dB); none at 129 and 143.4 Mbit/s, where it takes yans.
ONTO_TABLE_DB = {
    6e6: ((-0.3, -1.19, 1.22, 0.29), (0.0, -0.98, 1.08, 0.54)),
    12e6: ((1.3, 0.02, 1.09, 0.30), (2.5, 1.58, 1.02, 0.44)),
    18e6: ((4.1, 3.74, 0.94, 0.28), (4.7, 4.54, 0.87, 0.31)),
    24e6: ((6.5, 5.86, 1.32, 0.05), (7.7, 7.46, 0.93, 0.36)),
    36e6: ((12.8, 13.01, 1.35, 0.40), (11.0, 11.94, 1.32, -0.49)),
    48e6: ((11.9, 11.31, 1.46, -0.21), (14.8, 14.81, 0.94, 0.35)),
    54e6: ((14.8, 15.58, 0.92, 0.10), (16.9, 17.57, 0.89, 0.25)),
    65e6: ((16.5, 17.85, 0.86, 0.13), (17.7, 19.48, 1.05, -0.10)),
    103.2e6: ((19.66, 22.55, 0.92, 0.11), (21.08, 24.13, 0.77, 0.17)),
    114.7e6: ((21.17, 24.19, 0.85, 0.24), (22.65, 25.88, 0.77, 0.25)),
}
_FIRST_BPS = {mode: rate_bps for rate_bps, mode in reversed(ALL_MODES.items())}
ALIKE_BPS = {rate_bps: _FIRST_BPS[mode] for rate_bps, mode in ALL_MODES.items()}
"""For each rate the first one of the same modulation and code."""
LEAST_SNR_DB = {
    6e6: 1.465,
    9e6: 3.809,
    12e6: 4.475,
    18e6: 6.985,
    24e6: 10.375,
    36e6: 13.465,
    48e6: 17.865,
    54e6: 19.125,
    65e6: 20.775,
    103.2e6: 24.525,
    114.7e6: 25.905,
    129e6: 33.277,
    143.4e6: 35.186,
}
"""SNR at which a bit fails with 1e-6, by which ns-3.44 ``IdealWifiManager`` chooses the rate (for others see `ALIKE_BPS`)."""
LONG_BITS = 8 * 400  # rate x time after the preamble, as in ns-3.44: padding and signal extension included

# Information bit errors of all events of weight d0, d0 + step, ...: (d0, step, information bits k that they count for, errors).
# P. Frenger, P. Orten, T. Ottosson, Multi-rate convolutional codes, Chalmers 1998.
SPECTRA = {
    "1/2": (10, 2, 1, (36, 211, 1404, 11633, 77433, 502690, 3322763, 21292910, 134365911)),
    "2/3": (6, 1, 2, (3, 70, 285, 1276, 6160, 27128, 117019, 498860, 2103891, 8784123)),
    "3/4": (5, 1, 3, (42, 201, 1492, 10469, 62935, 379644, 2253373, 13073811, 75152755, 428005675)),
}


@dataclass(frozen=True)
class Ofdm:
    """IEEE 802.11a (``band`` 5GHz) or g (2.4GHz, no protection) in 20 MHz, 6 to 54 Mbit/s; n, 6.5 to 65; ax, 8.6 to 143.4.

    Air time (IEEE 802.11-2016, 17.4.3 and 18.5.3): preamble and header 20 us, then symbols of 4 us with 16 bits of service, the
    PSDU and 6 bits of tail, the last one filled up; at 2.4 GHz 6 us of silence end it (signal extension). The PSDU is the
    payload and 36 bytes: MAC header 24, FCS 4, LLC and SNAP 8. An MSDU has 2304 bytes at most, 2296 of payload: a longer
    message crosses as several frames, SIFS (10 us, at 5 GHz 16) apart, and is received or lost as one.

    802.11n is HT-mixed with one stream and a guard interval of 800 ns, without aggregation (19.3, 19.4.3): preamble and headers
    36 us, the other rates (MCS 0 to 7), and a MAC header of 26 bytes (QoS). Acknowledgements are those of 802.11a and g.
    802.11ax is an HE SU PPDU with one stream and a guard interval of 800 ns, otherwise like n (27.3): preamble and headers 44
    us as in ns-3.44 (HE-LTF 8 us; by the standard 7.2), symbols of 13.6 us with 234 subcarriers, MCS 0 to 11, convolutional
    code, and 4 more bytes, the delimiter of an A-MPDU with one MPDU.

    Power, sensitivity and noise are as in ns-3.44 and `netsim.phy.dsss.Dsss`: 16.0206 dBm, and -82 dBm for every rate. The
    standard requires -82 dBm at 6 Mbit/s and -65 dBm at 54 (17.3.10.2); here this difference comes from the packet errors of
    ``error_model`` (`OfdmErrors`, whose three models differ by up to 5 dB).
    """

    rate_bps: BitRate = 6e6  # of 802.11a, g (6e6 to 54e6), n (6.5e6 to 65e6) or ax (8.6e6 to 143.4e6), one of the table
    band: Literal["2.4GHz", "5GHz"] = "2.4GHz"  # 802.11g or a; n and ax have both
    tx_power_dbm: Decibels = 16.0206  # transmitted power
    sensitivity_dbm: Decibels = -82.0  # weakest level at which a frame is noticed
    noise_figure_db: Decibels = 7.0  # of the receiver, above the thermal noise in 20 MHz
    preamble_snr_db: Decibels = 4.0  # least ratio to noise and interference at which a frame is noticed
    error_model: Literal["table", "yans", "nist"] = "table"  # packet errors by SINR; they differ by up to 5 dB

    def __post_init__(self) -> None:
        if self.rate_bps not in ALL_MODES:
            legacy, ht, he = (each.rates for each in (LEGACY, HT, HE))
            problem = f"must be {legacy} bit/s (802.11a/g), {ht} (n) or {he} (ax), not {self.rate_bps:g}"
            raise ScenarioError(problem, key="rate_bps")
        if self.is_ht and self.error_model == "nist":
            raise ScenarioError("nist has no errors of 802.11n and ax: use table or yans", key="error_model")

    @property
    def standard(self) -> Standard:
        """`LEGACY` (802.11a or g), `HT` (n) or `HE` (ax)."""
        return STANDARD_OF[self.rate_bps]

    @property
    def is_ht(self) -> bool:
        """Whether it is 802.11n (high throughput) or ax, which build on it."""
        return self.standard is not LEGACY

    @property
    def rates_bps(self) -> tuple[float, ...]:
        """The rates of its standard, rising."""
        return tuple(self.standard.modes)

    @property
    def least_snr_db(self) -> float:
        """Ratio of signal to noise above which rate control takes this rate."""
        return LEAST_SNR_DB[ALIKE_BPS[self.rate_bps]]

    @property
    def headers_bytes(self) -> int:
        """Bytes of a PSDU besides the payload."""
        return self.standard.headers_bytes

    @property
    def noise_dbm(self) -> float:
        """Thermal noise in 20 MHz."""
        return ThermalNoise(noise_figure_db=self.noise_figure_db).dbm

    @cached_property
    def errors(self) -> ErrorRate:
        """Packet errors by SINR."""
        return OfdmErrors(self.rate_bps, self.band, self.error_model)

    def air_time_ns(self, size_bytes: int) -> int:
        """Preamble, headers and symbols of the PSDU, + 6 us at 2.4 GHz; of a long message: its frames with SIFS between."""
        sifs_us = 10 if self.band == "2.4GHz" else 16
        head_ns = self.standard.head_us * US
        return over_frames(size_bytes, LARGEST_MSDU_BYTES, lambda size: head_ns + self._payload_ns(size), sifs_us * US)

    def payload_bits(self, size_bytes: int) -> int:
        """Bits for the error rate: rate x time after preamble and header, padding and extension included."""
        bits, symbol_ns = self._symbol
        return bits * over_frames(size_bytes, LARGEST_MSDU_BYTES, self._payload_ns) // symbol_ns

    @cached_property
    def _symbol(self) -> tuple[int, int]:
        """Data bits of a symbol, and its length in ns."""
        if self.standard is not HE:
            return 4 * int(self.rate_bps) // 1_000_000, 4_000
        points, code = HE_MODES[self.rate_bps]
        return round(HE_SUBCARRIERS * math.log2(points) * CODE_RATES[code]), 13_600

    def _payload_ns(self, size_bytes: int) -> int:
        bits, symbol_ns = self._symbol
        symbols = -(-(22 + 8 * (size_bytes + self.headers_bytes)) // bits)
        return symbols * symbol_ns + (6 * US if self.band == "2.4GHz" else 0)


@dataclass(frozen=True)
class OfdmErrors(ErrorRate):
    """IEEE 802.11a or g at one rate. ``band`` affects only the number of bits of a frame, ``long`` only the model table."""

    rate_bps: BitRate = 6e6
    band: Literal["2.4GHz", "5GHz"] = "2.4GHz"
    model: Literal["table", "yans", "nist"] = "table"
    long: bool = False  # the curve of frames of at least `LONG_BITS`

    def __post_init__(self) -> None:
        Ofdm(rate_bps=self.rate_bps, band=self.band)  # checks the rate

    def payload(self, size_bytes: int) -> tuple[ErrorRate, int]:
        """Rate x the time behind the preamble: 1620 bits for 100 bytes at 54 Mbit/s in 802.11g, whose PSDU has 1088."""
        bits = Ofdm(rate_bps=self.rate_bps, band=self.band).payload_bits(size_bytes)
        long = self.model == "table" and bits >= LONG_BITS
        return self if long == self.long else replace(self, long=long), bits

    @property
    def header(self) -> tuple[ErrorRate, int]:
        """The signal field: 24 bits at 6 Mbit/s."""
        return OfdmErrors(6e6, self.band, self.model), 24

    def hazard(self, sinr: Floats) -> Floats:
        """Hazard by the model, (n,); see `yans_bit_error` and `nist_bit_error`."""
        if self.model == "nist":
            return hazard_of(nist_bit_error(sinr, self.rate_bps))
        rate_bps = ALIKE_BPS[self.rate_bps] if self.model == "table" else self.rate_bps
        if self.model == "table" and rate_bps in ONTO_TABLE_DB:
            sinr = _onto_table(sinr, *ONTO_TABLE_DB[rate_bps][self.long])
        return hazard_of(yans_bit_error(sinr, rate_bps))


def _onto_table(sinr: Floats, at_db: float, yans_db: float, slope: float, bend: float) -> Floats:
    """SINR at which yans has the errors of the model table at ``sinr``, see `ONTO_TABLE_DB`."""
    x = 10.0 * np.log10(sinr) - at_db
    return 10.0 ** ((yans_db + slope * x + bend * np.hypot(x, 1.0)) / 10.0)


def yans_bit_error(sinr: Floats, rate_bps: float) -> Floats:
    """Bit error rate after the decoder, (n,): ``min(1, a P(d) + a' P(d + 1))``, the same as ns-3.44 ``YansErrorRateModel``.

    ``P(d)``, the chance that a path at distance d is preferred, is that of more than d/2 errors in d bits (half of it for d/2);
    as in ns-3, d errors are left out, and the weight d + 1 of BPSK. The bit error rate before the decoder is
    ``b = erfc(sqrt E) / 2`` for BPSK, and ``b = (1 - (1 - z)^2) / log2 M`` for M points with
    ``z = (1 - 1 / sqrt M) erfc sqrt(1.5 E log2 M / (M - 1))``; E = x 20 MHz / coded bit rate (M. Lacage, T. Henderson, Yet
    another network simulator, WNS2 2006).
    """
    points, code = ALL_MODES[rate_bps]
    energy = sinr * 20e6 * CODE_RATES[code] / rate_bps
    distance, errors, errors_next = LIGHTEST[code]
    if points == 2:
        b = 0.5 * erfc(np.sqrt(energy))
        return np.minimum(1.0, errors * _wrong_path(b, distance))
    bits = math.log2(points)
    z = (1.0 - 1.0 / math.sqrt(points)) * erfc(np.sqrt(1.5 * bits * energy / (points - 1)))
    b = z * (2.0 - z) / bits
    return np.minimum(1.0, errors * _wrong_path(b, distance) + errors_next * _wrong_path(b, distance + 1))


def _wrong_path(b: Floats, d: int) -> Floats:
    terms = [math.comb(d, i) * b**i * (1.0 - b) ** (d - i) for i in range(d // 2 + 1, d)]
    if d % 2 == 0:
        terms.append(0.5 * math.comb(d, d // 2) * (b * (1.0 - b)) ** (d // 2))
    return np.sum(terms, axis=0)


def nist_bit_error(sinr: Floats, rate_bps: float) -> Floats:
    """Bit error rate after a hard-decision decoder, (n,): the same as ns-3.44 ``NistErrorRateModel``, and as INET's.

    ``min(1, sum over the spectrum of errors D^d / (2 k))``, ``D = sqrt(4 b (1 - b))``, k information bits in a puncturing
    period; before the decoder b = erfc(sqrt x) / 2 (BPSK), erfc(sqrt(x / 2)) / 2 (QPSK), 3/8 erfc sqrt(x / 10) (16-QAM),
    7/24 erfc sqrt(x / 42) (64-QAM) (G. Pei, T. Henderson, Validation of OFDM error rate model in ns-3, Boeing 2010).
    """
    points, code = MODES[rate_bps]
    scale, divisor = {2: (0.5, 1.0), 4: (0.5, 2.0), 16: (0.375, 10.0), 64: (7.0 / 24.0, 42.0)}[points]
    b = scale * erfc(np.sqrt(sinr / divisor))
    chernoff = np.sqrt(4.0 * b * (1.0 - b))
    weight, step, information_bits, errors = SPECTRA[code]
    bound = sum(count * chernoff ** (weight + step * i) for i, count in enumerate(errors))
    return np.minimum(1.0, bound / (2.0 * information_bits))
