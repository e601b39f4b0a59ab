"""Medium access: who may send when."""

from dataclasses import dataclass
from typing import Protocol

from netsim.layers import Keys, Phy
from netsim.medium import Medium


class Mac(Protocol):
    """A rule of medium access."""

    def open(self, phy: Phy, count: int, keys: Keys, noise_mw: float) -> Medium | None:
        """The air for ``count`` radios whose random keys are (count,); None: nobody waits for anybody else."""


@dataclass(frozen=True)
class Ideal:
    """Every radio has the air for itself: its frames wait for its own earlier ones, and for nothing else.

    No contention, no collisions, no interframe spaces; a radio hears while it sends. The queue has no end.
    """

    def open(self, phy: Phy, count: int, keys: Keys, noise_mw: float) -> Medium | None:
        """None: there is nothing to share."""
        return None
