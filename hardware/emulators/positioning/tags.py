"""Emulated positioning system: positions with errors, as Ubisense datagrams or as a DWM1001 tag.

`Tag` draws positions and has no clock; a `TagServer` sends them in time, with a thread, to an `Outlet`.
"""

import contextlib
import math
import socket
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Protocol

import msgspec

from vcmvsp.cosim.clock import SECOND_NS, Ticks, seconds_to_ns
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.frames import arc
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import Probability, Rate, Seconds, Vec3
from vcmvsp.hardware.emulators.arcos.server import Pty
from vcmvsp.hardware.emulators.device_server import DeviceServer
from vcmvsp.hardware.localisation import Located, dwm1001, ubisense

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
    """Positions of one tag. Each takes the same number of draws, so that no parameter changes the draws of another.

    Args:
        name: of the tag in the system.
        errors: of the system.
        seed: tags of different names draw different numbers.
    """

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
        """One answer."""
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


class Outlet(Protocol):
    """Destination of positions."""

    url: str

    def waits_on(self) -> int | None:
        """Descriptor that becomes readable when there is something to `hear`."""

    def hear(self) -> None:
        """Process input for the system."""

    def tell(self, located: Located) -> bool:
        """Send one position; whether it was sent."""

    def close(self) -> None:
        """Free the port."""


class _Ubisense:
    """Sends datagrams of the Ubisense protocol to one address, with or without a receiver."""

    def __init__(self, host: str, port: int) -> None:
        self.url = f"udp://{host}:{port}"
        try:
            kind, _, _, _, to = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except OSError as error:
            raise UsageError(f"{self.url}: {error.strerror or error}; give the name or number of a host") from None
        self._to: Any = to
        self._socket = socket.socket(kind, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)

    def waits_on(self) -> int | None:
        return None

    def hear(self) -> None:
        pass  # there are no answers

    def tell(self, located: Located) -> bool:
        with contextlib.suppress(OSError):  # the network may come back
            self._socket.sendto(ubisense.encode(located), self._to)
            return True
        return False

    def close(self) -> None:
        self._socket.close()


class _Dwm1001:
    """A DWM1001 tag on a pseudo-terminal: the shell opens at two carriage returns, ``lep`` switches lines on."""

    def __init__(self, link: Path | None = None) -> None:
        self._shell = dwm1001.Tag()
        try:
            self._line = Pty(link)
        except OSError as error:
            raise UsageError(f"{link or 'pseudo-terminal'}: {error.strerror}") from None
        self.url = self._line.url

    def waits_on(self) -> int | None:
        return self._line.waits_on()

    def hear(self) -> None:
        self._line.write(self._shell.receive(self._line.read()))

    def tell(self, located: Located) -> bool:
        line = self._shell.say(located)
        return bool(line) and self._line.write(line) == len(line)

    def close(self) -> None:
        self._line.close()


def ubisense_outlet(host: str, port: int) -> Outlet:
    """Datagrams to this address; `UsageError` if there is no such host."""
    return _Ubisense(host, port)


def dwm1001_outlet(link: Path | None = None) -> Outlet:
    """A pseudo-terminal, and a link that leads to it; `UsageError` if it cannot be made."""
    return _Dwm1001(link)


class TagServer(DeviceServer):
    """Sends the positions of a tag in time.

    Attributes:
        told: number of positions sent.
    """

    def __init__(self, tag: Tag, truth: Truth, outlet: Outlet) -> None:
        self.told = 0
        self._tag, self._truth, self._outlet = tag, truth, outlet
        self._origin_ns = time.monotonic_ns()
        self._unix_ns = time.time_ns()  # for stamps of positions
        super().__init__(outlet.url, outlet.close)

    def _due_ns(self) -> int:
        return self._origin_ns + self._tag.due_ns

    def _waits_on(self) -> int | None:
        return self._outlet.waits_on()

    def _turn(self) -> None:
        self._outlet.hear()
        for located in self._tag.advance(time.monotonic_ns() - self._origin_ns, self._truth):
            stamped = msgspec.structs.replace(located, source_ns=self._unix_ns + (located.source_ns or 0))
            self.told += self._outlet.tell(stamped)
