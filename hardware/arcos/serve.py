"""An emulated robot at a port, at the pace of the wall clock: on a pseudo-terminal or at a TCP port.

::

    with serve_pty(Device(ROBOTS["amigo"])) as served:
        driver = connect(served.url)

As with a real robot the session outlives the connection: who hangs up without CLOSE leaves a robot that goes on sending, and
that its watchdog stops. What is sent while nobody is connected, or reads, is lost, except for the 4 kB that a terminal keeps
until somebody opens it (pyserial then throws them away).
"""

import contextlib
import os
import pty
import select
import socket
import termios
import threading
import time
import tty
from pathlib import Path
from typing import Protocol, Self

from cosim.rng import stream
from hardware.arcos.commands import BAUDS
from hardware.arcos.device import Device
from hardware.arcos.wire import Faults, Wire

TCP_PORT = 8101  # of the first simulated robot, by the custom of MobileSim and ARIA; the next ones follow

_PAUSE_NS = 100_000_000  # the longest sleep
_CLOSE_S = 5.0  # the thread ends within one sleep
_SPEEDS: dict[int, int] = {baud: getattr(termios, f"B{baud}") for baud in BAUDS}  # as terminals call them


class Line(Protocol):
    """A place where a client connects."""

    url: str

    def waits_on(self) -> int:
        """The descriptor that becomes readable when there is something to `read`."""

    def read(self) -> bytes:
        """Bytes of the client, or none."""

    def write(self, data: bytes) -> int:
        """Send as much as goes without waiting; how many bytes went."""

    def baud(self) -> int | None:
        """The rate that the client has set; None: this line has none."""

    def close(self) -> None:
        """Unplug it."""


class Served:
    """A device that is being served by a thread of its own; a context manager, which closes it.

    Attributes:
        url: what a driver connects to, ``/dev/pts/3`` or ``socket://127.0.0.1:8101``.
        device: the robot; look at it and move it while holding ``lock``.
        lock: guards the device.
        unsent: bytes that nobody took.
        misread: bytes that became noise because the client was at another baud rate, where bytes are paced.
        error: what ended the thread before its time, if anything did; `close` raises it.
    """

    def __init__(self, device: Device, line: Line, faults: Faults, *, paced: bool) -> None:
        self.url, self.device, self.lock = line.url, device, threading.Lock()
        self.unsent = self.misread = 0
        self.error: Exception | None = None
        self._line, self._paced = line, paced
        baud = device.baud if paced else None
        self.up = Wire(faults, stream(faults.seed, "arcos/up"), baud)  # robot to client
        self.down = Wire(faults, stream(faults.seed, "arcos/down"), baud)
        self._noise = stream(faults.seed, "arcos/rate")
        self._origin_ns = time.monotonic_ns() - device.now_ns
        self._wake_read, self._wake_write = os.pipe()
        self._thread = threading.Thread(target=self._run, name=f"serve {self.url}", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def now_ns(self) -> int:
        """The device's time."""
        return time.monotonic_ns() - self._origin_ns

    def close(self) -> None:
        """Unplug the robot: a client that is connected reads an error or the end of the stream. More than once is fine."""
        if self._wake_write < 0:
            return
        os.write(self._wake_write, b"x")
        self._thread.join(_CLOSE_S)
        if self._thread.is_alive():
            raise RuntimeError(f"the robot at {self.url} does not stop being served")
        self._line.close()
        os.close(self._wake_read)
        os.close(self._wake_write)
        self._wake_write = -1
        if self.error is not None:
            raise self.error

    def _run(self) -> None:
        try:
            while not self._stopped():
                self._exchange()
        except Exception as error:
            self.error = error

    def _stopped(self) -> bool:
        """Sleep until something is due or comes; whether to stop."""
        with self.lock:
            due = [each for each in (self.device.due_ns, self.up.due_ns, self.down.due_ns) if each is not None]
        pause_ns = max(0, min([*due, self.now_ns + _PAUSE_NS]) - self.now_ns)
        poll = select.poll()  # select() takes no descriptors above 1023
        for each in (self._line.waits_on(), self._wake_read):
            poll.register(each, select.POLLIN)
        return any(each == self._wake_read for each, _ in poll.poll(pause_ns / 1e6))

    def _exchange(self) -> None:
        """Bytes in, bytes out."""
        now = self.now_ns
        self.down.push(self._at_rate(self._line.read()), now)
        with self.lock:
            sent = self.device.receive(heard, now) if (heard := self.down.pop(now)) else self.device.advance(now)
            if self._paced:
                self.up.baud = self.down.baud = self.device.baud
        self.up.push(sent, now)
        if data := self._at_rate(self.up.pop(now)):
            self.unsent += len(data) - self._line.write(data)

    def _at_rate(self, data: bytes) -> bytes:
        """What is read of these bytes: noise where both ends are at different rates."""
        if not data or not self._paced or self._line.baud() in (None, self.device.baud):
            return data
        self.misread += len(data)
        return self._noise.bytes(len(data))


class Pty:
    """A pseudo-terminal; its far end stays open here too, so that clients may come and go."""

    def __init__(self, link: Path | None, baud: int | None = None) -> None:
        """A link that shall lead to it; the rate until a client sets one."""
        self._here, self._there = pty.openpty()
        tty.setraw(self._there)
        if baud is not None:
            settings = termios.tcgetattr(self._there)
            settings[4] = settings[5] = _SPEEDS[baud]
            termios.tcsetattr(self._there, termios.TCSANOW, settings)
        os.set_blocking(self._here, False)
        self.url, self._link = os.ttyname(self._there), link
        if link is not None:
            try:
                link.symlink_to(self.url)
            except OSError:
                self.close_ends()
                raise
            self.url = str(link)

    def waits_on(self) -> int:
        """The end that is here."""
        return self._here

    def read(self) -> bytes:
        """What a client has written, or nothing."""
        with contextlib.suppress(BlockingIOError):
            return os.read(self._here, 4096)
        return b""

    def write(self, data: bytes) -> int:
        """As much as goes without waiting; how many bytes went."""
        with contextlib.suppress(BlockingIOError):
            return os.write(self._here, data)
        return 0

    def baud(self) -> int | None:
        """The rate that the client has set."""
        speed = termios.tcgetattr(self._here)[5]
        return next((baud for baud, each in _SPEEDS.items() if each == speed), 0)

    def close(self) -> None:
        """Unplug it: the link goes, too."""
        if self._link is not None:
            self._link.unlink(missing_ok=True)
        self.close_ends()

    def close_ends(self) -> None:
        """Free the pseudo-terminal alone."""
        os.close(self._there)
        os.close(self._here)


class _Tcp:
    """A TCP port for one client at a time; the next one is heard when the last has hung up."""

    def __init__(self, host: str, port: int) -> None:
        self._listener = socket.create_server((host, port), backlog=1)
        self._listener.setblocking(False)
        self._client: socket.socket | None = None
        self.url = f"socket://{host}:{self._listener.getsockname()[1]}"

    def waits_on(self) -> int:
        return (self._client or self._listener).fileno()

    def read(self) -> bytes:
        if self._client is None:
            with contextlib.suppress(BlockingIOError, ConnectionError):
                self._client, _ = self._listener.accept()
                self._client.setblocking(False)
                self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return b""
        try:
            data = self._client.recv(4096)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._hang_up()
        return data

    def write(self, data: bytes) -> int:
        if self._client is None:
            return 0
        try:
            return self._client.send(data)
        except BlockingIOError:
            return 0
        except OSError:
            self._hang_up()
            return 0

    def baud(self) -> int | None:
        return None

    def _hang_up(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None

    def close(self) -> None:
        self._hang_up()
        self._listener.close()


def serve_pty(device: Device, *, link: Path | None = None, faults: Faults | None = None, paced: bool = False) -> Served:
    """Serve it on a pseudo-terminal.

    Args:
        device: the robot; its time goes on from where it is.
        link: a path that shall lead to the terminal as long as it is there, for clients that come back.
        faults: of the line, both ways.
        paced: whether bytes take as long as the device's baud rate says, and become noise where the client has set another one.
    """
    return Served(device, Pty(link, device.baud), faults or Faults(), paced=paced)


def serve_tcp(
    device: Device, *, host: str = "127.0.0.1", port: int = 0, faults: Faults | None = None, paced: bool = False
) -> Served:
    """Serve it at a TCP port; 0: any that is free, see `Served.url`. `TCP_PORT` is where clients look first."""
    return Served(device, _Tcp(host, port), faults or Faults(), paced=paced)
