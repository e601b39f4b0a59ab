"""Messages between a run and its viewer process, length-prefixed, over a socket pair; the run never waits.

The run sends `Start` and then `PageUpdate`s; the viewer process answers with `Up` or `Down`, and then with orders.
"""

import contextlib
import select
import socket
import struct
import time
from collections.abc import Iterator

from vcmvsp.cosim.types import Value
from vcmvsp.cosim.util import codec
from vcmvsp.cosim.view.messages import Order, PageUpdate, Scenery

LARGEST = 1 << 28  # bytes of a message: a mosaic of the ground
_CHUNK = 1 << 20
_length = struct.Struct("<I")


class Start(Value, frozen=True, kw_only=True):
    """First message to the viewer process."""

    scenery: Scenery
    host: str
    port: int
    token: str


class Up(Value, frozen=True, kw_only=True, tag_field="kind", tag="up"):
    """The page is served."""

    port: int


class Down(Value, frozen=True, kw_only=True, tag_field="kind", tag="down"):
    """The page is not served, or no longer."""

    problem: str


starts: codec.Decoder[Start] = codec.Decoder(Start)
shows: codec.Decoder[PageUpdate] = codec.Decoder(PageUpdate)
answers: codec.Decoder[Up | Down | Order] = codec.Decoder(Up | Down | Order)


class Pipe:
    """One end of the socket pair. Messages may be sent in pieces; each one is finished before the next begins."""

    def __init__(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        self._sock, self._poll = sock, select.poll()
        self._poll.register(sock, select.POLLOUT)
        self._unsent = memoryview(b"")  # rest of the current message
        self._received = bytearray()
        self.open = True  # as far as known: the other end is connected

    def push(self) -> bool:
        """Continue to send; returns whether another message can begin."""
        while self._unsent and self.open:
            try:
                self._unsent = self._unsent[self._sock.send(self._unsent) :]
            except BlockingIOError:
                return False
            except OSError:
                self._lose()
        return self.open and bool(self._poll.poll(0))

    def offer(self, payload: bytes) -> bool:
        """Begin a message if there is room and no other one is in progress; returns whether it has begun."""
        if not self.push():
            return False
        self._unsent = memoryview(_length.pack(len(payload)) + fitting(payload))
        self.push()
        return True

    def offer_within(self, payload: bytes, wait_s: float) -> bool:
        """Send all pending bytes and this message; returns whether that succeeded within ``wait_s``."""
        until_s = time.monotonic() + wait_s
        begun = False
        while self.open:
            begun = begun or self.offer(payload)
            if begun and not self._unsent:
                return True
            left_s = until_s - time.monotonic()
            if left_s <= 0.0:
                break
            self._poll.poll(1e3 * min(left_s, 0.05))  # poll reports some room, not enough room
            self.push()
        return False

    def take(self, wait_s: float | None = 0.0) -> list[bytes]:
        """The received messages, oldest first.

        Args:
            wait_s: maximum wait for the first bytes; None: until there are some or the other end has closed.

        Raises:
            ValueError: the bytes are not valid messages.
        """
        poll = select.poll()
        poll.register(self._sock, select.POLLIN)
        if self.open and poll.poll(None if wait_s is None else 1e3 * wait_s):
            self._read()
        return list(self._messages())

    def close(self) -> None:
        """Close this end; the other end sees the end of the stream."""
        self.open = False
        self._sock.close()

    def _read(self) -> None:
        """Read all available bytes, up to the size of the largest message."""
        while len(self._received) < LARGEST:
            try:
                data = self._sock.recv(_CHUNK)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                self._lose()
                return
            self._received += data

    def _messages(self) -> Iterator[bytes]:
        while len(self._received) >= _length.size:
            (length,) = _length.unpack_from(self._received)
            if length > LARGEST:
                raise ValueError(f"a message of {length} bytes")
            end = _length.size + length
            if len(self._received) < end:
                return
            message = bytes(memoryview(self._received)[_length.size : end])
            del self._received[:end]
            yield message

    def _lose(self) -> None:
        self.open, self._unsent = False, memoryview(b"")


def fitting(payload: bytes) -> bytes:
    """The payload unchanged; one that is too long raises a `ValueError`."""
    if len(payload) > LARGEST:
        raise ValueError(f"{len(payload)} bytes are too many for the control station")
    return payload


def pair() -> tuple[Pipe, socket.socket]:
    """Create two connected ends; the second is for another process."""
    own_end, child_end = socket.socketpair()
    for each in (own_end, child_end):
        with contextlib.suppress(OSError):
            each.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _CHUNK)
    return Pipe(own_end), child_end
