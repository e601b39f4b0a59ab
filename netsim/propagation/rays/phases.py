"""Sums of the waves of many links with their phases. The code runs interpreted or compiled, see `cosim.compiled`."""

from math import sin
from typing import NamedTuple

from vcmvsp.netsim.interfaces.layers import Floats, Ints

TOGETHER = 1e-9  # rad: the sine of less is its angle
NEGLIGIBLE = 1e-16  # product of the powers of two waves, relative to the square of all power, below which they do not interfere


class Waves(NamedTuple):
    """The waves of n links, m in all, link by link."""

    paths: Ints  # (n,) number of waves of each link
    power: Floats  # (n,) sum of their powers
    real: Floats  # (m,)
    imag: Floats
    turn: Floats  # (m,) rad: pi times the band, times the delay
    single: Floats  # (m,) space to work in: power of each


class Sums(NamedTuple):
    """Results for the n links."""

    power: Floats  # (n,) of the sum of the waves, averaged over the band


def run(w: Waves, s: Sums, _: int) -> int:
    """Set the power of each link in ``s``; returns 0."""
    first = 0
    for n in range(len(w.paths)):
        end = first + w.paths[n]
        for i in range(first, end):
            w.single[i] = w.real[i] * w.real[i] + w.imag[i] * w.imag[i]
        mixed, least = 0.0, NEGLIGIBLE * w.power[n] * w.power[n]
        for i in range(first, end):
            for k in range(i + 1, end):
                if w.single[i] * w.single[k] >= least:
                    apart = max(abs(w.turn[i] - w.turn[k]), TOGETHER)
                    mixed += (w.real[i] * w.real[k] + w.imag[i] * w.imag[k]) * sin(apart) / apart
        s.power[n] = w.power[n] + 2.0 * mixed
        first = end
    return 0
