"""Flooding: every vehicle passes every message on, once."""

from collections.abc import Sequence
from dataclasses import dataclass

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.types import Seconds
from vcmvsp.netsim.routing.router import BROADCAST, HopLimit, Router


@dataclass(frozen=True)
class Flooding:
    """Every vehicle forwards the first copy of a message that it receives, once, up to ``hop_limit`` hops.

    Unicast messages are flooded, too; their destination does not forward them. Flooding needs no tables and finds every route,
    at the cost of a frame for each vehicle and message. Receivers of one frame would forward it at the same instant, so each
    waits a random time first. The first copy may thus have come over the longer route, and be at its limit: every reachable
    vehicle is reached for certain only with a ``hop_limit`` of the number of vehicles less one, or more.
    """

    hop_limit: HopLimit = 8  # longest route
    jitter_s: Seconds = 0.01  # largest delay before a message is forwarded, uniform

    def open(self, vehicles: Sequence[str], seed: int) -> Router:
        """Begin a run."""
        return _Flood(self.hop_limit, seconds_to_ns(self.jitter_s))


class _Flood:
    def __init__(self, hop_limit: int, jitter_ns: int) -> None:
        self.hop_limit, self.jitter_ns = hop_limit, jitter_ns

    def next_hop(self, row: int, to: int, now_ns: int) -> int | None:
        return BROADCAST

    def relays(self, row: int, by: int) -> bool:
        return True
