"""What layers are given that tell links apart: the run's seed, names, keys and times."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from netsim.layers import Floats

Keys = NDArray[np.uint64]

# Draws of `cosim.rng.link_uniform` that do not go by frame numbers take slots of their own.
WAVE_SLOT = 16  # fading in time: the waves of a pair
BURST_SLOT = 17  # bursts: what changes a link, and when


class LinkPaths(Protocol):
    """Paths (`netsim.layers.Paths`) that know the run's seed."""

    @property
    def tx(self) -> Floats:
        """Transmitter, (3,) m, world."""

    @property
    def rx(self) -> Floats:
        """Receivers, (n, 3) m, world."""

    @property
    def distance_m(self) -> Floats:
        """Between them, (n,)."""

    @property
    def seed(self) -> int:
        """Seed of the run."""


class LinkFrame(Protocol):
    """A frame (`netsim.layers.Frame`) that knows its links."""

    @property
    def start_ns(self) -> int:
        """Begins on the air."""

    @property
    def end_ns(self) -> int:
        """Ends on the air."""

    @property
    def sender(self) -> str:
        """Who sends it."""

    @property
    def receivers(self) -> tuple[str, ...]:
        """The n that may hear it."""

    @property
    def keys(self) -> Keys:
        """Random keys of the links, (n,): from A to B another than from B to A."""

    @property
    def pair_keys(self) -> Keys:
        """Random keys of the pairs, (n,): from A to B the same as from B to A."""
