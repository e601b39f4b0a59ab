"""Wheel odometry: truth where nothing slips or errs, and the drift that each error means."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.physics.sensor_scenes import readings, scene_of
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.frames import arc
from vcmvsp.physics.sensors.motion import WheelOdometry
from vcmvsp.physics.world.world import Scene

R, B = 0.05, 0.25
Pose = tuple[float, float, float]


def driven(speeds: list[tuple[float, float]], dt: float = 0.1, start: Pose = (1.0, 2.0, 0.5)) -> tuple[list[Scene], list[Pose]]:
    """Scenes of a robot that keeps each (v m/s, w rad/s) for dt without slip, and its true poses."""
    poses, left, right, scenes = [start], 3.0, -2.0, []
    for number in range(len(speeds) + 1):
        x, y, yaw = poses[-1]
        scenes.append(scene_of((x, y, 0.0), t=number * dt, yaw=yaw, wheels=(left, right)))
        if number < len(speeds):
            v, w = speeds[number]
            left, right = left + (v - 0.5 * B * w) * dt / R, right + (v + 0.5 * B * w) * dt / R
            poses.append(arc(poses[-1], v, w, dt))
    return scenes, poses


def odometer(**errors: float) -> WheelOdometry:
    return WheelOdometry(wheel_radius_m=R, track_m=B, **errors)  # type: ignore[arg-type]


@settings(max_examples=50)
@given(st.lists(st.tuples(st.floats(-1.0, 1.0), st.floats(-2.0, 2.0)), min_size=1, max_size=30))
def test_without_slip_and_errors_it_is_the_truth(speeds: list[tuple[float, float]]) -> None:
    scenes, poses = driven(speeds)
    said = readings(odometer(), scenes)
    for reading, pose, (v, w) in zip(said, poses, [(0.0, 0.0), *speeds], strict=True):
        assert reading.pose == pytest.approx(pose, abs=1e-9)
        assert (reading.v, reading.w) == pytest.approx((v, w), abs=1e-9)


def test_wheels_taken_for_one_per_cent_larger_make_the_way_one_per_cent_longer() -> None:
    scenes, _ = driven([(0.5, 0.0)] * 100, start=(0.0, 0.0, 0.0))
    last = readings(odometer(left_radius_error=0.01, right_radius_error=0.01), scenes)[-1]
    assert last.pose == pytest.approx((5.05, 0.0, 0.0))
    assert last.v == pytest.approx(0.505)


def test_one_wheel_taken_for_larger_makes_a_straight_way_a_circle() -> None:
    """The left way is 1 % longer than the right one: a right turn of radius b (2.01 / 2) / 0.01."""
    scenes, _ = driven([(0.5, 0.0)] * 100, start=(0.0, 0.0, 0.0))
    x, y, yaw = readings(odometer(left_radius_error=0.01), scenes)[-1].pose
    turned, radius = 0.01 * 5.0 / B, B * 1.005 / 0.01
    assert (x, y, yaw) == pytest.approx((radius * math.sin(turned), -radius * (1 - math.cos(turned)), -turned))


def test_a_wide_track_makes_turns_small() -> None:
    scenes, poses = driven([(0.0, 1.0)] * 100, start=(0.0, 0.0, 0.0))
    assert readings(odometer(track_error=0.01), scenes)[-1].pose[2] == pytest.approx(poses[-1][2] / 1.01)


def test_a_walk_grows_with_the_root_of_the_way() -> None:
    """Of s m: each wheel by walk sqrt(s), so the middle by walk sqrt(s / 2) and the yaw by walk sqrt(2 s) / track."""
    scenes, _ = driven([(0.5, 0.0)] * 40, start=(0.0, 0.0, 0.0))
    ends = np.array([readings(odometer(walk_m=0.002), scenes, f"car{n}/odo")[-1].pose for n in range(600)])
    assert ends[:, 0].std() == pytest.approx(0.002 * 1.0, rel=0.12)
    assert ends[:, 2].std() == pytest.approx(0.002 * 2.0 / B, rel=0.12)


def test_encoder_ticks_are_never_lost() -> None:
    scenes, poses = driven([(0.0333, 0.0)] * 300, start=(0.0, 0.0, 0.0))
    said = np.array([reading.pose[0] for reading in readings(odometer(ticks_per_turn=64), scenes)])
    assert np.abs(said - [pose[0] for pose in poses]).max() <= math.tau * R / 64
    assert np.unique(said.round(9)).size < 250


def test_slip_is_not_seen() -> None:
    scenes = [scene_of((0.0, 0.0, 0.0), t=t, wheels=(10.0 * t, 10.0 * t)) for t in (0.0, 1.0, 2.0)]
    assert readings(odometer(), scenes)[-1].pose == pytest.approx((1.0, 0.0, 0.0))


@pytest.mark.parametrize("sensor", [odometer(), WheelOdometry()])
def test_a_vehicle_without_wheels_is_refused_by_name(sensor: WheelOdometry) -> None:
    with pytest.raises(ScenarioError, match="car0 has no two driven wheels") as refused:
        readings(sensor, [scene_of()])
    assert refused.value.key == "vehicle.car0.sensors"
