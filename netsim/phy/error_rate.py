"""Error rates: the chance that bits sent at some SINR are all received.

A frame, or any piece of it at a constant SINR, survives with ``(1 - pb)^bits``. The SINR changes when an interferer starts or
ends: the success of the pieces multiplies, so that their ``bits * bit_hazard`` add up, interpolated from tables.

For each frame a receiver draws the hazard that the frame survives: an exponential variate, its patience. The frame is received
if the sum of its hazards stays below the patience: with the probability ``exp(-sum)``, independent of the division into pieces.

A table holds the hazard of a bit at 2048 equal steps of every octave of the SINR (as a ratio of powers), from 2^-16 to 2^16
(-48 to 48 dB), and is interpolated linearly. The step is read from the bits of the floating-point number itself, exponent and
the first eleven of the fraction. Nothing but integer operations, a product and two sums: compiled code and NumPy agree to the
last bit.
"""

import math
from abc import ABC, abstractmethod
from functools import lru_cache

import numpy as np

from vcmvsp.cosim.types import frozen
from vcmvsp.netsim.interfaces.layers import Floats, Ints

ERROR_FLOOR = 1e-300  # lower bound of bit errors: logarithms stay finite
ERROR_CEILING = 1.0 - 2.0**-53  # upper bound, for the same reason


class ErrorRate(ABC):
    """Error curve of one bit rate. Hashable, as frozen dataclasses are: equal models share their table.

    Success by the table is within 1e-5 of the formula for pieces of 4 bits to 2304 bytes, from -48 to 48 dB.
    """

    @abstractmethod
    def hazard(self, sinr: Floats) -> Floats:
        """``-log(success per bit)`` by the formula, (n,), never negative; ``sinr`` is a ratio of powers, (n,), not in dB."""

    @abstractmethod
    def payload(self, size_bytes: int) -> tuple["ErrorRate", int]:
        """Curve and number of the bits of a frame of this size that have to survive: rate x time, padding included."""

    @property
    @abstractmethod
    def header(self) -> tuple["ErrorRate", int]:
        """Curve and number of the bits before the payload, which have to survive, too."""

    @property
    def table(self) -> Floats:
        """The hazard per bit at all `steps`, (2^16 + 1,), read-only; not increasing."""
        return _table(self)

    def bit_hazard(self, sinr: Floats) -> Floats:
        """`hazard` by the table, the shape of ``sinr``: a ratio of powers."""
        return look_up(self.table, sinr)

    def success(self, sinr_db: Floats, bits: Floats | float) -> Floats:
        """Chance that all of ``bits`` survive, of the shape to which both arguments broadcast."""
        return np.exp(-bits * self.bit_hazard(10.0 ** (sinr_db / 10.0)))

    def frame_hazard(self, sinr_db: Floats, size_bytes: int) -> Floats:
        """``-log`` of a frame's chance to survive, header included, at constant SINR; the shape of ``sinr_db``."""
        (payload, payload_bits), (header, header_bits) = _pieces(self, size_bytes)
        step, part = places(10.0 ** (sinr_db / 10.0))
        hazard = payload_bits * between(payload, step, part)
        return hazard + header_bits * between(header, step, part) if header_bits else hazard

    def frame_success(self, sinr_db: Floats, size_bytes: int) -> Floats:
        """Chance that a frame with this payload survives, header included, at constant SINR; the shape of ``sinr_db``."""
        return np.exp(-self.frame_hazard(sinr_db, size_bytes))


def hazard_of(bit_error: Floats) -> Floats:
    """``-log(1 - pb)``, (n,): exact also where ``pb`` is far below the rounding of 1."""
    return -np.log1p(-np.clip(bit_error, ERROR_FLOOR, ERROR_CEILING))


def erfc(x: Floats) -> Floats:
    """Complementary error function of each element, (n,); NumPy has none."""
    return np.array([math.erfc(value) for value in x.tolist()])


@lru_cache(maxsize=64)
def _table(errors: ErrorRate) -> Floats:
    return frozen(errors.hazard(steps()))


@lru_cache(maxsize=256)
def _pieces(errors: ErrorRate, size_bytes: int) -> tuple[tuple[Floats, int], tuple[Floats, int]]:
    (payload, payload_bits), (header, header_bits) = errors.payload(size_bytes), errors.header
    return (payload.table, payload_bits), (header.table, header_bits)


LOWEST, HIGHEST = -16, 16  # octaves; outside, the first or last step holds
STEP_BITS = 11  # steps in an octave: 2^11
FRACTION_BITS = 52 - STEP_BITS  # of a double's fraction: what is left within a step
FIRST = (1023 + LOWEST) << STEP_BITS  # exponent and step of 2^LOWEST in a double, whose exponents are biased by 1023
LAST = ((HIGHEST - LOWEST) << STEP_BITS) - 1
WITHIN = (1 << FRACTION_BITS) - 1
STEP = 2.0**-FRACTION_BITS


def steps() -> Floats:
    """The SINRs of all steps, (2^16 + 1,), at which a table holds the hazard per bit."""
    return ((FIRST + np.arange(LAST + 2)) << FRACTION_BITS).view(np.float64)


def look_up(table: Floats, sinr: Floats) -> Floats:
    """Hazard per bit at SINRs that are ratios of powers, of their shape."""
    step, part = places(sinr)
    return between(table, step, part)


def places(sinr: Floats) -> tuple[Ints, Floats]:
    """Position of SINRs in any table, (n,): step, and fraction of the way to the next."""
    bits = sinr.view(np.int64)
    step: Ints = np.minimum(np.maximum((bits >> FRACTION_BITS) - FIRST, 0), LAST)
    return step, (bits & WITHIN).astype(np.float64) * STEP


def between(table: Floats, step: Ints, part: Floats) -> Floats:
    """Hazards per bit at some `places`."""
    low = table[step]
    return low + part * (table[step + 1] - low)


def look_up_one(table: Floats, sinr: float) -> float:
    """`look_up` of a single SINR."""
    bits = int(np.float64(sinr).view(np.int64))
    step = min(max((bits >> FRACTION_BITS) - FIRST, 0), LAST)
    low = table[step]
    return float(low + (bits & WITHIN) * STEP * (table[step + 1] - low))
