"""One direction of a relayed TCP connection: its bytes cross the air in numbered chunks, and come out whole and in order.

TCP promises its bytes, so a chunk that the channel loses is sent again. No acknowledgements cross the air: both ends of the
stream live here, and the bridge says what was lost. What is under way is bounded, so that TCP itself holds the sender back, and
adapts to the channel as TCP does (RFC 5681): it grows with what arrives, and is halved when something is lost.
"""

import asyncio
import socket
from collections.abc import Callable

WINDOW = 64  # chunks read and not yet taken by the program at the other end, at most
FIRST_WINDOW = 10.0  # RFC 6928
AGAIN_S = 0.02  # after which a lost chunk is sent again; twice as long each time
DOUBLED = 5  # times at most: 0.64 s
NO_ROOM_S = 0.002  # after which a chunk is offered again for which the bridge had no room

Offer = Callable[[int, bytes], bool]
"""Takes a chunk and its number; whether there was room."""


class Window:
    """How many chunks may be under way."""

    def __init__(self) -> None:
        self.chunks = FIRST_WINDOW
        self._quick_up_to = float(WINDOW)
        self._halved_at = -1  # by then so many had been read

    def grow(self) -> None:
        """A chunk has arrived."""
        self.chunks = min(self.chunks + (1.0 if self.chunks < self._quick_up_to else 1.0 / self.chunks), float(WINDOW))

    def shrink(self, lost: int, read: int) -> None:
        """A chunk of this number has been lost; what was lost together counts once."""
        if lost >= self._halved_at:
            self._halved_at = read
            self._quick_up_to = self.chunks = max(self.chunks / 2.0, 2.0)


class Stream:
    """One direction.

    Args:
        loop: the bridge's.
        offer: hands a chunk to the sender's radio.
        chunk_bytes: of a chunk, at most.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, offer: Offer, chunk_bytes: int) -> None:
        self._loop, self._offer, self._chunk_bytes = loop, offer, chunk_bytes
        self._window, self._moved = Window(), asyncio.Event()
        self._read = self._taken = 0  # chunks, from the one program and by the other
        self._under_way: dict[int, tuple[bytes, int]] = {}  # number -> chunk, how often it was lost
        self._arrived: dict[int, bytes] = {}  # before those that are still missing
        self._next = 0  # the first that is missing
        self._in_order: asyncio.Queue[bytes] = asyncio.Queue()
        self._over = False

    async def run(self, source: socket.socket, sink: socket.socket) -> None:
        """Carry everything from one socket to the other, to the end; raises `OSError` when either of them breaks."""
        try:
            async with asyncio.TaskGroup() as both:
                both.create_task(self._read_all(source))
                both.create_task(self._write_all(sink))
        finally:
            self._over = True

    def deliver(self, number: int, chunk: bytes) -> None:
        """A chunk has arrived."""
        if self._under_way.pop(number, None) is None:
            return  # a second time
        self._arrived[number] = chunk
        while self._next in self._arrived:
            self._in_order.put_nowait(self._arrived.pop(self._next))
            self._next += 1
        self._window.grow()
        self._moved.set()

    def lost(self, number: int) -> None:
        """A chunk has been lost."""
        if number in self._under_way:
            chunk, often = self._under_way[number]
            self._under_way[number] = chunk, often + 1
            self._window.shrink(number, self._read)
            self._loop.call_later(AGAIN_S * 2 ** min(often, DOUBLED), self._send, number)

    async def _read_all(self, source: socket.socket) -> None:
        chunk = b"?"
        while chunk:  # an empty one is the end, which must not overtake the rest
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
