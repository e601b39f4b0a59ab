"""Outages as the scenario scripts them: a jammer, a tunnel, a radio that is switched off."""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import ClassVar

import msgspec
import numpy as np

from cosim.clock import seconds_to_ns
from cosim.keys import matches
from cosim.types import Probability, Seconds
from netsim.layers import Bools, Draw, Floats
from netsim.links import LinkFrame


class Outage(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Some links lose frames for some time.

    Args:
        from_s: it begins.
        to_s: it is over.
        links: key expressions of ``sender/receiver``: ``car1/car2`` is that direction alone, ``car1/*`` all that car1 sends,
            ``*/car1`` all that is sent to it, ``**`` every link.
        probability: that a frame is lost.
    """

    from_s: Seconds
    to_s: Seconds
    links: tuple[str, ...] = ("**",)
    probability: Probability = 1.0

    def __post_init__(self) -> None:
        if self.to_s <= self.from_s:
            raise ValueError(f"to_s = {self.to_s:g}: an outage from {self.from_s:g} s must end later than it begins")


@dataclass(frozen=True)
class Scripted:
    """Frames that are on the air at any time of an outage of their link are lost, with its probability.

    Where several outages meet, each strikes independently. A name that no vehicle has matches nothing.
    """

    outages: tuple[Outage, ...]
    cause: ClassVar[str] = "scripted outage"

    def lost(self, frame: LinkFrame, draw: Draw) -> Bools:
        """Which receivers lose the frame, (n,)."""
        present = [each for each, (begin, end) in self._spans_ns if frame.start_ns < end and frame.end_ns > begin]
        if not present:
            return np.zeros(len(frame.receivers), np.bool_)
        passes = np.ones(len(frame.receivers))
        for outage in present:
            passes = passes * _passes(outage, frame.sender, frame.receivers)
        lost: Bools = draw()[..., 0] >= passes
        return lost

    @cached_property
    def _spans_ns(self) -> list[tuple[Outage, tuple[int, int]]]:
        return [(each, (seconds_to_ns(each.from_s), seconds_to_ns(each.to_s))) for each in self.outages]


@lru_cache(maxsize=4096)
def _passes(outage: Outage, sender: str, receivers: tuple[str, ...]) -> Floats:
    """Probability that a frame passes an outage that is present, (n,)."""
    struck = [any(matches(links, f"{sender}/{receiver}") for links in outage.links) for receiver in receivers]
    return np.where(struck, 1.0 - outage.probability, 1.0)
