"""A node of ROS 2 on a Zenoh session: publishers, subscribers, other nodes, and the presence of a robot.

Zenoh calls back in its own threads; callbacks only pass on.
"""

import contextlib
import time
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import zenoh
import zenoh.ext
from zenoh.handlers import Callback

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.endpoints import with_slash
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.transport.zenoh_session import opened
from vcmvsp.hardware.drivers.base import PortError
from vcmvsp.hardware.drivers.ros2.protocol import Endpoint, Mapping, Origin, gid_of, origin_of

Mode = Literal["connect", "listen"]
GRAPH_S = 1.0  # for the list of other nodes
_RETRY = {"period_init_ms": 100, "period_max_ms": 1000}
_MOST_BYTES = 65536  # an Odometry message has some 700


class ReceivedMessage(NamedTuple):
    """A message as it arrived."""

    type: str  # empty: unknown
    data: bytes
    sender: bytes | None  # its id; None: unknown
    arrived_ns: int  # of this machine's monotonic clock


class Call:
    """A request of a service's client. It may be answered later, from any thread, and at most once."""

    def __init__(self, query: zenoh.Query, answer: Callable[[bytes], None]) -> None:
        self.data = query.payload.to_bytes() if query.payload is not None else b""
        self._query, self._answer = query, answer

    def reply(self, data: bytes) -> None:
        """Send the response. A client that has gone does not get it."""
        with contextlib.suppress(zenoh.ZError):
            self._answer(data)
        self._query.drop()  # type: ignore[no-untyped-call]


class Node:
    """One node with its endpoints, on a session with a router or a bridge, or one that is the router of rmw_zenoh ("listen").

    `PortError`: no connection, or the endpoint cannot be bound.
    """

    def __init__(self, endpoint: str, mode: Mode, mapping: Mapping, endpoints: tuple[Endpoint, ...]) -> None:
        self._mapping = mapping
        self._session = _session(with_slash(endpoint), mode)
        self._ids: dict[Endpoint, bytes] = {}
        self._references: list[Any] = []  # Zenoh undeclares objects without references
        self._session_id = str(self._session.zid())
        try:
            self._declare(mapping.tokens(self._session_id, ())[-1])
            self.add(*endpoints)
        except zenoh.ZError as error:
            self.close()
            raise PortError(endpoint, f"the session failed ({error})", "open it again") from None

    def add(self, *endpoints: Endpoint) -> None:
        """Announce further endpoints to the other nodes."""
        every = (*self._ids, *endpoints)
        for each, token in zip(every, self._mapping.tokens(self._session_id, every), strict=False):
            if each not in self._ids:
                self._ids[each] = gid_of(token)
                self._declare(token)

    def _declare(self, token: str) -> None:
        self._references.append(self._session.liveliness().declare_token(token))

    def publisher(
        self, endpoint: Endpoint, matched: Callable[[bool], None], *, complete: bool = False
    ) -> Callable[[bytes], None]:
        """Function that publishes a message; ``matched`` gets, in Zenoh's thread, whether there is a subscriber.

        By default a subscriber that does not read loses messages; if they must be ``complete``, it delays the publisher.
        """
        congestion = zenoh.CongestionControl
        publisher = self._session.declare_publisher(
            self._mapping.publishes(endpoint.topic, endpoint.type),
            congestion_control=congestion.BLOCK if complete else congestion.DROP,
            express=True,
        )

        def told(status: Any) -> None:
            matched(status.matching)

        told(publisher.matching_status)
        self._references += [publisher, publisher.declare_matching_listener(Callback(told, indirect=False))]
        number = 0

        def publish(data: bytes) -> None:
            nonlocal number
            number += 1
            attachment = self._mapping.attachment(Origin(number, time.time_ns(), self._ids[endpoint]))
            publisher.put(data, attachment=attachment)

        return publish

    def hear(self, endpoint: Endpoint, on_message: Callable[[ReceivedMessage], None], *, any_type: bool = False) -> None:
        """Pass on messages of a topic, in Zenoh's thread; with ``any_type`` those of other types, too."""

        def took(sample: zenoh.Sample) -> None:
            arrived_ns = time.monotonic_ns()
            name = self._mapping.type_of(str(sample.key_expr))
            if name is None or sample.kind != zenoh.SampleKind.PUT or len(sample.payload) > _MOST_BYTES:
                return
            origin = origin_of(sample.attachment.to_bytes()) if sample.attachment is not None else None
            on_message(ReceivedMessage(name, sample.payload.to_bytes(), origin.gid if origin else None, arrived_ns))

        expression = (
            self._mapping.subscription_key(endpoint.topic)
            if any_type
            else self._mapping.publishes(endpoint.topic, endpoint.type)
        )
        self._references.append(self._session.declare_subscriber(expression, Callback(took, indirect=False)))

    def latch(self, endpoint: Endpoint, data: bytes) -> None:
        """Publish a message that later subscribers get, too: rmw_zenoh's transient-local topics are advanced publishers."""
        key = self._mapping.publishes(endpoint.topic, endpoint.type)
        cache = zenoh.ext.CacheConfig(max_samples=1)
        publisher = zenoh.ext.declare_advanced_publisher(self._session, key, cache=cache, publisher_detection=True)
        publisher.put(data, attachment=self._mapping.attachment(Origin(1, time.time_ns(), self._ids[endpoint])))
        self._references.append(publisher)

    def serve(self, endpoint: Endpoint, called: Callable[[Call], None]) -> None:
        """Pass on calls of a service, in Zenoh's thread; those without a valid attachment get no answer.

        The attachment of an answer has the number and the sender of the request.
        """
        key = self._mapping.publishes(endpoint.topic, endpoint.type)

        def took(query: zenoh.Query) -> None:
            origin = origin_of(query.attachment.to_bytes()) if query.attachment is not None else None
            if origin is None or (query.payload is not None and len(query.payload) > _MOST_BYTES):
                query.drop()  # type: ignore[no-untyped-call]
                return

            def answer(data: bytes) -> None:
                query.reply(key, data, attachment=self._mapping.attachment(origin._replace(time_ns=time.time_ns())))

            called(Call(query, answer))

        self._references.append(self._session.declare_queryable(key, Callback(took, indirect=False), complete=True))

    def others(self) -> list[Endpoint]:
        """Publishers and subscribers of other nodes."""
        own = {endpoint.topic for endpoint in self._ids}
        endpoints = set()
        for reply in self._session.liveliness().get(self._mapping.graph, timeout=GRAPH_S):
            token = str(reply.ok.key_expr) if reply.ok is not None else ""
            endpoint = self._mapping.endpoint(token)
            if endpoint is not None and f"/{self._session_id}/" not in token:
                endpoints.add(endpoint)
        return sorted(endpoints, key=lambda each: (each.topic not in own, each))

    def watch(self, on_change: Callable[[str, Endpoint, bool], None]) -> None:
        """Pass on, in Zenoh's thread, each endpoint of other nodes that is there, comes or goes, with its unique token."""

        def took(sample: zenoh.Sample) -> None:
            token = str(sample.key_expr)
            endpoint = self._mapping.endpoint(token)
            if endpoint is not None and f"/{self._session_id}/" not in token:
                on_change(token, endpoint, sample.kind == zenoh.SampleKind.PUT)

        liveliness = self._session.liveliness()
        self._references.append(
            liveliness.declare_subscriber(self._mapping.graph, Callback(took, indirect=False), history=True)
        )

    def close(self) -> None:
        """End the session, which undeclares everything. Never raises."""
        with contextlib.suppress(zenoh.ZError):  # already closed
            self._session.close()  # type: ignore[no-untyped-call]


class RobotPresence:
    """Presence of a robot: a node (``sender``) publishes its odometry, and one hears its commands, or is silent for a while."""

    def __init__(self, silence_s: float) -> None:
        self.sender: bytes | None = None
        self._silence_ns = seconds_to_ns(silence_s)
        self._heard_ns: int | None = None  # time of the newest odometry
        self._listened_ns: int | None = None  # last time with a subscriber to commands
        self._listens = False

    def hear(self, sender: bytes | None, now_ns: int) -> bool:
        """Note odometry of a node; False if another node already supplies it and is not silent."""
        if sender != self.sender and self._recent(self._heard_ns, now_ns):
            return False
        self.sender, self._heard_ns = sender, now_ns
        return True

    def listen(self, listens: bool, now_ns: int) -> None:
        """Note whether a node subscribes to the commands."""
        if listens or self._listens:
            self._listened_ns = now_ns
        self._listens = listens

    def missing(self, now_ns: int) -> tuple[bool, bool]:
        """Whether odometry is missing, and whether a subscriber is."""
        unheard = not self._listens and not self._recent(self._listened_ns, now_ns)
        return not self._recent(self._heard_ns, now_ns), unheard

    def due_ns(self, now_ns: int) -> int:
        """Time at which either may begin to be missing."""
        times = [self._heard_ns] if self._listens else [self._heard_ns, self._listened_ns]
        soon = [each + self._silence_ns for each in times if each is not None and each + self._silence_ns > now_ns]
        return min(soon, default=now_ns + SECOND_NS)

    def _recent(self, then_ns: int | None, now_ns: int) -> bool:
        return then_ns is not None and now_ns < then_ns + self._silence_ns


def _session(endpoint: str, mode: Mode) -> zenoh.Session:
    if mode == "connect":
        connect = {"endpoints": [endpoint], "timeout_ms": 0, "exit_on_failure": True, "retry": _RETRY}
        config: dict[str, Any] = {"mode": "client", "connect": connect, "listen": {"endpoints": []}}
        config["transport"] = {"unicast": {"open_timeout": 2000}}
    else:  # gossip lets the nodes of a robot find each other, as with rmw_zenohd
        config = {"mode": "router", "listen": {"endpoints": [endpoint]}, "scouting": {"gossip": {"enabled": True}}}
    config["timestamping"] = {"enabled": True}  # which latched topics need; rmw_zenoh has it, too
    try:
        return opened(config, {}, "Zenoh")
    except UsageError as error:
        happened = str(error).removeprefix("Zenoh: ").rstrip("! ")
        if mode == "connect":
            advice = "start rmw_zenohd or zenoh-bridge-ros2dds there, or make this driver the router: mode = 'listen'"
        else:
            advice = "end the other router there, or use mode = 'connect'"
        raise PortError(endpoint, f"no session ({happened})", advice) from None
