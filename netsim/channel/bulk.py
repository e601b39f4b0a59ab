"""Batched broadcasts of radios at rest: counts and delays only, no object for each frame.

For channels without layers that act on single frames, over a medium with array methods. Uses the same random numbers as
`netsim.channel.channel.Channel`, so outcomes are equal.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from vcmvsp.cosim.rng import link_uniform
from vcmvsp.netsim.channel.mean_budget import MeanBudget
from vcmvsp.netsim.channel.reception import TOO_WEAK, WORDS
from vcmvsp.netsim.interfaces.layers import Floats, Ints, Keys, SenderLinks
from vcmvsp.netsim.interfaces.link_draws import ERROR_SLOT
from vcmvsp.netsim.interfaces.medium import Codes, DecidedFrames, Fate

_OWN = np.uint8(255)  # code at the sender itself


@runtime_checkable
class BulkMedium(Protocol):
    """A medium with array methods."""

    def offer_many(
        self, time_ns: Ints, sender: Ints, size_bytes: int, power_mw: Floats, patience: Floats, numbers: Ints
    ) -> None:
        """Offer k broadcasts: times, senders, numbers (k,), patience (k, n); levels (n, n) mW by sender and receiver."""

    def advance_many(self, until_ns: int) -> Sequence[DecidedFrames]:
        """All decisions up to ``until_ns``."""


class BroadcastCounts(NamedTuple):
    """Outcomes of m broadcasts."""

    number: Ints  # (m,)
    end_ns: Ints  # (m,)
    receptions: Ints  # (m,) number of receivers
    losses: dict[str, int]  # in total, by cause


class Bulk:
    """Broadcasts of n radios at rest: links, mean budgets and causes of weak signals, (n - 1,), of each radio."""

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
        self._frames = np.zeros(count, np.int64)  # of each radio so far

    def send(self, time_ns: Ints, sender: Ints, size_bytes: int) -> None:
        """Offer broadcasts of one size: times, never decreasing, and rows of the senders, (k,) each."""
        numbers = len(self._sender) + np.arange(len(sender))
        self._sender = np.concatenate([self._sender, sender])
        uniform = link_uniform(self._keys[sender], self._own_numbers(sender)[:, None], ERROR_SLOT)[..., 0]
        patience = -np.log1p(-uniform)
        patience[np.arange(len(sender)), sender] = 0.0
        self._medium.offer_many(time_ns, sender, size_bytes, self._power_mw, patience, numbers)

    def advance(self, until_ns: int) -> BroadcastCounts | None:
        """Outcomes that are decided up to a time, if there are any."""
        decided = self._medium.advance_many(until_ns)
        if not decided:
            return None
        number, end_ns, fate = (np.concatenate([batch[column] for batch in decided]) for column in (0, 2, 4))
        sender = self._sender[number]
        code = np.where(fate == np.uint8(Fate.UNDETECTED), TOO_WEAK + self._weakness[sender], fate)
        code[np.arange(len(sender)), sender] = _OWN
        counts = np.bincount(code.ravel(), minlength=len(WORDS))[: len(WORDS)].tolist()
        losses = {word: count for word, count in zip(WORDS[1:], counts[1:], strict=True) if count}
        return BroadcastCounts(number, end_ns, (code == 0).sum(axis=1), losses)

    def _own_numbers(self, sender: Ints) -> Keys:
        """The number of each frame, counted by sender."""
        order = np.argsort(sender, kind="stable")
        first = np.searchsorted(sender[order], sender[order])
        numbers: Ints = np.empty_like(sender)
        numbers[order] = self._frames[sender[order]] + np.arange(len(sender)) - first
        self._frames += np.bincount(sender, minlength=len(self._frames))
        return numbers.astype(np.uint64)
