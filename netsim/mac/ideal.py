"""Medium access: who may send when."""

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from vcmvsp.netsim.interfaces.layers import Keys, Phy
from vcmvsp.netsim.interfaces.medium import Medium


class Mac(Protocol):
    """A rule of medium access."""

    def open(self, phy: Phy, count: int, keys: Keys, noise_mw: float) -> Medium | None:
        """The air for ``count`` radios whose random keys are (count,); None: nobody waits for anybody else."""


class Needs(NamedTuple):
    """What a frame needs to be noticed."""

    sensitivity_dbm: float
    preamble_snr_db: float


def needs(mac: Mac, phy: Phy) -> Needs:
    """What radios of this phy and mac need; a mac with ``needs_snr_db`` goes by the SINR alone, not by the sensitivity."""
    own: float | None = getattr(mac, "needs_snr_db", None)
    if own is not None:
        return Needs(-math.inf, own)
    return Needs(phy.sensitivity_dbm, getattr(phy, "preamble_snr_db", -math.inf))


@dataclass(frozen=True)
class Ideal:
    """Every radio has the air for itself: its frames wait for its own earlier ones, and for nothing else.

    No contention, no collisions, no interframe spaces; a radio hears while it sends. The queue has no end.
    """

    def open(self, phy: Phy, count: int, keys: Keys, noise_mw: float) -> Medium | None:
        """None: there is nothing to share."""
        return None
