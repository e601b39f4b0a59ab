"""Servers of emulated devices: a thread that serves a device, its ports (terminal, TCP, UDP), and programs around it."""

import contextlib
import os
import pty
import socket
import termios
import threading
import time
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from math import inf
from pathlib import Path
from typing import Any, Self

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.endpoints import bracketed
from vcmvsp.cosim.errors import Interrupted, UsageError, VcmvspError
from vcmvsp.cosim.util.polling import readable

LOOPBACK = "127.0.0.1"
"""Address that only this machine can reach."""

Ready = Callable[[Mapping[str, Any]], object]
"""Called when a device can be connected to, with its addresses."""

_PAUSE_NS = 100_000_000  # longest sleep
_CLOSE_S = 5.0  # the thread ends within one sleep
_LOOK_S = 0.1  # period of checks of the threads
_READ = 65_535  # bytes


class TcpListener:
    """A TCP port for one client at a time; the next one is accepted after the last has closed its connection."""

    def __init__(self, scheme: str, host: str, port: int) -> None:
        self._listener = socket.create_server((host, port), backlog=1)
        self._listener.setblocking(False)
        self._client: socket.socket | None = None
        self.url = f"{scheme}{host}:{self._listener.getsockname()[1]}"

    def waits_on(self) -> int:
        """Descriptor that becomes readable when there is something to `read`."""
        return (self._client or self._listener).fileno()

    def read(self) -> bytes:
        """Bytes of the client, or none."""
        if self._client is None:
            with contextlib.suppress(BlockingIOError, ConnectionError):
                self._client, _ = self._listener.accept()
                self._client.setblocking(False)
                self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return b""
        try:
            data = self._client.recv(_READ)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._hang_up()
        return data

    def write(self, data: bytes) -> int:
        """Send without waiting; 0 without a client."""
        try:
            return self._client.send(data) if self._client is not None else 0
        except BlockingIOError:
            return 0
        except OSError:
            self._hang_up()
            return 0

    def baud(self) -> None:
        """A TCP connection has no baud rate."""

    def _hang_up(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None

    def close(self) -> None:
        """Hang up, and free the port."""
        self._hang_up()
        self._listener.close()


class UdpPort:
    """Datagrams, one for each read: to a fixed address, or from a free port of loopback to the last sender."""

    _to: Any  # an address of the operating system

    def __init__(self, to: tuple[str, int] | None = None, scheme: str = "") -> None:
        family, self._to, self._fixed = socket.AF_INET, None, to is not None
        if to:
            family, _, _, _, self._to = socket.getaddrinfo(*to, type=socket.SOCK_DGRAM)[0]
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        try:
            self._socket.bind(("" if to else LOOPBACK, 0))  # a loopback port is reachable on this machine only
        except OSError:
            self._socket.close()
            raise
        port = self._socket.getsockname()[1]
        self.url = f"{scheme or 'udpin:'}{bracketed(to[0])}:{to[1]}" if to else f"udpout:{LOOPBACK}:{port}"

    def waits_on(self) -> int:
        """Socket that becomes readable."""
        return self._socket.fileno()

    def read(self) -> bytes:
        """The next datagram, or none."""
        with contextlib.suppress(OSError):
            data, where = self._socket.recvfrom(_READ)
            if not self._fixed:
                self._to = where
            return data
        return b""

    def write(self, data: bytes) -> int:
        """Send one datagram; 0: no receiver, or no network, which may come back."""
        with contextlib.suppress(OSError):
            return self._socket.sendto(data, self._to) if self._to is not None else 0
        return 0

    def close(self) -> None:
        """Free the port."""
        self._socket.close()


class Pty:
    """A pseudo-terminal, and a link to it; its far end stays open here too. ``baud`` holds until a client sets a rate."""

    def __init__(self, link: Path | None, baud: int | None = None) -> None:
        self._near_end, self._far_end = pty.openpty()
        tty.setraw(self._far_end)
        if baud is not None:
            settings = termios.tcgetattr(self._far_end)
            settings[4] = settings[5] = getattr(termios, f"B{baud}")
            termios.tcsetattr(self._far_end, termios.TCSANOW, settings)
        os.set_blocking(self._near_end, False)
        self.url, self._link = os.ttyname(self._far_end), None
        if link is None:
            return
        try:
            old = link.readlink() if link.is_symlink() else Path()
            if old.parent == Path("/dev/pts") and (not old.exists() or str(old) == self.url):  # of a killed emulator
                link.unlink()
            link.symlink_to(self.url)
        except OSError:
            self.close()
            raise
        self.url, self._link = str(link), link

    def waits_on(self) -> int:
        """Descriptor of this end."""
        return self._near_end

    def read(self) -> bytes:
        """Bytes of the client, or none."""
        with contextlib.suppress(BlockingIOError):
            return os.read(self._near_end, _READ)
        return b""

    def write(self, data: bytes) -> int:
        """Write without waiting."""
        with contextlib.suppress(BlockingIOError):
            return os.write(self._near_end, data)
        return 0

    def baud(self) -> int:
        """The rate that the client has set; 0: unknown."""
        speed = termios.tcgetattr(self._near_end)[5]
        rates = (int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit())
        return next((rate for rate in rates if getattr(termios, f"B{rate}") == speed), 0)

    def close(self) -> None:
        """Close the terminal, and remove the link."""
        if self._link is not None:
            self._link.unlink(missing_ok=True)
        os.close(self._far_end)
        os.close(self._near_end)


Port = TcpListener | UdpPort | Pty
"""Port of an emulated device. Nothing waits: `read` gives the bytes that are there, `write` returns how many it took."""


class DeviceServer(ABC):
    """Serves a device at a port by a thread, which starts at once and leaves its ``error`` for `close`; a context manager."""

    def __init__(self, port: Port) -> None:
        self.url, self._port = port.url, port
        self.error: Exception | None = None
        self._wake_read, self._wake_write = os.pipe()
        self._thread = threading.Thread(target=self._run, name=f"serve {self.url}", daemon=True)
        self._thread.start()

    @abstractmethod
    def _due_ns(self) -> int | None:
        """Monotonic time of the next `_turn`; None: not before bytes arrive."""

    @abstractmethod
    def _turn(self) -> None:
        """Process received bytes, and send what is due."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the thread, and release the port. May be called twice."""
        if self._wake_write < 0:
            return
        os.write(self._wake_write, b"x")
        self._thread.join(_CLOSE_S)
        if self._thread.is_alive():
            raise RuntimeError(f"the device at {self.url} does not stop being served")
        self._port.close()
        os.close(self._wake_read)
        os.close(self._wake_write)
        self._wake_write = -1
        if self.error is not None:
            raise self.error

    def check(self) -> None:
        """Raise the error that ended the thread, if any."""
        if (error := self.error) is not None:
            raise VcmvspError(f"the device at {self.url} failed: {type(error).__name__}: {error}")

    def _run(self) -> None:
        try:
            while True:
                due_ns, now_ns = self._due_ns(), time.monotonic_ns()
                pause_ns = _PAUSE_NS if due_ns is None else max(0, min(due_ns - now_ns, _PAUSE_NS))
                if self._wake_read in readable([self._wake_read, self._port.waits_on()], pause_ns / SECOND_NS):
                    return
                self._turn()
        except Exception as error:
            self.error = error


def duration_of(seconds: float | None) -> float | None:
    """How long to stay; None: until it is interrupted. `UsageError`: not positive."""
    if seconds is not None and not 0.0 < seconds < inf:
        raise UsageError(f"--duration {seconds}: must be a positive number of seconds")
    return seconds


def wait(duration_s: float | None, check: Callable[[], None]) -> None:
    """Wait for this time, forever without it; ``check`` is called often, and may raise."""
    until = inf if duration_s is None else time.monotonic() + duration_s
    pause = threading.Event()
    while (remaining_s := until - time.monotonic()) > 0.0:
        pause.wait(min(remaining_s, _LOOK_S))
        check()


@contextlib.contextmanager
def until_interrupted() -> Iterator[None]:
    """Ctrl-C and SIGTERM end an emulated device normally."""
    with contextlib.suppress(KeyboardInterrupt, Interrupted):
        yield


@contextlib.contextmanager
def served_quietly(server: DeviceServer) -> Iterator[DeviceServer]:
    """A server that is closed at the end; `DeviceServer.check` reports errors of its thread."""
    try:
        yield server
    finally:
        with contextlib.suppress(Exception):
            server.close()
