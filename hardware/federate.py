"""The federate `hardware`: real vehicles replace simulated ones, under the same names and keys.

Events of a real vehicle, at the instants at which physics publishes the events of simulated vehicles:

========================  ============  ===================================================================================
``<vehicle>/estimate``    VehicleState  estimated state
``<vehicle>/odometry``    Odometry      wheel odometry, extrapolated to this instant
``<vehicle>/fix``         Fix           new positions
``<vehicle>/sonar``       Measured      new ranges, m, by the numbers of the sonars
``<vehicle>/real``        RealStatus    age and uncertainty, the command that was sent, and the causes that changed it
``<vehicle>/incident``    Incident      connected, lost, stopped: with its cause
========================  ============  ===================================================================================

Commands go to the robot at once, and so does ``operator/halted`` (`Halted`): a halted vehicle gets zero velocity in place of
its agent's commands, and all safety rules stay active; after the halt it follows the newest command.

Physics shows the vehicle at the state that `states` returns (`cosim.federate.ExternalMotion`).
"""

import contextlib
import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence

import msgspec
import numpy as np

from vcmvsp.cosim import types
from vcmvsp.cosim.clock import SECOND_NS, Ticks, WallClock
from vcmvsp.cosim.errors import FederateError, Interrupted, ScenarioError, VcmvspError
from vcmvsp.cosim.estimation.dead_reckoning import LONGEST_NS, ahead, planar
from vcmvsp.cosim.federate import Event, Log, Needed, RunInfo, Slot, Step, vehicle_of
from vcmvsp.cosim.frames import arc, quaternion_from_yaw
from vcmvsp.cosim.scenario.schema import RealVehicle
from vcmvsp.cosim.types import ORIGIN, Array, Measured, Odometry, RealStatus, States, VehicleState, Velocity
from vcmvsp.hardware.drivers.base import DriverError, Notice
from vcmvsp.hardware.station.messages import KNOWN_S, OPERATOR_STOP, StationOrder, StationReport
from vcmvsp.hardware.stations import Connections, Station

HEARTBEAT = Ticks.every(0.05)
"""Period of orders; a station without orders stops its robot."""

MOST = 500  # other vehicles in an order


class Hardware:
    """All real vehicles of a run that ``clock`` paces, with the times of the robots.

    Args:
        radius_m: of a circle around the body of each vehicle of the run, by name.
        tell: takes lines for the user.
        log: takes what a replay needs: key, time, value.
        connect: connect to the robots; False: vehicles stand at their starts while a scenario is checked.
    """

    name = "hardware"
    slot = Slot.WORLD
    wake_slot = Slot.APPLY
    latest: tuple[str, ...] = ("world/states",)

    def __init__(
        self,
        vehicles: Sequence[RealVehicle],
        *,
        run: str,
        clock: WallClock,
        radius_m: Mapping[str, float],
        tell: Callable[[str], None],
        log: Log,
        connect: bool,
    ) -> None:
        self.names = tuple(each.name for each in vehicles)
        self.reads = self.wakes = (*(f"{name}/command" for name in self.names), "operator/halted")
        self._clock, self._radius_m, self._log = clock, radius_m, log
        self._proxies = {each.name: VehicleProxy(each, clock) for each in vehicles}
        self._run, self._tell, self._connect = run, tell, connect
        self._connections: Connections | None = None
        self._world: tuple[int, States] | None = None  # time and states
        self._published_ns = -1
        self._lost = set[str]()  # lost vehicles, while the run continues

    def start(self, run: RunInfo) -> int:
        """Connect to all robots, which then stand; `ScenarioError`: they cannot keep away from a vehicle of unknown radius."""
        for name in run.vehicles:
            if self.names != (name,) and not 0.0 < (radius_m := self._radius_m.get(name, 0.0)) < np.inf:
                problem = f"{name} has a radius of {radius_m:g} m, so real vehicles cannot avoid it: give its kind a hull"
                raise ScenarioError(problem, key=f"vehicle.{name}.kind")
        self._needed, self._end_ns = Needed(run), run.duration_ns
        if self._connect:
            driven = [proxy.vehicle for proxy in self._proxies.values()]
            self._connections = Connections(driven, self._run, self._tell, run.periods_s)
            for name, station in self._connections.open().items():
                self._proxies[name].station = station
        return 0

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """Process commands and reports, publish, and send orders."""
        for event in inbox:
            self._take(event)
        events: list[Event] = []
        for proxy in self._proxies.values():
            if proxy.over is not None:
                raise proxy.over
            proxy.hear()
            if proxy.lost is not None and proxy.vehicle.name not in self._lost:
                events += self._go_on_without(proxy.vehicle, now_ns)
        if now_ns != self._published_ns and self._needed.hits(now_ns):
            self._published_ns = now_ns
            events += [event for proxy in self._proxies.values() for event in proxy.publish(now_ns)]
        elif any(proxy.over for proxy in self._proxies.values()):  # raised at the next step, after this is recorded
            events += [event for proxy in self._proxies.values() for event in proxy.last_words(now_ns)]
        for event in events:
            key = f"{event.value.vehicles[0]}/outage" if isinstance(event.value, types.Outage) else event.key
            self._log(key, event.time_ns, event.value)
        for name, proxy in self._proxies.items():
            proxy.order(self._others(name), now_ns=now_ns)
        next_ns = self._needed.after(now_ns)
        if next_ns is not None and self._connect:
            next_ns = min(next_ns, HEARTBEAT.after(now_ns))
        return Step(events, next_ns)

    def states(self, now_ns: int) -> list[VehicleState]:
        """States of the vehicles, for physics."""
        states = [proxy.state(now_ns) for proxy in self._proxies.values()]
        for name, state in zip(self.names, states, strict=True):
            self._log(f"{name}/reflected", now_ns, state)
        return states

    def release(self) -> None:
        """Stop all robots at once."""
        for proxy in self._proxies.values():
            with contextlib.suppress(FederateError):  # a robot without a station has a watchdog
                proxy.order(None, stop="the run is over")

    def close(self) -> None:
        """Stop and disconnect all robots."""
        if self._connections is not None:
            self._connections.close()

    def _take(self, event: Event) -> None:
        if isinstance(event.value, States):
            self._world = event.time_ns, event.value
        elif isinstance(event.value, types.Halted):
            for name in event.value.vehicles:
                if name in self._proxies:  # other vehicles are simulated
                    self._proxies[name].halted = event.value.halted
        else:
            self._proxies[vehicle_of(event.key)].command(event)

    def _go_on_without(self, vehicle: RealVehicle, now_ns: int) -> list[Event]:
        """Close the station of a lost robot; a removed vehicle loses radio and place."""
        self._lost.add(vehicle.name)
        if self._connections is not None:
            self._connections.drop(vehicle.name)
        if vehicle.on_lost == "hold":
            return []
        outage = types.Outage(vehicles=(vehicle.name,), until_ns=self._end_ns)
        return [
            Event("operator/outage", now_ns, outage),  # like an operator's outage
            Event(f"{vehicle.name}/follows", now_ns, types.Follows(leader=None)),
        ]

    def _others(self, name: str) -> Array | None:
        """Other vehicles nearest to this one, at the current wall time (n, 7): x y z m, vx vy vz m/s, radius m."""
        if self._world is None:
            return None
        world_ns, world = self._world
        age_s = min(max(0, self._clock.logical_ns(time.monotonic_ns()) - world_ns) / SECOND_NS, KNOWN_S)
        own = world.names.index(name)
        distance = np.linalg.norm(world.position - world.position[own], axis=1)
        rows = [row for row in np.argsort(distance, kind="stable")[: MOST + 1].tolist() if row != own]
        radii = [self._radius_m[world.names[row]] for row in rows]
        return np.column_stack([world.position[rows] + age_s * world.velocity[rows], world.velocity[rows], radii])


LOST = "its robot is lost"
HALTED = "operator's halt"
"""Cause in a status: an intervention of the run halts the vehicle."""
KEPT_NS = 2 * SECOND_NS  # of reports
SILENT_NS = SECOND_NS  # a station sends 50 reports a second; one that is silent for longer hangs


class VehicleProxy:
    """Turns the reports of a station into events and commands into orders."""

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
        # The agent's newest command, its monotonic time, its logical time.
        self._command: tuple[Velocity | None, int | None, int] = (None, None, 0)
        self._orders, self._published = 0, (0, self._still)
        self._latest = (-1, self._still)

    def command(self, event: Event) -> None:
        """Store a command of the agent."""
        if isinstance(event.value, types.Waypoint):
            problem = "received a Waypoint, which real vehicles do not accept: send Velocity"
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
        age_ns = None if command is None or now_ns is None else now_ns - since_ns
        self.station.order(
            StationOrder(
                number=self._orders,
                sent_ns=time.monotonic_ns(),
                command=command,
                command_ns=command_ns,
                command_age_ns=age_ns,
                others=others,
                stop=stop,
            )
        )

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
            happened = f"no message of its station for {SILENT_NS / SECOND_NS:g} s"
            advice = "the station hangs: secure the robot, which its watchdog stops"
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
        rested = msgspec.structs.replace(self._state(now_ns), velocity=ORIGIN, angular_velocity=ORIGIN)
        report = StationReport(number=last.number, time_ns=now_ns, state=rested, causes=(LOST,), notices=(notice,))
        self._fresh.append(report)
        self._history.append(report)

    def state(self, now_ns: int) -> VehicleState:
        """State at a logical time, extrapolated from the newest earlier report."""
        if self._latest[0] != now_ns:
            self._latest = now_ns, self._state(self._clock.monotonic_ns(now_ns))
        return self._latest[1]

    def _state(self, at_ns: int) -> VehicleState:
        reports = [each for each in self._history if each.state is not None]
        if not reports:
            return self._still
        report = next((each for each in reversed(reports) if each.time_ns <= at_ns), reports[0])
        assert report.state is not None  # noqa: S101  selected above
        return ahead(report.state, at_ns - report.time_ns, flies=self.vehicle.flies)

    def publish(self, now_ns: int) -> Iterator[Event]:
        """Events of an instant."""
        at_ns = self._clock.monotonic_ns(now_ns)  # a late run has received newer reports
        newest = next((each for each in reversed(self._history) if each.time_ns <= at_ns), None)
        name, fresh, self._fresh = self.vehicle.name, self._fresh, []
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
        self._published = now_ns, state

    def last_words(self, now_ns: int) -> Iterator[Event]:
        """Incidents that are not published yet, at the end of the run."""
        fresh, self._fresh = self._fresh, []
        return self._incidents(now_ns, fresh)

    def _incidents(self, now_ns: int, fresh: Sequence[StationReport]) -> Iterator[Event]:
        for notice in (each for report in fresh for each in report.notices):
            happened_ns = self._clock.logical_ns(notice.time_ns)
            incident = types.Incident(what=notice.what, cause=notice.cause, happened_ns=happened_ns)
            yield Event(f"{self.vehicle.name}/incident", now_ns, incident)

    def _odometry(self, report: StationReport, now_ns: int) -> Odometry:
        odometry = report.odometry
        assert odometry is not None  # noqa: S101  checked by the caller
        since_ns = self._clock.monotonic_ns(now_ns) - report.measured_ns
        seconds = max(0, min(since_ns, LONGEST_NS)) / SECOND_NS
        return Odometry(pose=arc(odometry.pose, odometry.v, odometry.w, seconds), v=odometry.v, w=odometry.w)

    def _readings(self, now_ns: int, fresh: Sequence[StationReport]) -> Iterator[Event]:
        """New positions and ranges; measurements from before the start of the run are dropped."""
        name, logical_ns = self.vehicle.name, self._clock.logical_ns
        for report in fresh:
            for fix in report.fixes:
                if (measured_ns := logical_ns(fix.time_ns)) >= 0:
                    yield Event(f"{name}/fix", now_ns, msgspec.structs.replace(fix, time_ns=measured_ns))
        ranges = {str(number): range_m for report in fresh for number, range_m in report.sonar}
        if ranges:
            values = dict(sorted(ranges.items(), key=lambda item: int(item[0])))
            yield Event(f"{name}/sonar", now_ns, Measured(time_ns=now_ns, values=values))

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
        since_ns, last_state = self._published
        if not self._history or since_ns == 0:
            return None
        expected = ahead(last_state, now_ns - since_ns, flies=self.vehicle.flies)
        return math.dist(expected.position, self.state(now_ns).position)
