"""Error rates: the chance that bits sent at some SINR are all received.

A frame, or any piece of it at a constant SINR, survives with ``(1 - pb)^bits``. The SINR changes when an interferer starts or
ends: the success of the pieces multiplies, so that their ``bits * bit_hazard`` add up, see `netsim.phy.error_table`.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from vcmvsp.cosim.types import frozen
from vcmvsp.netsim.interfaces.layers import Floats
from vcmvsp.netsim.phy.error_table import between, look_up, places, steps
from vcmvsp.netsim.phy.standards import US, BitRate, Dsss

ERROR_FLOOR = 1e-300  # every bit may fail, if only in theory: logarithms stay finite
ERROR_CEILING = 1.0 - 2.0**-53  # and every bit may survive


class ErrorRate(ABC):
    """One bit rate's curve. Hashable, as frozen dataclasses are: equal models share their table.

    By the table success is that of the formula within 1e-5 for pieces of 4 bits to 2304 bytes, from -48 to 48 dB.
    """

    @abstractmethod
    def hazard(self, sinr: Floats) -> Floats:
        """``-log(success per bit)`` by the formula, (n,), never negative; ``sinr`` is a ratio of powers, (n,), not in dB."""

    @abstractmethod
    def payload(self, size_bytes: int) -> tuple["ErrorRate", int]:
        """By which curve, and how many, bits of a frame of this size have to survive: rate x their time, filling included."""

    @property
    @abstractmethod
    def header(self) -> tuple["ErrorRate", int]:
        """By which curve, and how many, bits before the payload have to survive as well."""

    @property
    def table(self) -> Floats:
        """The hazard per bit at all steps of `netsim.phy.error_table`, (2^16 + 1,), read-only; not increasing."""
        return _table(self)

    def bit_hazard(self, sinr: Floats) -> Floats:
        """`hazard` by the table, the shape of ``sinr``: a ratio of powers."""
        return look_up(self.table, sinr)

    def success(self, sinr_db: Floats, bits: Floats | float) -> Floats:
        """Chance that all of ``bits`` survive, of the shape to which both arguments broadcast."""
        success: Floats = np.exp(-bits * self.bit_hazard(10.0 ** (sinr_db / 10.0)))
        return success

    def frame_hazard(self, sinr_db: Floats, size_bytes: int) -> Floats:
        """``-log`` of a frame's chance to survive, header included, at a SINR that lasts; the shape of ``sinr_db``."""
        (payload, payload_bits), (header, header_bits) = _pieces(self, size_bytes)
        step, part = places(10.0 ** (sinr_db / 10.0))
        hazard = payload_bits * between(payload, step, part)
        return hazard + header_bits * between(header, step, part) if header_bits else hazard

    def frame_success(self, sinr_db: Floats, size_bytes: int) -> Floats:
        """Chance that a frame with this payload survives, header included, at a SINR that lasts; the shape of ``sinr_db``."""
        success: Floats = np.exp(-self.frame_hazard(sinr_db, size_bytes))
        return success


def hazard_of(bit_error: Floats) -> Floats:
    """``-log(1 - pb)``, (n,): exact also where ``pb`` is far below the rounding of 1."""
    hazard: Floats = -np.log1p(-np.clip(bit_error, ERROR_FLOOR, ERROR_CEILING))
    return hazard


def erfc(x: Floats) -> Floats:
    """Complementary error function of each element, (n,); NumPy has none."""
    return np.array([math.erfc(value) for value in x.tolist()])


@lru_cache(maxsize=64)
def _table(errors: ErrorRate) -> Floats:
    return frozen(errors.hazard(steps()))


@lru_cache(maxsize=256)
def _pieces(errors: ErrorRate, size_bytes: int) -> tuple[tuple[Floats, int], tuple[Floats, int]]:
    """Table and bits of the payload and of the header of a frame."""
    (payload, payload_bits), (header, header_bits) = errors.payload(size_bytes), errors.header
    return (payload.table, payload_bits), (header.table, header_bits)


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
        Dsss(rate_bps=self.rate_bps)  # says which rates there are

    def payload(self, size_bytes: int) -> tuple[ErrorRate, int]:
        """Rate x the time behind the preamble, whole microseconds."""
        return self, round(self.rate_bps * (Dsss(rate_bps=self.rate_bps).air_time_ns(size_bytes) - 192 * US) / 1e9)

    @property
    def header(self) -> tuple[ErrorRate, int]:
        """Signal, service, length and their check: 48 bits at 1 Mbit/s."""
        return DsssErrors(1e6), 48

    def hazard(self, sinr: Floats) -> Floats:
        """See the table of the class, (n,)."""
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
    4th edition, 5.2-34). Written over u = t + b it is the integral of ``w(u) phi(u - b)`` with w = 1 below 0 and
    ``1 - erf(u / sqrt 2)^7`` above: a sum of positive terms, exact in the tail. w has six derivatives at 0, therefore
    the trapezoidal rule hardly sees the seam: with a step of 1/8 the error is right within 2e-11.
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


@dataclass(frozen=True)
class OqpskErrors(ErrorRate):
    """IEEE 802.15.4 at 2.4 GHz: 16 nearly orthogonal sequences (IEEE 802.15.4-2006, Annex E.4.1.8).

    ``pb = 8/15 1/16 sum_(k=2..16) (-1)^k C(16, k) exp(20 x (1/k - 1))``; the same as ns-3.44 ``LrWpanErrorModel``.
    """

    def payload(self, size_bytes: int) -> tuple[ErrorRate, int]:
        """250 kbit/s x the air time of all its frames: preamble, delimiter and length have to survive too."""
        frames = max(1, -(-size_bytes // (127 - 11)))
        return self, 8 * (size_bytes + frames * (6 + 11))

    @property
    def header(self) -> tuple[ErrorRate, int]:
        """No bits: the payload's begin with the preamble."""
        return self, 0

    def hazard(self, sinr: Floats) -> Floats:
        """The sum, (n,), whose terms nearly cancel at low SINR but keep 12 digits."""
        terms = [(-1) ** k * math.comb(16, k) * np.exp(20.0 * sinr * (1.0 / k - 1.0)) for k in range(2, 17)]
        return hazard_of(8.0 / 15.0 / 16.0 * np.sum(terms, axis=0))
