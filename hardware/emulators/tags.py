"""Emulated positioning system: positions with errors, as Ubisense datagrams or as a DWM1001 tag.

`Tag` draws positions and has no clock; a `TagServer` sends them in time, with a thread.
"""

import math
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import msgspec

from vcmvsp.cosim.clock import SECOND_NS, Ticks, seconds_to_ns
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.frames import arc
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Probability, Rate, Seconds, Vec3
from vcmvsp.hardware.emulators.device_server import DeviceServer, Pty, UdpPort
from vcmvsp.hardware.localisation import dwm1001, ubisense
from vcmvsp.hardware.localisation.source import Located

Truth = Callable[[], tuple[float, float, float, float] | None]
"""Where the tag is: x, y, z in m, yaw in rad; None while that is not known."""

Metres = Annotated[float, msgspec.Meta(ge=0, le=1e4)]


class Errors(msgspec.Struct, frozen=True, kw_only=True):
    """Errors of a positioning system. Usual for ultra-wideband: 1 to 10 Hz, 0.1 to 0.3 m, some outliers."""

    fix_hz: Rate = 5.0
    sigma_m: Metres = 0.15  # standard deviation of each coordinate
    outliers: Probability = 0.0  # of a fix that is `outlier_m` off, by a reflected path
    outlier_m: Metres = 2.0  # on average; from half of it to one and a half
    drop_outs: Probability = 0.0  # of an answer without position
    latency_s: Seconds = 0.0  # from measurement to sending


class Tag:
    """Positions of one tag. Each takes the same number of draws, so that no parameter changes the draws of another."""

    def __init__(self, name: str, errors: Errors, seed: int) -> None:
        self.name, self.errors = name, errors
        self._draws = stream(seed, f"{name}/positioning")
        self._ticks, self._latency_ns = Ticks.rate(errors.fix_hz), seconds_to_ns(errors.latency_s)
        self._next_ns = 0
        self._under_way: deque[tuple[int, Located]] = deque()

    @property
    def due_ns(self) -> int:
        """Time of the next `advance`."""
        return min(self._next_ns, self._under_way[0][0]) if self._under_way else self._next_ns

    def advance(self, now_ns: int, truth: Truth) -> list[Located]:
        """Positions due by now, ns since the start; missed ones are skipped."""
        if now_ns >= self._next_ns:
            self._next_ns = self._ticks.after(now_ns)
            if (where := truth()) is not None:
                self._under_way.append((now_ns + self._latency_ns, self.measure(where[:3], now_ns)))
        due = []
        while self._under_way and self._under_way[0][0] <= now_ns:
            due.append(self._under_way.popleft()[1])
        return due

    def measure(self, true: Vec3, now_ns: int) -> Located:
        """Draw one answer of the positioning system."""
        errors = self.errors
        missed, astray, far, direction = self._draws.random(4).tolist()
        x, y, z = (a + errors.sigma_m * b for a, b in zip(true, self._draws.standard_normal(3).tolist(), strict=True))
        if astray < errors.outliers:
            off = errors.outlier_m * (0.5 + far)
            x, y = x + off * math.cos(math.tau * direction), y + off * math.sin(math.tau * direction)
        return Located(
            tag=self.name,
            position=None if missed < errors.drop_outs else (x, y, z),
            sigma_m=errors.sigma_m,
            quality=1.0 / (1.0 + errors.sigma_m),
            source_ns=now_ns,
        )


def standing(pose: Vec3) -> Truth:
    """Truth of a tag at rest: x m, y m, yaw rad."""
    x, y, yaw = pose
    return lambda: (x, y, 0.0, yaw)


def circling(pose: Vec3, radius_m: float, speed: float, now: Callable[[], int] = time.monotonic_ns) -> Truth:
    """Truth of a tag on a circle from this pose, at ``speed`` m/s; to the right for a negative radius."""
    began_ns = now()

    def truth() -> tuple[float, float, float, float]:
        x, y, yaw = arc(pose, speed, speed / radius_m, (now() - began_ns) / SECOND_NS)
        return x, y, 0.0, yaw

    return truth


def ubisense_port(host: str, port: int) -> UdpPort:
    """Datagrams to this address; `UsageError` if there is no such host."""
    try:
        return UdpPort((host, port), "udp://")
    except OSError as error:
        raise UsageError(f"udp://{host}:{port}: {error.strerror or error}; use a host name or an IP address") from None


def dwm1001_port(link: Path | None = None) -> Pty:
    """A pseudo-terminal, and a link that leads to it; `UsageError` if it cannot be made."""
    try:
        return Pty(link)
    except OSError as error:
        raise UsageError(f"{link or 'pseudo-terminal'}: {error.strerror}") from None


class TagServer(DeviceServer):
    """Sends the positions of a tag in time, and counts them: lines of a DWM1001 over a terminal, else Ubisense datagrams."""

    def __init__(self, tag: Tag, truth: Truth, port: UdpPort | Pty) -> None:
        self.told = 0
        self._tag, self._truth = tag, truth
        self._shell = dwm1001.Tag() if isinstance(port, Pty) else None
        self._origin_ns = time.monotonic_ns()
        self._unix_ns = time.time_ns()  # for stamps of positions
        super().__init__(port)

    def _due_ns(self) -> int:
        return self._origin_ns + self._tag.due_ns

    def _turn(self) -> None:
        received = self._port.read()
        if self._shell is not None:
            self._port.write(self._shell.receive(received))
        for located in self._tag.advance(time.monotonic_ns() - self._origin_ns, self._truth):
            stamped = msgspec.structs.replace(located, source_ns=self._unix_ns + (located.source_ns or 0))
            data = ubisense.encode(stamped) if self._shell is None else self._shell.say(stamped)
            self.told += bool(data) and self._port.write(data) == len(data)
