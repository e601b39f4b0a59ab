"""NED and FRD against ENU and FLU, as laws, and against rotation matrices multiplied out by SciPy."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vcmvsp.cosim.frames import quaternion_from_yaw, wrap, yaw_of
from vcmvsp.cosim.types import Array, VehicleState, Velocity
from vcmvsp.hardware.drivers.mavlink.codec import Sender, mavlink
from vcmvsp.hardware.drivers.mavlink.command_schedule import setpoint
from vcmvsp.hardware.drivers.mavlink.coordinate_frames import (
    attitude_from_euler,
    body_flipped,
    euler_from_attitude,
    world_flipped,
    yaw_flipped,
)
from vcmvsp.hardware.emulators.mavlink.motion import GRAVITY, VehicleMotion

ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FRD_FROM_FLU = np.diag([1.0, -1.0, -1.0])

angle = st.floats(-math.pi, math.pi)
tilt = st.floats(-1.5, 1.5)
vector = st.tuples(*[st.floats(-1e6, 1e6)] * 3)


def matrix(q: tuple[float, float, float, float]) -> Array:
    result: Array = Rotation.from_quat(q, scalar_first=True).as_matrix()
    return result


@given(vector)
def test_vectors_come_back_and_match_the_matrices(v: tuple[float, float, float]) -> None:
    assert world_flipped(world_flipped(v)) == v
    assert body_flipped(body_flipped(v)) == v
    np.testing.assert_array_equal(world_flipped(v), ENU_FROM_NED @ v)
    np.testing.assert_array_equal(body_flipped(v), FRD_FROM_FLU @ v)


@given(angle, tilt, angle)
def test_an_attitude_is_the_product_of_the_matrices(roll: float, pitch: float, yaw: float) -> None:
    ned_from_frd = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    expected = ENU_FROM_NED @ ned_from_frd @ FRD_FROM_FLU
    np.testing.assert_allclose(matrix(attitude_from_euler(roll, pitch, yaw)), expected, atol=1e-12)


@given(angle, tilt, angle)
def test_an_attitude_comes_back(roll: float, pitch: float, yaw: float) -> None:
    back = euler_from_attitude(attitude_from_euler(roll, pitch, yaw))
    for told, meant in zip(back, (roll, pitch, yaw), strict=True):
        assert abs(wrap(told - meant)) < 1e-7


@given(angle)
def test_yaw_is_counter_clockwise_from_east(yaw: float) -> None:
    assert abs(wrap(yaw_flipped(yaw_flipped(yaw)) - yaw)) < 1e-12
    assert abs(wrap(yaw_of(attitude_from_euler(0.0, 0.0, yaw_flipped(yaw))) - yaw)) < 1e-9


@pytest.mark.parametrize(("enu_deg", "ned_deg"), [(0.0, 90.0), (90.0, 0.0), (180.0, -90.0), (-90.0, 180.0)])
def test_east_is_90_degrees_of_a_compass(enu_deg: float, ned_deg: float) -> None:
    assert abs(wrap(yaw_flipped(math.radians(enu_deg)) - math.radians(ned_deg))) < 1e-12


@given(angle, tilt, angle)
def test_gravity_points_down_in_both(roll: float, pitch: float, yaw: float) -> None:
    down_frd = Rotation.from_euler("ZYX", [yaw, pitch, roll]).inv().apply([0.0, 0.0, 1.0])  # NED
    down_flu = matrix(attitude_from_euler(roll, pitch, yaw)).T @ [0.0, 0.0, -1.0]  # ENU
    np.testing.assert_allclose(body_flipped(tuple(down_frd)), down_flu, atol=1e-12)


def test_nose_up_and_right_side_down_have_the_signs_of_aviation() -> None:
    nose_up = matrix(attitude_from_euler(0.0, 0.1, 0.5 * math.pi))
    assert nose_up[2, 0] == pytest.approx(math.sin(0.1))  # the x axis rises
    right_down = matrix(attitude_from_euler(0.1, 0.0, 0.5 * math.pi))
    assert right_down[2, 1] == pytest.approx(math.sin(0.1))  # the y axis, to the left, rises


def test_a_set_point_east_up_and_counter_clockwise() -> None:
    to = Sender(system=1, component=1)
    sent = setpoint(to, 0, (1.0, 2.0, 3.0), 0.5, on_ground=False)
    assert (sent.vx, sent.vy, sent.vz, sent.yaw_rate) == (2.0, 1.0, -3.0, -0.5)
    assert sent.coordinate_frame == mavlink.MAV_FRAME_LOCAL_NED
    ignored = {
        mavlink.POSITION_TARGET_TYPEMASK_X_IGNORE,
        mavlink.POSITION_TARGET_TYPEMASK_Y_IGNORE,
        mavlink.POSITION_TARGET_TYPEMASK_Z_IGNORE,
        mavlink.POSITION_TARGET_TYPEMASK_AX_IGNORE,
        mavlink.POSITION_TARGET_TYPEMASK_AY_IGNORE,
        mavlink.POSITION_TARGET_TYPEMASK_AZ_IGNORE,
        mavlink.POSITION_TARGET_TYPEMASK_YAW_IGNORE,
    }
    assert sent.type_mask == sum(ignored)
    rover = setpoint(to, 0, (1.0, 2.0, 3.0), 0.5, on_ground=True)
    assert (rover.vx, rover.vy, rover.vz, rover.yaw_rate) == (1.0, 0.0, 0.0, -0.5)
    assert rover.coordinate_frame == mavlink.MAV_FRAME_BODY_NED


@given(st.tuples(*[st.floats(-3.0, 3.0)] * 3), angle)
def test_the_emulated_quadrotor_leans_along_its_thrust(linear: tuple[float, float, float], yaw: float) -> None:
    start = VehicleState(position=(0.0, 0.0, 10.0), attitude=quaternion_from_yaw(yaw))
    state = VehicleMotion(start, on_ground=False).step(Velocity(linear=linear), 0.005, 0.0)
    thrust = np.array(state.velocity) / 0.005 + [0.0, 0.0, GRAVITY]
    np.testing.assert_allclose(matrix(state.attitude)[:, 2], thrust / np.linalg.norm(thrust), atol=1e-9)
    assert abs(wrap(euler_from_attitude(state.attitude)[2] - yaw_flipped(yaw))) < 1e-9
