"""Random numbers as named, counter-based streams: an additional vehicle or draw never changes the draws of others.

`stream` gives an ordinary NumPy generator for a name. `link_uniform` gives the draws of many (link, frame) pairs at once,
each a pure function of seed, link, frame and slot, so that evaluation order and grouping do not matter.
The generator is Philox4x32-10 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC'11).
"""

import hashlib
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.random.bit_generator import ISeedSequence
from numpy.typing import NDArray

U64 = NDArray[np.uint64]
Word = int | NDArray[Any]  # word of a counter or key: a plain integer, or an array in uint64

_M0, _M1, _W0, _W1 = 0xD2511F53, 0xCD9E8D57, 0x9E3779B9, 0xBB67AE85
_LOW = 0xFFFFFFFF
_ROUNDS = 10
_FEW = 12  # up to so many numbers, plain Python is faster than NumPy


class _Key(ISeedSequence):
    """A fixed Philox key: ``Philox(key=...)`` would first draw an unused seed from the operating system."""

    def __init__(self, words: NDArray[np.uint64]) -> None:
        self._words = words

    def generate_state(self, n_words: int, dtype: object = np.uint32) -> NDArray[Any]:
        """The two 64-bit words of a Philox key."""
        return self._words


def key64(seed: int, name: str) -> int:
    """A 64-bit key for a named stream; the same on every machine and Python version (BLAKE2b)."""
    return int.from_bytes(hashlib.blake2b(f"{seed}/{name}".encode(), digest_size=8).digest(), "little")


def keys64(seed: int, names: Iterable[str]) -> U64:
    """The keys (`key64`) of many names, (n,)."""
    blake2b, prefix = hashlib.blake2b, f"{seed}/"
    return np.frombuffer(b"".join([blake2b((prefix + name).encode(), digest_size=8).digest() for name in names]), "<u8")


def stream(seed: int, name: str) -> np.random.Generator:
    """A separate generator for ``name``, e.g. ``stream(1, "car2/positioning")``."""
    digest = hashlib.blake2b(f"{seed}/{name}".encode(), digest_size=16).digest()
    key = _Key(np.frombuffer(digest, "<u8"))
    return np.random.Generator(np.random.Philox(key))  # type: ignore[arg-type]  # NumPy takes it, its annotation does not


def philox4x32(counter: tuple[Word, Word, Word, Word], key: tuple[Word, Word]) -> tuple[U64, U64, U64, U64]:
    """Philox4x32-10 over arrays: four counter words and two key words of 32 bits each (held in uint64)."""
    a, b, c, d = _rounds(*(np.asarray(word, np.uint64) for word in (*counter, *key)))
    return np.asarray(a), np.asarray(b), np.asarray(c), np.asarray(d)


def _rounds(x0: Word, x1: Word, x2: Word, x3: Word, k0: Word, k1: Word) -> tuple[Word, Word, Word, Word]:
    low, m0, m1, w0, w1 = _LOW, _M0, _M1, _W0, _W1
    for _ in range(_ROUNDS):
        p0, p1 = x0 * m0, x2 * m1
        x0, x1, x2, x3 = (p1 >> 32) ^ x1 ^ k0, p1 & low, (p0 >> 32) ^ x3 ^ k1, p0 & low
        k0, k1 = (k0 + w0) & low, (k1 + w1) & low
    return x0, x1, x2, x3


def link_uniform(keys: U64, frames: U64, slot: int) -> NDArray[np.float64]:
    """Two independent uniforms in [0, 1) with 53 bits for each link and frame.

    Args:
        keys: 64-bit key of each link (`key64`), any shape that broadcasts with ``frames``.
        frames: the frame number of each draw.
        slot: which draw of the frame: layers of a channel use different slots. 0 <= slot < 2**32.

    Returns:
        Array of the broadcast shape + (2,).
    """
    keys, frames = np.asarray(keys, np.uint64), np.asarray(frames, np.uint64)
    if keys.size * frames.size <= _FEW:
        every, numbers = np.broadcast_arrays(keys, frames)
        pairs = [_pair(key, frame, slot) for key, frame in zip(every.ravel().tolist(), numbers.ravel().tolist(), strict=True)]
        return np.array(pairs, np.float64).reshape(*every.shape, 2)
    return np.stack(np.broadcast_arrays(*_pair(keys, frames, slot)), axis=-1)


def _pair(keys: Word, frames: Word, slot: int) -> tuple[NDArray[Any] | float, NDArray[Any] | float]:
    """The two uniforms of one draw, or of an array of draws."""
    a, b, c, d = _rounds(frames & _LOW, frames >> 32, slot, 0, keys & _LOW, keys >> 32)
    return ((a << 21) ^ (b >> 11)) * 2.0**-53, ((c << 21) ^ (d >> 11)) * 2.0**-53
