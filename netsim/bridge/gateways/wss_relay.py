"""Relay ports, through which one robot reaches another, and relayed TCP connections.

The bytes of a connection cross the channel in numbered chunks and are delivered in order. Lost chunks are sent again. No
acknowledgements cross the channel: both ends are in this process, and the bridge reports losses. The chunks under way are
limited by a congestion window as in TCP (RFC 5681): it grows with arrivals and is halved by a loss.
"""

import asyncio
import contextlib
import socket
import struct
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from vcmvsp.netsim.bridge.gateways.base import Gateway, GatewayContext

WINDOW = 64  # chunks read and not yet taken by the program at the other end
FIRST_WINDOW = 10.0  # RFC 6928
AGAIN_S = 0.02  # until a lost chunk is sent again; doubled each time
DOUBLED = 5  # doublings at most: 0.64 s
NO_ROOM_S = 0.002  # until a chunk without room in the bridge is offered again

Offer = Callable[[int, bytes], bool]
"""Takes a chunk and its number; returns whether there was room."""

HEADER = struct.Struct(">II")  # of a frame: number of the connection, number of the chunk
MOST_RELAYS = 32  # through one port at a time
ACCEPTED_AT_ONCE = 16
CONNECT_S = 5.0  # timeout of the connection to the other robot

Called = Callable[[socket.socket, str], None]
"""Takes over a connection and the address that it comes from."""


class Window:
    """Congestion window: number of chunks that may be under way."""

    def __init__(self) -> None:
        self.chunks = FIRST_WINDOW
        self._quick_up_to = float(WINDOW)
        self._halved_at = -1  # chunks read at the last halving

    def grow(self) -> None:
        """Grow after an arrival."""
        self.chunks = min(self.chunks + (1.0 if self.chunks < self._quick_up_to else 1.0 / self.chunks), float(WINDOW))

    def shrink(self, lost: int, read: int) -> None:
        """Shrink after a loss; losses of one window count once."""
        if lost >= self._halved_at:
            self._halved_at = read
            self._quick_up_to = self.chunks = max(self.chunks / 2.0, 2.0)


class RelayStream:
    """One direction; ``offer`` hands a chunk of at most ``chunk_bytes`` to the sender's radio."""

    def __init__(self, loop: asyncio.AbstractEventLoop, offer: Offer, chunk_bytes: int) -> None:
        self._loop, self._offer, self._chunk_bytes = loop, offer, chunk_bytes
        self._window, self._moved = Window(), asyncio.Event()
        self._read = self._written = 0  # chunks: read from one program, taken by the other
        self._under_way: dict[int, tuple[bytes, int]] = {}  # number -> chunk, losses so far
        self._arrived: dict[int, bytes] = {}  # out of order
        self._next = 0  # first missing chunk
        self._in_order: asyncio.Queue[bytes] = asyncio.Queue()
        self._over = False

    async def run(self, source: socket.socket, sink: socket.socket) -> None:
        """Copy all data from one socket to the other; raises `OSError` when either fails."""
        try:
            async with asyncio.TaskGroup() as both:
                both.create_task(self._read_all(source))
                both.create_task(self._write_all(sink))
        finally:
            self._over = True

    def deliver(self, number: int, chunk: bytes) -> None:
        """Take a chunk that has arrived."""
        if self._under_way.pop(number, None) is None:
            return  # a copy
        self._arrived[number] = chunk
        while self._next in self._arrived:
            self._in_order.put_nowait(self._arrived.pop(self._next))
            self._next += 1
        self._window.grow()
        self._moved.set()

    def lost(self, number: int) -> None:
        """Schedule a lost chunk to be sent again."""
        if number in self._under_way:
            chunk, losses = self._under_way[number]
            self._under_way[number] = chunk, losses + 1
            self._window.shrink(number, self._read)
            self._loop.call_later(AGAIN_S * 2 ** min(losses, DOUBLED), self._send, number)

    async def _read_all(self, source: socket.socket) -> None:
        chunk = b"?"
        while chunk:  # an empty chunk marks the end, in order like all others
            while self._read - self._written >= self._window.chunks:
                self._moved.clear()
                await self._moved.wait()
            chunk = await self._loop.sock_recv(source, self._chunk_bytes)
            self._under_way[self._read] = chunk, 0
            self._send(self._read)
            self._read += 1

    async def _write_all(self, sink: socket.socket) -> None:
        while chunk := await self._in_order.get():
            await self._loop.sock_sendall(sink, chunk)
            self._written += 1
            self._moved.set()
        sink.shutdown(socket.SHUT_WR)

    def _send(self, number: int) -> None:
        if not self._over and number in self._under_way and not self._offer(number, self._under_way[number][0]):
            self._loop.call_later(NO_ROOM_S, self._send, number)


class Pair(NamedTuple):
    """User and destination of a relay port."""

    caller: int  # row of the vehicle that connects
    called: int  # row of the vehicle at the other end
    port: int  # on which the called robot listens


class RelayPort:
    """A port that is reserved from its first request on and listens only while the link is up.

    Args:
        port: 0: any free port.

    Raises:
        OSError: the port is not available.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, address: str, port: int, called: Called) -> None:
        self._loop, self._called = loop, called
        self._holder = _tcp(address)
        self._listener: socket.socket | None = None
        try:
            self._holder.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._holder.bind((address, port))
        except OSError:
            self._holder.close()
            raise
        self.port: int = self._holder.getsockname()[1]

    def let(self, listening: bool) -> None:
        """Start or stop to listen."""
        if listening and self._listener is None:
            self._listen()
        elif not listening and self._listener is not None:
            self._loop.remove_reader(self._listener)
            self._listener.close()
            self._listener = None

    def close(self) -> None:
        """Release the port."""
        self.let(False)
        self._holder.close()

    def _listen(self) -> None:
        """Listen with a second socket: two sockets may share a port if only one of them listens."""
        address = self._holder.getsockname()
        listener = _tcp(address[0])
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
            listener.listen()
        except OSError:  # out of descriptors: the next `let` tries again
            listener.close()
        else:
            self._listener = listener
            self._loop.add_reader(listener, self._accept, listener)

    def _accept(self, listener: socket.socket) -> None:
        try:
            for _ in range(ACCEPTED_AT_ONCE):
                near, address = listener.accept()
                self._called(near, address[0])
        except BlockingIOError:
            pass
        except OSError:  # out of descriptors: connections are refused until the next `let`
            self.let(False)


class Relay:
    """A relayed connection; ``number``: of the connection, in its frames; ``chunk_bytes``: longest payload of a frame."""

    def __init__(self, context: GatewayContext, gateway: Gateway, pair: Pair, number: int, chunk_bytes: int) -> None:
        self.pair, self.number = pair, number
        self.origin: int | None = None  # local port of the connection to the called robot
        self._context, self._gateway = context, gateway
        room = chunk_bytes - HEADER.size
        ends = (pair.caller, pair.called), (pair.called, pair.caller)
        self.streams = {sender: RelayStream(context.loop, partial(self._offer, sender, to), room) for sender, to in ends}

    async def run(self, near: socket.socket, host: str) -> None:
        """Connect to the other robot and relay both directions, until both have ended or one has failed."""
        far = _tcp(host)
        with near, far, contextlib.suppress(OSError):
            near.setblocking(False)
            far.bind(("::" if far.family == socket.AF_INET6 else "0.0.0.0", 0))  # noqa: S104 - to call from
            self.origin = far.getsockname()[1]
            async with asyncio.timeout(CONNECT_S):
                await self._context.loop.sock_connect(far, (host, self.pair.port))
            await self._carry(near, far)

    async def _carry(self, near: socket.socket, far: socket.socket) -> None:
        for each in (near, far):
            each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        forth, back = self.streams.values()
        try:
            async with asyncio.TaskGroup() as both:
                both.create_task(forth.run(near, far))
                both.create_task(back.run(far, near))
        except* OSError:
            pass

    def _offer(self, sender: int, to: int, number: int, chunk: bytes) -> bool:
        return self._context.offer(self._gateway, sender, to, HEADER.pack(self.number, number) + chunk)


def _tcp(address: str) -> socket.socket:
    end = socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_STREAM)
    end.setblocking(False)
    return end
