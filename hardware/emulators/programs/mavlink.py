"""Emulated MAVLink vehicle at a port until it is interrupted."""

import contextlib
from typing import Any

from vcmvsp.cosim.endpoints import endpoint_of
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.types import ORIGIN, Vec3
from vcmvsp.hardware.emulators.device_server import LOOPBACK
from vcmvsp.hardware.emulators.mavlink.server import MavlinkServer, serve_tcp, serve_udp
from vcmvsp.hardware.emulators.mavlink.vehicle import Vehicle
from vcmvsp.hardware.emulators.programs.arcos import Ready, alive, until_interrupted, wait
from vcmvsp.hardware.emulators.programs.options import duration_of

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
    """Serve a vehicle on an empty floor; its final state.

    Args:
        port: ``udp://HOST:PORT``, destination of its messages, as with PX4; or ``tcp://HOST:PORT``, where it listens.
        ready: called when it can be connected to.
        autopilot: one of `AUTOPILOTS`.
        kind: one of `KINDS`.
        system_id: its number.
        armed: whether it starts armed.
        pose: start, x m, y m, yaw rad.
        duration_s: None: until it is interrupted.

    Raises:
        UsageError: an option is invalid.
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
    with until_interrupted():
        served = serve(vehicle, port)
        try:
            ready({"url": served.url, "positioning": {}})
            wait(duration_s, lambda: alive(served.url, served.error))
        finally:
            with contextlib.suppress(Exception):  # errors of its thread are reported by `alive`
                served.close()
    x, y, z = vehicle.state.position
    return {
        "messages": len(vehicle.heard),
        "mode": vehicle.mode,
        "armed": vehicle.armed,
        "x_m": x,
        "y_m": y,
        "z_m": z,
        "fixes": {},
    }


def serve(vehicle: Vehicle, port: str) -> MavlinkServer:
    """Serve a vehicle at its port.

    Raises:
        UsageError: the port cannot be opened.
    """
    protocol, host, number = endpoint_of(port) or ("", "", None)
    try:
        if protocol == "tcp":
            return serve_tcp(vehicle, host=host or LOOPBACK, port=TCP_PORT if number is None else number)
        if protocol == "udp" and host and number:
            return serve_udp(vehicle, to=(host, number))
    except OSError as error:
        raise UsageError(f"--port {port}: {error.strerror or error}") from None
    raise UsageError(f"--port {port}: write udp://HOST:PORT or tcp://HOST:PORT, e.g. udp://{LOOPBACK}:14540")
