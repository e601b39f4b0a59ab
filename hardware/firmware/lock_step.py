"""Lock-step with firmware: readings of a step go out to all, then the run waits for the outputs of each."""

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from vcmvsp.cosim.errors import FederateError
from vcmvsp.cosim.federate import FlightReadings
from vcmvsp.cosim.types import Incident, Velocity, Waypoint
from vcmvsp.cosim.util.polling import readable
from vcmvsp.hardware.drivers.base import DriverError
from vcmvsp.hardware.firmware.betaflight import Betaflight
from vcmvsp.hardware.firmware.commander import MavlinkCommander
from vcmvsp.hardware.firmware.link import STILL, FirmwareLink, FirmwareLost
from vcmvsp.hardware.firmware.pilot import StickPilot

LOOK_S = 0.1  # between two looks at a process
_FATE = {"fall": "its rotors stop", "hold": "its own autopilot holds it in place"}


class LockStepFirmware:
    """Firmware of several vehicles (`cosim.federate.FlightFirmware`).

    Args:
        links: by vehicle, in the order of ``names``.
        tell: receives lines for the user.
    """

    def __init__(self, links: Mapping[str, FirmwareLink], tell: Callable[[str], None] = lambda _: None) -> None:
        self.names = tuple(links)
        self._links, self._tell = [*links.values()], tell
        self._commanders = {name: commander for name, each in links.items() if (commander := _commander(each)) is not None}
        self._lost: dict[str, Sequence[float] | None] = {}  # outputs, by vehicle
        self._incidents: list[tuple[str, Incident]] = []
        self._began_s: float | None = None
        self._last_ns, self._last_s = 0, 0.0  # the last exchange

    def _open(self) -> None:
        """Listen at all ports, and start the processes, once.

        Raises:
            FederateError: a port cannot be opened, or a process cannot be started.
        """
        if self._began_s is not None:
            return
        for link in self._links:
            try:
                link.listen()
            except OSError as error:
                cause = f"port {link.port} for {link.vehicle} cannot be opened: {error.strerror or error}; "
                raise FederateError("firmware", f"{cause}close the other program there, or set firmware.instance") from error
        for link in self._links:
            try:
                link.start()
            except FirmwareLost as lost:
                raise FederateError("firmware", f"{link.vehicle}: {lost}") from lost
            if link.how_to_start:
                self._tell(f"waiting for the firmware of {link.vehicle}{link.how_to_start}")
        self._began_s = time.monotonic()

    def exchange(self, readings: Sequence[FlightReadings]) -> Sequence[Sequence[float] | None]:
        """Outputs of all for these readings."""
        self._open()
        step_s, self._last_ns = 1e-9 * (readings[0].now_ns - self._last_ns), readings[0].now_ns
        if any(link.at_wall_pace for link in self._links if link.vehicle not in self._lost):
            time.sleep(max(0.0, self._last_s + step_s - time.monotonic()))
        self._last_s = time.monotonic()
        until_s = self._last_s + step_s
        for link, each in zip(self._links, readings, strict=True):
            if link.vehicle not in self._lost:
                self._guarded(link, each.now_ns, partial(link.send, each))
        outputs = []
        for link, each in zip(self._links, readings, strict=True):
            if link.vehicle not in self._lost:
                self._guarded(link, each.now_ns, partial(self._await, link, each.now_ns, until_s))
            outputs.append(self._lost.get(link.vehicle, link.outputs))
        return outputs

    def command(self, vehicle: str, command: Velocity | Waypoint) -> None:
        """Pass a command on, if its firmware can be commanded."""
        if vehicle in self._commanders:
            self._commanders[vehicle].command(command)

    def incidents(self) -> Sequence[tuple[str, Incident]]:
        """Incidents since the last call."""
        incidents, self._incidents = self._incidents, []
        return incidents

    def close(self) -> None:
        """End connections and processes."""
        for commander in self._commanders.values():
            commander.close()
        for link in self._links:
            link.close()

    def _guarded(self, link: FirmwareLink, now_ns: int, do: Callable[[], None]) -> None:
        """Call ``do``; if the firmware of ``link`` is lost in it, treat its vehicle as ``on_lost`` says."""
        try:
            do()
        except (FirmwareLost, DriverError) as lost:
            cause = f"the firmware of {link.vehicle} is lost: {lost}"
            if link.on_lost == "stop":
                raise FederateError("firmware", cause) from lost
            link.close()
            if link.vehicle in self._commanders:
                self._commanders.pop(link.vehicle).close()
            self._lost[link.vehicle] = STILL if link.on_lost == "fall" else None
            self._note(link, "lost", f"{cause}; {_FATE[link.on_lost]}", now_ns)

    def _note(self, link: FirmwareLink, what: str, cause: str, now_ns: int) -> None:
        self._incidents.append((link.vehicle, Incident(what=what, cause=cause, happened_ns=now_ns)))  # type: ignore[arg-type]

    def _await(self, link: FirmwareLink, now_ns: int, until_s: float) -> None:
        """Wait for the outputs of a link; before its first, no longer than ``until_s`` if it needs readings to begin."""
        deadline_s = time.monotonic() + link.timeout_s if link.started else (self._began_s or 0.0) + link.start_s
        while not link.receive():
            left_s = deadline_s - time.monotonic()
            if ended := link.why_ended():
                raise FirmwareLost(f"its process {ended}")
            if left_s <= 0.0:
                raise FirmwareLost(_silence(link))
            if link.free_runs and not link.started:
                left_s = until_s - time.monotonic()
                if left_s <= 0.0:
                    return
            readable([link.fileno()], min(left_s, LOOK_S))
        if not link.started:
            link.started = True
            self._note(link, "connected", f"its firmware, instance {link.instance}, flies it", now_ns)
        commander = self._commanders.get(link.vehicle)
        if commander is not None:
            for what, cause in commander.advance(now_ns):
                self._note(link, what, cause, now_ns)


def _commander(link: FirmwareLink) -> MavlinkCommander | StickPilot | None:
    if isinstance(link, Betaflight):
        return StickPilot(link)
    return MavlinkCommander(link) if link.mavlink else None


def _silence(link: FirmwareLink) -> str:
    refused = f"; there were {link.refused}" if link.refused else ""
    if link.started:
        return f"no outputs came for {link.timeout_s:g} s{refused}"
    return f"no outputs came within {link.start_s:g} s{refused}{link.how_to_start}"
