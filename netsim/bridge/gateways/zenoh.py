"""Eclipse Zenoh gateway: publications of a vehicle's programs cross the channel to the programs of other vehicles.

Each vehicle has a separate router session for its programs, which reach each other there directly. Between vehicles there is
only the radio: a publication is one frame. Queries, liveliness, keys with a part that begins with ``@``, and keys of the
simulator do not cross.
"""

import asyncio
import contextlib
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import msgspec
import zenoh
from zenoh.handlers import Callback

from vcmvsp.cosim.endpoints import endpoint_of
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.transport import access_control
from vcmvsp.cosim.transport.endpoints import is_loopback
from vcmvsp.cosim.transport.zenoh_session import opened
from vcmvsp.cosim.types import Name
from vcmvsp.cosim.util.codec import Decoder, encode
from vcmvsp.netsim.bridge.gateways.base import (
    BROADCAST,
    HIGHEST,
    LARGEST,
    Bytes,
    GatewayContext,
    GatewayError,
    Port,
    check_names,
)

BACKLOG = 4096  # publications of a vehicle that wait for the loop
OWN = "vcmvsp/"
HEARD = f"{OWN}heard/"
"""Key prefix of agents' messages; the name of the sender follows."""

_ACCEPTING = {"accept_timeout": access_control.ACCEPT_MS, "accept_pending": 1000}  # many silent ones exclude no program
_QUEUE = {
    "size": {"data": 16},  # 64 KiB each, for every program
    "congestion_control": {"drop": {"wait_before_drop": 1000, "max_wait_before_drop_fragments": 1000}},
}
CLIENTS: dict[str, Any] = {"mode": "router", "transport": {"unicast": _ACCEPTING, "link": {"tx": {"queue": _QUEUE}}}}
"""Zenoh configuration for programs. A program that stops reading delays the others by 1 ms, once; then Zenoh drops its data."""

TOO_LONG = "longer than max_bytes"
NO_ROOM = "dropped: more than the run takes"


class Publication(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """Content of a frame, as MessagePack."""

    key: str
    payload: bytes | None  # None: the key was deleted
    encoding: str = ""
    attachment: bytes | None = None


_publications: Decoder[Publication] = Decoder(Publication)


class ZenohGateway:
    """A Zenoh router for each vehicle; the vehicle's programs are its clients.

    Args:
        first_port: the first vehicle of the run is served at ``tcp/127.0.0.1:first_port``, the next at the port after it, ...
        vehicles: vehicles with a router; empty: all.
        listen: other endpoints, ``tcp/HOST:PORT``, by vehicle.
        insecure: allow endpoints that other machines reach; there are no passwords and no encryption.
        max_bytes: longest publication, with its key; a longer one is counted and not sent.
        unicast_prefix: publications under PREFIX/VEHICLE/ are sent to that vehicle alone, under the same key; empty: all
            publications are broadcast.
    """

    def __init__(
        self,
        first_port: Port = 7460,
        vehicles: tuple[Name, ...] = (),
        listen: Mapping[Name, str] = {},
        insecure: bool = False,
        max_bytes: Bytes = LARGEST,
        unicast_prefix: str = "",
    ) -> None:
        self._first_port, self._vehicles, self._listen, self._insecure = first_port, vehicles, listen, insecure
        self._max_bytes = max_bytes
        prefix = unicast_prefix.strip("/")
        self._prefix = f"{prefix}/" if prefix else ""
        self._context: GatewayContext
        self._inbox: Inbox
        self._sessions: dict[int, zenoh.Session] = {}  # by the vehicle's row

    def check(self, vehicles: Sequence[str]) -> None:
        """Check vehicles, endpoints and prefix."""
        self._endpoints(vehicles)
        if any(each in self._prefix for each in "*?#$") or "//" in self._prefix:
            raise ValueError(f"unicast_prefix: {self._prefix!r} is not a key: it must not contain *, ?, #, $ or empty parts")

    async def open(self, context: GatewayContext) -> Sequence[str]:
        """Listen for the programs of each vehicle."""
        self._context, self._inbox = context, Inbox(context, partial(context.offer, self))
        endpoints = self._endpoints(context.vehicles)
        for row, endpoint in endpoints.items():
            self._sessions[row] = session = _listening(endpoint)
            take = Callback(partial(self._on_sample, row), indirect=False)
            session.declare_subscriber("**", take, allowed_origin=zenoh.Locality.REMOTE)
        return [f"Zenoh clients of {context.vehicles[row]} connect to {endpoint}" for row, endpoint in endpoints.items()]

    def deliver(self, sender: int, receiver: int, payload: bytes) -> None:
        """Publish to the programs of a vehicle; a payload that is no publication is an agent's message."""
        session = self._sessions.get(receiver)
        if session is None:
            return
        try:
            publication = _publications.decode(payload)
        except ValueError:
            publication = Publication(HEARD + self._context.vehicles[sender], payload)
        how: dict[str, Any] = {"attachment": publication.attachment, "congestion_control": zenoh.CongestionControl.DROP}
        how["allowed_destination"] = zenoh.Locality.REMOTE
        try:
            if publication.payload is None:
                session.delete(publication.key, **how)
            else:
                session.put(publication.key, publication.payload, encoding=publication.encoding or None, **how)
        except zenoh.ZError:  # an agent's message that decodes as a publication with an invalid key
            self._context.count(receiver, "not taken by Zenoh")

    async def close(self) -> None:
        """Close all sessions."""
        for session in self._sessions.values():
            with contextlib.suppress(zenoh.ZError):
                await asyncio.to_thread(session.close)  # waits for its callbacks

    def _endpoints(self, vehicles: Sequence[str]) -> dict[int, str]:
        check_names("vehicles", self._vehicles, vehicles)
        check_names("listen", self._listen, vehicles)
        endpoints: dict[int, str] = {}
        for row, name in enumerate(vehicles):
            if not self._vehicles or name in self._vehicles:
                port = self._first_port + row
                if name not in self._listen and port > HIGHEST:
                    raise ValueError(f"first_port = {self._first_port} is too high: no port is left for '{name}'")
                endpoints[row] = self._checked(name, self._listen.get(name, f"tcp/127.0.0.1:{port}"))
        if doubled := [endpoint for endpoint, count in Counter(endpoints.values()).items() if count > 1]:
            raise ValueError(f"listen: {doubled[0]} is assigned to two vehicles")
        return endpoints

    def _checked(self, name: str, text: str) -> str:
        endpoint = endpoint_of(text)
        if not endpoint or endpoint.protocol != "tcp" or not endpoint.host or not endpoint.port:
            raise ValueError(f"listen: '{text}' of {name} must be tcp/HOST:PORT")
        if not self._insecure and not is_loopback(endpoint.host):
            problem = f"listen: {text} of {name} accepts connections from every machine in reach of this address"
            raise ValueError(f"{problem}: listen at 127.0.0.1 and use ssh -L, or set insecure = true")
        return str(endpoint)

    def _on_sample(self, row: int, sample: zenoh.Sample) -> None:
        """Queue a publication for the radio; called in a thread of Zenoh."""
        key = str(sample.key_expr)
        if key.startswith(OWN):
            return
        deleted = sample.kind == zenoh.SampleKind.DELETE
        long = len(sample.payload) > self._max_bytes
        payload = b"" if deleted or long else sample.payload.to_bytes()
        attachment = None if sample.attachment is None else sample.attachment.to_bytes()
        publication = Publication(key, None if deleted else payload, str(sample.encoding), attachment)
        data = b"" if long else encode(publication)
        to = self._to(key)
        if long or len(data) > self._max_bytes:
            self._inbox.count(row, TOO_LONG)
        elif to != row:  # the vehicle's own programs have it already
            self._inbox.put(row, to, data)

    def _to(self, key: str) -> int:
        if self._prefix and key.startswith(self._prefix):
            name = key.removeprefix(self._prefix).partition("/")[0]
            if name in self._context.vehicles:
                return self._context.vehicles.index(name)
        return BROADCAST


class Inbox:
    """Bounded queue of datagrams from Zenoh's threads to the loop; ``offer``: see `GatewayContext.offer`."""

    def __init__(self, context: GatewayContext, offer: Callable[..., bool]) -> None:
        self._context, self._offer = context, offer
        self._lock = threading.Lock()
        self._waiting: list[tuple[int, int, bytes, int]] = []
        self._number: Counter[int] = Counter()  # of waiting datagrams, by row
        self._counts: Counter[tuple[int, str]] = Counter()

    def put(self, row: int, to: int, payload: bytes) -> None:
        """Add a datagram; thread-safe."""
        with self._lock:
            if self._number[row] >= BACKLOG:
                self._counts[row, NO_ROOM] += 1
                return
            self._number[row] += 1
            self._waiting.append((row, to, payload, time.monotonic_ns()))
            if len(self._waiting) > 1:
                return  # the loop has been woken
        self._wake()

    def count(self, row: int, what: str) -> None:
        """Count a dropped datagram; thread-safe."""
        with self._lock:
            self._counts[row, what] += 1
            if sum(self._counts.values()) > 1:
                return
        self._wake()

    def _wake(self) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._context.loop.call_soon_threadsafe(self._take)

    def _take(self) -> None:
        with self._lock:
            waiting, counts = self._waiting, self._counts
            self._waiting, self._counts, self._number = [], Counter(), Counter()
        for row, to, payload, came_ns in waiting:
            if not self._offer(row, to, payload, came_ns=came_ns):
                counts[row, NO_ROOM] += 1
        for (row, what), number in counts.items():
            self._context.count(row, what, number)


def _listening(endpoint: str) -> zenoh.Session:
    config = access_control.merge(CLIENTS, {"listen": {"endpoints": [endpoint]}})
    try:
        return opened(config, access_control.LIMITS, f"cannot serve Zenoh clients at {endpoint}")
    except UsageError as problem:
        raise GatewayError(f"{problem}; end the program that uses the port, or set first_port or listen") from problem
