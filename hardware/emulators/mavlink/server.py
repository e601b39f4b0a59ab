"""Emulated vehicle at a UDP or TCP port, at the pace of the wall clock, and the program that serves it."""

import threading
import time
from typing import Any

from vcmvsp.cosim.endpoints import endpoint_of
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.types import ORIGIN, Vec3
from vcmvsp.hardware.emulators import device_server
from vcmvsp.hardware.emulators.device_server import LOOPBACK, DeviceServer, Ready, TcpListener, UdpPort, duration_of, wait
from vcmvsp.hardware.emulators.mavlink.vehicle import Vehicle


class MavlinkServer(DeviceServer):
    """Serves a vehicle; access it with ``lock`` held. ``mute``: it is out of reach, nothing is sent or received."""

    def __init__(self, vehicle: Vehicle, port: UdpPort | TcpListener) -> None:
        self.vehicle, self.lock, self.mute = vehicle, threading.Lock(), False
        self._origin_ns = time.monotonic_ns() - vehicle.now_ns
        super().__init__(port)

    def _due_ns(self) -> int:
        with self.lock:
            return self._origin_ns + self.vehicle.due_ns

    def _turn(self) -> None:
        received = self._port.read()
        with self.lock:
            output = self.vehicle.receive(b"" if self.mute else received, time.monotonic_ns() - self._origin_ns)
        if output and not self.mute:
            self._port.write(output)


TCP_PORT = 5760  # of ArduPilot's simulator

AUTOPILOTS, KINDS = ("px4", "ardupilot"), ("quadrotor", "rover")


def emulate(
    port: str,
    ready: Ready,
    *,
    autopilot: str = "px4",
    kind: str = "quadrotor",
    system_id: int = 1,
    armed: bool = False,
    pose: Vec3 | None = None,
    duration_s: float | None = None,
) -> dict[str, Any]:
    """Serve a vehicle on an empty floor until it is interrupted; its final state. `UsageError`: an option is invalid.

    ``port``: ``udp://HOST:PORT``, destination of its messages, as with PX4; or ``tcp://HOST:PORT``, where it listens. The pose
    is that of its start: x m, y m, yaw rad.
    """
    if autopilot not in AUTOPILOTS:
        raise UsageError(f"--autopilot {autopilot}: must be {' or '.join(AUTOPILOTS)}")
    if kind not in KINDS:
        raise UsageError(f"--kind {kind}: must be {' or '.join(KINDS)}")
    if not 1 <= system_id <= 255:
        raise UsageError(f"--system-id {system_id}: must be from 1 to 255")
    x, y, yaw = pose or ORIGIN
    vehicle = Vehicle(autopilot=autopilot, kind=kind, system_id=system_id, armed=armed, start=(x, y, 0.0, yaw))  # type: ignore[arg-type]  # both checked above
    duration_of(duration_s)
    with device_server.until_interrupted(), device_server.served_quietly(serve(vehicle, port)) as served:
        ready({"url": served.url, "positioning": {}})
        wait(duration_s, served.check)
    place = dict(zip(("x_m", "y_m", "z_m"), vehicle.state.position, strict=True))
    return {"messages": len(vehicle.heard), "mode": vehicle.mode, "armed": vehicle.armed, **place, "fixes": {}}


def serve(vehicle: Vehicle, port: str) -> MavlinkServer:
    """Serve a vehicle, whose time continues, at its port, see `emulate`; `UsageError`: it cannot be opened."""
    protocol, host, number = endpoint_of(port) or ("", "", None)
    try:
        if protocol == "tcp":
            return MavlinkServer(vehicle, TcpListener("tcp:", host or LOOPBACK, TCP_PORT if number is None else number))
        if protocol == "udp" and host and number:
            return MavlinkServer(vehicle, UdpPort((host, number)))
    except OSError as error:
        raise UsageError(f"--port {port}: {error.strerror or error}") from None
    raise UsageError(f"--port {port}: write udp://HOST:PORT or tcp://HOST:PORT, e.g. udp://{LOOPBACK}:14540")
