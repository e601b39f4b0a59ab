"""One direction of a relayed TCP connection: its bytes cross the channel in numbered chunks and are delivered in order.

Lost chunks are sent again. No acknowledgements cross the channel: both ends are in this process, and the bridge reports losses.
The chunks under way are limited by a congestion window as in TCP (RFC 5681): it grows with arrivals and is halved by a loss.
"""

import asyncio
import socket
from collections.abc import Callable

WINDOW = 64  # chunks read and not yet taken by the program at the other end
FIRST_WINDOW = 10.0  # RFC 6928
AGAIN_S = 0.02  # until a lost chunk is sent again; doubled each time
DOUBLED = 5  # doublings at most: 0.64 s
NO_ROOM_S = 0.002  # until a chunk without room in the bridge is offered again

Offer = Callable[[int, bytes], bool]
"""Takes a chunk and its number; returns whether there was room."""


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
        self._read = self._taken = 0  # chunks: read from one program, taken by the other
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
        """A chunk has arrived."""
        if self._under_way.pop(number, None) is None:
            return  # a copy
        self._arrived[number] = chunk
        while self._next in self._arrived:
            self._in_order.put_nowait(self._arrived.pop(self._next))
            self._next += 1
        self._window.grow()
        self._moved.set()

    def lost(self, number: int) -> None:
        """A chunk has been lost."""
        if number in self._under_way:
            chunk, losses = self._under_way[number]
            self._under_way[number] = chunk, losses + 1
            self._window.shrink(number, self._read)
            self._loop.call_later(AGAIN_S * 2 ** min(losses, DOUBLED), self._send, number)

    async def _read_all(self, source: socket.socket) -> None:
        chunk = b"?"
        while chunk:  # an empty chunk marks the end, in order like all others
            while self._read - self._taken >= self._window.chunks:
                self._moved.clear()
                await self._moved.wait()
            chunk = await self._loop.sock_recv(source, self._chunk_bytes)
            self._under_way[self._read] = chunk, 0
            self._send(self._read)
            self._read += 1

    async def _write_all(self, sink: socket.socket) -> None:
        while chunk := await self._in_order.get():
            await self._loop.sock_sendall(sink, chunk)
            self._taken += 1
            self._moved.set()
        sink.shutdown(socket.SHUT_WR)

    def _send(self, number: int) -> None:
        if not self._over and number in self._under_way and not self._offer(number, self._under_way[number][0]):
            self._loop.call_later(NO_ROOM_S, self._send, number)
