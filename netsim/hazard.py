"""Hazard tables: what a bit risks at some SINR, looked up without a logarithm.

A receiver has drawn, for a frame, how much risk it survives: an exponential variate, its patience. What the frame suffers at
every bit, the hazard ``-log(success per bit)``, adds up over header and payload and over the pieces between interferers, and
the frame is received if the sum stays below the patience: with the chance ``exp(-sum)``, whatever the pieces.

The table holds the hazard at 1024 equal steps of every octave of the SINR (as a ratio of powers), from 2^-16 to 2^16 (-48 to
48 dB), and is interpolated linearly. The step is read from the bits of the floating-point number itself, exponent and first ten
bits of the fraction. Nothing but integer operations, a product and two sums: compiled code and NumPy agree to the last bit.
"""

from functools import lru_cache

import numpy as np

from netsim.error_rate import ErrorRate
from netsim.layers import Floats, Ints

LOWEST, HIGHEST = -16, 16  # octaves; outside, the steps at the ends go on
STEP_BITS = 10  # steps in an octave: 2^10
FRACTION_BITS = 52 - STEP_BITS  # of a double's fraction: what is left within a step
FIRST = (1023 + LOWEST) << STEP_BITS  # exponent and step of 2^LOWEST in a double, whose exponents are biased by 1023
LAST = ((HIGHEST - LOWEST) << STEP_BITS) - 1
WITHIN = (1 << FRACTION_BITS) - 1
STEP = 2.0**-FRACTION_BITS


@lru_cache(maxsize=64)
def hazard_table(errors: ErrorRate) -> Floats:
    """The hazard per bit at all steps, (2^15 + 1,), not negative and never increasing within rounding; for `look_up`."""
    steps = FIRST + np.arange(LAST + 2)
    table: Floats = errors.hazard((steps << FRACTION_BITS).view(np.float64))
    table.flags.writeable = False
    return table


def look_up(table: Floats, sinr: Floats) -> Floats:
    """Hazard per bit, (n,), at SINRs that are ratios of powers, (n,), positive and finite."""
    step, part = places(sinr)
    return between(table, step, part)


def places(sinr: Floats) -> tuple[Ints, Floats]:
    """Where SINRs are in any table, (n,): at which step, and at what part of the way to the next."""
    bits = sinr.view(np.int64)
    step: Ints = np.minimum(np.maximum((bits >> FRACTION_BITS) - FIRST, 0), LAST)
    return step, (bits & WITHIN).astype(np.float64) * STEP


def between(table: Floats, step: Ints, part: Floats) -> Floats:
    """Hazards per bit at some `places`."""
    low = table[step]
    hazard: Floats = low + part * (table[step + 1] - low)
    return hazard


def look_up_one(table: Floats, sinr: float) -> float:
    """`look_up` of a single SINR."""
    bits = int(np.float64(sinr).view(np.int64))
    step = min(max((bits >> FRACTION_BITS) - FIRST, 0), LAST)
    low = table[step]
    return float(low + (bits & WITHIN) * STEP * (table[step + 1] - low))
