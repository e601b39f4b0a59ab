"""Byte link to a device: a serial port, a pseudo-terminal or a TCP connection, by URL.

TCP does not use pyserial: its ``socket://`` delays small packets (Nagle), sleeps 0.3 s on closing, and leaks the socket if
the other side closed first.
"""

import errno
import os
import socket
import time
from pathlib import Path
from typing import Protocol

import serial  # type: ignore[import-untyped]
from serial.tools.list_ports import comports  # type: ignore[import-untyped]

from vcmvsp.cosim.endpoints import endpoint_of, with_slash
from vcmvsp.cosim.util.polling import readable, writable
from vcmvsp.hardware.drivers.base import LinkLost, PortError

READ_BYTES = 4096
WRITE_S = 0.2  # a hundred bytes take 0.1 s at 9600 baud
FAREWELL_S = 0.2  # for the other side of a TCP connection to take the last bytes
OPEN_S = 2.0  # for a TCP connection

_GROUP = "join the group that owns it (usually: sudo usermod -aG dialout $USER, then log in again)"
_PROBLEMS = {  # errors: problem, and advice; empty: the ports that are there
    (errno.ENOENT, errno.ENODEV): ("there is no such port", ""),
    (errno.ENXIO,): ("there is no device behind this port", ""),
    (errno.EACCES, errno.EPERM): ("access is denied", _GROUP),
    (errno.EBUSY, errno.EAGAIN): ("it is in use", "close the other program that has it open"),
    (errno.ENOTTY, errno.EISDIR): ("it is not a serial port", ""),
}


class ByteLink(Protocol):
    """Bytes in both directions. `read` and `write` raise `LinkLost` when the other side is gone."""

    def fileno(self) -> int:
        """For select."""

    def read(self) -> bytes:
        """Available bytes; call it when select reports some."""

    def write(self, data: bytes) -> None:
        """Send all bytes within `WRITE_S`."""

    def close(self) -> None:
        """Free the port. Never raises."""


def open_line(url: str, baud: int) -> ByteLink:
    """Open ``/dev/ttyUSB0``, the path of a pseudo-terminal, or ``socket://host:port``; a serial port for this process alone.

    ``tcp`` means ``socket``, and ``/`` means ``://``.

    Raises:
        PortError: it cannot be opened.
    """
    if with_slash(url).startswith(("socket/", "tcp/")):
        return _TcpLink(url)
    if "://" in url:
        raise PortError(url, "unknown kind of port", "give a serial port such as /dev/ttyUSB0, or socket://host:port")
    return _SerialLink(url, baud)


class _SerialLink:
    """A serial port, 8N1, or a pseudo-terminal. pyserial only opens it: its reading and writing fail above 1023 open files."""

    def __init__(self, path: str, baud: int) -> None:
        self._path = path
        try:
            self._port = serial.Serial(path, baud, exclusive=True)
        except (serial.SerialException, OSError, ValueError) as error:
            raise _port_error(path, error) from None

    def fileno(self) -> int:
        return int(self._port.fileno())

    def read(self) -> bytes:
        try:
            if not readable([self.fileno()], 0.0):
                return b""
            chunk = os.read(self.fileno(), READ_BYTES)
        except OSError:
            chunk = b""
        if not chunk:  # end of file, or an input error: the device is gone
            raise _unplugged(self._path)
        return chunk

    def write(self, data: bytes) -> None:
        until = time.monotonic() + WRITE_S
        try:
            while data := data[self._written(data) :]:
                remaining_s = until - time.monotonic()
                if remaining_s <= 0.0 or not writable(self.fileno(), remaining_s):
                    raise LinkLost(self._path, "the port accepts no more bytes", "check cable and radio")
        except OSError:
            raise _unplugged(self._path) from None

    def _written(self, data: bytes) -> int:
        try:
            return os.write(self.fileno(), data)
        except BlockingIOError:
            return 0

    def close(self) -> None:
        try:
            self._port.close()
        except (serial.SerialException, OSError):
            return  # it was unplugged


class _TcpLink:
    """A TCP connection to a simulator of robots or a server of serial ports."""

    def __init__(self, url: str) -> None:
        self._url = url
        _, host, port = endpoint_of(url) or ("", "", None)
        if not host or not port:
            raise PortError(url, "not an address", "write socket://host:port, such as socket://localhost:8101")
        try:
            self._socket = socket.create_connection((host, port), OPEN_S)
        except TimeoutError:
            raise PortError(url, f"{host} does not answer", "check that it is on, and in this network") from None
        except ConnectionRefusedError:
            raise PortError(url, f"nothing listens on port {port} of {host}", "start the robot's simulator or server") from None
        except OSError as error:
            raise PortError(url, f"no connection ({error.strerror or error})", "check host name and network") from None
        self._socket.settimeout(WRITE_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def fileno(self) -> int:
        return self._socket.fileno()

    def read(self) -> bytes:
        try:
            chunk = self._socket.recv(READ_BYTES)
        except TimeoutError:
            return b""
        except OSError:
            chunk = b""
        if not chunk:
            raise _hung_up(self._url)
        return chunk

    def write(self, data: bytes) -> None:
        try:
            self._socket.sendall(data)
        except TimeoutError:
            raise LinkLost(self._url, "the connection accepts no more bytes", "check network and server") from None
        except OSError:
            raise _hung_up(self._url) from None

    def close(self) -> None:
        """Closing with unread bytes would reset the connection, and could lose the last bytes sent."""
        try:
            self._socket.shutdown(socket.SHUT_WR)
            until = time.monotonic() + FAREWELL_S
            while time.monotonic() < until and self._socket.recv(READ_BYTES):
                pass
        except OSError:
            pass  # the other side closed first
        self._socket.close()


def _hung_up(url: str) -> LinkLost:
    return LinkLost(url, "the other side closed the connection", "check that the robot's simulator or server is running")


def _unplugged(path: str) -> LinkLost:
    return LinkLost(path, "the port has disappeared (unplugged or switched off)", "plug it in again")


def _port_error(path: str, error: Exception) -> PortError:
    number = int(getattr(error, "errno", None) or 0)
    if not number and Path(path).exists():  # opened, but not configured
        number = errno.ENOTTY
    ports = ", ".join(sorted(each.device for each in comports())) or "none"
    unknown = (os.strerror(number) if number else str(error), "")
    problem, advice = next((texts for numbers, texts in _PROBLEMS.items() if number in numbers), unknown)
    return PortError(path, problem, advice or f"available ports: {ports}")
