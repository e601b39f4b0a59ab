"""Random numbers as named, counter-based streams: an additional vehicle or draw never changes the draws of others.

`stream` gives an ordinary NumPy generator for a name. `link_uniform` gives the draws of many (link, frame) pairs at once,
each a pure function of seed, link, frame and slot, so that evaluation order and grouping do not matter. The generator is
`cosim.philox`.
"""

import hashlib
from collections.abc import Iterable
from functools import cache
from typing import Any

import numpy as np
from numpy.random.bit_generator import ISeedSequence
from numpy.typing import NDArray

from vcmvsp.cosim import philox
from vcmvsp.cosim.compiled.machine_code import Core, Interpreted
from vcmvsp.cosim.philox import Word

U64 = NDArray[np.uint64]

PAIR_S = 5e-8  # CPU time of a pair of numbers by NumPy
COMPILE_AFTER_S = 2.0  # CPU time of such work from which compiling pays, once for each computer
_FEW = 12  # up to so many numbers, plain Python is faster than NumPy
_MANY = 1024  # from so many on, compiled code is faster


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
    a, b, c, d = philox.rounds(*(np.asarray(word, np.uint64) for word in (*counter, *key)))
    return np.asarray(a), np.asarray(b), np.asarray(c), np.asarray(d)


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
        words = zip(every.ravel().tolist(), numbers.ravel().tolist(), strict=True)
        pairs = [philox.pair(key, frame, slot) for key, frame in words]
        return np.array(pairs, np.float64).reshape(*every.shape, 2)
    uniform = _compiled(keys, frames, slot) if np.broadcast(keys, frames).size >= _MANY else None
    if uniform is not None:
        return uniform
    return np.stack(np.broadcast_arrays(*philox.pair(keys, frames, slot)), axis=-1)


def _compiled(keys: U64, frames: U64, slot: int) -> NDArray[np.float64] | None:
    """`link_uniform` in compiled code, ten times as fast; None: that does not pay yet."""
    keys, frames = np.broadcast_arrays(keys, frames)
    core = _core()
    if isinstance(core.chosen(PAIR_S * keys.size, COMPILE_AFTER_S), Interpreted):
        return None
    first, second = np.empty((2, keys.size))
    core.call(philox.Draws((_signed(keys), _signed(frames)), (first, second)), philox.Which(slot), keys.size)
    return np.stack((first.reshape(keys.shape), second.reshape(keys.shape)), axis=-1)


@cache
def _core() -> Core:
    none = np.zeros(0)
    return Core((philox,), philox.Draws((_signed(none), _signed(none)), (none, none)), philox.Which(0))


def _signed(words: NDArray[Any]) -> NDArray[np.int64]:
    return words.ravel().view(np.int64)
