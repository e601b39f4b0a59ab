"""Random numbers of one transmitter's links, drawn in blocks.

Each number is a pure function of seed, link, frame and layer (`cosim.rng.link_uniform`). One call of the generator costs some
hundred NumPy calls, so it draws a block of frames at once; the size of blocks changes no number.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.rng import link_uniform
from vcmvsp.netsim.interfaces.layers import Floats, SenderLinks

# The draws of each layer, by frame. A number that is changed changes every recorded run: new layers take new ones.
LOSS_SLOT = 1
DELAY_SLOT = 2
FADING_SLOT = 3
SCRIPT_SLOT = 4
TRACE_SLOT = 5
DELIVERY_SLOT = 6
JAMMER_SLOT = 7
ERROR_SLOT = 32  # and those behind it: one for each attempt to send the frame
RETRY_FADING_SLOT = 64  # the same: fading of each attempt but the first
ACK_FADING_SLOT = 96  # the same: fading of the acknowledgement of each attempt
# Draws that do not go by frames.
WAVE_SLOT = 16  # fading in time: the waves of a pair
BURST_SLOT = 17  # bursts: what changes a link, and when
BACKOFF_SLOT = 18  # of a radio: its backoffs

Make = Callable[[Floats], NDArray[Any]]
"""Function of draws (..., n, 2) alone, (..., n)."""

_BLOCK_LINKS = 4096  # links x frames in a block: 64 KiB, where the cost per number has become flat
_BLOCK_FRAMES = 256  # at most, so that short runs do not pay for what they never use


class LinkDraws:
    """Draws for the links from one sender to each of n receivers."""

    def __init__(self, links: SenderLinks) -> None:
        self._links = links
        self._frames = max(1, min(_BLOCK_FRAMES, _BLOCK_LINKS // max(1, len(links.receivers))))
        self._blocks: dict[int, tuple[int, Floats]] = {}  # slot: number of the block, its draws (frames, n, 2)
        self._made: dict[int, tuple[int, Make, NDArray[Any]]] = {}  # slot: number of the block, function, its result

    def uniform(self, frame: int, slot: int) -> Floats:
        """Two uniforms in [0, 1) for each receiver, (n, 2), of the sender's own frame number ``frame``."""
        number, index = divmod(frame, self._frames)
        draws: Floats = self._block(number, slot)[index]
        return draws

    def patience(self, frame: int, slot: int) -> Floats:
        """Exponential variates of mean 1 for each receiver, (n,), from the first of its uniforms."""
        return self.made(frame, slot, _exponential)

    def made(self, frame: int, slot: int, make: Make) -> NDArray[Any]:
        """Result of ``make`` for the draws of a frame, (n,), computed for a whole block at once, (frames, n, 2)."""
        number, index = divmod(frame, self._frames)
        cached = self._made.get(slot)
        if cached is None or cached[0] != number or cached[1] != make:
            cached = self._made[slot] = (number, make, make(self._block(number, slot)))
        row: NDArray[Any] = cached[2][index]
        return row

    def _block(self, number: int, slot: int) -> Floats:
        cached = self._blocks.get(slot)
        if cached is None or cached[0] != number:
            frames = np.arange(number * self._frames, (number + 1) * self._frames, dtype=np.uint64)
            cached = self._blocks[slot] = (number, link_uniform(self._links.keys, frames[:, None], slot))
        return cached[1]

    def some(self, frame: int, slot: int, which: NDArray[np.intp]) -> Floats:
        """The same for some receivers only, by their place: (len(which), 2)."""
        return link_uniform(self._links.keys[which], np.array(frame, np.uint64), slot)


def _exponential(draws: Floats) -> Floats:
    variates: Floats = -np.log1p(-draws[..., 0])
    return variates
