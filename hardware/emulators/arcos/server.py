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
import termios
import threading
import time
import tty
from pathlib import Path

from vcmvsp.cosim.rng import stream
from vcmvsp.hardware.drivers.arcos.command_numbers import BAUDS
from vcmvsp.hardware.emulators.arcos.device import Device
from vcmvsp.hardware.emulators.arcos.serial_line import Faults, Wire
from vcmvsp.hardware.emulators.device_server import DeviceServer, TcpListener

TCP_PORT = 8101  # of the first simulated robot, by the custom of MobileSim and ARIA; the next ones follow

_SPEEDS: dict[int, int] = {baud: getattr(termios, f"B{baud}") for baud in BAUDS}  # as terminals call them


class ArcosServer(DeviceServer):
    """A robot that is being served.

    Attributes:
        url: what a driver connects to, ``/dev/pts/3`` or ``socket://127.0.0.1:8101``.
        device: the robot; look at it and move it while holding ``lock``.
        lock: guards the device.
        unsent: bytes that nobody took.
        misread: bytes that became noise because the client was at another baud rate, where bytes are paced.
    """

    def __init__(self, device: Device, line: "Pty | TcpListener", faults: Faults, *, paced: bool) -> None:
        self.device, self.lock = device, threading.Lock()
        self.unsent = self.misread = 0
        self._line, self._paced = line, paced
        baud = device.baud if paced else None
        self.up = Wire(faults, stream(faults.seed, "arcos/up"), baud)  # robot to client
        self.down = Wire(faults, stream(faults.seed, "arcos/down"), baud)
        self._noise = stream(faults.seed, "arcos/rate")
        self._origin_ns = time.monotonic_ns() - device.now_ns
        super().__init__(line.url, line.close)

    @property
    def now_ns(self) -> int:
        """The device's time."""
        return time.monotonic_ns() - self._origin_ns

    def _due_ns(self) -> int | None:
        with self.lock:
            due = [each for each in (self.device.due_ns, self.up.due_ns, self.down.due_ns) if each is not None]
        return self._origin_ns + min(due) if due else None

    def _waits_on(self) -> int:
        return self._line.waits_on()

    def _turn(self) -> None:
        now = self.now_ns
        self.down.push(self._at_rate(self._line.read()), now)
        with self.lock:
            output = self.device.receive(received, now) if (received := self.down.pop(now)) else self.device.advance(now)
            if self._paced:
                self.up.baud = self.down.baud = self.device.baud
        self.up.push(output, now)
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
                if link.is_symlink() and _is_left(link.readlink(), self.url):
                    link.unlink()
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


def _is_left(terminal: Path, own: str) -> bool:
    """Whether an emulator that was killed left a link to this terminal, which is gone, or is ours by now."""
    return terminal.parent == Path("/dev/pts") and (not terminal.exists() or str(terminal) == own)


def serve_pty(device: Device, *, link: Path | None = None, faults: Faults | None = None, paced: bool = False) -> ArcosServer:
    """Serve it on a pseudo-terminal.

    Args:
        device: the robot; its time goes on from where it is.
        link: a path that shall lead to the terminal as long as it is there, for clients that come back.
        faults: of the line, both ways.
        paced: whether bytes take as long as the device's baud rate says, and become noise where the client has set another one.
    """
    return ArcosServer(device, Pty(link, device.baud), faults or Faults(), paced=paced)


def serve_tcp(
    device: Device, *, host: str = "127.0.0.1", port: int = 0, faults: Faults | None = None, paced: bool = False
) -> ArcosServer:
    """Serve it at a TCP port; 0: any that is free, see `ArcosServer.url`. `TCP_PORT` is where clients look first."""
    return ArcosServer(device, TcpListener("socket://", host, port), faults or Faults(), paced=paced)
