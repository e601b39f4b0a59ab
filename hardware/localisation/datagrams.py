"""UDP datagrams as a `hardware.drivers.byte_link.ByteLink`: each read is one datagram."""

import errno
import socket

from vcmvsp.cosim.endpoints import bracketed, endpoint_of
from vcmvsp.hardware.drivers.base import PortError

LARGEST_BYTES = 65535


class Datagrams:
    """A UDP socket bound to ``udp://host:port``; port 0 takes a free one, see ``url``.

    Raises:
        PortError: the address cannot be bound.
    """

    def __init__(self, url: str) -> None:
        host, port = address(url)
        try:
            family, kind, protocol, _, where = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except OSError:
            raise PortError(
                url, f"no address is known for {host}", "give an address of this machine, or 0.0.0.0 for all"
            ) from None
        self._socket = socket.socket(family, kind, protocol)
        try:
            self._socket.bind(where)
        except OSError as error:
            self._socket.close()
            raise _problem(url, host, port, error) from None
        self._socket.setblocking(False)
        self.url = f"udp://{bracketed(host)}:{self._socket.getsockname()[1]}"

    def fileno(self) -> int:
        """For poll."""
        return self._socket.fileno()

    def read(self) -> bytes:
        """The next datagram; empty if there is none."""
        try:
            return self._socket.recv(LARGEST_BYTES)
        except OSError:  # no datagram, or an ICMP error
            return b""

    def write(self, data: bytes) -> None:
        """Nothing is sent."""

    def close(self) -> None:
        """Free the port."""
        self._socket.close()


def address(url: str) -> tuple[str, int]:
    """Host and port of ``udp://host:port``.

    Raises:
        ValueError: the text has another form.
    """
    protocol, host, port = endpoint_of(url) or ("", "", None)
    if protocol != "udp" or not host or port is None:
        raise ValueError(f"listen = '{url}': an address to listen on is written udp://host:port, such as udp://0.0.0.0:5010")
    return host, port


def _problem(url: str, host: str, port: int, error: OSError) -> PortError:
    if error.errno == errno.EADDRINUSE:
        return PortError(
            url, f"port {port} is in use", "close the other program that listens there, or have positions sent to another"
        )
    if error.errno == errno.EADDRNOTAVAIL:
        return PortError(
            url, f"this machine has no interface with the address {host}", "take one of its own, or 0.0.0.0 for all"
        )
    if error.errno == errno.EACCES:
        return PortError(url, f"port {port} may not be opened by you", "take one above 1023")
    return PortError(url, f"nothing can listen there ({error.strerror or error})", "look at address and network")
