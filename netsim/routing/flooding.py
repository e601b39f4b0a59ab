"""Flooding: every vehicle passes every message on, once."""

from collections.abc import Sequence
from dataclasses import dataclass

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.types import Seconds
from vcmvsp.netsim.routing.router import BROADCAST, HopLimit, Router


@dataclass(frozen=True)
class Flooding:
    """Every vehicle that hears a message for the first time sends it again, once, until it has gone ``hop_limit`` hops.

    Messages to one vehicle go the same way; it does not pass them on. It needs no tables and finds every way there is, at the
    price of a frame per vehicle and message. Those who heard the same frame would all answer it at the same instant, so each
    waits a random time first. The first copy that a vehicle hears may thus have come the longer way, and be at its limit there:
    whom all ways can reach, they do reach where ``hop_limit`` is the number of vehicles less one, or more.
    """

    hop_limit: HopLimit = 8  # transmissions from the origin to whom it reaches, at most
    jitter_s: Seconds = 0.01  # a message waits so long at most before it is passed on, uniform

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
