"""Turns of a station with a simulated robot on a manual clock: stops, state estimation and reports."""

import math
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest

from tests.support.hardware.stations import mission
from vcmvsp.cosim.frames import quaternion_from_yaw, yaw_of
from vcmvsp.cosim.types import ORIGIN, Array, Fix, Odometry, Vec3, VehicleState, Velocity
from vcmvsp.hardware.drivers.base import Notice, Sample
from vcmvsp.hardware.drivers.bench_robot import Bench
from vcmvsp.hardware.station.controller import StationController, others_at
from vcmvsp.hardware.station.messages import PartSpec, StationMission, StationOrder, StationReport

MS = 1_000_000
TURN_MS = 20
SQUARE = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))
TAG = PartSpec(group="localisation", kind="a test's", params={})


class ScriptedDriver:
    """Driver with samples set by a test."""

    def __init__(self) -> None:
        self.next: Sample | None = None
        self.sent: list[Velocity] = []
        self.stops: list[str] = []

    def open(self, start: Vec3 = ORIGIN) -> None: ...

    def read(self) -> Sample | None:
        sample, self.next = self.next, None
        return sample

    def write(self, velocity: Velocity) -> None:
        self.sent.append(velocity)

    def stop(self, cause: str) -> None:
        self.stops.append(cause)

    def notices(self) -> list[Notice]:
        return []


class Tag:
    """Positioning system with fixes set by a test."""

    def __init__(self) -> None:
        self.fixes: list[Fix] = []

    def read(self, now_ns: int) -> list[Fix]:
        fixes, self.fixes = self.fixes, []
        return fixes

    def notices(self) -> list[Notice]:
        return []


class Station:
    """A station on a manual clock, and a run that sends it orders every 100 ms."""

    def __init__(self, station_mission: StationMission, driver: Any = None, tag: Any = None) -> None:
        self.ns = 7_000_000_000
        self.driver: Any = driver or Bench(now=self.now, latency_s=0.02, accel=2.0, decel=2.0)
        self.driver.open(station_mission.start)
        self.onboard = StationController(station_mission, self.driver, tag, self.now)
        self.reports: list[StationReport] = []
        self._orders = 0
        self.climb = 0.0

    def now(self) -> int:
        return self.ns

    def drive(
        self,
        seconds: float,
        v: float | None = None,
        w: float = 0.0,
        *,
        others: Array | None = None,
        stop: str = "",
        each: Callable[[], None] = lambda: None,
    ) -> Any:
        """Advances by ``seconds``; the run is silent if v is None."""
        for turn in range(round(1000 * seconds / TURN_MS)):
            self.ns += TURN_MS * MS
            each()
            order = None
            if v is not None and turn % 5 == 0:
                self._orders += 1
                command = Velocity(linear=(v, 0.0, self.climb), yaw_rate=w)
                order = StationOrder(
                    number=self._orders,
                    sent_ns=5 * self.ns,  # the run's clock differs
                    command=command,
                    command_ns=5 * self.ns,
                    others=others,
                    stop=stop,
                )
            self.reports.append(self.onboard.turn(self.ns, order))
            self.onboard.delivered()
        return self.reports[-1]

    @property
    def notices(self) -> list[tuple[str, str]]:
        return [(each.what, each.cause) for report in self.reports for each in report.notices]

    @property
    def stops(self) -> list[str]:
        return [cause for kind, cause in self.notices if kind == "stopped"]


def test_a_robot_follows_commands_and_the_station_reports_its_pose() -> None:
    station = Station(mission())
    report = station.drive(3.0, v=0.3, w=0.4)
    assert report.state.position[:2] == pytest.approx(station.driver.pose[:2], abs=0.002)
    assert report.state.yaw == pytest.approx(station.driver.pose[2], abs=0.002)
    v, yaw = 0.3, report.state.yaw
    assert report.state.velocity == pytest.approx((v * math.cos(yaw), v * math.sin(yaw), 0.0), abs=1e-9)
    assert report.causes == ()
    assert station.stops == []  # no stop before the first order


def test_others_keep_their_distance() -> None:
    station = Station(mission(separation_m=0.3))
    rows = np.array([[1.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.25]])
    report = station.drive(8.0, v=0.5, others=rows)
    assert "separation" in report.causes
    assert station.driver.pose[0] <= 1.5 - 0.25 - 0.3 - 0.2 + 1e-6


def test_others_move_between_orders_for_a_second() -> None:
    rows = np.array([[1.0, 2.0, 3.0, 0.5, 0.0, -0.5, 0.25]])
    assert others_at(rows, 0.4).position.tolist() == [pytest.approx([1.2, 2.0, 2.8])]
    assert others_at(rows, 9.0).position.tolist() == [pytest.approx([1.5, 2.0, 2.5])]
    assert len(others_at(None, 0.0).position) == 0


def test_silence_of_the_run_stops_the_robot_until_its_return() -> None:
    station = Station(mission(federation_s=0.5, command_s=None))
    station.drive(1.0, v=0.4)
    before_ns = station.ns
    station.drive(2.0)
    stopped = next(each for each in station.reports if "federation" in each.causes)
    assert stopped.sent == Velocity()
    assert stopped.time_ns - before_ns <= 500 * MS + TURN_MS * MS
    assert station.driver.pose[0] < 0.4 * 1.0 + 0.4 * 0.52 + 0.4**2 / 4.0 + 0.02
    assert station.drive(1.0, v=0.4).causes == ()
    assert station.stops == ["no message of the run for 0.5 s"]


@pytest.mark.parametrize(
    ("pace", "cause"),  # run time per wall time, in the agent's command age
    [(None, "no command for 0.5 s"), (0.5, "no command for 0.5 s: the run is late by 0.51 s")],
)
def test_an_old_command_stops_the_robot_until_a_new_one(pace: float | None, cause: str) -> None:
    """Orders arrive, but their command gets old."""
    station = Station(mission(command_s=0.5, federation_s=0.5))
    station.drive(1.0, v=0.4)
    given_ns = 5 * station.ns
    for number in range(60):
        station.ns += TURN_MS * MS
        age_ns = (number + 1) * TURN_MS * MS
        order = StationOrder(
            number=1000 + number,
            sent_ns=given_ns + age_ns,
            command=Velocity(linear=(0.4, 0.0, 0.0)),
            command_ns=given_ns,
            command_age_ns=None if pace is None else round(pace * age_ns),
        )
        station.reports.append(station.onboard.turn(station.ns, order))
        station.onboard.delivered()
    assert station.reports[-1].causes == ("command",)
    assert station.stops == [cause]
    assert station.drive(1.0, v=0.4).causes == ()


@pytest.mark.parametrize("late_ms", [300, 400])
def test_one_late_tick_of_the_run_stops_no_robot(late_ms: int) -> None:
    station = Station(mission(command_s=0.5, federation_s=0.5))
    station.drive(1.0, v=0.4)
    given_ns = 5 * station.ns

    def order(number: int, age_ms: int, in_run_ms: int) -> StationOrder:
        command = Velocity(linear=(0.4, 0.0, 0.0))
        sent_ns, own_ns = given_ns + age_ms * MS, in_run_ms * MS
        return StationOrder(number=number, sent_ns=sent_ns, command=command, command_ns=given_ns, command_age_ns=own_ns)

    station.ns += TURN_MS * MS
    station.reports.append(station.onboard.turn(station.ns, order(1000, 200, 200)))  # a slow agent
    station.drive(late_ms / 1000)  # no message of the run
    station.ns += TURN_MS * MS
    station.reports.append(station.onboard.turn(station.ns, order(1001, 220 + late_ms, 220)))  # the agent is not late
    assert station.stops == []
    assert station.driver.pose[0] > 0.4 * (1.0 + late_ms / 1000) - 0.2


@pytest.mark.parametrize("operator", [0.5, None])
def test_silence_of_the_operator_stops_it_for_good(operator: float | None) -> None:
    station = Station(mission(operator_s=operator))
    report = station.drive(1.0, v=0.4)
    assert report.causes == (("operator",) if operator else ())
    if operator:
        assert station.drive(1.0, v=0.4, each=station.onboard.operator_heard).causes == ()
        station.drive(1.0, v=0.4)
        assert station.drive(1.0, v=0.4, each=station.onboard.operator_heard).causes == ("operator",)
        assert station.stops == ["no message of the operator for 0.5 s"]


def test_the_first_halt_counts_and_stays() -> None:
    station = Station(mission())
    station.drive(1.0, v=0.4)
    station.onboard.halt("operator's stop")
    station.onboard.halt("something later")
    report = station.drive(1.0, v=0.4, stop="later still")
    assert report.causes == ("operator's stop",)
    assert report.sent == Velocity()
    assert station.stops == ["operator's stop"]
    assert station.onboard.stands


def test_a_non_finite_number_stops_it_briefly() -> None:
    station = Station(mission())
    station.drive(1.0, v=0.4)
    assert station.drive(0.5, v=math.nan).causes == ("not_finite",)
    rows = np.array([[math.inf, 0.0, 0.0, 0.0, 0.0, 0.0, 0.25]])
    assert station.drive(0.5, v=0.4, others=rows).causes == ("not_finite",)
    assert station.drive(0.5, v=0.4).causes == ()


def test_a_delayed_station_stops_its_robot_first() -> None:
    station = Station(mission())
    station.drive(1.0, v=0.4)
    station.ns += 2_000 * MS
    assert "clock" in station.drive(0.02, v=0.4).causes
    assert station.drive(0.5, v=0.4).causes == ()
    assert station.stops.count("the station was delayed, or its clock jumped") == 1


def test_rows_of_others_must_be_rows() -> None:
    with pytest.raises(ValueError, match="rows of 7 numbers"):
        Station(mission()).drive(0.1, v=0.0, others=np.zeros((2, 3)))


def test_undelivered_notices_are_repeated() -> None:
    station = Station(mission())
    station.drive(1.0, v=0.4)
    station.onboard.halt("enough")
    for _ in range(3):
        station.ns += TURN_MS * MS
        report = station.onboard.turn(station.ns)
        assert ("stopped", "enough") in [(each.what, each.cause) for each in report.notices]
    station.onboard.delivered()
    assert station.onboard.turn(station.ns).notices == ()


# Robots with and without a state of their own


def sample(
    number: int, ns: int, *, pose: Vec3 = ORIGIN, state: VehicleState | None = None, link: int = 1, v: float = 0.0
) -> Sample:
    return Sample(
        number=number, link=link, arrived_ns=ns, measured_ns=ns, odometry=Odometry(pose=pose, v=v, w=0.0), state=state
    )


def test_a_state_of_the_robot_is_extrapolated_until_too_old() -> None:
    driver = ScriptedDriver()
    station = Station(msgspec.structs.replace(mission(positioning_s=1.0), flies=True), driver)
    assert station.drive(0.1, v=0.0).causes[:1] == ("positioning",)
    attitude = quaternion_from_yaw(0.3)
    state = VehicleState(
        position=(1.0, 2.0, 3.0), velocity=(0.5, 0.0, -0.5), attitude=attitude, angular_velocity=(0.0, 0.0, 0.8)
    )
    driver.next = sample(1, station.ns, state=state)
    report = station.drive(0.2, v=0.1)
    assert report.state.position == pytest.approx((1.1, 2.0, 2.9))
    assert yaw_of(report.state.attitude) == pytest.approx(0.3 + 0.16)
    assert driver.sent[-1].linear[0] == pytest.approx(0.1)
    later = station.drive(0.5, v=0.1).state
    assert later.velocity == (0.0, 0.0, 0.0)  # extrapolation ends
    assert station.drive(0.5, v=0.1).causes == ("positioning",)


def test_flight_stays_below_the_ceiling() -> None:
    driver = ScriptedDriver()
    station = Station(msgspec.structs.replace(mission(ceiling_m=3.0, max_climb=0.7, decel=1.0), flies=True), driver)
    height, climbs = 1.0, list[float]()

    def flown() -> None:
        nonlocal height
        vz = driver.sent[-1].linear[2] if driver.sent else 0.0
        height += vz * TURN_MS / 1000
        climbs.append(vz)
        driver.next = sample(1, station.ns, state=VehicleState(position=(0.0, 0.0, height), velocity=(0.0, 0.0, vz)))

    station.climb = 5.0
    report = station.drive(8.0, v=0.0, each=flown)
    assert max(climbs) == pytest.approx(0.7)
    assert 2.9 < height <= 3.0 + 1e-6
    assert "geofence" in report.causes


@pytest.mark.parametrize("tag", [None, Tag()])
def test_a_non_finite_pose_stops_the_robot_at_once(tag: Tag | None) -> None:
    driver = ScriptedDriver()
    station = Station(msgspec.structs.replace(mission(), localisation=TAG if tag else None), driver, tag)

    def told(x: float) -> Callable[[], None]:
        def tell() -> None:
            driver.next = sample(1, station.ns, pose=(x, 0.0, 0.0))
            if tag:
                tag.fixes = [Fix(time_ns=station.ns, position=(0.0, 0.0, 0.0), sigma_m=0.1)]

        return tell

    assert station.drive(0.4, v=0.1, each=told(0.0)).causes == ()
    report = station.drive(0.02, v=0.1, each=told(math.nan))
    assert report.causes == ("positioning",)
    assert (report.state, report.odometry) == (None, None)  # non-finite values are not reported
    assert station.drive(0.4, v=0.1, each=told(0.0)).causes == ()


# Positions without heading


class TaggedRobot:
    """A simulated robot with a tag of 5 Hz."""

    def __init__(self, *, sigma_m: float = 0.05, offset: tuple[float, float] = (0.0, 0.0), **changed: Any) -> None:
        self.tag, self.offset, self.sigma_m = Tag(), offset, sigma_m
        self.station = Station(msgspec.structs.replace(mission(**changed), localisation=TAG), None, self.tag)
        self.fixes, self._draws = True, np.random.default_rng(4)

    def each(self) -> None:
        if self.fixes and (self.station.ns // MS // TURN_MS) % 10 == 0:
            x, y, _ = self.station.driver.pose
            dx, dy = self._draws.normal(0.0, self.sigma_m, 2).tolist()
            place = (x + dx + self.offset[0], y + dy + self.offset[1], 0.0)
            self.tag.fixes.append(Fix(time_ns=self.station.ns, position=place, sigma_m=self.sigma_m))

    def drive(self, seconds: float, v: float, w: float = 0.0) -> Any:
        return self.station.drive(seconds, v, w, each=self.each)


def test_positions_and_odometry_are_fused() -> None:
    guided = TaggedRobot()
    report = guided.drive(20.0, v=0.3, w=0.2)
    x, y, yaw = guided.station.driver.pose
    assert math.dist(report.state.position[:2], (x, y)) < 0.1
    assert math.remainder(report.state.yaw - yaw, math.tau) == pytest.approx(0.0, abs=0.1)
    assert math.sqrt(report.covariance[0, 0]) < 0.05
    assert report.fix_age_s <= 0.2
    fixes = [fix for each in guided.station.reports for fix in each.fixes]
    assert len(fixes) == 100


def test_without_positions_the_robot_stops_until_they_are_back() -> None:
    guided = TaggedRobot(positioning_s=1.0)
    guided.drive(2.0, v=0.3)
    guided.fixes = False
    assert guided.drive(1.5, v=0.3).causes == ("positioning",)
    assert guided.station.stops == ["its position is unknown: no positions or odometry (time-out 1 s)"]
    guided.fixes = True
    assert guided.drive(1.0, v=0.3).causes == ()


def test_far_wrong_positions_stop_the_robot_for_good() -> None:
    """Otherwise a robot far outside the fence would be considered inside."""
    guided = TaggedRobot()
    guided.drive(3.0, v=0.3)
    guided.offset = (5.0, 0.0)
    report = guided.drive(3.0, v=0.3)
    (cause,) = report.causes
    assert cause.startswith("its position jumped by 5.0 m")
    assert guided.station.stops == [cause]
    assert report.sent == Velocity()
    assert guided.station.driver.pose[0] < 3.0 * 0.3 + 2.0 * 0.3


def test_a_robot_off_its_command_is_stopped_until_a_zero_command() -> None:
    station = Station(mission())
    station.drive(1.0, v=0.4)
    pose, station.driver._most = station.driver.pose, (0.0, 0.0)
    assert "stuck" in station.drive(3.0, v=0.4).causes
    assert station.driver.pose == pytest.approx(pose, abs=0.2)
    station.driver._most = (1.0, 1.0)
    assert "stuck" in station.drive(1.0, v=0.4).causes
    station.drive(0.1, v=0.0)
    assert station.drive(1.0, v=0.4).causes == ()
    assert len(station.stops) == 1


def test_a_robot_blocked_from_the_start_reports_the_cause() -> None:
    station = Station(mission(operator_s=0.5))
    station.drive(1.0, v=0.0)
    station.drive(3.0, v=0.4)
    assert station.stops == ["no message of the operator for 0.5 s"]


def test_a_small_jump_of_positions_is_omitted_then_accepted_with_a_notice() -> None:
    guided = TaggedRobot()
    guided.drive(3.0, v=0.3)
    guided.offset = (0.9, 0.0)
    assert guided.drive(0.6, v=0.3).gated >= 2
    report = guided.drive(8.0, v=0.3)
    assert report.state.position[0] == pytest.approx(guided.station.driver.pose[0] + 0.9, abs=0.15)
    assert report.state.yaw == pytest.approx(0.0, abs=0.3)
    assert [kind for kind, cause in guided.station.notices if "jumped" in cause] == ["warned"]


def test_motion_during_a_loss_is_not_taken_for_standstill() -> None:
    driver, tag = ScriptedDriver(), Tag()
    station = Station(msgspec.structs.replace(mission(), localisation=TAG), driver, tag)

    def turn(x: float, link: int, fix: float | None = None) -> Any:
        def tell() -> None:
            driver.next = sample(1, station.ns, pose=(x, 0.0, 0.0), link=link)
            if fix is not None:
                tag.fixes = [Fix(time_ns=station.ns, position=(fix, 0.0, 0.0), sigma_m=0.05)]

        return station.drive(0.02, v=0.0, each=tell)

    for number in range(100):
        report = turn(0.01 * number, 1, fix=0.01 * number)
    before = math.sqrt(report.covariance[0, 0])
    station.drive(1.0, v=0.0)  # the link is lost, and the robot coasts on for 0.5 m
    report = turn(0.99, 2)
    assert math.sqrt(report.covariance[0, 0]) > 5.0 * before
    for _ in range(4):
        report = turn(0.99, 2, fix=1.5)
    assert report.gated == 0
    assert report.state.position[0] == pytest.approx(1.5, abs=0.05)


def test_positions_alone_do_not_let_a_silent_robot_drive() -> None:
    driver, tag = ScriptedDriver(), Tag()
    station = Station(msgspec.structs.replace(mission(positioning_s=1.0), localisation=TAG), driver, tag)
    driver.next = sample(1, station.ns)

    def fixed() -> None:
        tag.fixes = [Fix(time_ns=station.ns, position=(0.0, 0.0, 0.0), sigma_m=0.05)]

    assert station.drive(0.9, v=0.1, each=fixed).causes == ()
    assert station.drive(0.4, v=0.1, each=fixed).causes == ("positioning",)
