"""Sensors in whole runs of the physics, with and without bodies."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.federate import Event, Instants
from vcmvsp.physics.federate import BulletPhysics, KinematicPhysics, Physics
from vcmvsp.physics.sensors.detectors import Bumper
from vcmvsp.physics.sensors.motion import InertialUnit, WheelOdometry
from vcmvsp.physics.sensors.sensor import Noise, Sensor
from vcmvsp.physics.vehicles.models import P2DX
from vcmvsp.physics.vehicles.specification import VehicleSpec
from vcmvsp.physics.world.solids import Box
from vcmvsp.physics.world.world import World

MODEL = P2DX()
TURNS = [(0.0, "car", 0.5, 0.0), (3.0, "car", 0.3, 0.6), (6.0, "car", 0.0, 0.0), (8.0, "car", 0.5, -0.4)]
Play = Callable[..., list[list[Event]]]


def odometer(**errors: float) -> WheelOdometry:
    return WheelOdometry(wheel_radius_m=MODEL.wheel_radius_m, track_m=MODEL.track_m, **errors)  # type: ignore[arg-type]


def ran(play: Play, kind: type[Physics], sensors: dict[str, Sensor], **rest: Any) -> dict[str, dict[int, Any]]:
    """Values by key and time of delivery, of a car that starts at the origin."""
    spec = VehicleSpec(name="car", model=MODEL, position=(0.0, 0.0, 0.0), heading=0.3, sensors=sensors)
    physics = kind(world=rest.get("world", World()), vehicles=[spec])
    steps = play(physics, rest.get("commands", TURNS), rest.get("seconds", 10.0), [Instants(Ticks.rate(10.0))])
    values: dict[str, dict[int, Any]] = {}
    for event in (event for events in steps for event in events):
        values.setdefault(event.key, {})[event.time_ns] = event.value
    return values


def poses(values: dict[str, dict[int, Any]]) -> tuple[Any, Any]:
    """What the odometer says and what is true, (n, 3) x m, y m, yaw rad."""
    said = np.array([reading.pose for reading in values["car/odo"].values()])
    true = np.array([(*state.position[:2], state.yaw) for state in values["car/estimate"].values()])
    return said, true


def test_odometry_of_wheels_that_do_not_slip_is_the_truth(play: Play) -> None:
    said, true = poses(ran(play, KinematicPhysics, {"odo": odometer()}))
    assert len(said) == 101
    assert np.abs(said - true).max() < 1e-9


def test_odometry_of_a_body_on_a_good_floor_is_nearly_the_truth(play: Play) -> None:
    said, true = poses(ran(play, BulletPhysics, {"odo": odometer()}))
    assert np.hypot(*(said - true)[:, :2].T).max() < 0.01
    assert np.abs(said - true)[:, 2].max() < 0.005
    wrong, _ = poses(ran(play, BulletPhysics, {"odo": odometer(track_error=0.02)}))
    assert np.abs(wrong - true)[:, 2].max() > 0.02


def test_a_bumper_says_when_the_car_has_reached_the_wall(play: Play) -> None:
    wall = World(solids=(Box(center=(2.0, 0.6, 0.5), size=(0.2, 6.0, 1.0), yaw_rad=0.3),))
    values = ran(play, BulletPhysics, {"bump": Bumper()}, world=wall, commands=[(0.0, "car", 0.5, 0.0)])
    (hit_ns,) = values["world/contact"]
    pressed = [time_ns for time_ns, reading in values["car/bump"].items() if reading.values["front"]]
    assert pressed[0] == hit_ns
    assert not any(reading.values["back"] + reading.values["left"] for reading in values["car/bump"].values())


@pytest.mark.parametrize("kind", [KinematicPhysics, BulletPhysics])
def test_an_inertial_unit_feels_the_floor_push_and_the_turn(play: Play, kind: type[Physics]) -> None:
    exact = InertialUnit(
        rate_hz=120.0, accelerometer_density=0.0, accelerometer=Noise(), gyroscope_density=0.0, gyroscope=Noise()
    )
    readings = ran(play, kind, {"imu": exact})["car/imu"]
    times = np.array(list(readings)) * 1e-9
    force = np.array([reading.acceleration for reading in readings.values()])
    turn = np.array([reading.angular_velocity for reading in readings.values()])
    circling, standing = (times > 4.5) & (times < 6.0), (times > 7.5) & (times < 8.0)
    assert force[circling].mean(axis=0) == pytest.approx((0.0, 0.3 * 0.6, 9.81), abs=0.02)  # v w to the left
    assert turn[circling].mean(axis=0) == pytest.approx((0.0, 0.0, 0.6), abs=0.005)
    assert force[standing].mean(axis=0) == pytest.approx((0.0, 0.0, 9.81), abs=0.02)
