"""Run side of a station's process; no call blocks the run.

Several stations open and close at the same time::

    stations = [Station.start(mission) for mission in missions]
    for station in stations:
        station.wait_ready()
    ...
    for station in stations:
        station.leave()
    for station in stations:
        station.close()
"""

import time

import msgspec

from vcmvsp.cosim.errors import FederateError
from vcmvsp.cosim.processes.child_process import LinkedProcess
from vcmvsp.cosim.util.codec import encode
from vcmvsp.hardware.drivers.base import DriverError
from vcmvsp.hardware.station import messages
from vcmvsp.hardware.station.messages import StationMission, StationOrder, StationReport

READY_S = 60.0  # longer than a station allows its driver
CLOSE_S = 15.0  # longer than a station needs to stop its robot and to close its driver
DYING_S = 2.0  # from the end of a link to that of the process
PAUSE_S = 0.05  # between two attempts to send to a station that does not read
WATCHDOG = "the robot's own watchdog stops it, if it has one: look after the robot"


class StationError(DriverError):
    """A station failed or ended."""

    def __init__(self, vehicle: str, happened: str, advice: str) -> None:
        self.device, self.happened, self.advice = vehicle, happened, advice
        FederateError.__init__(self, f"the robot of {vehicle}", f"{happened}; {advice}")


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
        """Of the process."""
        return self._process.pid

    def wait_ready(self, until: float | None = None) -> None:
        """Wait until the robot is connected and stands, at most until this ``time.monotonic()`` [now + `READY_S`].

        Raises:
            DriverError: it cannot be driven; the station has ended.
        """
        until = time.monotonic() + READY_S if until is None else until
        while not self._waiting and self._failure is None:
            self._read(until - time.monotonic())
            if time.monotonic() >= until and not self._waiting and self._failure is None:
                self._end(patient=False)
                happened = "its station did not say in time that the robot is connected"
                self._failure = StationError(self.vehicle, happened, "look at what it says above, at the robot and at its port")
        if self._failure is not None:
            raise self._failure

    def order(self, order: StationOrder) -> bool:
        """Send an order without waiting; whether it was sent (not if the station hangs or has ended)."""
        self._number = order.number
        return not self._is_closed and self._link.send(encode(order))

    def reports(self) -> list[StationReport]:
        """Reports since the last call, oldest first, without waiting.

        Raises:
            DriverError: the station failed or ended, and all its reports were returned.
        """
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
        """Wait for the end of the process, or kill it."""
        if self._is_closed:
            return
        self._is_closed = True
        if not self._process.close(DYING_S if patient and self._link.ended else 0.0):
            happened = "its station did not end by itself and was killed"
            self._waiting.append(StationReport(number=0, time_ns=time.monotonic_ns(), failed=happened, advice=WATCHDOG))
        self._link.close()

    def _read(self, wait_s: float) -> None:
        """Receive reports, and note the end of the station."""
        if self._is_closed or self._link.ended:
            return
        if wait_s > 0.0:
            self._link.wait(wait_s)
        for message in self._link.receive():
            report = self._decoded(message)
            self._waiting.append(report)
            if report.failed:
                self._failure = StationError(self.vehicle, report.failed, report.advice)
        if self._link.ended and self._failure is None and not self._leaving:
            ended = self._process.why_ended(DYING_S) or "has hung up"
            self._failure = StationError(self.vehicle, f"its station {ended}", WATCHDOG)

    def _decoded(self, message: bytes) -> StationReport:
        try:
            return messages.reports.decode(message)
        except (ValueError, msgspec.MsgspecError) as error:
            happened = f"its station said something that cannot be read ({error})"
            return StationReport(number=0, time_ns=time.monotonic_ns(), failed=happened, advice="report this")
