"""Paths and frames as layers are given them that tell links apart."""

from collections.abc import Sequence
from typing import Any, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from cosim.rng import key64
from netsim.layers import Floats
from netsim.links import Keys


class Line(msgspec.Struct, frozen=True):
    """Pairs of points, one transmitter to a receiver."""

    tx: Floats
    rx: Floats
    distance_m: Floats
    seed: int = 1

    @classmethod
    def between(cls, tx: Any, rx: Any, seed: int = 1) -> Self:
        here, there = np.asarray(tx, np.float64), np.asarray(rx, np.float64)
        return cls(here, there, np.sqrt(((there - here) ** 2).sum(axis=-1)), seed)


class LinkedFrame(msgspec.Struct, frozen=True):
    start_ns: int
    end_ns: int
    sender: str
    receivers: tuple[str, ...]
    keys: Keys
    pair_keys: Keys
    rssi_dbm: Floats


def linked_frame(sender: str, *receivers: str, at_s: float = 0.0, seed: int = 1, air_ns: int = 1_000_000) -> LinkedFrame:
    keys = [key64(seed, f"radio/{sender}/{name}") for name in receivers]
    pairs = [key64(seed, "radio/" + "/".join(sorted((sender, name)))) for name in receivers]
    start = round(at_s * 1e9)
    levels = np.zeros(len(receivers))
    return LinkedFrame(start, start + air_ns, sender, receivers, np.array(keys, np.uint64), np.array(pairs, np.uint64), levels)


def many_frame(count: int, at_ns: int = 0, seed: int = 1) -> LinkedFrame:
    """A frame with as many receivers, whose keys are merely different."""
    keys = many_keys(count, seed)
    return LinkedFrame(at_ns, at_ns + 1, "a", ("b",) * count, keys, keys, np.zeros(count))


def many_keys(count: int, seed: int = 1) -> Keys:
    keys: Keys = np.random.default_rng(seed).integers(0, 2**63, count).astype(np.uint64)
    return keys


def even_uniforms(count: int) -> NDArray[np.float64]:
    """Uniforms (count, 2): the first evenly spaced, the second in an order that has nothing to do with it."""
    first = (np.arange(count) + 0.5) / count
    return np.stack([first, np.random.default_rng(5).permutation(first)], axis=-1)


def each_alone(paths: Line) -> Sequence[Line]:
    return [Line.between(paths.tx, receiver[None], paths.seed) for receiver in paths.rx]
