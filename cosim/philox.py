"""Philox4x32-10, a generator of random numbers by counters, for plain integers, NumPy arrays and compiled code.

Source: Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC'11. Products of two words are taken modulo 2^64, also
by arithmetic with signs, so the high word of a product is its masked shift.
"""

from typing import Any, NamedTuple

from numpy import float64, int64
from numpy.typing import NDArray

Word = int | int64 | NDArray[Any]
"""A word of a counter or key; of NumPy's in 64 bits."""

M0, M1, W0, W1 = 0xD2511F53, 0xCD9E8D57, 0x9E3779B9, 0xBB67AE85
LOW = 0xFFFFFFFF
ROUNDS = 10
INLINE = True  # see `cosim.compiled.machine_code`
UNIT = 2.0**-53  # of numbers in [0, 1) with 53 bits


class Draws(NamedTuple):
    """Random numbers of n links in frames."""

    words: tuple[NDArray[int64], NDArray[int64]]  # (n,) each: 64-bit keys of the links, and numbers of the frames
    uniform: tuple[NDArray[float64], NDArray[float64]]  # (n,) each: filled by `run`


class Which(NamedTuple):
    """Which draw of each frame."""

    slot: int


def rounds(x0: Word, x1: Word, x2: Word, x3: Word, k0: Word, k1: Word) -> tuple[Word, Word, Word, Word]:
    """Ten rounds over four counter words with two key words, of 32 bits each."""
    for _ in range(ROUNDS):
        p0, p1 = x0 * M0, x2 * M1
        x0, x1, x2, x3 = ((p1 >> 32) & LOW) ^ x1 ^ k0, p1 & LOW, ((p0 >> 32) & LOW) ^ x3 ^ k1, p0 & LOW
        k0, k1 = (k0 + W0) & LOW, (k1 + W1) & LOW
    return x0, x1, x2, x3


def pair(key: Word, frame: Word, slot: int) -> tuple[float | NDArray[Any], float | NDArray[Any]]:
    """Two uniforms in [0, 1) of 53 bits."""
    a, b, c, d = rounds(frame & LOW, (frame >> 32) & LOW, slot, 0, key & LOW, (key >> 32) & LOW)
    return ((a << 21) ^ (b >> 11)) * UNIT, ((c << 21) ^ (d >> 11)) * UNIT


def run(draws: Draws, which: Which, count: int) -> int:
    """Fill in the uniforms of the first links."""
    for i in range(count):
        draws.uniform[0][i], draws.uniform[1][i] = pair(draws.words[0][i], draws.words[1][i], which.slot)
    return 0
