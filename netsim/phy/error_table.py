"""Hazard tables: what a bit risks at some SINR, looked up without a logarithm.

A receiver has drawn, for a frame, how much risk it survives: an exponential variate, its patience. What the frame suffers at
every bit, the hazard ``-log(success per bit)``, adds up over header and payload and over the pieces between interferers, and
the frame is received if the sum stays below the patience: with the chance ``exp(-sum)``, whatever the pieces.

The table holds the hazard at 2048 equal steps of every octave of the SINR (as a ratio of powers), from 2^-16 to 2^16 (-48 to
48 dB), and is interpolated linearly. The step is read from the bits of the floating-point number itself, exponent and the first
eleven of the fraction. Nothing but integer operations, a product and two sums: compiled code and NumPy agree to the last bit.
"""

import numpy as np

from vcmvsp.netsim.interfaces.layers import Floats, Ints

LOWEST, HIGHEST = -16, 16  # octaves; outside, the steps at the ends go on
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
