"""Emulated robot at a port until it is interrupted, optionally with tags of positioning systems."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import msgspec

from vcmvsp.cosim.errors import Interrupted, UsageError, VcmvspError
from vcmvsp.cosim.types import ORIGIN, Vec3
from vcmvsp.hardware.drivers.arcos.command_numbers import BAUDS
from vcmvsp.hardware.drivers.arcos.robot_parameters import ROBOTS, Robot
from vcmvsp.hardware.emulators.arcos.device import Device
from vcmvsp.hardware.emulators.arcos.server import ArcosServer, serve_pty, serve_tcp
from vcmvsp.hardware.emulators.device_server import DeviceServer
from vcmvsp.hardware.emulators.positioning.tags import (
    Outlet,
    Tag,
    TagServer,
    Truth,
    circling,
    dwm1001_outlet,
    standing,
    ubisense_outlet,
)
from vcmvsp.hardware.emulators.programs.options import RobotOptions, Tags, TcpPort

KINDS = {"amigobot": "amigo", "p2dx": "p2dx", "amigo-sh": "amigo-sh"}
"""Robots by the names of vehicles, and the subclass that each of them tells."""

Ready = Callable[[Mapping[str, Any]], object]

_LOOK_S = 0.1  # period of checks of the threads


def parameters(name: str, chosen: RobotOptions) -> Robot:
    """Parameters of the robot with these options.

    Raises:
        UsageError: an option is invalid.
    """
    if not 4.0 <= chosen.rate_hz <= 100.0:  # its configuration has the period in a byte of ms
        raise UsageError(f"--rate-hz {chosen.rate_hz:g}: must be from 4 to 100")
    if chosen.baud not in BAUDS:
        raise UsageError(f"--baud {chosen.baud}: must be one of {', '.join(map(str, BAUDS))}")
    robot = ROBOTS[KINDS[name]]
    changes: dict[str, Any] = {"period_s": round(1.0 / chosen.rate_hz, 9), "baud": chosen.baud}
    return msgspec.structs.replace(robot, **changes, **({} if chosen.watchdog else {"watchdog_s": 0.0}))


def serve(device: Device, chosen: RobotOptions) -> ArcosServer:
    """Serve a robot at its port.

    Raises:
        UsageError: the port cannot be opened.
    """
    port = chosen.port
    try:
        if isinstance(port, TcpPort):
            return serve_tcp(device, host=port.host, port=port.port, faults=chosen.faults, paced=chosen.paced)
        return serve_pty(device, link=port.link, faults=chosen.faults, paced=chosen.paced)
    except FileExistsError:
        raise UsageError(f"--port {port[0]}: is there already; remove it, or give another path") from None
    except OSError as error:
        where = f"tcp://{port.host}:{port.port}" if isinstance(port, TcpPort) else port.link or "PTY"
        raise UsageError(f"--port {where}: {error.strerror or error}") from None


def device_of(name: str, chosen: RobotOptions, start: Vec3 | None) -> Device:
    """The robot; without a start the caller moves it."""
    robot = parameters(name, chosen)
    try:
        return Device(robot, name=f"emulated {robot.name}", start=start, ping_ms=chosen.ping_ms)
    except ValueError as error:
        raise UsageError(f"--ping-ms: {error}") from None


def truth_of(device: Device) -> Truth:
    """True position of a tag on a robot."""

    def truth() -> tuple[float, float, float, float]:
        x, y, yaw = device.pose or ORIGIN
        return x, y, 0.0, yaw

    return truth


class Rig:
    """An emulated device: a robot at its port, tag servers, and their counts.

    It is a context manager, which closes everything. `start` calls `ready` when the device can be connected to.
    """

    def __init__(self, ready: Ready) -> None:
        self.served: ArcosServer | None = None
        self.sources: dict[str, TagServer] = {}
        self._outlets: dict[str, Outlet] = {}
        self._ready = ready
        self._all = contextlib.ExitStack()

    def __enter__(self) -> "Rig":
        return self

    def __exit__(self, *_: object) -> None:
        for outlet in self._outlets.values():  # not started yet
            outlet.close()
        self._all.close()

    def serve(self, device: Device, chosen: RobotOptions) -> ArcosServer:
        """Serve the robot from now on."""
        self.served = serve(device, chosen)
        self._all.callback(_quietly, self.served)
        return self.served

    def fit(self, tags: Tags) -> None:
        """Open the ports of tags."""
        if tags.ubisense is not None:
            self._outlets["ubisense"] = ubisense_outlet(*tags.ubisense)
        if tags.dwm1001 is not None:
            self._outlets["dwm1001"] = dwm1001_outlet(tags.dwm1001.link)

    def start(self, tags: Tags, truth: Truth) -> None:
        """Start the tags, and call `ready`."""
        for name in [*self._outlets]:
            tag = Tag(tags.name, tags.errors, tags.seed)
            self.sources[name] = TagServer(tag, truth, self._outlets.pop(name))
            self._all.callback(_quietly, self.sources[name])
        urls = {name: each.url for name, each in self.sources.items()}
        robot = {} if self.served is None else {"url": self.served.url}
        self._ready({**robot, "positioning": urls})

    def check(self) -> None:
        """Raise the error that ended a thread, if any."""
        threads: list[DeviceServer] = [*self.sources.values(), *([self.served] if self.served else [])]
        for each in threads:
            alive(each.url, each.error)

    def summary(self) -> dict[str, Any]:
        """Counts so far."""
        counts: dict[str, Any] = {}
        if (served := self.served) is not None:
            with served.lock:
                device = served.device
                counts = {"commands": device.commands, "packets": device.packets, "bytes_unread": served.unsent}
                counts |= {"bytes_lost": served.up.dropped + served.down.dropped}
                counts |= {"bytes_changed": served.up.flipped + served.down.flipped + served.misread}
                counts |= {"x_m": device.odometry[0], "y_m": device.odometry[1], "yaw_rad": device.odometry[2]}
        return {**counts, "fixes": {name: each.told for name, each in self.sources.items()}}


def _quietly(served: DeviceServer) -> None:
    """Close a server; `Rig.check` reports errors of its thread."""
    with contextlib.suppress(Exception):
        served.close()


def alive(url: str, error: Exception | None) -> None:
    """Raise the error that ended a device's thread, if any."""
    if error is not None:
        raise VcmvspError(f"the device at {url} failed: {type(error).__name__}: {error}")


def wait(duration_s: float | None, check: Callable[[], None]) -> None:
    """Wait for this time, forever without it; ``check`` is called often, and may raise."""
    until = float("inf") if duration_s is None else time.monotonic() + duration_s
    pause = threading.Event()
    while (remaining_s := until - time.monotonic()) > 0.0:
        pause.wait(min(remaining_s, _LOOK_S))
        check()


@contextlib.contextmanager
def until_interrupted() -> Iterator[None]:
    """Ctrl-C and SIGTERM end an emulated device normally."""
    with contextlib.suppress(KeyboardInterrupt, Interrupted):
        yield


def emulate(name: str, chosen: RobotOptions, ready: Ready, pose: Vec3 | None = None) -> dict[str, Any]:
    """Serve a robot on an empty floor until it is interrupted; its counts."""
    device = device_of(name, chosen, pose or ORIGIN)
    with Rig(ready) as rig:
        with until_interrupted():
            rig.fit(chosen.tags)
            rig.serve(device, chosen)
            rig.start(chosen.tags, truth_of(device))
            wait(chosen.duration_s, rig.check)
        return rig.summary()


def emulate_tag(
    tags: Tags, ready: Ready, *, pose: Vec3 = ORIGIN, circle: tuple[float, float] | None = None, duration_s: float | None = None
) -> dict[str, Any]:
    """Serve a tag alone, at rest or on a circle (radius m, speed m/s), until it is interrupted; its counts."""
    with Rig(ready) as rig:
        with until_interrupted():
            rig.fit(tags)
            rig.start(tags, standing(pose) if circle is None else circling(pose, *circle))
            wait(duration_s, rig.check)
        return rig.summary()
