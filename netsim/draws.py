"""The random numbers of one transmitter's links, made in blocks.

Each number is a pure function of seed, link, frame and layer (`cosim.rng.link_uniform`). The generator costs some hundred NumPy
calls however little is asked of it, so a block of frames is drawn at once; blocks change no number.
"""

from collections.abc import Sequence

import numpy as np

from cosim.rng import key64, link_uniform
from netsim.layers import Floats

# The draws of each layer. A number that is changed changes every recorded run: new layers take new ones.
LOSS_SLOT = 1
DELAY_SLOT = 2

_BLOCK_LINKS = 4096  # links x frames in a block: 64 KiB, where the cost per number has become flat
_BLOCK_FRAMES = 64  # at most, so that short runs do not pay for what they never use


class LinkDraws:
    """Draws for the links from one sender to each of n receivers."""

    def __init__(self, seed: int, sender: str, receivers: Sequence[str]) -> None:
        self._keys = np.array([key64(seed, f"radio/{sender}/{receiver}") for receiver in receivers], np.uint64)
        self._frames = max(1, min(_BLOCK_FRAMES, _BLOCK_LINKS // max(1, len(receivers))))
        self._blocks: dict[int, tuple[int, Floats]] = {}  # slot: number of the block, its draws (frames, n, 2)

    def uniform(self, frame: int, slot: int) -> Floats:
        """Two uniforms in [0, 1) for each receiver, (n, 2), of the sender's own frame number ``frame``."""
        block, index = divmod(frame, self._frames)
        cached = self._blocks.get(slot)
        if cached is None or cached[0] != block:
            frames = np.arange(block * self._frames, (block + 1) * self._frames, dtype=np.uint64)
            cached = self._blocks[slot] = (block, link_uniform(self._keys, frames[:, None], slot))
        draws: Floats = cached[1][index]
        return draws
