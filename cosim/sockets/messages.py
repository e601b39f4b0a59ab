"""Messages between a program and the run on a socket (`cosim.sockets`): MessagePack behind four bytes of length.

A program sends `Hello` and gets `Welcome` or `Refused`. From then on it sends in its turns only: a turn lasts from `Go` to its
`Wait`. In its turn it sends its vehicle's datagrams, which are not acknowledged. Either side leaves by closing the connection.
"""

import socket
from typing import Annotated, TypeVar

import msgspec

from vcmvsp.cosim.endpoints import endpoint_of, with_slash

T = TypeVar("T")
VERSION = 1
DEFAULT = "tcp/127.0.0.1:7550"
LARGEST = 65_535  # bytes of a datagram
ROOM = 4 << 20  # bytes of datagrams that wait for a program
EACH = 512  # overhead of a waiting datagram, bytes
MOST_UP = LARGEST + 1024  # bytes of a message from a program
MOST_DOWN = 2 * ROOM  # bytes of a message to a program
LONGEST_NS = 10**18  # longest wait of a program
PIECE = 1 << 16  # bytes of a read

Name = Annotated[str, msgspec.Meta(max_length=256)]


class Hello(msgspec.Struct, frozen=True, array_like=True, tag="hello"):
    """First message of a program."""

    version: int
    vehicle: Name


class Send(msgspec.Struct, frozen=True, array_like=True, tag="send"):
    """A datagram that the program's vehicle sends at the present instant."""

    to: Name | None  # None: broadcast
    payload: Annotated[bytes, msgspec.Meta(max_length=LARGEST)]


class Wait(msgspec.Struct, frozen=True, array_like=True, tag="wait"):
    """End of the program's turn."""

    for_ns: Annotated[int, msgspec.Meta(ge=1, le=LONGEST_NS)] | None  # None: no time limit
    hears: bool  # also resume when a datagram arrives
    held: Annotated[int, msgspec.Meta(ge=0, le=ROOM)]  # bytes of received datagrams that the program has not taken, with `EACH`


class Welcome(msgspec.Struct, frozen=True, array_like=True, tag="welcome"):
    """Answer to `Hello`: the program takes part."""

    run: str
    vehicles: tuple[str, ...]


class Refused(msgspec.Struct, frozen=True, array_like=True, tag="refused"):
    """Answer to `Hello`: the program does not take part."""

    why: str


class Go(msgspec.Struct, frozen=True, array_like=True, tag="go"):
    """Start of the program's turn."""

    time_ns: int
    position: tuple[float, float, float] | None  # m, world: the vehicle's estimate of its position; None: unknown
    heard: list[tuple[bytes, str]]  # payload and sender, oldest first


class Over(msgspec.Struct, frozen=True, array_like=True, tag="over"):
    """End of the run."""


Up = Hello | Send | Wait
Down = Welcome | Refused | Go | Over
_encoder = msgspec.msgpack.Encoder()
_ups: msgspec.msgpack.Decoder[Up] = msgspec.msgpack.Decoder(Up)
_downs: msgspec.msgpack.Decoder[Down] = msgspec.msgpack.Decoder(Down)


class WireError(ValueError):
    """Received bytes are not a valid message."""


class Frames:
    """Splits a stream of bytes into messages."""

    def __init__(self, longest: int) -> None:
        self._longest, self._bytes = longest, bytearray()

    def __bool__(self) -> bool:
        """Whether bytes of an incomplete message are waiting."""
        return bool(self._bytes)

    def feed(self, piece: bytes) -> None:
        """Add received bytes."""
        self._bytes += piece

    def next(self) -> bytes | None:
        """The next message; None: it is incomplete. Raises `WireError` (its length exceeds the longest one)."""
        if len(self._bytes) < 4:
            return None
        end = 4 + int.from_bytes(self._bytes[:4], "big")
        if end - 4 > self._longest:
            raise WireError(f"a message of {end - 4} bytes (at most {self._longest})")
        if len(self._bytes) < end:
            return None
        message = bytes(self._bytes[4:end])
        del self._bytes[:end]
        return message


class Stream:
    """One end of a connection. Its methods block, and raise an `OSError` if the connection fails."""

    def __init__(self, end: socket.socket, longest: int) -> None:
        self.socket, self.frames = end, Frames(longest)
        if end.family != socket.AF_UNIX:
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, message: Up | Down) -> None:
        """Send a message."""
        self.socket.sendall(framed(message))

    def receive(self) -> bytes | None:
        """The next message; None: the other side has closed the connection. Raises `WireError` (as `Frames.next`)."""
        while (message := self.frames.next()) is None:
            piece = self.socket.recv(PIECE)
            if not piece:
                return None
            self.frames.feed(piece)
        return message


def framed(message: Up | Down) -> bytes:
    """A message as bytes with its length in front."""
    content = _encoder.encode(message)
    return len(content).to_bytes(4, "big") + content


def up(message: bytes) -> Up:
    """Decode a message of a program; raises `WireError`."""
    return _decoded(_ups, message)


def down(message: bytes) -> Down:
    """Decode a message of the run; raises `WireError`."""
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
    address = endpoint_of(endpoint)
    if not address or address.protocol != "tcp" or not address.host or address.port is None:
        raise ValueError(f"'{endpoint}': must be tcp/HOST:PORT or unix/PATH, e.g. {DEFAULT}")
    return address.host, address.port
