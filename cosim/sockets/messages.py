"""What a program and the run say to each other on a socket (`cosim.sockets`): MessagePack behind four bytes of length.

A program says hello, and is welcome or refused. From then on it speaks in its turns alone: `Go` gives it one, which lasts until
it says `Wait`. In its turn it says what its vehicle sends, for which no answer is awaited. Whoever ends the connection leaves.
"""

import socket
from typing import Annotated, TypeVar

import msgspec

from vcmvsp.cosim.endpoints import endpoint_of, with_slash

T = TypeVar("T")
VERSION = 1
DEFAULT = "tcp/127.0.0.1:7550"
LARGEST = 65_535  # bytes of a datagram
ROOM = 4 << 20  # bytes of datagrams that wait for a program to take them
EACH = 512  # bytes that a datagram takes up there beside its own
MOST_UP = LARGEST + 1024  # bytes of a message from a program
MOST_DOWN = 2 * ROOM  # bytes of a message to it
LONGEST_NS = 10**18  # that a program waits
PIECE = 1 << 16  # bytes that are read at a time

Name = Annotated[str, msgspec.Meta(max_length=256)]


class Hello(msgspec.Struct, frozen=True, array_like=True, tag="hello"):
    """The first word of a program."""

    version: int
    vehicle: Name


class Send(msgspec.Struct, frozen=True, array_like=True, tag="send"):
    """What its vehicle sends at the present instant."""

    to: Name | None  # None: broadcast
    payload: Annotated[bytes, msgspec.Meta(max_length=LARGEST)]


class Wait(msgspec.Struct, frozen=True, array_like=True, tag="wait"):
    """The end of its turn."""

    for_ns: Annotated[int, msgspec.Meta(ge=1, le=LONGEST_NS)] | None  # None: however long
    hears: bool  # go on as soon as something is heard
    held: Annotated[int, msgspec.Meta(ge=0, le=ROOM)]  # bytes of datagrams that it was given and has not taken, with `EACH`


class Welcome(msgspec.Struct, frozen=True, array_like=True, tag="welcome"):
    """It takes part."""

    run: str
    vehicles: tuple[str, ...]


class Refused(msgspec.Struct, frozen=True, array_like=True, tag="refused"):
    """It does not."""

    why: str


class Go(msgspec.Struct, frozen=True, array_like=True, tag="go"):
    """The program has its turn."""

    time_ns: int
    position: tuple[float, float, float] | None  # m, world: where its vehicle takes itself to be; None: nobody has told
    heard: list[tuple[bytes, str]]  # payload and sender, oldest first


class Over(msgspec.Struct, frozen=True, array_like=True, tag="over"):
    """The run has ended."""


Up = Hello | Send | Wait
Down = Welcome | Refused | Go | Over
_encoder = msgspec.msgpack.Encoder()
_ups: msgspec.msgpack.Decoder[Up] = msgspec.msgpack.Decoder(Up)
_downs: msgspec.msgpack.Decoder[Down] = msgspec.msgpack.Decoder(Down)


class WireError(ValueError):
    """What came cannot be read."""


class Frames:
    """Takes bytes as they come, and gives whole messages."""

    def __init__(self, longest: int) -> None:
        self._longest, self._bytes = longest, bytearray()

    def __bool__(self) -> bool:
        """Whether something has come that was not given yet."""
        return bool(self._bytes)

    def feed(self, piece: bytes) -> None:
        """Take what has come."""
        self._bytes += piece

    def next(self) -> bytes | None:
        """The next message; None: it is not there yet. Raises `WireError` (it says that it is longer than any may be)."""
        if len(self._bytes) < 4:
            return None
        end = 4 + int.from_bytes(self._bytes[:4], "big")
        if end - 4 > self._longest:
            raise WireError(f"a message of {end - 4} bytes, of which none has more than {self._longest}")
        if len(self._bytes) < end:
            return None
        message = bytes(self._bytes[4:end])
        del self._bytes[:end]
        return message


class Stream:
    """One end of a connection. Its methods wait, and raise an `OSError` where that fails."""

    def __init__(self, end: socket.socket, longest: int) -> None:
        self.socket, self.frames = end, Frames(longest)
        if end.family != socket.AF_UNIX:
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, message: Up | Down) -> None:
        """Send a message."""
        self.socket.sendall(framed(message))

    def receive(self) -> bytes | None:
        """The next message; None: the other side has ended the connection. Raises `WireError` (as `Frames.next`)."""
        while (message := self.frames.next()) is None:
            piece = self.socket.recv(PIECE)
            if not piece:
                return None
            self.frames.feed(piece)
        return message


def framed(message: Up | Down) -> bytes:
    """A message as it goes over the wire."""
    content = _encoder.encode(message)
    return len(content).to_bytes(4, "big") + content


def up(message: bytes) -> Up:
    """What a program says; raises `WireError`."""
    return _decoded(_ups, message)


def down(message: bytes) -> Down:
    """What the run says; raises `WireError`."""
    return _decoded(_downs, message)


def _decoded(decoder: msgspec.msgpack.Decoder[T], message: bytes) -> T:
    try:
        return decoder.decode(message)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise WireError(f"{error}") from None


def parsed(endpoint: str) -> str | tuple[str, int]:
    """The path, or host and port, of ``unix/PATH`` or ``tcp/HOST:PORT``, or with ``://``; raises a `ValueError`."""
    protocol, _, path = with_slash(endpoint).partition("/")
    if protocol == "unix" and path and "\0" not in path:
        return path
    found = endpoint_of(endpoint)
    if not found or found.protocol != "tcp" or not found.host or found.port is None:
        raise ValueError(f"'{endpoint}': must be tcp/HOST:PORT or unix/PATH, e.g. {DEFAULT}")
    return found.host, found.port
