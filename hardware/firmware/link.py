"""Common to all firmware: keys of the scenario, the process, and the protocol of a link."""

import contextlib
import os
import shlex
import signal
import socket
import subprocess
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.estimation.tangent_plane import TangentPlane
from vcmvsp.cosim.federate import FlightReadings
from vcmvsp.cosim.processes.child_process import ending
from vcmvsp.cosim.types import Count, Positive, Vec3

Port = Annotated[int, msgspec.Meta(ge=1, le=65535)]
OnLost = Literal["stop", "fall", "hold"]
LOOPBACK = "127.0.0.1"
STILL = (0.0, 0.0, 0.0, 0.0)
LEAVE_S = 2.0  # for a process to end, before it is killed
DATAGRAM = 2048  # bytes
LAST_BYTES = 2000  # of the output of a process, in which its last line is


class FirmwareLost(Exception):
    """The firmware does not answer any more; the text says why."""


class FirmwareLink(ABC):
    """Firmware of one vehicle. All sockets are on loopback.

    Args:
        vehicle: its name. It comes from the program, like the next two.
        number: of the vehicle among those with this kind of firmware.
        folder: of the scenario.
        command: command line that starts the firmware; ``{instance}``, ``{vehicle}`` and ``{folder}``, that of the scenario,
            are replaced. Empty: it is started by hand. It runs in a temporary folder and ends with the run.
        instance: number of the firmware, from which its port follows; default: counts the vehicles with this kind from 0.
        mavlink: address of its MAVLink port for commands of the vehicle's agent, as of the driver ``mavlink``; empty: none.
        origin: latitude and longitude, degrees, and height, m, of the world's origin; default: the firmware's own default.
        takeoff_m: m, height of the take-off before commands of the agent are followed.
        on_lost: if it ends or does not answer: ``stop`` the run, let the vehicle ``fall`` with its rotors off, or let its own
            autopilot ``hold`` it in place.
        start_s: s, wall-clock time within which its first outputs must come.
        timeout_s: s, wall-clock time within which it must answer.
    """

    base_port: Port  # of instance 0
    port_step: int  # between instances
    home: Vec3  # default of ``origin``
    free_runs = False  # whether it needs readings before its first outputs
    at_wall_pace = False  # whether steps must come no faster than the wall clock
    has_sticks = False  # whether the run can fly it by a remote control

    def __init__(
        self,
        *,
        vehicle: str,
        number: int,
        folder: str,
        command: str = "",
        instance: Count | None = None,
        mavlink: str = "",
        origin: Vec3 | None = None,
        takeoff_m: Positive = 2.0,
        on_lost: OnLost = "stop",
        start_s: Positive = 60.0,
        timeout_s: Positive = 10.0,
    ) -> None:
        self.vehicle, self.mavlink, self.takeoff_m, self.on_lost = vehicle, mavlink, takeoff_m, on_lost
        self.start_s, self.timeout_s = start_s, timeout_s
        self.instance = number if instance is None else instance
        self.port = self.base_port + self.port_step * self.instance
        if self.port > 65535:
            raise ScenarioError(f"{self.instance} is too large: its port would be {self.port}", key="instance")
        self.origin = self.home if origin is None else origin
        try:
            self.plane = TangentPlane(*self.origin)
        except ValueError as error:
            raise ScenarioError(str(error), key="origin") from None
        self.started = False  # its outputs have come
        self.outputs: tuple[float, ...] = STILL  # shares of the greatest rotor speeds, in the order of ArduPilot's motors
        self._words = _words(command, {"instance": str(self.instance), "vehicle": vehicle, "folder": folder})
        self._process: FirmwareProcess | None = None

    @abstractmethod
    def listen(self) -> None:
        """Open the port. Repeated calls are allowed.

        Raises:
            OSError: it cannot be opened.
        """

    @abstractmethod
    def fileno(self) -> int:
        """Descriptor that is readable when `receive` should be called."""

    @abstractmethod
    def send(self, readings: FlightReadings) -> None:
        """Send the readings of a step."""

    @abstractmethod
    def receive(self) -> bool:
        """Read what has come; whether `outputs` now answer the last readings.

        Raises:
            FirmwareLost: it has gone.
        """

    @property
    def refused(self) -> str:
        """Received data of another protocol, in words; empty: none."""
        return ""

    @property
    def is_alone(self) -> bool:
        """Whether its ports are in a network of its own."""
        return False

    def start(self) -> None:
        """Start the process, if there is a command line.

        Raises:
            FirmwareLost: it cannot be started.
        """
        if self._words and self._process is None:
            try:
                self._process = FirmwareProcess(self._words)
            except OSError as error:
                raise FirmwareLost(f"{self._words[0]} cannot be started: {error.strerror or error}") from error

    @property
    def how_to_start(self) -> str:
        """What to do, if the run does not start it."""
        return "" if self._words else f"; start it by hand, instance {self.instance}, for port {self.port} of {LOOPBACK}"

    def why_ended(self) -> str:
        """How its process ended, in words; empty: it runs, or was started by hand."""
        return "" if self._process is None else self._process.why_ended()

    def close(self) -> None:
        """End process and connection. Repeated calls are allowed."""
        if self._process is not None:
            self._process.close()
            self._process = None


class UdpFirmware(FirmwareLink):
    """Firmware that sends its outputs to a UDP port of loopback."""

    _socket: socket.socket | None = None

    def listen(self) -> None:
        """Open the port."""
        if self._socket is None:
            opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            try:
                opened.bind((LOOPBACK, self.port))
            except OSError:
                opened.close()
                raise
            self._use(opened)

    def fileno(self) -> int:
        """The socket."""
        return self._open.fileno()

    def close(self) -> None:
        """End the process and close the port."""
        super().close()
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    @property
    def _open(self) -> socket.socket:
        assert self._socket is not None  # noqa: S101  `listen` and `start` were called
        return self._socket

    def _datagrams(self) -> Iterator[tuple[bytes, tuple[str, int]]]:
        """Datagrams that are there, with their senders."""
        with contextlib.suppress(OSError):  # no datagram is left, or no program listens yet
            while True:
                yield self._open.recvfrom(DATAGRAM)

    def _use(self, opened: socket.socket) -> None:
        opened.setblocking(False)
        self._socket = opened


class FirmwareProcess:
    """A process of firmware in a session and a temporary folder of its own; its output is kept for its last line.

    Args:
        keep: descriptor that it inherits.
    """

    def __init__(self, words: list[str], *, keep: int | None = None) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="vcmvsp-firmware-", ignore_cleanup_errors=True)
        self._output = tempfile.TemporaryFile()  # noqa: SIM115  closed by `close`
        try:
            self._process = subprocess.Popen(
                words,
                cwd=self._folder.name,
                stdin=subprocess.DEVNULL,
                stdout=self._output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                pass_fds=() if keep is None else (keep,),
            )
        except OSError:
            self._remove()
            raise

    def why_ended(self, wait_s: float = 0.0) -> str:
        """How it ended, with its last line; empty: it runs, also after waiting."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(wait_s)
        code = self._process.returncode
        if code is None:
            return ""
        self._output.seek(max(0, self._output.seek(0, os.SEEK_END) - LAST_BYTES))
        lines = self._output.read().decode(errors="replace").split("\n")
        last = next((line.strip() for line in reversed(lines) if line.strip()), "")
        return f"{ending(code)}{last and f', last line: {last}'}"

    def close(self) -> None:
        """End it with all processes of its session."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGTERM)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(LEAVE_S)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._remove()

    def _remove(self) -> None:
        self._output.close()
        self._folder.cleanup()


def _words(command: str, values: dict[str, str]) -> list[str]:
    """The words of a command line with placeholders replaced; a path with a folder is relative to the scenario."""
    try:
        words = [word.format(**values) for word in shlex.split(command)]
    except (ValueError, KeyError, IndexError) as error:
        allowed = ", ".join(f"{{{name}}}" for name in values)
        raise ScenarioError(f"{command!r} is no command line with {allowed}: {error}", key="command") from error
    if words and os.sep in words[0]:
        words[0] = str(Path(values["folder"]) / words[0])
    return words
