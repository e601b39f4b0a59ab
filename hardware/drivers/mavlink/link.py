"""Link to a vehicle: UDP, TCP or a serial port, by the addresses of pymavlink and MAVSDK.

Anybody may send to an open UDP port: bytes come with their source, and answers go to one source.
"""

import contextlib
import re
import socket
from typing import Any, Protocol

from vcmvsp.cosim.transport.endpoints import check_interfaces
from vcmvsp.hardware.drivers.base import PortError
from vcmvsp.hardware.drivers.byte_link import ByteLink, open_line

DATAGRAM = 65_535
DATAGRAMS = 100  # in one read
SOURCES = 32  # known while the vehicle is searched; a new one replaces the oldest
_ADVICE = "write udpin:127.0.0.1:14540, udpout:HOST:PORT, tcp:HOST:PORT or a serial port such as /dev/ttyACM0"
_NETWORK = re.compile(r"(udpin|udpout|tcp|socket)(?:://|:|/)(\[[0-9a-fA-F:.]+\]|[^:/\[\]]+):(\d{1,5})")
Chunks = list[tuple[str, bytes]]  # source, bytes


class MavlinkLink(Protocol):
    """Bytes in both directions. `read` and `write` raise `LinkLost` when the other side is known to be gone."""

    def fileno(self) -> int:
        """For select."""

    def read(self) -> Chunks:
        """Available bytes with their sources; call it when select reports some."""

    def answer(self, source: str) -> None:
        """Exchange bytes with this source only from now on."""

    def write(self, data: bytes) -> None:
        """Send to the source of `answer`, if there is one; datagrams may be lost."""

    def close(self) -> None:
        """Free the port. Never raises."""


def open_link(address: str, baud: int, *, insecure: bool = False) -> MavlinkLink:
    """Open ``udpin:HOST:PORT`` (wait there), ``udpout:HOST:PORT`` (send first), ``tcp:HOST:PORT`` or a serial port.

    ``/`` and ``://`` mean the first ``:``.

    Raises:
        PortError: it cannot be opened.
    """
    match = _NETWORK.fullmatch(address)
    if match is None:
        if ":" in address or not address:
            raise PortError(address or "''", "this is no address", _ADVICE)
        return _StreamLink(open_line(address, baud))
    scheme, host, port = match[1], match[2].strip("[]"), int(match[3])
    if not 0 < port < 65_536:
        raise PortError(address, f"there is no port {port}", "ports are from 1 to 65535")
    if scheme in ("tcp", "socket"):
        return _StreamLink(open_line(f"socket://{match[2]}:{port}", baud))
    if scheme == "udpin":
        try:
            check_interfaces(host, insecure=insecure)
        except ValueError as error:
            problem, _, advice = str(error).partition(": ")
            raise PortError(address, problem, advice) from None
    return _UdpLink(address, host, port, listens=scheme == "udpin")


class _StreamLink:
    """A serial port or a TCP connection, with one other side."""

    def __init__(self, line: ByteLink) -> None:
        self._line = line

    def fileno(self) -> int:
        return self._line.fileno()

    def read(self) -> Chunks:
        return [("", self._line.read())]

    def answer(self, source: str) -> None:
        """There is one source only."""

    def write(self, data: bytes) -> None:
        self._line.write(data)

    def close(self) -> None:
        self._line.close()


class _UdpLink:
    """A UDP port. One that listens sends nothing before `answer`; one that does not receives from its target only."""

    def __init__(self, address: str, host: str, port: int, *, listens: bool) -> None:
        self._to: Any = None  # an address of the operating system
        self._source = ""
        self._sources: dict[str, Any] = {}
        try:
            family, _, _, _, where = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(family, socket.SOCK_DGRAM)
        except OSError as error:
            raise PortError(address, f"no address ({error.strerror or error})", "look at host name and network") from None
        self._connected = not listens
        try:
            self._socket.setblocking(False)
            if listens:
                self._socket.bind(where)
            else:
                self._socket.connect(where)
        except OSError as error:
            self._socket.close()
            advice = "close the other program that has it open, or give another port" if listens else "look at the network"
            raise PortError(address, error.strerror or str(error), advice) from None

    def fileno(self) -> int:
        return self._socket.fileno()

    def read(self) -> Chunks:
        chunks: Chunks = []
        for _ in range(DATAGRAMS):
            try:
                data, where = self._socket.recvfrom(DATAGRAM)
            except ConnectionRefusedError:  # the target does not listen yet
                continue
            except OSError:  # no more datagrams
                break
            source = "" if self._connected else f"{where[0]}:{where[1]}"
            if self._source in ("", source):
                chunks.append((source, data))
                self._sources[source] = where
                if len(self._sources) > SOURCES:
                    del self._sources[next(iter(self._sources))]
        return chunks

    def answer(self, source: str) -> None:
        self._source = source
        if not self._connected:
            self._to = self._sources.get(source)

    def write(self, data: bytes) -> None:
        with contextlib.suppress(OSError):
            if self._connected:
                self._socket.send(data)
            elif self._to is not None:
                self._socket.sendto(data, self._to)

    def close(self) -> None:
        self._socket.close()
