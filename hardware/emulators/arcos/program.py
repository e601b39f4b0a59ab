"""Emulated robot at a port, optionally with tags of positioning systems, from command-line options."""

import contextlib
import math
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from vcmvsp.cosim.endpoints import endpoint_of, with_slash
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.types import ORIGIN, Positive, Vec3
from vcmvsp.hardware.drivers.arcos.protocol import BAUDS
from vcmvsp.hardware.drivers.arcos.robot_parameters import ROBOTS, Robot
from vcmvsp.hardware.emulators.arcos.device import Device
from vcmvsp.hardware.emulators.arcos.server import TCP_PORT, ArcosServer, Faults, serve_pty, serve_tcp
from vcmvsp.hardware.emulators.device_server import LOOPBACK, Pty, Ready, UdpPort, served_quietly, until_interrupted, wait
from vcmvsp.hardware.emulators.tags import Errors, Tag, TagServer, Truth, circling, dwm1001_port, standing, ubisense_port
from vcmvsp.hardware.localisation import ubisense


class PtyPort(NamedTuple):
    """A pseudo-terminal, with a link that leads to it, or without one."""

    link: Path | None = None


class HostPort(NamedTuple):
    """A TCP port of this machine (0: any free port), or the destination of datagrams."""

    host: str
    port: int


class Tags(msgspec.Struct, frozen=True, kw_only=True):
    """Positioning systems that see a tag."""

    ubisense: HostPort | None = None  # where datagrams go
    dwm1001: PtyPort | None = None  # where its serial port is
    name: str = "0000000000000001"  # of the tag
    errors: Errors = Errors()
    seed: int = 0


class RobotOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Options of an emulated robot at a port."""

    port: PtyPort | HostPort = PtyPort()
    rate_hz: Positive = 10.0  # of its information packets
    faults: Faults = Faults()
    paced: bool = False  # bytes take their time at the baud rate
    baud: int = 9600
    ping_ms: int = 40  # from ping to ping within an array of 8 sonars
    watchdog: bool = True
    tags: Tags = Tags()
    duration_s: Positive | None = None  # None: until it is interrupted


def port_of(text: str) -> PtyPort | HostPort:
    """Port from ``PTY``, ``tcp://HOST:PORT`` (no host: this machine only; no port: 8101) or the path of a link to create."""
    if with_slash(text).startswith(("tcp/", "socket/")):
        endpoint = endpoint_of(text)
        if endpoint is None:
            raise UsageError(f"--port {text}: write tcp://HOST:PORT, a port from 0 to 65535 and nothing behind it")
        return HostPort(endpoint.host or LOOPBACK, TCP_PORT if endpoint.port is None else endpoint.port)
    link = pty_of(text)
    if link is None:
        raise UsageError(f"--port {text}: write PTY, tcp://HOST:PORT, or a path such as /tmp/robot")
    return link


def pty_of(text: str) -> PtyPort | None:
    """Pseudo-terminal from ``PTY`` or the path of a link; None: neither."""
    if text.lower() == "pty":
        return PtyPort()
    return PtyPort(Path(text)) if "/" in text and "://" not in text else None


def udp_of(text: str, option: str) -> HostPort:
    """Destination of datagrams from ``udp://HOST:PORT``."""
    protocol, host, port = endpoint_of(text) or ("", "", None)
    if protocol != "udp" or not host or not port:
        raise UsageError(f"{option} {text}: write udp://HOST:PORT, e.g. udp://{LOOPBACK}:5000")
    return HostPort(host, port)


def faults_of(text: str, seed: int) -> Faults:
    """Faults from ``drop=0.01,flip=0.001,split=0.2`` (probabilities per byte) and ``gap_ms=30`` (duration of a split)."""
    values: dict[str, float] = {}
    for part in filter(None, text.split(",")):
        name, equals, value = part.partition("=")
        if not equals or name not in ("drop", "flip", "split", "gap_ms"):
            raise UsageError(f"--faults {text}: '{part}' must be drop=P, flip=P, split=P or gap_ms=T")
        values[name] = _number(value, f"--faults {text}: {name}")
    gap_ns = round(1e6 * values.pop("gap_ms", 30.0))
    if gap_ns < 0:
        raise UsageError(f"--faults {text}: gap_ms must not be negative")
    try:
        return msgspec.convert({**values, "gap_ns": gap_ns, "seed": seed}, Faults)
    except msgspec.ValidationError:
        raise UsageError(f"--faults {text}: drop, flip and split are probabilities, from 0 to 1") from None


def circle_of(text: str) -> tuple[float, float]:
    """Circle from ``R,SPEED``: radius in m, positive to the left, and speed in m/s."""
    numbers = [_number(each, f"--circle {text}") for each in text.split(",")]
    if len(numbers) != 2 or numbers[0] == 0.0:
        raise UsageError(f"--circle {text}: write RADIUS,SPEED (m, m/s), e.g. 2,0.3; a negative radius turns right")
    return numbers[0], numbers[1]


def tag_of(text: str) -> str:
    """The number of a tag in hexadecimal, as 16 digits."""
    try:
        return ubisense.tag_of(text)
    except ValueError as error:
        raise UsageError(f"--tag: {error}") from None


def tags_of(
    *,
    ubisense: str | None,
    dwm1001: str | None,
    tag: str,
    seed: int,
    option: str | None = None,
    **errors: float,
) -> Tags:
    """Tags from a command line: ports, `Errors`, and the option that gave a port, if its name differs."""
    serial = None if dwm1001 is None else pty_of(dwm1001)
    if dwm1001 is not None and serial is None:
        raise UsageError(f"{option or '--dwm1001'} {dwm1001}: write PTY, or a path such as /tmp/tag")
    try:
        values = msgspec.convert(errors, Errors)
    except msgspec.ValidationError as error:
        raise UsageError(f"errors of positioning: {error}") from None
    return Tags(
        ubisense=None if ubisense is None else udp_of(ubisense, option or "--ubisense"),
        dwm1001=serial,
        name=tag_of(tag),
        errors=values,
        seed=seed,
    )


def _number(text: str, where: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise UsageError(f"{where}: '{text}' is not a number")
    return number


KINDS = {"amigobot": "amigo", "p2dx": "p2dx", "amigo-sh": "amigo-sh"}
"""Robots by the names of vehicles, and the subclass that each of them tells."""


def parameters(name: str, chosen: RobotOptions) -> Robot:
    """Parameters of the robot with these options; `UsageError`: one is invalid."""
    if not 4.0 <= chosen.rate_hz <= 100.0:  # its configuration has the period in a byte of ms
        raise UsageError(f"--rate-hz {chosen.rate_hz:g}: must be from 4 to 100")
    if chosen.baud not in BAUDS:
        raise UsageError(f"--baud {chosen.baud}: must be one of {', '.join(map(str, BAUDS))}")
    robot = ROBOTS[KINDS[name]]
    changes: dict[str, Any] = {"period_s": round(1.0 / chosen.rate_hz, 9), "baud": chosen.baud}
    return msgspec.structs.replace(robot, **changes, **({} if chosen.watchdog else {"watchdog_s": 0.0}))


def serve(device: Device, chosen: RobotOptions) -> ArcosServer:
    """Serve a robot at its port; `UsageError`: it cannot be opened."""
    port = chosen.port
    try:
        if isinstance(port, HostPort):
            return serve_tcp(device, host=port.host, port=port.port, faults=chosen.faults, paced=chosen.paced)
        return serve_pty(device, link=port.link, faults=chosen.faults, paced=chosen.paced)
    except FileExistsError:
        raise UsageError(f"--port {port[0]}: already exists; remove it, or choose another path") from None
    except OSError as error:
        where = f"tcp://{port.host}:{port.port}" if isinstance(port, HostPort) else port.link or "PTY"
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


class Rig(contextlib.ExitStack):
    """A robot at its port, tag servers, and their counts; a context manager, which closes everything."""

    def __init__(self, ready: Ready) -> None:
        super().__init__()
        self.served: ArcosServer | None = None
        self.sources: dict[str, TagServer] = {}
        self._ports: dict[str, UdpPort | Pty] = {}  # of tags, not started yet
        self._ready = ready
        self.callback(lambda: [port.close() for port in self._ports.values()])

    def serve(self, device: Device, chosen: RobotOptions) -> ArcosServer:
        """Serve the robot from now on."""
        self.served = served = serve(device, chosen)
        self.enter_context(served_quietly(served))
        return served

    def fit(self, tags: Tags) -> None:
        """Open the ports of tags."""
        if tags.ubisense is not None:
            self._ports["ubisense"] = ubisense_port(*tags.ubisense)
        if tags.dwm1001 is not None:
            self._ports["dwm1001"] = dwm1001_port(tags.dwm1001.link)

    def start(self, tags: Tags, truth: Truth) -> None:
        """Start the tags, and call `ready`."""
        for name in [*self._ports]:
            tag = Tag(tags.name, tags.errors, tags.seed)
            self.sources[name] = TagServer(tag, truth, self._ports.pop(name))
            self.enter_context(served_quietly(self.sources[name]))
        robot = {} if self.served is None else {"url": self.served.url}
        self._ready({**robot, "positioning": {name: each.url for name, each in self.sources.items()}})

    def check(self) -> None:
        """Raise the error that ended a thread, if any."""
        for each in (*self.sources.values(), *([self.served] if self.served else [])):
            each.check()

    def summary(self) -> dict[str, Any]:
        """Counts of commands, packets and bytes, and the position by the wheels (m), so far."""
        counts: dict[str, Any] = {}
        if (served := self.served) is not None:
            with served.lock:
                device = served.device
                counts = {"commands": device.commands, "packets": device.packets, "bytes_unread": served.unsent}
                counts |= {"bytes_lost": served.up.dropped + served.down.dropped}
                counts |= {"bytes_changed": served.up.flipped + served.down.flipped + served.misread}
                counts |= dict(zip(("x_m", "y_m", "yaw_rad"), device.odometry, strict=True))
        return {**counts, "fixes": {name: each.told for name, each in self.sources.items()}}


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
