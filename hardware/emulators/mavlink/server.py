"""Emulated vehicle at a UDP or TCP port, at the pace of the wall clock.

::

    with serve_udp(Vehicle()) as served:
        driver = MavlinkDriver(address=served.url)
"""

import contextlib
import socket
import threading
import time
from typing import Any

from vcmvsp.cosim.endpoints import bracketed
from vcmvsp.hardware.emulators.device_server import LOOPBACK, DeviceServer, TcpListener
from vcmvsp.hardware.emulators.mavlink.vehicle import Vehicle

_READ = 65_535  # bytes


class _UdpPort:
    """One datagram per turn, to a fixed address or to the last sender."""

    _to: Any  # an address of the operating system

    def __init__(self, to: tuple[str, int] | None) -> None:
        family, self._to, self._fixed = socket.AF_INET, None, to is not None
        if to:
            family, _, _, _, self._to = socket.getaddrinfo(*to, type=socket.SOCK_DGRAM)[0]
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind(("" if to else LOOPBACK, 0))  # a loopback port is reachable on this machine only
        except OSError:
            self._socket.close()
            raise
        self.url = f"udpin:{bracketed(to[0])}:{to[1]}" if to else f"udpout:{LOOPBACK}:{self._socket.getsockname()[1]}"

    def waits_on(self) -> int:
        return self._socket.fileno()

    def read(self) -> bytes:
        with contextlib.suppress(OSError):
            data, where = self._socket.recvfrom(_READ)
            if not self._fixed:
                self._to = where
            return data
        return b""

    def write(self, data: bytes) -> int:
        if self._to is not None:
            with contextlib.suppress(OSError):
                return self._socket.sendto(data, self._to)
        return 0

    def close(self) -> None:
        self._socket.close()


class MavlinkServer(DeviceServer):
    """Serves a vehicle.

    Attributes:
        url: for a driver.
        vehicle: access it with ``lock`` held.
        lock: guards the vehicle.
        mute: out of reach: nothing is sent or received.
    """

    def __init__(self, vehicle: Vehicle, line: _UdpPort | TcpListener) -> None:
        self.vehicle, self.lock, self.mute = vehicle, threading.Lock(), False
        self._line = line
        self._origin_ns = time.monotonic_ns() - vehicle.now_ns
        super().__init__(line.url, line.close)

    def _due_ns(self) -> int:
        with self.lock:
            return self._origin_ns + self.vehicle.due_ns

    def _waits_on(self) -> int:
        return self._line.waits_on()

    def _turn(self) -> None:
        received = self._line.read()
        with self.lock:
            output = self.vehicle.receive(b"" if self.mute else received, time.monotonic_ns() - self._origin_ns)
        if output and not self.mute:
            self._line.write(output)


def serve_udp(vehicle: Vehicle, *, to: tuple[str, int] | None = None) -> MavlinkServer:
    """Serve a vehicle over UDP.

    Args:
        vehicle: its time continues.
        to: address of its messages, as PX4 sends to port 14540; None: it answers the last sender, at a free port of loopback.

    Raises:
        OSError: the address is invalid.
    """
    return MavlinkServer(vehicle, _UdpPort(to))


def serve_tcp(vehicle: Vehicle, *, host: str = LOOPBACK, port: int = 0) -> MavlinkServer:
    """Serve a vehicle at a TCP port, as ArduPilot's simulator does at 5760; 0: any free port."""
    return MavlinkServer(vehicle, TcpListener("tcp:", host, port))
