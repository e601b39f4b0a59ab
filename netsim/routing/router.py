"""What a kind of routing is: whom a message is handed to next, who passes a broadcast on, and what vehicles tell of routes.

A kind is a frozen dataclass whose fields are the keys of ``[routing]``; for each run it opens a router, which knows vehicles by
their rows. A router answers for each vehicle from what that vehicle can know: its own tables, and what it has heard.
"""

from collections.abc import Sequence
from typing import Annotated, Any, Protocol, runtime_checkable

import msgspec

BROADCAST = -1
"""In place of the row of a vehicle: everybody in reach."""

HEADER_BYTES = 8
"""What routing adds to the payload of each frame: what the packet is (1), how many hops it may still go (1), its origin (2),
its destination (2), and its number among those of its origin (2). The next hop stands in the frame's own header already."""

HopLimit = Annotated[int, msgspec.Meta(ge=1, le=255)]


class Update(msgspec.Struct, frozen=True):
    """What a vehicle tells its neighbours of routes."""

    content: Any  # for `Router.take` of those who hear it
    size_bytes: int  # behind the header
    next_ns: int  # when it tells again; later than now


class Router(Protocol):
    """The routing of a run."""

    hop_limit: int
    jitter_ns: int  # the longest that a broadcast waits before it is passed on

    def next_hop(self, row: int, to: int, now_ns: int) -> int | None:
        """To whom a vehicle hands a message to ``to``: a neighbour, `BROADCAST`, or None where it knows no route."""

    def relays(self, row: int, by: int) -> bool:
        """Whether a vehicle passes a broadcast on that it heard first from ``by``."""


@runtime_checkable
class AdvertisingRouter(Router, Protocol):
    """One whose vehicles tell each other of routes."""

    def first_ns(self) -> Sequence[int]:
        """When each vehicle first tells of routes."""

    def update(self, row: int, now_ns: int) -> Update:
        """What a vehicle tells now."""

    def take(self, row: int, by: int, content: Any, now_ns: int) -> None:
        """A vehicle hears an update of another."""


class Routing(Protocol):
    """A kind of routing, as a scenario configures it."""

    def open(self, vehicles: Sequence[str], seed: int) -> Router:
        """Begin a run; the answer may be one that is `AdvertisingRouter`.

        Raises:
            ScenarioError: it names a vehicle that there is not, or routes that lead nowhere.
        """
