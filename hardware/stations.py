"""Run side of the processes of stations, which open and close at the same time; no call blocks the run."""

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence

import msgspec

from vcmvsp.cosim.processes.child_process import LinkedProcess
from vcmvsp.cosim.scenario.schema import RealVehicle
from vcmvsp.cosim.util.codec import encode
from vcmvsp.hardware.drivers.base import DriverError
from vcmvsp.hardware.emulators.arcos.in_run import EMULATED, Emulated
from vcmvsp.hardware.safety.obstacles import Polygon
from vcmvsp.hardware.safety.supervisor import Safety
from vcmvsp.hardware.station import messages
from vcmvsp.hardware.station.controller import guard
from vcmvsp.hardware.station.messages import PartSpec, StationMission, StationOrder, StationReport

READY_S = 60.0  # longer than a station allows its driver
CLOSE_S = 15.0  # longer than a station needs to stop its robot and to close its driver
DYING_S = 2.0  # from the end of a link to that of the process
PAUSE_S = 0.05  # between two attempts to send to a station that does not read
WATCHDOG = "the robot's own watchdog stops it, if it has one: secure the robot"


class StationError(DriverError):
    """A station failed or ended; its ``device`` is the vehicle."""

    _subject = "the robot of"


class Station:
    """A process that drives one robot; see `start`."""

    def __init__(self, mission: StationMission, process: LinkedProcess) -> None:
        self.vehicle = mission.vehicle
        self._process, self._link = process, process.link
        self._waiting: list[StationReport] = []  # received, not yet returned
        self._failure: StationError | None = None
        self._leaving = self._is_closed = False
        self._number = 0  # of the newest order

    @classmethod
    def start(cls, mission: StationMission) -> "Station":
        """Start the process, which connects to the robot, without waiting for that."""
        process = LinkedProcess("vcmvsp.hardware.station")
        process.link.send(encode(mission))
        return cls(mission, process)

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def wait_ready(self, until: float | None = None) -> None:
        """Wait for the robot until this ``time.monotonic()`` [now + `READY_S`]; `DriverError`: it cannot be driven."""
        until = time.monotonic() + READY_S if until is None else until
        while not self._waiting and self._failure is None:
            self._read(until - time.monotonic())
            if time.monotonic() >= until and not self._waiting and self._failure is None:
                self._end(patient=False)
                happened = "its station did not connect to the robot in time"
                self._failure = StationError(self.vehicle, happened, "see its messages above; check the robot and its port")
        if self._failure is not None:
            raise self._failure

    def order(self, order: StationOrder) -> bool:
        """Send an order without waiting; whether it was sent (not if the station hangs or has ended)."""
        self._number = order.number
        return not self._is_closed and self._link.send(encode(order))

    def reports(self) -> list[StationReport]:
        """Reports since the last call, oldest first; `DriverError`: the station has ended, and all were returned."""
        self._read(0.0)
        if not self._waiting and self._failure is not None:
            raise self._failure
        reports, self._waiting = self._waiting, []
        return reports

    def leave(self) -> None:
        """Ask the station to stop the robot and to end, without waiting; `close` repeats it if necessary."""
        if not self._leaving and not self._is_closed:
            order = StationOrder(number=self._number + 1, sent_ns=time.monotonic_ns(), leave=True)
            self._leaving = self._link.send(encode(order))

    def close(self, until: float | None = None) -> list[StationReport]:
        """End the process, at most until this ``time.monotonic()`` [now + `CLOSE_S`]; kill it after that.

        Returns its last reports; never raises.
        """
        self.leave()
        until = time.monotonic() + CLOSE_S if until is None else until
        while not self._link.ended and not self._is_closed and time.monotonic() < until:
            self.leave()
            self._read(min(until - time.monotonic(), PAUSE_S))
        self._end(patient=True)
        reports, self._waiting = self._waiting, []
        return reports

    def _end(self, *, patient: bool) -> None:
        if self._is_closed:
            return
        self._is_closed = True
        if not self._process.close(DYING_S if patient and self._link.ended else 0.0):
            happened = "its station did not end in time and was killed"
            self._waiting.append(StationReport(number=0, time_ns=time.monotonic_ns(), failed=happened, advice=WATCHDOG))
        self._link.close()

    def _read(self, wait_s: float) -> None:
        if self._is_closed or self._link.ended:
            return
        if wait_s > 0.0:
            self._link.wait(wait_s)
        for message in self._link.receive():
            try:
                report = messages.reports.decode(message)
            except (ValueError, msgspec.MsgspecError) as error:
                happened = f"its station sent an invalid message ({error})"
                report = StationReport(number=0, time_ns=time.monotonic_ns(), failed=happened, advice="report this")
            self._waiting.append(report)
            if report.failed:
                self._failure = StationError(self.vehicle, report.failed, report.advice)
        if self._link.ended and self._failure is None and not self._leaving:
            ended = self._process.why_ended(DYING_S) or "closed its connection"
            self._failure = StationError(self.vehicle, f"its station {ended}", WATCHDOG)


COMMAND_S = 0.5  # command time-out


class Connections:
    """Opens and closes all stations together; ``periods_s``: period of each vehicle's agent."""

    def __init__(
        self, vehicles: Sequence[RealVehicle], run: str, tell: Callable[[str], None], periods_s: Mapping[str, float]
    ) -> None:
        self._vehicles, self._run, self._tell, self._periods_s = vehicles, run, tell, periods_s
        self._emulated: list[Emulated] = []
        self._stations: dict[str, Station] = {}

    def open(self) -> dict[str, Station]:
        """Start all stations, and wait until each robot is ready; `DriverError`: a robot cannot be connected."""
        try:
            for vehicle in self._vehicles:
                self._start(vehicle)
            until = time.monotonic() + READY_S
            for station in self._stations.values():
                station.wait_ready(until)
        except BaseException:
            with contextlib.suppress(StationError):  # already reported
                self.close()
            raise
        return dict(self._stations)

    def _start(self, vehicle: RealVehicle) -> None:
        if vehicle.driver_params.get("port") == EMULATED:
            emulated = Emulated(vehicle)
            self._emulated.append(emulated)
            vehicle = emulated.reached
        self._stations[vehicle.name] = Station.start(mission(vehicle, self._run, self._periods_s.get(vehicle.name, 0.0)))

    def drop(self, name: str) -> None:
        """Close the station of a lost robot."""
        self._stations.pop(name).close(time.monotonic())

    def close(self) -> None:
        """Stop and release all robots; emulated ones are closed last.

        `StationError`: a station did not end properly; check the robot.
        """
        until = time.monotonic() + CLOSE_S
        for station in self._stations.values():
            station.leave()
        failed = [
            StationError(name, report.failed, report.advice)
            for name, station in self._stations.items()
            for report in station.close(until)
            if report.failed
        ]
        self._stations.clear()
        for emulated in self._emulated:
            emulated.close()
        self._emulated.clear()
        for error in failed:
            self._tell(str(error))
        if failed:
            raise failed[0]


def check_safety(vehicle: RealVehicle) -> None:
    """Raise `ValueError` if safety parameters are invalid, or the start is outside the fence."""
    guard(mission(vehicle, ""))
    x, y, _ = vehicle.start
    fence = vehicle.safety.fence
    if fence is not None and not Polygon(fence).contains(x, y):
        where = f"{vehicle.name} starts outside the fence, at x = {x:g} m, y = {y:g} m"
        raise ValueError(f"{where}: it could not move; start it inside, or enlarge safety.fence")


def mission(vehicle: RealVehicle, run: str, period_s: float = 0.0) -> StationMission:
    """Mission of a vehicle's station; ``period_s`` is the period of its agent."""
    localisation = None
    if vehicle.localisation is not None:
        localisation = PartSpec(group="localisation", kind=vehicle.localisation, params=vehicle.localisation_params)
    limits = {name: value for name, value in msgspec.structs.asdict(vehicle.safety).items() if value is not None}
    limits = {"command_s": max(COMMAND_S, 2.5 * period_s), **limits}
    return StationMission(
        run=run,
        vehicle=vehicle.name,
        folder=vehicle.folder,
        driver=PartSpec(group="driver", kind=vehicle.driver, params=vehicle.driver_params),
        localisation=localisation,
        fusion=vehicle.fusion,
        start=vehicle.start,
        height_m=vehicle.height_m,
        flies=vehicle.flies,
        safety=Safety(**limits, yaw_decel=limits["yaw_accel"]),
    )
