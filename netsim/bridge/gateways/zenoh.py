"""Eclipse Zenoh: what a vehicle's programs publish crosses the channel, and is published to the programs of who receives it.

Each vehicle has a session of its own to which its programs connect as clients; they hear each other there at once, as on one
machine. No two of these sessions know each other: between vehicles there is only the radio. A publication is one frame.
Queries, liveliness, and keys in which a part begins with ``@`` do not cross; neither do keys of the simulator's own.
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
from vcmvsp.cosim.transport import access_control, endpoints
from vcmvsp.cosim.transport.zenoh_session import opened
from vcmvsp.cosim.types import Name
from vcmvsp.cosim.util.codec import Decoder, encode
from vcmvsp.netsim.bridge.gateways.base import BROADCAST, HIGHEST, LARGEST, Bytes, DoorError, Hall, Port, check_names

BACKLOG = 4096  # publications of a vehicle that wait for the loop
OWN = "vcmvsp/"
HEARD = f"{OWN}heard/"
"""Before the name of a vehicle: what its agent said."""

CLIENTS: dict[str, Any] = {
    "mode": "router",
    "transport": {
        "unicast": {
            "accept_timeout": access_control.ACCEPT_MS,
            "accept_pending": 1000,
        },  # strangers who say nothing keep nobody out
        "link": {
            "tx": {
                "queue": {
                    "size": {"data": 16},  # 64 KiB each, for every program
                    "congestion_control": {"drop": {"wait_before_drop": 1000, "max_wait_before_drop_fragments": 1000}},
                }
            }
        },
    },
}
"""For those who connect. A program that takes nothing any more holds the others up for a millisecond, once; then Zenoh drops
what is for it, until it takes something again."""

TOO_LONG = "longer than max_bytes"
NO_ROOM = "dropped: more than the run deals with"


class Publication(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """What a frame carries, as MessagePack."""

    key: str
    payload: bytes | None  # None: the key was deleted
    encoding: str = ""
    attachment: bytes | None = None


_publications: Decoder[Publication] = Decoder(Publication)


class ZenohDoor:
    """A Zenoh router for the programs of each vehicle, who are its clients.

    Args:
        first_port: the first vehicle of the run is served at ``tcp/127.0.0.1:first_port``, the next at the port after it, ...
        vehicles: whose programs take part; none named: all.
        listen: other endpoints, ``tcp/HOST:PORT``, by vehicle.
        insecure: endpoints may be reached from other machines, by anybody: there are no passwords and no encryption.
        max_bytes: what is longer, with its key and all, is counted, not sent: a publication is one frame.
        unicast_prefix: what is published under PREFIX/VEHICLE/ is sent to that vehicle alone, under the same key; empty:
            everything is broadcast.
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
        self._hall: Hall
        self._inbox: Inbox
        self._sessions: dict[int, zenoh.Session] = {}  # by the vehicle's row

    def check(self, vehicles: Sequence[str]) -> None:
        """Vehicles that there are, endpoints and keys that can be."""
        self._endpoints(vehicles)
        if any(each in self._prefix for each in "*?#$") or "//" in self._prefix:
            raise ValueError(f"unicast_prefix: {self._prefix!r} is no key: without *, ?, #, $ and empty parts")

    async def open(self, hall: Hall) -> Sequence[str]:
        """Listen for the programs of each vehicle."""
        self._hall, self._inbox = hall, Inbox(hall, partial(hall.offer, self))
        endpoints = self._endpoints(hall.vehicles)
        for row, endpoint in endpoints.items():
            self._sessions[row] = session = _listening(endpoint)
            take = Callback(partial(self._on_sample, row), indirect=False)
            session.declare_subscriber("**", take, allowed_origin=zenoh.Locality.REMOTE)
        return [f"Zenoh clients of {hall.vehicles[row]} connect to {endpoint}" for row, endpoint in endpoints.items()]

    def deliver(self, sender: int, receiver: int, payload: bytes) -> None:
        """Publish it to the programs of a vehicle; what is no publication, an agent has said."""
        session = self._sessions.get(receiver)
        if session is None:
            return
        try:
            said = _publications.decode(payload)
        except ValueError:
            said = Publication(HEARD + self._hall.vehicles[sender], payload)
        drop, remote = zenoh.CongestionControl.DROP, zenoh.Locality.REMOTE
        try:
            if said.payload is None:
                session.delete(said.key, attachment=said.attachment, congestion_control=drop, allowed_destination=remote)
            else:
                session.put(
                    said.key,
                    said.payload,
                    encoding=said.encoding or None,
                    attachment=said.attachment,
                    congestion_control=drop,
                    allowed_destination=remote,
                )
        except zenoh.ZError:  # what an agent said happens to look like a publication, under a key that is none
            self._hall.count(receiver, "not taken by Zenoh")

    async def close(self) -> None:
        """Send all programs away."""
        for session in self._sessions.values():
            with contextlib.suppress(zenoh.ZError):
                await asyncio.to_thread(session.close)  # waits for its callbacks

    def _endpoints(self, vehicles: Sequence[str]) -> dict[int, str]:
        """By the rows of those who take part."""
        check_names("vehicles", self._vehicles, vehicles)
        check_names("listen", self._listen, vehicles)
        found: dict[int, str] = {}
        for row, name in enumerate(vehicles):
            if not self._vehicles or name in self._vehicles:
                port = self._first_port + row
                if name not in self._listen and port > HIGHEST:
                    raise ValueError(f"first_port = {self._first_port}: there is no port left for '{name}'")
                found[row] = self._allowed(name, self._listen.get(name, f"tcp/127.0.0.1:{port}"))
        if doubled := [endpoint for endpoint, often in Counter(found.values()).items() if often > 1]:
            raise ValueError(f"listen: {doubled[0]} is that of two vehicles")
        return found

    def _allowed(self, name: str, endpoint: str) -> str:
        found = endpoint_of(endpoint)
        if not found or found.protocol != "tcp" or not found.host or not found.port:
            raise ValueError(f"listen: '{endpoint}' of {name} must be tcp/HOST:PORT")
        if not self._insecure and not endpoints.is_loopback(found.host):
            problem = f"listen: {endpoint} of {name} lets in everybody who can reach that address"
            raise ValueError(f"{problem}: listen at 127.0.0.1 and come through ssh -L, or add insecure = true")
        return str(found)

    def _on_sample(self, row: int, sample: zenoh.Sample) -> None:
        """In a thread of Zenoh's."""
        key = str(sample.key_expr)
        if key.startswith(OWN):
            return
        deleted = sample.kind == zenoh.SampleKind.DELETE
        long = len(sample.payload) > self._max_bytes
        payload = b"" if deleted or long else sample.payload.to_bytes()
        attachment = None if sample.attachment is None else sample.attachment.to_bytes()
        said = Publication(key, None if deleted else payload, str(sample.encoding), attachment)
        data = b"" if long else encode(said)
        to = self._to(key)
        if long or len(data) > self._max_bytes:
            self._inbox.count(row, TOO_LONG)
        elif to != row:  # else its own programs have it already
            self._inbox.put(row, to, data)

    def _to(self, key: str) -> int:
        if self._prefix and key.startswith(self._prefix):
            name = key.removeprefix(self._prefix).partition("/")[0]
            if name in self._hall.vehicles:
                return self._hall.vehicles.index(name)
        return BROADCAST


class Inbox:
    """What comes in threads of Zenoh's, on its way to the loop; bounded.

    Args:
        hall: of the bridge.
        offer: hands a datagram to it: sender, to whom, payload.
    """

    def __init__(self, hall: Hall, offer: Callable[..., bool]) -> None:
        self._hall, self._offer = hall, offer
        self._lock = threading.Lock()
        self._waiting: list[tuple[int, int, bytes, int]] = []
        self._number: Counter[int] = Counter()  # of those that wait, by row
        self._counts: Counter[tuple[int, str]] = Counter()

    def put(self, row: int, to: int, payload: bytes) -> None:
        """Hand over a datagram; in any thread."""
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
        """Count what was not handed over; in any thread."""
        with self._lock:
            self._counts[row, what] += 1
            if sum(self._counts.values()) > 1:
                return
        self._wake()

    def _wake(self) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._hall.loop.call_soon_threadsafe(self._take)

    def _take(self) -> None:
        with self._lock:
            waiting, counts = self._waiting, self._counts
            self._waiting, self._counts, self._number = [], Counter(), Counter()
        for row, to, payload, came_ns in waiting:
            if not self._offer(row, to, payload, came_ns=came_ns):
                counts[row, NO_ROOM] += 1
        for (row, what), number in counts.items():
            self._hall.count(row, what, number)


def _listening(endpoint: str) -> zenoh.Session:
    config = access_control.merge(CLIENTS, {"listen": {"endpoints": [endpoint]}})
    try:
        return opened(config, access_control.LIMITS, f"cannot serve Zenoh clients at {endpoint}")
    except UsageError as problem:
        raise DoorError(f"{problem}; end what holds it, or set first_port or listen") from problem
