"""Cycle of a station: read the robot, estimate its state, decide, send a command, report."""

import math
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Literal

import msgspec
import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import ORIGIN, Array, Fix, Odometry, Vec3, VehicleState, Velocity, frozen
from vcmvsp.hardware.drivers.base import Driver, Notice, Sample
from vcmvsp.hardware.safety.aerial_supervisor import AerialSupervisor
from vcmvsp.hardware.safety.obstacles import Others
from vcmvsp.hardware.safety.supervisor import Cause, Decision, GroundSupervisor, LastReceived, Supervisor
from vcmvsp.hardware.station.estimator import DriverEstimator, FusedEstimator, StateEstimate, StateEstimator
from vcmvsp.hardware.station.messages import KNOWN_S, StationMission, StationOrder, StationReport

if TYPE_CHECKING:
    from vcmvsp.hardware.localisation.source import Localisation


SLOWING = (Cause.LIMITS, Cause.GEOFENCE, Cause.SEPARATION)  # these change a command; all others stop the robot
LATCHED = (Cause.OPERATOR,)  # needs a person; other causes end by themselves
NO_VEHICLES = frozen(np.empty((0, 7)))


def guard(mission: StationMission) -> Supervisor:
    """Safety supervisor of a mission; `ValueError`: its safety parameters are invalid."""
    return (AerialSupervisor if mission.flies else GroundSupervisor)(mission.safety, LATCHED)


def others_at(rows: Array | None, age_s: float) -> Others:
    """Other vehicles of an order (see `StationOrder.others`), extrapolated by ``age_s``."""
    rows = NO_VEHICLES if rows is None else rows
    velocity = rows[:, 3:6]
    return Others(rows[:, 0:3] + velocity * max(0.0, min(age_s, KNOWN_S)), velocity, rows[:, 6])


AT_REST = (0.01, 0.02)  # m/s, rad/s: a slower robot stands
STUCK, STUCK_S = "stuck", 2.0  # s: longer than any robot needs to start moving
RUN_LATE_S = 0.15  # s: orders repeat every 0.1 s, so a larger delay is lateness of the run
CREEPS = 0.05  # m/s: a slower robot may stand for lack of force
KEPT = 200  # notices and fixes, while the run takes no reports


class StationController:
    """Control of one robot, without clock, process or run; ``halted``: why it stands until the station ends, if it does."""

    def __init__(
        self, mission: StationMission, driver: Driver, localisation: "Localisation | None", now: Callable[[], int]
    ) -> None:
        self._mission, self._driver, self._localisation, self._now = mission, driver, localisation, now
        self._supervisor = guard(mission)
        self._estimator: StateEstimator = DriverEstimator(mission.height_m, flies=mission.flies)
        if mission.localisation is not None and not mission.flies:
            self._estimator = FusedEstimator(mission.fusion, mission.start, mission.height_m)
        self._order, self._order_heard_ns = StationOrder(number=0, sent_ns=0), 0
        self._operator_ns: int | None = None
        self._sample: Sample | None = None
        self._jumps = self._turns = 0
        self.halted = ""
        self._halted_ns = 0
        self._stands, self._released = True, False  # an open driver holds its robot at zero speed
        self._place: Vec3 | None = None  # position at the last cycle
        self._sent = 0.0  # m/s, last forward speed
        self._late_s = 0.0  # part of the command's age that is lateness of the run
        self._pushed_ns: int | None = None  # since when it does not move
        self._stuck = False
        self._wanted_ns: int | None = None  # since when it should drive and could not
        self._notices: list[Notice] = []
        self._fixes: list[Fix] = []
        self._sonar: dict[int, float] = {}

    def operator_heard(self) -> None:
        """Note that the operator is present."""
        self._operator_ns = self._now()

    def halt(self, cause: str) -> None:
        """Stop the robot until the station ends; the first cause counts."""
        if self.halted:
            return
        self.halted, self._halted_ns = cause, self._now()
        self._stop(self.halted)

    @property
    def stands(self) -> bool:
        """Whether the robot stood after it was halted."""
        sample = self._sample
        if sample is None or not self.halted or sample.measured_ns < self._halted_ns:
            return False
        return abs(sample.odometry.v) < AT_REST[0] and abs(sample.odometry.w) < AT_REST[1]

    def turn(
        self, now_ns: int, order: StationOrder | None = None, *, arrival_ns: int | None = None, late_s: float = 0.0
    ) -> StationReport:
        """Run one cycle with the newest order since the last one, which arrived now unless ``arrival_ns`` is given."""
        if order is not None:
            self._take(order, now_ns if arrival_ns is None else arrival_ns)
        self._listen(now_ns)
        estimate = self._estimator.at(now_ns)
        if estimate is not None and not _finite(estimate.state):
            estimate = None
        self._look_for_jumps(estimate)
        sent, causes = self._decide(now_ns, estimate)
        self._turns += 1
        report = self._report(now_ns, estimate)
        return msgspec.structs.replace(report, sent=sent, causes=causes, late_s=late_s)

    def last_words(self, now_ns: int, failed: str = "", advice: str = "") -> StationReport:
        """Last report, with notices of the driver's closing."""
        self._notices += [each for each in self._gathered() if (each.what, each.cause) != ("stopped", self.halted)]
        self._turns += 1
        causes = (failed,) if failed else ()
        return msgspec.structs.replace(self._report(now_ns, None), causes=causes, failed=failed, advice=advice)

    def delivered(self) -> None:
        """Note that the last report was sent: its notices, fixes and ranges are not repeated."""
        self._notices, self._fixes, self._sonar = [], [], {}

    def _take(self, order: StationOrder, arrival_ns: int) -> None:
        if order.others is not None and (order.others.ndim != 2 or order.others.shape[1] != 7):
            raise ValueError(f"others must be rows of 7 numbers, not of shape {order.others.shape}")
        self._order, self._order_heard_ns = order, arrival_ns
        if order.stop:
            self.halt(order.stop)

    def _listen(self, now_ns: int) -> None:
        if (sample := self._driver.read()) is not None:
            self._sample = sample
            self._estimator.sample(sample, now_ns)
            self._sonar.update(sample.sonar)
        if self._localisation is not None:
            for speed in self._localisation.read(now_ns):
                fix = msgspec.structs.replace(speed, time_ns=min(speed.time_ns, now_ns))
                self._estimator.fix(fix)
                self._fixes.append(fix)
        self._notices += self._gathered()

    def _look_for_jumps(self, estimate: StateEstimate | None) -> None:
        """Check for a jump of the estimate: a small one is accepted, a large one stops the robot.

        A robot that was carried and a faulty positioning system cannot be distinguished here: in the second case the fence
        would be in the wrong place.
        """
        if estimate is None:
            return
        before, self._place = self._place, estimate.state.position
        if self._estimator.jumps > self._jumps:
            self._jumps = self._estimator.jumps
            jump_m = math.dist(before, self._place) if before else 0.0
            jumped = f"its position jumped by {jump_m:.1f} m"
            if jump_m > self._mission.safety.jump_m:
                self.halt(f"{jumped}: the robot was carried, or the positioning system is wrong")
            else:
                self._note("warned", f"{jumped}: the estimate restarts from the measured positions")

    def _is_stuck(self, now_ns: int, command: Velocity | None) -> bool:
        """Whether the robot was commanded to drive for `STUCK_S` and its odometry shows none; until the command is to stand."""
        speed, sample = abs(self._sent), self._sample
        if command is None or abs(command.linear[0]) < CREEPS:
            self._stuck, self._pushed_ns = False, None
        elif self._stuck or speed < CREEPS or sample is None or abs(sample.odometry.v) > 0.2 * speed:
            self._pushed_ns = None
        else:
            self._pushed_ns = self._pushed_ns or now_ns
            self._stuck = now_ns - self._pushed_ns > STUCK_S * SECOND_NS
        return self._stuck

    def _decide(self, now_ns: int, estimate: StateEstimate | None) -> tuple[Velocity, tuple[str, ...]]:
        """Send a command; the command, and the causes of its difference from the requested one."""
        order, received = self._order, self._last_message_times(now_ns, estimate)
        command = Velocity() if self.halted else order.command  # the supervisor slows down with the robot
        others = others_at(order.others, (now_ns - self._order_heard_ns) / SECOND_NS)
        pose = None if estimate is None else self._supervisor.pose(estimate.state)
        decision = self._supervisor.step(now_ns, command, pose, others, received)
        causes = tuple(each.value for each in decision.causes)
        if not self.halted and not self._mission.flies and self._is_stuck(now_ns, order.command):
            if self._sent:
                self._stop(f"commanded to drive for {STUCK_S:g} s, but its odometry shows no motion")
            self._sent = 0.0
            return Velocity(), (STUCK, *causes)
        if self.halted:
            return Velocity(), (self.halted, *(each.value for each in decision.causes if each not in SLOWING))
        if not decision.stop:
            self._stands, self._released = False, True
            self._sent = decision.command.linear[0]
            self._driver.write(decision.command)
            return decision.command, causes
        self._sent = 0.0
        for cause in self._due_causes(now_ns, order.command, decision):
            if cause not in SLOWING:
                self._stop(self._words(cause))
        return Velocity(), causes

    def _due_causes(self, now_ns: int, command: Velocity | None, decision: Decision) -> tuple[Cause, ...]:
        """Causes to report now: new ones; for a robot that never could drive, all of them, after `STUCK_S`."""
        if self._released:
            return decision.began
        if command is None or (command.linear == ORIGIN and not command.yaw_rate):
            return ()
        self._wanted_ns = self._wanted_ns or now_ns
        if now_ns - self._wanted_ns < STUCK_S * SECOND_NS:
            return ()
        self._released = True
        return decision.causes

    def _last_message_times(self, now_ns: int, estimate: StateEstimate | None) -> LastReceived:
        """Time of the newest message of each source; the command's age at the run is added to the time since its arrival.

        Lateness of the run is not the agent's fault: the robot continues within its limits for as long as a run may be silent.
        """
        order, arrival_ns = self._order, min(self._order_heard_ns, now_ns)
        command_ns: int | None = None
        if order.command is not None:
            sent_ns = order.sent_ns if order.command_ns is None else order.command_ns
            age_ns = max(0, order.sent_ns - sent_ns) + now_ns - arrival_ns
            own_ns = order.sent_ns - sent_ns if order.command_age_ns is None else order.command_age_ns
            late_ns = max(0, age_ns - max(0, own_ns))
            self._late_s = late_ns / SECOND_NS
            command_ns = now_ns - age_ns + min(late_ns, round((self._mission.safety.federation_s or 0.0) * SECOND_NS))
        measured_ns = None if estimate is None else estimate.measured_ns
        return LastReceived(
            operator_ns=self._operator_ns and min(self._operator_ns, now_ns),
            command_ns=command_ns,
            positioning_ns=measured_ns,
            federation_ns=arrival_ns if order.number else None,
        )

    def _stop(self, cause: str) -> None:
        """Zero speed; each cause is reported once, also if the driver reports it too. Before the first motion nothing stops."""
        if not self._stands or self.halted:
            self._driver.stop(cause)
            self._stands = self._released = True
            self._notices += [each for each in self._driver.notices() if (each.what, each.cause) != ("stopped", cause)]
        if self._released:
            self._note("stopped", cause)

    def _note(self, what: Literal["stopped", "warned"], cause: str) -> None:
        self._notices.append(Notice(time_ns=self._now(), what=what, cause=cause))

    def _gathered(self) -> Iterable[Notice]:
        localisation = self._localisation
        return [*self._driver.notices(), *(localisation.notices() if localisation is not None else ())]

    def _words(self, cause: Cause) -> str:
        safety = self._mission.safety
        match cause:
            case Cause.OPERATOR:
                return f"no message of the operator for {safety.operator_s:g} s"
            case Cause.COMMAND if self._order.command is None:
                return "no command yet"
            case Cause.COMMAND:
                late = f": the run is late by {self._late_s:.2f} s" if self._late_s > RUN_LATE_S else ""
                return f"no command for {safety.command_s:g} s{late}"
            case Cause.POSITIONING:
                limit = f" (time-out {safety.positioning_s:g} s)" if safety.positioning_s else ""
                return f"its position is unknown: no positions or odometry{limit}"
            case Cause.FEDERATION:
                return f"no message of the run for {safety.federation_s:g} s"
            case Cause.CLOCK:
                return "the station was delayed, or its clock jumped"
            case Cause.NOT_FINITE:
                return "a command or a position of another vehicle is not a number"
            case _:
                return cause.value

    def _report(self, now_ns: int, estimate: StateEstimate | None) -> StationReport:
        order, sample = self._order, self._sample
        del self._notices[:-KEPT], self._fixes[:-KEPT]
        report = StationReport(
            number=self._turns,
            time_ns=now_ns,
            order=order.number,
            fixes=tuple(self._fixes),
            gated=self._estimator.gated,
            sonar=tuple(sorted(self._sonar.items())),
            notices=tuple(self._notices),
        )
        if estimate is not None:
            report = msgspec.structs.replace(
                report, state=estimate.state, covariance=estimate.covariance, fix_age_s=estimate.fix_age_s
            )
        if sample is None:
            return report
        return msgspec.structs.replace(
            report,
            odometry=sample.odometry if _finite(sample.odometry) else None,
            sample=sample.number,
            measured_ns=sample.measured_ns,
            link=sample.link,
            battery_v=sample.battery_v,
            bumpers=sample.bumpers,
        )


def _finite(value: VehicleState | Odometry) -> bool:
    return bool(np.isfinite(np.hstack(msgspec.structs.astuple(value))).all())
