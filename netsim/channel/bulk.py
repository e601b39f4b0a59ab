"""Many broadcasts at once, of which only counts and delays are wanted: no object per frame.

For channels whose layers have no say in single frames, over a medium that takes and gives arrays. It draws the same numbers as
`netsim.channel.channel.Channel`, and so finds the same fates.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from vcmvsp.cosim.rng import link_uniform
from vcmvsp.netsim.channel.mean_budget import MeanBudget
from vcmvsp.netsim.channel.reception import TOO_WEAK, WORDS
from vcmvsp.netsim.interfaces.layers import Floats, Ints, Keys, SenderLinks
from vcmvsp.netsim.interfaces.link_draws import ERROR_SLOT
from vcmvsp.netsim.interfaces.medium import Codes, Fate

_OWN = np.uint8(255)  # code of a sender at itself


@runtime_checkable
class BulkMedium(Protocol):
    """A medium that takes and gives arrays."""

    def offer_many(
        self, time_ns: Ints, sender: Ints, size_bytes: int, power_mw: Floats, patience: Floats, numbers: Ints
    ) -> None:
        """Hand over k broadcasts: times, senders, numbers (k,), patience (k, n); levels (n, n) mW, a row for each sender."""

    def advance_arrays(self, until_ns: int) -> tuple[Ints, Ints, Ints, Codes, Floats]:
        """What is decided: number, start_ns, end_ns (m,), fate (m, n), least SINR (m, n)."""


class BroadcastCounts(NamedTuple):
    """What became of m broadcasts."""

    number: Ints  # (m,)
    end_ns: Ints  # (m,)
    received: Ints  # (m,) at how many radios
    losses: dict[str, int]  # all together, by cause


class Bulk:
    """Broadcasts of n radios that stand still.

    Args:
        medium: the air.
        links: of each radio.
        means: the mean budget of each one's links.
        weakness: what would make its frames too weak, (n - 1,) each.
    """

    def __init__(
        self, medium: BulkMedium, links: Sequence[SenderLinks], means: Sequence[MeanBudget], weakness: Sequence[Codes]
    ) -> None:
        count = len(links)
        others = ~np.eye(count, dtype=np.bool_)
        self._medium, self._power_mw = medium, np.stack([mean.power_mw for mean in means])
        self._weakness = np.zeros((count, count), np.uint8)
        self._weakness[others] = np.concatenate(weakness)
        self._keys = np.zeros((count, count), np.uint64)
        self._keys[others] = np.concatenate([each.keys for each in links])
        self._sender: Ints = np.zeros(0, np.int64)  # of each frame
        self._sent = np.zeros(count, np.int64)  # frames of each so far

    def send(self, time_ns: Ints, sender: Ints, size_bytes: int) -> None:
        """Hand over broadcasts of one size: times, never decreasing, and rows of the senders, (k,) each."""
        numbers = len(self._sender) + np.arange(len(sender))
        self._sender = np.concatenate([self._sender, sender])
        uniform = link_uniform(self._keys[sender], self._own_numbers(sender)[:, None], ERROR_SLOT)[..., 0]
        patience = -np.log1p(-uniform)
        patience[np.arange(len(sender)), sender] = 0.0
        self._medium.offer_many(time_ns, sender, size_bytes, self._power_mw, patience, numbers)

    def advance(self, until_ns: int) -> BroadcastCounts:
        """What is decided up to a time."""
        number, _, end_ns, fate, _ = self._medium.advance_arrays(until_ns)
        sender = self._sender[number]
        code = np.where(fate == np.uint8(Fate.UNDETECTED), TOO_WEAK + self._weakness[sender], fate)
        code[np.arange(len(sender)), sender] = _OWN
        found = np.bincount(code.ravel(), minlength=len(WORDS))[: len(WORDS)].tolist()
        losses = {word: many for word, many in zip(WORDS[1:], found[1:], strict=True) if many}
        return BroadcastCounts(number, end_ns, (code == 0).sum(axis=1), losses)

    def _own_numbers(self, sender: Ints) -> Keys:
        """The number of each frame among those of its sender."""
        order = np.argsort(sender, kind="stable")
        first = np.searchsorted(sender[order], sender[order])
        numbers: Ints = np.empty_like(sender)
        numbers[order] = self._sent[sender[order]] + np.arange(len(sender)) - first
        self._sent += np.bincount(sender, minlength=len(self._sent))
        return numbers.astype(np.uint64)
