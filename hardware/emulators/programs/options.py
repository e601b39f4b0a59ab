"""Command-line options of emulated devices; invalid text is a `UsageError`."""

import math
from pathlib import Path
from typing import NamedTuple

import msgspec

from vcmvsp.cosim.endpoints import bracketed, endpoint_of, with_slash
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.types import Positive
from vcmvsp.hardware.emulators.arcos.serial_line import Faults
from vcmvsp.hardware.emulators.arcos.server import TCP_PORT
from vcmvsp.hardware.emulators.device_server import LOOPBACK
from vcmvsp.hardware.emulators.positioning.tags import Errors
from vcmvsp.hardware.localisation import ubisense


class PtyPort(NamedTuple):
    """A pseudo-terminal, with a link that leads to it, or without one."""

    link: Path | None = None


class TcpPort(NamedTuple):
    """A TCP port of this machine; 0: any that is free."""

    host: str
    port: int


class UdpAddress(NamedTuple):
    """Where datagrams go."""

    host: str
    port: int

    @property
    def url(self) -> str:
        """As it is written."""
        return f"udp://{bracketed(self.host)}:{self.port}"


class Tags(msgspec.Struct, frozen=True, kw_only=True):
    """Positioning systems that see a tag."""

    ubisense: UdpAddress | None = None  # where datagrams go
    dwm1001: PtyPort | None = None  # where its serial port is
    name: str = "0000000000000001"  # of the tag
    errors: Errors = Errors()
    seed: int = 0


class RobotOptions(msgspec.Struct, frozen=True, kw_only=True):
    """How a robot is served."""

    port: PtyPort | TcpPort = PtyPort()
    rate_hz: Positive = 10.0  # of its information packets
    faults: Faults = Faults()
    paced: bool = False  # bytes take their time at the baud rate
    baud: int = 9600
    ping_ms: int = 40  # from ping to ping within an array of 8 sonars
    watchdog: bool = True
    tags: Tags = Tags()
    duration_s: Positive | None = None  # None: until it is interrupted


def port_of(text: str) -> PtyPort | TcpPort:
    """``PTY``, ``tcp://HOST:PORT`` (no host: this machine alone; no port: 8101) or the path of a link that is to be made."""
    if with_slash(text).startswith(("tcp/", "socket/")):
        endpoint = endpoint_of(text)
        if endpoint is None:
            raise UsageError(f"--port {text}: write tcp://HOST:PORT, a port from 0 to 65535 and nothing behind it")
        return TcpPort(endpoint.host or LOOPBACK, TCP_PORT if endpoint.port is None else endpoint.port)
    link = pty_of(text)
    if link is None:
        raise UsageError(f"--port {text}: write PTY, tcp://HOST:PORT, or a path such as /tmp/robot")
    return link


def pty_of(text: str) -> PtyPort | None:
    """``PTY`` or the path of a link; None: neither."""
    if text.lower() == "pty":
        return PtyPort()
    return PtyPort(Path(text)) if "/" in text and "://" not in text else None


def udp_of(text: str, option: str) -> UdpAddress:
    """``udp://HOST:PORT``."""
    protocol, host, port = endpoint_of(text) or ("", "", None)
    if protocol != "udp" or not host or not port:
        raise UsageError(f"{option} {text}: write udp://HOST:PORT, e.g. udp://{LOOPBACK}:5000")
    return UdpAddress(host, port)


def faults_of(text: str, seed: int) -> Faults:
    """``drop=0.01,flip=0.001,split=0.2``, each a probability for each byte; ``gap_ms=30`` is how long a split lasts."""
    values: dict[str, float] = {}
    for part in filter(None, text.split(",")):
        name, equals, value = part.partition("=")
        if not equals or name not in ("drop", "flip", "split", "gap_ms"):
            raise UsageError(f"--faults {text}: '{part}' is none of drop=P, flip=P, split=P, gap_ms=T")
        values[name] = _number(value, f"--faults {text}: {name}")
    gap_ns = round(1e6 * values.pop("gap_ms", 30.0))
    if gap_ns < 0:
        raise UsageError(f"--faults {text}: gap_ms must not be negative")
    try:
        return msgspec.convert({**values, "gap_ns": gap_ns, "seed": seed}, Faults)
    except msgspec.ValidationError:
        raise UsageError(f"--faults {text}: drop, flip and split are probabilities, from 0 to 1") from None


def duration_of(seconds: float | None) -> float | None:
    """How long to stay; None: until it is interrupted."""
    if seconds is not None and not 0.0 < seconds < math.inf:
        raise UsageError(f"--duration {seconds}: must be a positive number of seconds")
    return seconds


def circle_of(text: str) -> tuple[float, float]:
    """``R,SPEED``: m, positive to the left; m/s."""
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


def robot_options(
    *,
    port: str,
    rate_hz: float,
    faults: str,
    paced: bool,
    baud: int,
    ping_ms: int,
    watchdog: bool,
    seed: int,
    duration_s: float | None,
    tags: Tags,
) -> RobotOptions:
    """Options as a command line says them."""
    return RobotOptions(
        port=port_of(port),
        rate_hz=rate_hz,
        faults=faults_of(faults, seed),
        paced=paced,
        baud=baud,
        ping_ms=ping_ms,
        watchdog=watchdog,
        duration_s=duration_of(duration_s),
        tags=tags,
    )


def tags_of(
    *,
    ubisense: str | None,
    dwm1001: str | None,
    tag: str,
    fix_hz: float,
    sigma_m: float,
    outliers: float,
    drop_outs: float,
    latency_s: float,
    seed: int,
    option: str | None = None,
) -> Tags:
    """Tags as a command line says them, where a port of theirs is not given by an option of its own name."""
    serial = None if dwm1001 is None else pty_of(dwm1001)
    if dwm1001 is not None and serial is None:
        raise UsageError(f"{option or '--dwm1001'} {dwm1001}: write PTY, or a path such as /tmp/tag")
    errors = {"fix_hz": fix_hz, "sigma_m": sigma_m, "outliers": outliers, "drop_outs": drop_outs, "latency_s": latency_s}
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
        raise UsageError(f"{where}: '{text}' is no number")
    return number
