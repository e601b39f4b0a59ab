"""Emulated robot on a pseudo-terminal or at a TCP port, at the pace of the wall clock.

As with a real robot the session outlives the connection: after a client disconnects without CLOSE the robot continues to
send, and its watchdog stops it. Bytes without a reader are lost, except for the 4 kB that a terminal buffers until it is
opened (pyserial then drops them).
"""

import threading
import time
from collections import deque
from pathlib import Path

import msgspec
import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Probability
from vcmvsp.hardware.emulators.arcos.device import Device
from vcmvsp.hardware.emulators.device_server import LOOPBACK, DeviceServer, Pty, TcpListener

BITS = 10  # of a byte on the line: start, 8 data, stop (8N1)


class Faults(msgspec.Struct, frozen=True, kw_only=True):
    """Probabilities of faults of each byte; draws depend on the seed and the bytes' numbers alone."""

    drop: Probability = 0.0  # it is lost
    flip: Probability = 0.0  # one of its bits is inverted
    split: Probability = 0.0  # a gap of `gap_ns` comes before it
    gap_ns: int = 30_000_000
    seed: int = 0


class Wire:
    """A line with faults: bytes arrive later, in order, some lost or changed; at ``baud`` bits/s, None: without delay."""

    def __init__(self, faults: Faults, draws: np.random.Generator, baud: int | None = None) -> None:
        self.faults, self.baud = faults, baud
        self.dropped = self.flipped = 0
        self._draws = draws
        self._queue: deque[tuple[int, int]] = deque()  # when it is there, byte
        self._last_ns = 0

    def push(self, data: bytes, now_ns: int) -> None:
        """Put bytes on the line."""
        if not data:
            return
        faults = self.faults
        luck = self._draws.random((len(data), 4)).tolist()
        byte_ns = BITS * SECOND_NS // self.baud if self.baud else 0
        for byte, (drop, flip, split, bit) in zip(data, luck, strict=True):
            self._last_ns = max(self._last_ns, now_ns) + byte_ns + (faults.gap_ns if split < faults.split else 0)
            if drop < faults.drop:
                self.dropped += 1
                continue
            changed = flip < faults.flip
            self.flipped += changed
            self._queue.append((self._last_ns, byte ^ (1 << int(8 * bit)) if changed else byte))

    def pop(self, now_ns: int) -> bytes:
        """Bytes that have arrived by now."""
        out = bytearray()
        while self._queue and self._queue[0][0] <= now_ns:
            out.append(self._queue.popleft()[1])
        return bytes(out)

    @property
    def due_ns(self) -> int | None:
        """Arrival time of the next byte; None: no byte is on its way."""
        return self._queue[0][0] if self._queue else None


TCP_PORT = 8101  # first port of MobileSim and ARIA; further robots have the next ones


class ArcosServer(DeviceServer):
    """Serves a robot; access ``device`` with ``lock`` held."""

    def __init__(self, device: Device, line: Pty | TcpListener, faults: Faults, *, paced: bool) -> None:
        self.device, self.lock = device, threading.Lock()
        self.unsent = 0  # bytes without a reader
        self.misread = 0  # bytes that became noise because of different baud rates, if bytes are paced
        self._line, self._paced = line, paced
        baud = device.baud if paced else None
        self.up = Wire(faults, stream(faults.seed, "arcos/up"), baud)  # robot to client
        self.down = Wire(faults, stream(faults.seed, "arcos/down"), baud)
        self._noise = stream(faults.seed, "arcos/rate")
        self._origin_ns = time.monotonic_ns() - device.now_ns
        super().__init__(line)

    @property
    def now_ns(self) -> int:
        """The device's time."""
        return time.monotonic_ns() - self._origin_ns

    def _due_ns(self) -> int | None:
        with self.lock:
            due = [each for each in (self.device.due_ns, self.up.due_ns, self.down.due_ns) if each is not None]
        return self._origin_ns + min(due) if due else None

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


def serve_pty(device: Device, *, link: Path | None = None, faults: Faults | None = None, paced: bool = False) -> ArcosServer:
    """Serve a robot, whose time continues, on a pseudo-terminal, and at a link to it for clients that reconnect.

    Faults act both ways. Paced: bytes take their time at the device's baud rate, and become noise at another one of the client.
    """
    return ArcosServer(device, Pty(link, device.baud), faults or Faults(), paced=paced)


def serve_tcp(
    device: Device, *, host: str = LOOPBACK, port: int = 0, faults: Faults | None = None, paced: bool = False
) -> ArcosServer:
    """Serve a robot at a TCP port; 0: any free port, see `ArcosServer.url`. Clients try `TCP_PORT` first."""
    return ArcosServer(device, TcpListener("socket://", host, port), faults or Faults(), paced=paced)
