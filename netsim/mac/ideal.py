"""Medium access: its protocol, and ideal access without contention."""

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from vcmvsp.netsim.interfaces.layers import Keys, Phy
from vcmvsp.netsim.interfaces.medium import Medium


class Mac(Protocol):
    """A rule of medium access."""

    def open(self, phy: Phy, count: int, keys: Keys, noise_mw: float) -> Medium | None:
        """The medium of ``count`` radios with random keys (count,); None: no contention."""


class Needs(NamedTuple):
    """Detection thresholds of a frame."""

    sensitivity_dbm: float
    preamble_snr_db: float


def needs(mac: Mac, phy: Phy) -> Needs:
    """Detection thresholds of this phy and mac; a mac with ``needs_snr_db`` uses the SINR alone, not the sensitivity."""
    own: float | None = getattr(mac, "needs_snr_db", None)
    if own is not None:
        return Needs(-math.inf, own)
    return Needs(phy.sensitivity_dbm, getattr(phy, "preamble_snr_db", -math.inf))


@dataclass(frozen=True)
class Ideal:
    """No contention: frames wait for earlier frames of the same radio only.

    No collisions, no interframe spaces; radios receive while they send. The queue is unbounded.
    """

    def open(self, phy: Phy, count: int, keys: Keys, noise_mw: float) -> Medium | None:
        """None: no contention."""
        return None
