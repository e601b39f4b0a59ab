"""Angles, arcs and quaternions against laws of composition and a second computation."""

import math

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from vcmvsp.cosim.frames import arc, product, quaternion_from_yaw, rotate2, wrap, yaw_of

pytestmark = pytest.mark.slow

ANGLES = st.floats(-100.0, 100.0)
SPEEDS = st.floats(-5.0, 5.0)
RATES = st.floats(-5.0, 5.0) | st.floats(-1e-6, 1e-6)
TIMES = st.floats(0.0, 10.0)
POSES = st.tuples(st.floats(-100.0, 100.0), st.floats(-100.0, 100.0), ANGLES)


@given(st.floats(-1e6, 1e6))
def test_wrapping_changes_by_whole_turns_only(angle: float) -> None:
    wrapped = wrap(angle)
    assert -math.pi <= wrapped < math.pi
    turns = (angle - wrapped) / math.tau
    assert turns == pytest.approx(round(turns), abs=1e-9)
    assert wrap(wrapped) == pytest.approx(wrapped, abs=1e-15)


@pytest.mark.parametrize(
    ("angle", "wrapped"),
    [(0.0, 0.0), (math.pi, -math.pi), (-math.pi, -math.pi), (1.5 * math.pi, -0.5 * math.pi), (math.tau, 0.0)],
)
def test_the_range_is_half_open(angle: float, wrapped: float) -> None:
    assert wrap(angle) == wrapped
    assert wrap(math.nextafter(-math.pi, -4.0)) < math.pi


@given(POSES, SPEEDS, RATES, TIMES, TIMES)
def test_two_arcs_in_a_row_are_one(pose: tuple[float, float, float], v: float, w: float, dt1: float, dt2: float) -> None:
    assert arc(arc(pose, v, w, dt1), v, w, dt2) == pytest.approx(arc(pose, v, w, dt1 + dt2), rel=1e-9, abs=1e-9)


@given(POSES, SPEEDS, RATES, TIMES)
def test_an_arc_driven_backwards_returns(pose: tuple[float, float, float], v: float, w: float, dt: float) -> None:
    assert arc(arc(pose, v, w, dt), -v, -w, dt) == pytest.approx(pose, rel=1e-9, abs=1e-9)


@given(POSES, SPEEDS, st.floats(0.01, 5.0) | st.floats(-5.0, -0.01), TIMES)
def test_an_arc_stays_on_its_circle(pose: tuple[float, float, float], v: float, w: float, dt: float) -> None:
    def centre(x: float, y: float, yaw: float) -> tuple[float, float]:
        return x - v / w * math.sin(yaw), y + v / w * math.cos(yaw)

    assert centre(*arc(pose, v, w, dt)) == pytest.approx(centre(*pose), rel=1e-9, abs=1e-9)


@given(POSES, SPEEDS, TIMES)
def test_without_turning_an_arc_is_a_line(pose: tuple[float, float, float], v: float, dt: float) -> None:
    x, y, yaw = pose
    assert arc(pose, v, 0.0, dt) == pytest.approx((x + v * dt * math.cos(yaw), y + v * dt * math.sin(yaw), yaw))


def test_a_circle_of_radius_two_ends_at_its_start() -> None:
    assert arc((1.0, 2.0, 0.0), 0.3, 0.15, math.tau / 0.15) == pytest.approx((1.0, 2.0, math.tau))
    assert arc((0.0, 0.0, 0.0), 0.3, 0.15, 0.5 * math.pi / 0.15) == pytest.approx((2.0, 2.0, 0.5 * math.pi))


@given(st.floats(-math.pi, math.pi))
def test_yaw_survives_the_quaternion(yaw: float) -> None:
    w, x, y, z = quaternion = quaternion_from_yaw(yaw)
    assert w * w + x * x + y * y + z * z == pytest.approx(1.0)
    assert wrap(yaw_of(quaternion) - yaw) == pytest.approx(0.0, abs=1e-12)


@given(ANGLES, st.floats(-1.4, 1.4), ANGLES)
def test_yaw_is_the_horizontal_direction_of_the_body_x_axis(yaw: float, pitch: float, roll: float) -> None:
    pitching = (math.cos(pitch / 2), 0.0, math.sin(pitch / 2), 0.0)
    rolling = (math.cos(roll / 2), math.sin(roll / 2), 0.0, 0.0)
    attitude = product(product(quaternion_from_yaw(yaw), pitching), rolling)
    w, x, y, z = attitude
    _, ahead, left, _ = product(product(attitude, (0.0, 1.0, 0.0, 0.0)), (w, -x, -y, -z))
    assume(math.hypot(ahead, left) > 1e-3)
    assert wrap(yaw_of(attitude) - math.atan2(left, ahead)) == pytest.approx(0.0, abs=1e-9)
    assert wrap(yaw_of(attitude) - yaw) == pytest.approx(0.0, abs=1e-9)


@given(st.floats(-10.0, 10.0), st.floats(-10.0, 10.0), ANGLES, ANGLES)
def test_turning_keeps_lengths_and_adds_up(x: float, y: float, a: float, b: float) -> None:
    turned = rotate2(x, y, a)
    assert math.hypot(*turned) == pytest.approx(math.hypot(x, y), abs=1e-12)
    assert rotate2(*turned, b) == pytest.approx(rotate2(x, y, a + b), abs=1e-12)


def test_turning_is_counter_clockwise() -> None:
    assert rotate2(1.0, 0.0, 0.5 * math.pi) == pytest.approx((0.0, 1.0))
    assert yaw_of(quaternion_from_yaw(0.5 * math.pi)) == pytest.approx(0.5 * math.pi)


def test_quaternions_have_hamiltons_product() -> None:
    """i j = k, j k = i, k i = j, all squares are -1; the first factor is the rotation applied last."""
    i, j, k = (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0)
    assert (product(i, j), product(j, k), product(k, i)) == (k, i, j)
    assert [product(each, each) for each in (i, j, k)] == [(-1.0, 0.0, 0.0, 0.0)] * 3
    assert product(j, i) == (0.0, 0.0, 0.0, -1.0)
    assert product(quaternion_from_yaw(0.3), quaternion_from_yaw(0.9)) == pytest.approx(quaternion_from_yaw(1.2))
