"""Proxy of a real vehicle in a run: reports of its station become events, commands become orders."""

import math
import time
from collections import deque
from collections.abc import Iterator, Sequence

import msgspec
import numpy as np

from vcmvsp.cosim.clock import SECOND_NS, WallClock
from vcmvsp.cosim.errors import FederateError, Interrupted, VcmvspError
from vcmvsp.cosim.estimation.dead_reckoning import LONGEST_NS, ahead, planar
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.frames import arc, quaternion_from_yaw
from vcmvsp.cosim.scenario.schema import RealVehicle
from vcmvsp.cosim.types import (
    ORIGIN,
    Array,
    Fix,
    Incident,
    Measured,
    Odometry,
    RealStatus,
    VehicleState,
    Velocity,
    Waypoint,
)
from vcmvsp.hardware.drivers.base import DriverError, Notice
from vcmvsp.hardware.station.messages import OPERATOR_STOP, StationOrder, StationReport
from vcmvsp.hardware.station.process_client import Station

LOST = "its robot is lost"
HALTED = "operator's halt"
"""Cause in a status: an intervention of the run halts the vehicle."""
KEPT_NS = 2 * SECOND_NS  # of reports
SILENT_NS = SECOND_NS  # a station sends 50 reports a second; one that is silent for longer hangs


class VehicleProxy:
    """Turns reports into events and commands into orders.

    Args:
        vehicle: table of the vehicle.
        clock: of the run.
    """

    def __init__(self, vehicle: RealVehicle, clock: WallClock) -> None:
        self.vehicle, self._clock = vehicle, clock
        self.station: Station | None = None  # None: not connected
        self.over: VcmvspError | None = None  # error that ends the run after this step is recorded
        self.lost: VcmvspError | None = None  # error that lost the robot while the run continues
        self.halted = False  # whether an intervention halts the vehicle
        self._heard_ns = self._looked_ns = 0  # monotonic times of the last report and of the last check
        x, y, yaw = vehicle.start
        place = (x, y, vehicle.height_m)
        self._still = VehicleState(position=place, attitude=quaternion_from_yaw(yaw))
        self._history: deque[StationReport] = deque()  # oldest first
        self._fresh: list[StationReport] = []  # since the last publication
        self._command: tuple[Velocity | None, int, int] = (None, 0, 0)  # command, its monotonic time, its logical time
        self._orders, self._shown = 0, (0, self._still)
        self._asked = (-1, self._still)

    # --- orders -------------------------------------------------------------------------------------------------------------

    def command(self, event: Event) -> None:
        """Store a command of the agent."""
        if isinstance(event.value, Waypoint):
            problem = "was given a Waypoint, which real vehicles do not take: send Velocity"
            raise FederateError(self.vehicle.name, problem)
        if isinstance(event.value, Velocity):
            self._command = event.value, self._clock.monotonic_ns(event.time_ns), event.time_ns

    def order(self, others: Array | None, stop: str = "", *, now_ns: int | None = None) -> None:
        """Send an order at this time of the run; the station monitors its arrival."""
        if self.station is None:
            return
        self._orders += 1
        command, command_ns, since_ns = self._command
        if self.halted and command is not None:
            command = Velocity()  # keeps the age of the agent's command
        self.station.order(
            StationOrder(
                number=self._orders,
                sent_ns=time.monotonic_ns(),
                command=command,
                command_ns=command_ns if command is not None else None,
                command_age_ns=None if command is None or now_ns is None else now_ns - since_ns,
                others=others,
                stop=stop,
            )
        )

    # --- reports ------------------------------------------------------------------------------------------------------------

    def hear(self) -> None:
        """Take the reports of the station."""
        if self.station is None or self.over is not None:
            return
        try:
            reports = self.station.reports()
        except DriverError as error:
            self._lose(error)
            return
        for report in reports:
            self._fresh.append(report)
            self._history.append(report)
            if OPERATOR_STOP in report.causes:
                self.over = Interrupted(f"{self.vehicle.name} stands: {OPERATOR_STOP}")
        self._look_after(heard=bool(reports))
        while len(self._history) > 1 and self._history[-1].time_ns - self._history[0].time_ns > KEPT_NS:
            self._history.popleft()

    def _look_after(self, *, heard: bool) -> None:
        """Detect a station that hangs: silent for longer than `SILENT_NS` while the run listened."""
        now_ns = time.monotonic_ns()
        if heard or now_ns - self._looked_ns > SILENT_NS // 2:  # the run itself may have been blocked
            self._heard_ns = now_ns
        self._looked_ns = now_ns
        if now_ns - self._heard_ns > SILENT_NS:
            happened = f"its station has said nothing for {SILENT_NS / SECOND_NS:g} s"
            advice = "it hangs; look after the robot, which its watchdog stops"
            self._lose(FederateError(self.vehicle.name, f"{happened}: {advice}"))

    def _lose(self, error: VcmvspError) -> None:
        """End the run, or continue with a vehicle that stands at its robot's last place and takes no commands."""
        if self.vehicle.on_lost == "stop":
            self.over = error
            return
        self.lost, self.station = error, None
        now_ns = time.monotonic_ns()
        notice = Notice(time_ns=now_ns, what="lost", cause=str(error))
        last = self._history[-1] if self._history else StationReport(number=0, time_ns=now_ns)
        told = StationReport(number=last.number, time_ns=now_ns, state=self._rested(now_ns), causes=(LOST,), notices=(notice,))
        self._fresh.append(told)
        self._history.append(told)

    def _rested(self, at_ns: int) -> VehicleState:
        return msgspec.structs.replace(self._state(at_ns), velocity=ORIGIN, angular_velocity=ORIGIN)

    def state(self, now_ns: int) -> VehicleState:
        """State at a logical time, extrapolated from the newest earlier report."""
        if self._asked[0] != now_ns:
            self._asked = now_ns, self._state(self._clock.monotonic_ns(now_ns))
        return self._asked[1]

    def _state(self, at_ns: int) -> VehicleState:
        reports = [each for each in self._history if each.state is not None]
        if not reports:
            return self._still
        report = next((each for each in reversed(reports) if each.time_ns <= at_ns), reports[0])
        assert report.state is not None  # noqa: S101  selected above
        return ahead(report.state, at_ns - report.time_ns, flies=self.vehicle.flies)

    def _report(self, now_ns: int) -> StationReport | None:
        """Newest report at an instant; a late run has received newer ones."""
        at_ns = self._clock.monotonic_ns(now_ns)
        return next((each for each in reversed(self._history) if each.time_ns <= at_ns), None)

    def publish(self, now_ns: int) -> Iterator[Event]:
        """Events of an instant."""
        name, newest, fresh = self.vehicle.name, self._report(now_ns), self._fresh
        self._fresh = []
        state = self.state(now_ns)
        estimate = state
        if newest is not None and newest.odometry is not None:
            odometry = self._odometry(newest, now_ns)
            yield Event(f"{name}/odometry", now_ns, odometry)
            if self.vehicle.pose_source == "odometry":
                estimate = planar(odometry.pose, odometry.v, odometry.w, self.vehicle.height_m)
        yield Event(f"{name}/estimate", now_ns, estimate)
        yield from self._readings(now_ns, fresh)
        yield Event(f"{name}/real", now_ns, self._status(now_ns, newest, fresh))
        yield from self._incidents(now_ns, fresh)
        self._shown = now_ns, state

    def last_words(self, now_ns: int) -> Iterator[Event]:
        """Incidents that are not published yet, at the end of the run."""
        fresh, self._fresh = self._fresh, []
        return self._incidents(now_ns, fresh)

    def _incidents(self, now_ns: int, fresh: Sequence[StationReport]) -> Iterator[Event]:
        for notice in (each for report in fresh for each in report.notices):
            happened_ns = self._clock.logical_ns(notice.time_ns)
            incident = Incident(what=notice.what, cause=notice.cause, happened_ns=happened_ns)
            yield Event(f"{self.vehicle.name}/incident", now_ns, incident)

    def _odometry(self, report: StationReport, now_ns: int) -> Odometry:
        """Newest odometry, extrapolated to this instant."""
        told = report.odometry
        assert told is not None  # noqa: S101  checked by the caller
        since_ns = self._clock.monotonic_ns(now_ns) - report.measured_ns
        seconds = max(0, min(since_ns, LONGEST_NS)) / SECOND_NS
        return Odometry(pose=arc(told.pose, told.v, told.w, seconds), v=told.v, w=told.w)

    def _readings(self, now_ns: int, fresh: Sequence[StationReport]) -> Iterator[Event]:
        """New positions and ranges; measurements from before the start of the run are dropped."""
        name, logical_ns = self.vehicle.name, self._clock.logical_ns
        for report in fresh:
            for fix in report.fixes:
                if (measured_ns := logical_ns(fix.time_ns)) >= 0:
                    yield Event(f"{name}/fix", now_ns, _timed(fix, measured_ns))
        ranges = {str(number): range_m for report in fresh for number, range_m in report.sonar}
        if ranges:
            yield Event(f"{name}/sonar", now_ns, Measured(time_ns=now_ns, values=dict(sorted(ranges.items(), key=_number))))

    def _status(self, now_ns: int, newest: StationReport | None, fresh: Sequence[StationReport]) -> RealStatus:
        if newest is None:
            return RealStatus(link=0, age_s=None)
        sigma_m = None
        if newest.covariance is not None:
            sigma_m = math.sqrt(max(float(np.linalg.eigvalsh(newest.covariance[:2, :2])[-1]), 0.0))
        held = (HALTED,) if self.halted else ()
        causes = (*held, *dict.fromkeys(cause for report in fresh or [newest] for cause in report.causes))
        age_s = None
        if newest.sample:
            age_s = max(0, self._clock.monotonic_ns(now_ns) - newest.measured_ns) / SECOND_NS
        return RealStatus(
            link=newest.link,
            age_s=age_s,
            fix_age_s=newest.fix_age_s,
            sigma_m=sigma_m,
            prediction_m=self._prediction_m(now_ns),
            gated=newest.gated,
            sent=newest.sent,
            causes=causes,
            battery_v=newest.battery_v,
            bumpers=newest.bumpers,
            late_s=max((report.late_s for report in fresh), default=0.0),
        )

    def _prediction_m(self, now_ns: int) -> float | None:
        """Distance between the state now and its prediction from the last published state, m."""
        since_ns, last_state = self._shown
        if not self._history or since_ns == 0:
            return None
        expected = ahead(last_state, now_ns - since_ns, flies=self.vehicle.flies)
        return math.dist(expected.position, self.state(now_ns).position)


def _timed(fix: Fix, time_ns: int) -> Fix:
    return msgspec.structs.replace(fix, time_ns=time_ns)


def _number(item: tuple[str, float]) -> int:
    return int(item[0])
