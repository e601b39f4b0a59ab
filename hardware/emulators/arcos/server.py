"""Emulated robot on a pseudo-terminal or at a TCP port, at the pace of the wall clock.

::

    with serve_pty(Device(ROBOTS["amigo"])) as served:
        driver = connect(served.url)

As with a real robot the session outlives the connection: after a client disconnects without CLOSE the robot continues to
send, and its watchdog stops it. Bytes without a reader are lost, except for the 4 kB that a terminal buffers until it is
opened (pyserial then drops them).
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

TCP_PORT = 8101  # first port of MobileSim and ARIA; further robots have the next ones

_SPEEDS: dict[int, int] = {baud: getattr(termios, f"B{baud}") for baud in BAUDS}  # termios constants


class ArcosServer(DeviceServer):
    """Serves a robot.

    Attributes:
        url: for a driver, ``/dev/pts/3`` or ``socket://127.0.0.1:8101``.
        device: the robot; access it with ``lock`` held.
        lock: guards the device.
        unsent: bytes without a reader.
        misread: bytes that became noise because of different baud rates, if bytes are paced.
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
        """Received bytes: noise if both ends have different rates."""
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
        """Descriptor of this end."""
        return self._here

    def read(self) -> bytes:
        """Bytes of the client, or none."""
        with contextlib.suppress(BlockingIOError):
            return os.read(self._here, 4096)
        return b""

    def write(self, data: bytes) -> int:
        """Write as much as possible without waiting; number of bytes."""
        with contextlib.suppress(BlockingIOError):
            return os.write(self._here, data)
        return 0

    def baud(self) -> int | None:
        """The rate that the client has set."""
        speed = termios.tcgetattr(self._here)[5]
        return next((baud for baud, each in _SPEEDS.items() if each == speed), 0)

    def close(self) -> None:
        """Close it, and remove the link."""
        if self._link is not None:
            self._link.unlink(missing_ok=True)
        self.close_ends()

    def close_ends(self) -> None:
        """Close the pseudo-terminal alone."""
        os.close(self._there)
        os.close(self._here)


def _is_left(terminal: Path, own: str) -> bool:
    """Whether a killed emulator left a link to this terminal, which is gone, or is this one now."""
    return terminal.parent == Path("/dev/pts") and (not terminal.exists() or str(terminal) == own)


def serve_pty(device: Device, *, link: Path | None = None, faults: Faults | None = None, paced: bool = False) -> ArcosServer:
    """Serve a robot on a pseudo-terminal.

    Args:
        device: the robot; its time continues.
        link: path of a link to the terminal while it exists, for clients that reconnect.
        faults: of the line, both ways.
        paced: whether bytes take their time at the device's baud rate, and become noise at another rate of the client.
    """
    return ArcosServer(device, Pty(link, device.baud), faults or Faults(), paced=paced)


def serve_tcp(
    device: Device, *, host: str = "127.0.0.1", port: int = 0, faults: Faults | None = None, paced: bool = False
) -> ArcosServer:
    """Serve it at a TCP port; 0: any that is free, see `ArcosServer.url`. `TCP_PORT` is where clients look first."""
    return ArcosServer(device, TcpListener("socket://", host, port), faults or Faults(), paced=paced)
