"""Protocol of routing kinds: next hops, forwarding of broadcasts, route updates.

A kind is a frozen dataclass with the keys of ``[routing]`` as fields; for each run it opens a router. Vehicles are rows. A
router decides for a vehicle from the information of that vehicle alone: its tables and the updates that it has received.
"""

from collections.abc import Sequence
from typing import Annotated, Any, Protocol, runtime_checkable

import msgspec

BROADCAST = -1
"""Instead of the row of a vehicle: all vehicles in range."""

HEADER_BYTES = 8
"""Routing header of each frame: type (1), remaining hops (1), origin (2), destination (2), number of the packet (2). The next
hop is in the frame's own header."""

HopLimit = Annotated[int, msgspec.Meta(ge=1, le=255)]


class Update(msgspec.Struct, frozen=True):
    """A route update of a vehicle."""

    content: Any  # for `AdvertisingRouter.take`
    size_bytes: int  # after the header
    next_ns: int  # time of the next update; later than now


class Router(Protocol):
    """The routing of a run."""

    hop_limit: int
    jitter_ns: int  # largest delay before a broadcast is forwarded

    def next_hop(self, row: int, to: int, now_ns: int) -> int | None:
        """Next hop of a message to ``to``: a neighbour, `BROADCAST`, or None without a route."""

    def relays(self, row: int, by: int) -> bool:
        """Whether a vehicle forwards a broadcast of which ``by`` sent the first copy."""


@runtime_checkable
class AdvertisingRouter(Router, Protocol):
    """A router with route updates."""

    def first_ns(self) -> Sequence[int]:
        """Time of the first update of each vehicle."""

    def update(self, row: int, now_ns: int) -> Update:
        """The update that a vehicle sends now."""

    def take(self, row: int, by: int, content: Any, now_ns: int) -> None:
        """A vehicle receives an update of another."""


class Routing(Protocol):
    """A kind of routing, as a scenario configures it."""

    def open(self, vehicles: Sequence[str], seed: int) -> Router:
        """The router of a run, perhaps an `AdvertisingRouter`.

        Raises:
            ScenarioError: an unknown vehicle, or a route that never reaches its destination.
        """
