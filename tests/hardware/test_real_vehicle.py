"""Real vehicle in a run: logical times, dead reckoning, events from reports."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.hardware.stations import FakeStation, real_vehicle
from vcmvsp.cosim.clock import SECOND_NS, WallClock
from vcmvsp.cosim.errors import FederateError
from vcmvsp.cosim.estimation.dead_reckoning import LONGEST_NS, ahead
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.frames import arc, quaternion_from_yaw, wrap
from vcmvsp.cosim.types import Fix, Measured, Odometry, RealStatus, VehicleState, Velocity, Waypoint
from vcmvsp.hardware.drivers.base import Notice
from vcmvsp.hardware.federate import VehicleProxy
from vcmvsp.hardware.station.messages import StationReport

START_NS = 1_000 * SECOND_NS  # monotonic clock at logical time 0
speeds = st.floats(-2.0, 2.0)


def connected_proxy(pose_source: str = "fusion", *, flies: bool = False) -> tuple[VehicleProxy, FakeStation]:
    """A proxy and its station at x = 1 m, facing north, at logical time 0."""
    clock = WallClock(now=lambda: START_NS)
    clock.start()
    vehicle = real_vehicle(pose_source=pose_source, start=(1.0, 0.0, math.pi / 2), flies=flies)
    made, station = VehicleProxy(vehicle, clock), FakeStation()
    made.station = station  # type: ignore[assignment]
    return made, station


def state(x: float, y: float, yaw: float, v: float = 0.0, w: float = 0.0) -> VehicleState:
    return VehicleState(
        position=(x, y, 0.0),
        velocity=(v * math.cos(yaw), v * math.sin(yaw), 0.0),
        attitude=quaternion_from_yaw(yaw),
        angular_velocity=(0.0, 0.0, w),
    )


def report(at_s: float, shown: VehicleState | None, **more: object) -> StationReport:
    return StationReport(number=1, time_ns=START_NS + round(at_s * SECOND_NS), state=shown, **more)  # type: ignore[arg-type]


def events(made: VehicleProxy, at_s: float) -> dict[str, list[Any]]:
    made.hear()
    found: dict[str, list[Any]] = {}
    for event in made.publish(round(at_s * SECOND_NS)):
        found.setdefault(event.key, []).append(event.value)
    return found


@given(st.floats(-math.pi, math.pi), speeds, speeds, st.floats(-0.4, 0.4))
def test_on_the_ground_dead_reckoning_is_close_to_a_circular_arc(yaw: float, v: float, w: float, dt: float) -> None:
    """Chord of exact direction with the arc's length: the error is at most (w dt)^2 / 24 of it."""
    later = ahead(state(1.0, 2.0, yaw, v, w), round(dt * SECOND_NS), flies=False)
    x, y, turned = arc((1.0, 2.0, yaw), v, w, round(dt * SECOND_NS) / SECOND_NS)
    assert math.dist(later.position[:2], (x, y)) <= abs(v * dt) * (w * dt) ** 2 / 24 + 1e-12
    assert wrap(later.yaw - turned) == pytest.approx(0.0, abs=1e-9)
    assert later.velocity[:2] == pytest.approx((v * math.cos(turned), v * math.sin(turned)), abs=1e-9)


@given(speeds, speeds, speeds, st.floats(-0.4, 0.4))
def test_in_the_air_it_goes_straight_on_while_it_turns(vx: float, vy: float, w: float, dt: float) -> None:
    flying = VehicleState(position=(0.0, 0.0, 5.0), velocity=(vx, vy, 1.0), angular_velocity=(0.0, 0.0, w))
    seconds = round(dt * SECOND_NS) / SECOND_NS
    later = ahead(flying, round(dt * SECOND_NS), flies=True)
    assert later.position == pytest.approx((vx * seconds, vy * seconds, 5.0 + seconds))
    assert later.velocity == flying.velocity
    assert later.yaw == pytest.approx(w * seconds)


def test_without_reports_for_long_it_stands() -> None:
    later = ahead(state(0.0, 0.0, 0.0, v=1.0, w=1.0), LONGEST_NS + 1, flies=False)
    assert later.velocity == (0.0, 0.0, 0.0)
    assert later.angular_velocity == (0.0, 0.0, 0.0)
    assert math.hypot(*later.position[:2]) == pytest.approx(0.5)


def test_before_any_report_it_stands_at_its_start() -> None:
    made, _ = connected_proxy()
    assert made.state(0).position == (1.0, 0.0, 0.0)
    assert made.state(0).yaw == pytest.approx(math.pi / 2)
    values = events(made, 0.0)
    assert [*values] == ["car1/estimate", "car1/real"]
    assert values["car1/real"][0] == RealStatus(link=0, age_s=None)


def test_each_instant_uses_the_report_before_it() -> None:
    """Also if the run is late and newer reports exist."""
    made, station = connected_proxy()
    station.saying = [report(t, state(10.0 * t, 0.0, 0.0, v=1.0)) for t in (0.0, 0.1, 0.2)]
    made.hear()
    for at_s, x in ((0.05, 0.05), (0.1, 1.0), (0.15, 1.05), (0.3, 2.1)):
        assert made.state(round(at_s * SECOND_NS)).position[0] == pytest.approx(x), at_s


def test_an_instant_keeps_its_state_after_new_reports() -> None:
    made, station = connected_proxy()
    station.saying = [report(0.0, state(0.0, 0.0, 0.0))]
    made.hear()
    first = made.state(SECOND_NS)
    station.saying = [report(0.9, state(9.0, 9.0, 0.0))]
    made.hear()
    assert made.state(SECOND_NS) is first


@pytest.mark.parametrize(("pose_source", "x"), [("fusion", 5.0), ("odometry", 7.0), ("truth", 5.0)])
def test_an_agent_gets_its_pose_source(pose_source: str, x: float) -> None:
    made, station = connected_proxy(pose_source)
    odometry = Odometry(pose=(7.0, 0.0, 0.0), v=0.0, w=0.0)
    station.saying = [report(0.0, state(5.0, 0.0, 0.0), odometry=odometry, measured_ns=START_NS, sample=1)]
    assert events(made, 0.0)["car1/estimate"][0].position[0] == x
    assert made.state(0).position[0] == 5.0  # the world uses the best estimate


def test_odometry_is_extrapolated_to_the_instant() -> None:
    made, station = connected_proxy()
    odometry = Odometry(pose=(0.0, 0.0, 0.0), v=1.0, w=0.0)
    station.saying = [report(0.2, state(0.0, 0.0, 0.0), odometry=odometry, measured_ns=START_NS + SECOND_NS // 10, sample=1)]
    assert events(made, 0.2)["car1/odometry"][0].pose[0] == pytest.approx(0.1)


def test_each_fix_comes_once_in_run_time_and_none_from_before() -> None:
    made, station = connected_proxy()
    fixes = [Fix(time_ns=START_NS + each, position=(0.0, 0.0, 0.0), sigma_m=0.1) for each in (-5, 7)]
    station.saying = [report(0.1, None, fixes=tuple(fixes))]
    assert [each.time_ns for each in events(made, 0.1)["car1/fix"]] == [7]
    assert "car1/fix" not in events(made, 0.2)


def test_each_instant_has_ranges_and_incidents_of_all_reports_since() -> None:
    made, station = connected_proxy()
    lost = Notice(time_ns=START_NS - SECOND_NS, what="lost", cause="the port has disappeared")
    station.saying = [
        report(0.02, None, sonar=((10, 1.0), (2, 2.0)), notices=(lost,)),
        report(0.04, None, sonar=((2, 2.5),), causes=("limits",)),
    ]
    values = events(made, 0.1)
    measured = values["car1/sonar"][0]
    assert isinstance(measured, Measured)
    assert list(measured.values.items()) == [("2", 2.5), ("10", 1.0)]
    assert values["car1/incident"][0].happened_ns == -SECOND_NS
    assert values["car1/real"][0].causes == ("limits",)


def test_uncertainty_is_that_along_the_worse_axis() -> None:
    made, station = connected_proxy()
    turn = np.array([[math.cos(0.3), -math.sin(0.3)], [math.sin(0.3), math.cos(0.3)]])
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = turn @ np.diag([0.01, 0.04]) @ turn.T
    station.saying = [report(0.0, state(0.0, 0.0, 0.0), covariance=covariance)]
    assert events(made, 0.0)["car1/real"][0].sigma_m == pytest.approx(0.2)


def test_the_prediction_error_is_the_distance_from_the_expected_place() -> None:
    made, station = connected_proxy()
    station.saying = [report(0.1, state(0.0, 0.0, 0.0, v=1.0))]
    events(made, 0.1)
    station.saying = [report(0.2, state(0.4, 0.0, 0.0, v=1.0))]
    assert events(made, 0.2)["car1/real"][0].prediction_m == pytest.approx(0.3)


def test_a_repeated_command_keeps_its_time() -> None:
    made, station = connected_proxy()
    made.order(None)
    made.command(Event("car1/command", SECOND_NS, Velocity(linear=(0.2, 0.0, 0.0))))
    made.order(None)
    made.order(None)
    first, *rest = station.orders
    assert (first.command, first.command_ns) == (None, None)
    assert [(each.command, each.command_ns) for each in rest] == [(Velocity(linear=(0.2, 0.0, 0.0)), START_NS + SECOND_NS)] * 2
    assert [each.number for each in station.orders] == [1, 2, 3]


def test_a_real_vehicle_takes_no_way_points() -> None:
    made, _ = connected_proxy(flies=True)
    with pytest.raises(FederateError, match="car1: received a Waypoint"):
        made.command(Event("car1/command", 0, Waypoint(position=(0.0, 0.0, 1.0))))
