"""An emulated vehicle at a port, at the pace of the wall clock: over UDP or at a TCP port.

::

    with serve_udp(Vehicle()) as served:
        driver = MavlinkDriver(address=served.address)
"""

import contextlib
import os
import select
import socket
import threading
import time
from typing import Self

from hardware.mavlink.vehicle import Vehicle

_PAUSE_NS = 100_000_000  # the longest sleep
_CLOSE_S = 5.0  # the thread ends within one sleep
_READ = 65_535


class _Udp:
    """One datagram for each turn; it goes to a fixed place, or to whom it heard last."""

    def __init__(self, host: str, port: int, to: tuple[str, int] | None) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.bind((host, port))
        self._to = to
        self._fixed = to is not None
        here = self._socket.getsockname()
        self.address = f"udpin:{to[0]}:{to[1]}" if to else f"udpout:{host}:{here[1]}"

    def fileno(self) -> int:
        return self._socket.fileno()

    def read(self) -> bytes:
        with contextlib.suppress(OSError):
            data, where = self._socket.recvfrom(_READ)
            if not self._fixed:
                self._to = where
            return data
        return b""

    def write(self, data: bytes) -> None:
        if self._to is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto(data, self._to)

    def close(self) -> None:
        self._socket.close()


class _Tcp:
    """One client at a time; the next one is heard when the last has hung up."""

    def __init__(self, host: str, port: int) -> None:
        self._listener = socket.create_server((host, port), backlog=1)
        self._listener.setblocking(False)
        self._client: socket.socket | None = None
        self.address = f"tcp:{host}:{self._listener.getsockname()[1]}"

    def fileno(self) -> int:
        return (self._client or self._listener).fileno()

    def read(self) -> bytes:
        if self._client is None:
            with contextlib.suppress(OSError):
                self._client, _ = self._listener.accept()
                self._client.setblocking(False)
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

    def write(self, data: bytes) -> None:
        if self._client is None:
            return
        try:
            self._client.send(data)
        except BlockingIOError:
            return  # nobody reads: telemetry is lost
        except OSError:
            self._hang_up()

    def _hang_up(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None

    def close(self) -> None:
        self._hang_up()
        self._listener.close()


class Served:
    """A vehicle that is being served by a thread of its own; a context manager, which closes it.

    Attributes:
        address: what a driver connects to.
        vehicle: look at it and move it while holding ``lock``.
        lock: guards the vehicle.
        mute: nothing is sent any more, and nothing heard: out of reach.
        error: what ended the thread before its time, if anything did; `close` raises it.
    """

    def __init__(self, vehicle: Vehicle, line: _Udp | _Tcp) -> None:
        self.address, self.vehicle, self.lock = line.address, vehicle, threading.Lock()
        self.mute = False
        self.error: Exception | None = None
        self._line = line
        self._origin_ns = time.monotonic_ns() - vehicle.now_ns
        self._wake_read, self._wake_write = os.pipe()
        self._thread = threading.Thread(target=self._run, name=f"serve {self.address}", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Switch it off. More than once is fine."""
        if self._wake_write < 0:
            return
        os.write(self._wake_write, b"x")
        self._thread.join(_CLOSE_S)
        if self._thread.is_alive():
            raise RuntimeError(f"the vehicle at {self.address} does not stop being served")
        self._line.close()
        os.close(self._wake_read)
        os.close(self._wake_write)
        self._wake_write = -1
        if self.error is not None:
            raise self.error

    def _run(self) -> None:
        try:
            while True:
                with self.lock:
                    pause_ns = max(0, min(self.vehicle.due_ns - self._now_ns(), _PAUSE_NS))
                ready, _, _ = select.select([self._line, self._wake_read], [], [], pause_ns / 1e9)
                if self._wake_read in ready:
                    return
                heard = self._line.read() if ready else b""
                with self.lock:
                    sent = self.vehicle.receive(heard if not self.mute else b"", self._now_ns())
                if sent and not self.mute:
                    self._line.write(sent)
        except Exception as error:
            self.error = error

    def _now_ns(self) -> int:
        return time.monotonic_ns() - self._origin_ns


def serve_udp(vehicle: Vehicle, *, host: str = "127.0.0.1", port: int = 0, to: tuple[str, int] | None = None) -> Served:
    """Serve it over UDP.

    Args:
        vehicle: its time goes on from where it is.
        host: where it is bound.
        port: the same; 0: any that is free.
        to: where it sends, unasked, as PX4 does to port 14540; None: it answers whom it heard last.
    """
    return Served(vehicle, _Udp(host, port, to))


def serve_tcp(vehicle: Vehicle, *, host: str = "127.0.0.1", port: int = 0) -> Served:
    """Serve it at a TCP port, as ArduPilot's simulator does at 5760; 0: any that is free."""
    return Served(vehicle, _Tcp(host, port))
