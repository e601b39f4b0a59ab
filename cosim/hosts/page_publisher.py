"""The page of a run for observers on other machines: updates as samples, the scenery on request. Nothing is ever read."""

import zenoh
from zenoh.handlers import Callback

from vcmvsp.cosim.transport import key_names
from vcmvsp.cosim.transport.zenoh_session import undeclare


class PagePublisher:
    """The run's end of a pipe to all observers' pages, with the methods of `cosim.view.live.protocol.Pipe`.

    A slow observer loses updates and never delays the run.

    Args:
        session: the hub's session.
        scenery: answer to an observer that asks for the scenery.
    """

    def __init__(self, session: zenoh.Session, scenery: bytes) -> None:
        self.open = True
        self._scenery, self._has_readers = scenery, False
        self._publisher = session.declare_publisher(
            key_names.PAGE_UPDATE, congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.DATA_LOW
        )
        self._publisher.declare_matching_listener(Callback(self._on_matching, indirect=False))
        self._queryable = session.declare_queryable(key_names.PAGE_SCENERY, Callback(self._on_question, indirect=False))

    def push(self) -> bool:
        """Whether any observer's page is open."""
        return self._has_readers

    def offer(self, payload: bytes) -> bool:
        """Publish an update."""
        self._publisher.put(payload)
        return True

    def offer_within(self, payload: bytes, wait_s: float) -> bool:
        """Publish an update if any page is open; returns whether one is."""
        return self.push() and self.offer(payload)

    def take(self, wait_s: float | None = 0.0) -> list[bytes]:
        """No orders: observers have none."""
        return []

    def close(self) -> None:
        """Stop publishing."""
        self.open = False
        undeclare(self._queryable, self._publisher)

    def _on_matching(self, status: zenoh.MatchingStatus) -> None:
        self._has_readers = status.matching

    def _on_question(self, query: zenoh.Query) -> None:
        with query:
            query.reply(key_names.PAGE_SCENERY, self._scenery)
