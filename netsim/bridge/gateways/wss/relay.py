"""Relay ports, through which one robot reaches another, and relayed connections."""

import asyncio
import contextlib
import socket
import struct
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from vcmvsp.netsim.bridge.gateways.base import Gateway, GatewayContext
from vcmvsp.netsim.bridge.gateways.wss.stream import RelayStream

HEADER = struct.Struct(">II")  # of a frame: number of the connection, number of the chunk
MOST_RELAYS = 32  # through one port at a time
ACCEPTED_AT_ONCE = 16
CONNECT_S = 5.0  # timeout of the connection to the other robot


Called = Callable[[socket.socket, str], None]
"""Takes over a connection and the address that it comes from."""


class Pair(NamedTuple):
    """User and destination of a relay port."""

    caller: int  # row of the vehicle that connects
    called: int  # row of the vehicle at the other end
    port: int  # on which the called robot listens


class RelayPort:
    """A port that is reserved from its first request on and listens only while the link is up.

    Args:
        address: of this machine.
        port: 0: any free port.
        called: takes accepted connections.

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
        self._streams = {sender: RelayStream(context.loop, partial(self._offer, sender, to), room) for sender, to in ends}

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
        return self._context.offer(self._gateway, sender, to, HEADER.pack(self.number, number) + chunk)


def _tcp(address: str) -> socket.socket:
    end = socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_STREAM)
    end.setblocking(False)
    return end
