"""A source of positions on a byte link: a thread reads it, and opens it again after a loss."""

import contextlib
import errno
import os
import socket
import threading
import time

from vcmvsp.cosim.endpoints import bracketed, endpoint_of
from vcmvsp.cosim.util.polling import readable
from vcmvsp.hardware.drivers.base import LinkLost, PortError
from vcmvsp.hardware.drivers.byte_link import ByteLink
from vcmvsp.hardware.localisation.source import PositionSource

LARGEST_BYTES = 65535


class Datagrams:
    """A UDP socket at ``udp://host:port``; port 0 takes a free one, see ``url``. `PortError`: it cannot be bound."""

    def __init__(self, url: str) -> None:
        host, port = address(url)
        try:
            family, kind, protocol, _, where = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except OSError:
            advice = "use an address of this machine, or 0.0.0.0 for all"
            raise PortError(url, f"the host name {host} is unknown", advice) from None
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
        """No effect: nothing is sent."""

    def close(self) -> None:
        """Free the port."""
        self._socket.close()


def address(url: str) -> tuple[str, int]:
    """Host and port of ``udp://host:port``; `ValueError`: the text has another form."""
    protocol, host, port = endpoint_of(url) or ("", "", None)
    if protocol != "udp" or not host or port is None:
        raise ValueError(f"listen = '{url}': must be udp://host:port, such as udp://0.0.0.0:5010")
    return host, port


def _problem(url: str, host: str, port: int, error: OSError) -> PortError:
    advice = "close the other program that listens there, or send positions to another port"
    problems = {
        errno.EADDRINUSE: (f"port {port} is in use", advice),
        errno.EADDRNOTAVAIL: (
            f"this machine has no interface with the address {host}",
            "use one of its own addresses, or 0.0.0.0 for all",
        ),
        errno.EACCES: (f"no permission to open port {port}", "use one above 1023"),
    }
    unknown = f"cannot listen there ({error.strerror or error})", "check address and network"
    return PortError(url, *problems.get(error.errno or 0, unknown))


RETRY_S = 0.5
TICK_S = 0.1  # period of writing
CLOSE_S = 5.0  # opening a TCP connection takes 2 s at most


class PortSource(PositionSource):
    """Reads a link, opened by `_open_line`, and writes what `_say` returns several times a second."""

    _thread: threading.Thread | None = None

    def _open_line(self) -> ByteLink:
        raise NotImplementedError

    def _say(self, now_ns: int) -> bytes:
        return b""

    def open(self) -> None:
        """Open the port and start reading; `PortError`: it cannot be opened."""
        self._begin()
        line = self._open_line()
        self._wake_read, self._wake_write = os.pipe()
        self._thread = threading.Thread(target=self._run, args=(line,), name=f"positions {self.device}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Free the port. May be called twice."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        os.write(self._wake_write, b"x")
        thread.join(CLOSE_S)
        if not thread.is_alive():  # otherwise the descriptors are still in use
            os.close(self._wake_read)
            os.close(self._wake_write)

    def _run(self, line: ByteLink | None) -> None:
        try:
            while True:
                if line is None:
                    if self._woken(RETRY_S):
                        return
                    with contextlib.suppress(PortError):
                        line = self._open_line()
                        self.back()
                    continue
                try:
                    if self._woken(TICK_S, line):
                        return
                except LinkLost as error:
                    line.close()
                    line = None
                    self.lost(f"{error.happened}; {error.advice}")
        except Exception as error:  # an error of the reader
            self.failed(error)
        finally:
            if line is not None:
                line.close()

    def _woken(self, seconds: float, line: ByteLink | None = None) -> bool:
        """Read and write for at most ``seconds``; whether to stop."""
        ready = readable([self._wake_read] if line is None else [self._wake_read, line.fileno()], seconds)
        if self._wake_read in ready:
            return True
        if line is not None:
            if ready and (chunk := line.read()):
                self.take(chunk, time.monotonic_ns())
            if words := self._say(time.monotonic_ns()):
                line.write(words)
        return False
