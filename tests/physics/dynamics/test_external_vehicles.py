"""External vehicles: published exactly as their source states, requested once per instant, unaffected by contacts."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.physics.engines import KINDS
from tests.support.physics.external_vehicles import Boat, Courses, spec, straight
from tests.support.physics.runs import run, values
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import FederateError, ScenarioError
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.frames import quaternion_from_yaw, wrap
from vcmvsp.cosim.types import ORIGIN, Later, VehicleState, Velocity, Waypoint
from vcmvsp.physics.dynamics.kinematic import ExternalEngine
from vcmvsp.physics.federate import BulletPhysics, KinematicPhysics, Physics
from vcmvsp.physics.sensors.detectors import NeighbourRange
from vcmvsp.physics.sensors.motion import InertialUnit, WheelOdometry
from vcmvsp.physics.sensors.positioning import Positioning
from vcmvsp.physics.sensors.range_scanner import RangeScanner
from vcmvsp.physics.vehicles.models import P2DX
from vcmvsp.physics.world.solids import Box
from vcmvsp.physics.world.world import World, rotations

HALF = 0.5 * P2DX().length_m


def circle_course(t: float) -> VehicleState:
    """Circle of 1 m around (4, 0) at 1 rad/s."""
    at = (4.0 + math.cos(t), math.sin(t), 0.0)
    speed = (-math.sin(t), math.cos(t), 0.0)
    attitude = quaternion_from_yaw(wrap(t + math.pi / 2))
    return VehicleState(position=at, velocity=speed, attitude=attitude, angular_velocity=(0.0, 0.0, 1.0))


@KINDS
def test_rows_equal_the_source_at_one_request_per_instant(kind: type[Physics]) -> None:
    courses = Courses(real=circle_course, other=straight(-3.0, 0.2))
    sensors = {"near": NeighbourRange(rate_hz=4.0)}
    vehicles = [spec("car"), spec("real", 5.0), spec("late", 0.0, 3.0, sensors=sensors), spec("other", -3.0)]
    events = run(kind(world=World(), vehicles=vehicles, outside=courses), [(0.25, "car", 0.3, 0.1), (0.55, "late", 0.1, 0.0)])
    states = [event for event in events if event.key == "world/states"]
    assert courses.call_times_ns == sorted({event.time_ns for event in events})
    assert {event.time_ns for event in states} < set(courses.call_times_ns)  # also at sensor instants
    for event in states:
        value: Any = event.value
        assert value.names == ("car", "real", "late", "other")
        expected = [circle_course(event.time_ns / 1e9), straight(-3.0, 0.2)(event.time_ns / 1e9)]
        for name in ("position", "velocity", "attitude", "angular_velocity"):
            assert getattr(value, name)[[1, 3]].tolist() == [list(getattr(each, name)) for each in expected]


@KINDS
def test_nothing_is_published_and_commands_are_ignored(kind: type[Physics]) -> None:
    real = spec("real", 3.0, positioning=Positioning(), pose_source="positioning")
    physics = kind(world=World(), vehicles=[spec("car"), real], outside=Courses(real=straight(3.0)))
    commands = [
        Event("real/command", 0, Velocity(linear=(math.nan, 0.0, 0.0))),
        Event("real/command", 10**8, Waypoint(position=(0.0, 0.0, 1.0))),
        Event("real/command", 2 * 10**8, Velocity(linear=(1.0, 0.0, 0.0))),
    ]
    events = run(physics, commands, 1.0)
    assert {event.key for event in events} == {"world/states", "car/estimate", "car/odometry"}
    assert values(events, "world/states")[-1].position[1].tolist() == [3.0, 0.0, 0.0]


@KINDS
@pytest.mark.parametrize("yaw", [0.0, 0.4])
def test_scanners_see_their_hulls_and_their_own_scanners_see_the_world(kind: type[Physics], yaw: float) -> None:
    eye = RangeScanner(beams=1, field_of_view=0.1, range_max=9.0, position=(0.0, 0.0, 0.1))
    world = World(solids=(Box(center=(9.0, 0.0, 1.0), size=(1.0, 9.0, 2.0)),))
    vehicles = [spec("car", sensors={"scan": eye}), spec("real", 3.0, sensors={"scan": eye})]
    physics = kind(world=world, vehicles=vehicles, outside=Courses(real=straight(3.0, 0.5, yaw=yaw)))
    events = run(physics, seconds=3.0)
    offset, length, width = -P2DX().axle_ahead_m, P2DX().length_m, P2DX().width_m
    # Rear face of the turned box where the x axis meets it, HALF behind the centre.
    assert abs((offset - HALF) * math.tan(yaw)) < 0.5 * width < length
    for event in events:
        if event.key.endswith("/scan"):
            later: Any = event.value
            reading: Any = later.get() if isinstance(later, Later) else later
            x = 3.0 + 0.5 * event.time_ns / SECOND_NS
            expected = x + (offset - HALF) / math.cos(yaw) if event.key == "car/scan" else (8.5 - x) / math.cos(yaw)
            settles_m = 2e-6 if kind is KinematicPhysics else 3e-4  # rolls of a simulated robot on its wheels
            assert reading.ranges[0] == pytest.approx(expected, abs=settles_m)


@KINDS
def test_its_imu_acceleration_is_the_change_of_its_speed(kind: type[Physics]) -> None:
    def faster(t: float) -> VehicleState:
        return VehicleState(position=(5.0 + t * t, 0.0, 0.0), velocity=(2.0 * t, 0.0, 0.0))

    imu = InertialUnit(rate_hz=10.0)
    events = run(kind(world=World(), vehicles=[spec("real", 5.0, sensors={"imu": imu})], outside=Courses(real=faster)))
    felt = np.array([reading.acceleration for reading in values(events, "real/imu")])[1:]
    assert felt.mean(axis=0) == pytest.approx((2.0, 0.0, 9.81), abs=0.1)


NUMBERS = st.floats(-3.0, 3.0)


@given(NUMBERS, NUMBERS, NUMBERS, NUMBERS, st.floats(-0.5, 0.5), st.floats(0.0, 1.0))
def test_extrapolation_is_straight_with_a_vertical_turn_axis(
    x: float, speed: float, yaw: float, turning: float, tilt: float, span_s: float
) -> None:
    c, s = math.cos(tilt / 2), math.sin(tilt / 2)
    w, _, _, z = quaternion_from_yaw(yaw)
    attitude = (w * c, w * s, z * s, z * c)  # yaw, then roll about the body's x axis
    spin = tuple((np.array(rotations(np.array([attitude]))[0]).T @ (0.0, 0.0, turning)).tolist())
    state = VehicleState(position=(x, 1.0, 2.0), velocity=(speed, 0.5, -0.1), attitude=attitude, angular_velocity=spin)
    reflected = ExternalEngine(Courses(real=lambda _: state), [spec("real", x)])
    reflected.update(SECOND_NS)
    after, yaw_rates = reflected.at(SECOND_NS + round(span_s * SECOND_NS))
    assert after.position[0] == pytest.approx((x + span_s * speed, 1.0 + 0.5 * span_s, 2.0 - 0.1 * span_s), abs=1e-8)
    assert yaw_rates[0] == pytest.approx(turning, abs=1e-9)
    before, now = rotations(np.array([attitude]))[0], rotations(after.attitude)[0]
    angle = span_s * turning
    turn = np.array([[math.cos(angle), -math.sin(angle), 0.0], [math.sin(angle), math.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    assert now == pytest.approx(turn @ before, abs=1e-8)
    assert reflected.at(SECOND_NS)[0].attitude[0].tolist() == list(attitude)


@KINDS
def test_unsupported_models_can_be_external(kind: type[Physics]) -> None:
    physics = kind(world=World(), vehicles=[spec("tug", 2.0, model=Boat())], outside=Courses(tug=straight(2.0)))
    assert values(run(physics), "world/states")[-1].position.tolist() == [[2.0, 0.0, 0.0]]


HERE = VehicleState(position=(0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("states", "words"),
    [
        ([VehicleState(position=(math.nan, 0.0, 0.0)), HERE], r"a at 0 s is not finite"),
        ([HERE, VehicleState(position=ORIGIN, attitude=(0.0,) * 4)], r"attitude .* b at 0 s is no unit quaternion"),
        ([HERE], "1 states for 2 external vehicles"),
    ],
)
def test_invalid_states_stop_the_run_and_name_the_vehicle(states: list[VehicleState], words: str) -> None:
    courses = Courses(a=straight(0.0), b=straight(2.0))
    courses.states = lambda now_ns: states  # type: ignore[method-assign]
    with pytest.raises(FederateError, match=words):
        run(KinematicPhysics(world=World(), vehicles=[spec("a"), spec("b", 2.0)], outside=courses))


def test_unknown_vehicles_and_another_order_are_refused() -> None:
    for courses in (Courses(ghost=straight(0.0)), Courses(b=straight(2.0), a=straight(0.0))):
        with pytest.raises(ValueError, match="in this order"):
            run(KinematicPhysics(world=World(), vehicles=[spec("a"), spec("b", 2.0)], outside=courses))


@KINDS
def test_wheel_odometry_is_refused_on_them(kind: type[Physics]) -> None:
    real = spec("real", sensors={"odo": WheelOdometry(wheel_radius_m=0.1, track_m=0.4)})
    with pytest.raises(ScenarioError, match="real is an external vehicle") as raised:
        run(kind(world=World(), vehicles=[real], outside=Courses(real=straight(0.0))))
    assert raised.value.key == "vehicle.real.sensors.odo"


def test_no_other_vehicle_may_start_at_their_place() -> None:
    with pytest.raises(ScenarioError, match="real and car overlap"):
        run(BulletPhysics(world=World(), vehicles=[spec("car"), spec("real", 0.3)], outside=Courses(real=straight(3.0))))
