"""Ports on which one robot reaches another, and the connections that are relayed there."""

import asyncio
import contextlib
import socket
import struct
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from vcmvsp.netsim.bridge.gateways.base import Door, Hall
from vcmvsp.netsim.bridge.gateways.wss.stream import Stream

HEADER = struct.Struct(">II")  # connection, number of the chunk: what the frame carries beside its bytes
MOST_RELAYS = 32  # through one port at a time
ACCEPTED_AT_ONCE = 16
CONNECT_S = 5.0  # within which the robot that is called takes the connection


Called = Callable[[socket.socket, str], None]
"""Takes over a connection and the address that it comes from."""


class Pair(NamedTuple):
    """Who may use a port of ours, and where it leads."""

    caller: int  # row of the vehicle
    called: int  # likewise
    port: int  # on which the robot that is called listens


class Gate:
    """A port that is held from its first request on, and listens only while the link is there: else connects are refused.

    Args:
        address: of ours.
        port: 0: any that is free.
        called: takes over those who connect.

    Raises:
        OSError: the port cannot be had.
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
        """Listen, or not."""
        if listening and self._listener is None:
            self._listen()
        elif not listening and self._listener is not None:
            self._loop.remove_reader(self._listener)
            self._listener.close()
            self._listener = None

    def close(self) -> None:
        """Give the port back."""
        self.let(False)
        self._holder.close()

    def _listen(self) -> None:
        """Beside the holder: two sockets may have one port as long as only one of them listens."""
        address = self._holder.getsockname()
        listener = _tcp(address[0])
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
            listener.listen()
        except OSError:  # out of sockets: tried again when it is asked next
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
            pass  # that were all
        except OSError:  # out of sockets: until it is asked next, who calls is refused
            self.let(False)


class Relay:
    """A connection of two robots.

    Args:
        door: whose it is.
        pair: who called whom.
        number: that its frames bear.
        chunk_bytes: of a frame's payload, at most.
    """

    def __init__(self, hall: Hall, door: Door, pair: Pair, number: int, chunk_bytes: int) -> None:
        self.pair, self.number = pair, number
        self.origin: int | None = None  # the port of ours from which the robot that is called sees it come
        self._hall, self._door = hall, door
        room = chunk_bytes - HEADER.size
        ends = (pair.caller, pair.called), (pair.called, pair.caller)
        self._streams = {sender: Stream(hall.loop, partial(self._offer, sender, to), room) for sender, to in ends}

    async def run(self, near: socket.socket, host: str) -> None:
        """Call the other robot and carry what both say, until they have said it all or one of them breaks off."""
        far = _tcp(host)
        with near, far, contextlib.suppress(OSError):
            near.setblocking(False)
            far.bind(("::" if far.family == socket.AF_INET6 else "0.0.0.0", 0))  # noqa: S104 - to call from
            self.origin = far.getsockname()[1]
            async with asyncio.timeout(CONNECT_S):
                await self._hall.loop.sock_connect(far, (host, self.pair.port))
            await self._carry(near, far)

    async def _carry(self, near: socket.socket, far: socket.socket) -> None:
        for each in (near, far):
            each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        there, back = self._streams.values()
        try:
            async with asyncio.TaskGroup() as both:
                both.create_task(there.run(near, far))
                both.create_task(back.run(far, near))
        except* OSError:
            pass

    def deliver(self, sender: int, number: int, chunk: bytes) -> None:
        """A chunk has arrived."""
        self._streams[sender].deliver(number, chunk)

    def lost(self, sender: int, number: int) -> None:
        """A chunk has been lost."""
        self._streams[sender].lost(number)

    def _offer(self, sender: int, to: int, number: int, chunk: bytes) -> bool:
        return self._hall.offer(self._door, sender, to, HEADER.pack(self.number, number) + chunk)


def _tcp(address: str) -> socket.socket:
    made = socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_STREAM)
    made.setblocking(False)
    return made
