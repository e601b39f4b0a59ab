"""Paths and frames for layers that tell links apart."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vcmvsp.netsim.interfaces.layers import Frame, Keys, Paths, SenderLinks


class Line:
    """Pairs of points, one transmitter to a receiver."""

    @staticmethod
    def between(tx: Any, rx: Any, seed: int = 1) -> Paths:
        here, there = np.asarray(tx, np.float64), np.asarray(rx, np.float64)
        return Paths(here, there, np.sqrt(((there - here) ** 2).sum(axis=-1)), seed)


def linked_frame(sender: str, *receivers: str, at_s: float = 0.0, seed: int = 1, air_ns: int = 1_000_000) -> Frame:
    start = round(at_s * 1e9)
    return _frame(SenderLinks(seed, sender, receivers), start, start + air_ns)


def many_frame(count: int, at_ns: int = 0, seed: int = 1) -> Frame:
    """A frame with as many receivers, whose keys are merely different."""
    links = SenderLinks(seed, "a", ("b",) * count)
    vars(links).update(keys=many_keys(count, seed), pair_keys=many_keys(count, seed))
    return _frame(links, at_ns, at_ns + 1)


def many_keys(count: int, seed: int = 1) -> Keys:
    keys: Keys = np.random.default_rng(seed).integers(0, 2**63, count).astype(np.uint64)
    return keys


def even_uniforms(count: int) -> NDArray[np.float64]:
    """Uniforms (count, 2): the first evenly spaced, the second in an order that has nothing to do with it."""
    first = (np.arange(count) + 0.5) / count
    return np.stack([first, np.random.default_rng(5).permutation(first)], axis=-1)


def each_alone(paths: Paths) -> Sequence[Paths]:
    return [Line.between(paths.tx, receiver[None], paths.seed) for receiver in paths.rx]


def _frame(links: SenderLinks, start_ns: int, end_ns: int) -> Frame:
    count = len(links.receivers)
    return Frame(start_ns, start_ns, end_ns, 100, Line.between(np.zeros(3), np.zeros((count, 3))), np.zeros(count), links)
