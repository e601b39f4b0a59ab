"""Clocks, poses, pace and presence by themselves, without a network: laws."""

from math import cos, pi, sin

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.frames import quaternion_from_yaw, wrap
from cosim.types import Vec3
from hardware.ros2.messages import OdometryMessage
from hardware.ros2.pace import NOT_YET, ZERO_SPEEDS, Pace
from hardware.ros2.presence import Presence
from hardware.ros2.track import Pose, RobotClock, Track

MS, S = 10**6, 10**9
coordinates = st.floats(-50.0, 50.0)
angles = st.floats(-3.0, 3.0)
poses = st.tuples(coordinates, coordinates, angles)


def message(x: float, y: float, yaw: float, stamp_ns: int = 0, v: float = 0.0, w: float = 0.0) -> OdometryMessage:
    return OdometryMessage((x, y, 0.0), quaternion_from_yaw(yaw), (v, 0.0, 0.0), (0.0, 0.0, w), stamp_ns)


def track(start: Vec3 = (0.0, 0.0, 0.0), pose: Pose = "odometry", origin: Vec3 = (0.0, 0.0, 0.0)) -> Track:
    made = Track(start, pose, origin, 1000.0)
    made.connect(anew=True)
    return made


@given(poses, st.lists(poses, min_size=2, max_size=6))
def test_the_pose_is_the_start_pose_composed_with_what_odometry_moved(start: Vec3, told: list[Vec3]) -> None:
    """start o first^-1 o last, in homogeneous matrices by hand."""
    made = track(start)
    samples = [made.add(message(*each), number * S, "") for number, each in enumerate(told)]
    assert samples[0].odometry.pose == start
    (x0, y0, yaw0), (x1, y1, yaw1) = told[0], told[-1]
    forward = cos(yaw0) * (x1 - x0) + sin(yaw0) * (y1 - y0)
    left = -sin(yaw0) * (x1 - x0) + cos(yaw0) * (y1 - y0)
    x, y, yaw = samples[-1].odometry.pose
    assert x == pytest.approx(start[0] + cos(start[2]) * forward - sin(start[2]) * left, abs=1e-9)
    assert y == pytest.approx(start[1] + sin(start[2]) * forward + cos(start[2]) * left, abs=1e-9)
    assert abs(wrap(yaw - start[2] - (yaw1 - yaw0))) < 1e-9


def test_the_heading_goes_on_over_half_a_turn() -> None:
    made = track()
    yaws = [made.add(message(0.0, 0.0, wrap(0.5 * each)), each * S, "").odometry.pose[2] for each in range(30)]
    assert yaws == pytest.approx([0.5 * each for each in range(30)])


def test_a_leap_is_left_out_and_what_follows_counts() -> None:
    made = Track((0.0, 0.0, 0.0), "odometry", (0.0, 0.0, 0.0), 1.0)
    made.connect(anew=True)
    told = [made.add(message(x, 0.0, 0.0), number * S // 10, "") for number, x in enumerate((0.0, 0.1, -40.0, -39.9))]
    assert [each.odometry.pose[0] for each in told] == pytest.approx([0.0, 0.1, 0.1, 0.2])
    assert made.leaps == 1


def test_odometry_of_the_same_node_goes_on_over_a_loss_and_that_of_another_begins_anew() -> None:
    made = track()
    made.add(message(1.0, 0.0, 0.0), 0, "")
    made.connect(anew=False)
    assert made.add(message(3.0, 0.0, 0.0), S, "").odometry.pose == (2.0, 0.0, 0.0)
    made.connect(anew=True)
    sample = made.add(message(0.0, 0.0, 0.0), 2 * S, "")
    assert (sample.odometry.pose, sample.link, sample.number) == ((2.0, 0.0, 0.0), 3, 3)


@given(poses, poses, st.floats(-3.0, 3.0))
def test_in_the_world_the_state_is_the_frame_moved_by_its_origin(origin: Vec3, told: Vec3, v: float) -> None:
    sample = track((9.0, 9.0, 1.0), "world", origin).add(message(*told, v=v, w=0.3), 0, "")
    assert sample.state is not None
    heading = origin[2] + told[2]
    x = origin[0] + cos(origin[2]) * told[0] - sin(origin[2]) * told[1]
    y = origin[1] + sin(origin[2]) * told[0] + cos(origin[2]) * told[1]
    assert sample.state.position == pytest.approx((x, y, 0.0), abs=1e-9)
    assert abs(wrap(sample.state.yaw - heading)) < 1e-9
    assert sample.state.velocity == pytest.approx((v * cos(heading), v * sin(heading), 0.0), abs=1e-9)
    assert sample.state.angular_velocity == (0.0, 0.0, 0.3)
    assert sample.odometry.pose == (*sample.state.position[:2], sample.state.yaw)


def test_in_the_world_all_three_axes_are_kept() -> None:
    """Nose down by a quarter turn about y: the body's x axis points to -z."""
    pitched = OdometryMessage((1.0, 2.0, 3.0), (cos(pi / 4), 0.0, sin(pi / 4), 0.0), linear=(1.0, 0.0, 0.0))
    state = track(pose="world").add(pitched, 0, "").state
    assert state is not None
    assert state.position == (1.0, 2.0, 3.0)
    assert state.velocity == pytest.approx((0.0, 0.0, -1.0), abs=1e-12)


@given(st.integers(-(10**18), 10**18), st.lists(st.integers(0, 900 * MS), min_size=60, max_size=60))
def test_measuring_times_are_right_but_for_the_least_delay(ahead_ns: int, delays: list[int]) -> None:
    """Never after the arrival, never before the truth, and right by the least delay so far and what clocks may drift."""
    clock, epoch = RobotClock(), 10**18 + 1
    for number, delay in enumerate(delays):
        true_ns = epoch + number * S
        measured_ns = clock.measured_ns(true_ns + ahead_ns, true_ns + delay)
        assert true_ns <= measured_ns <= true_ns + delay
        assert measured_ns - true_ns <= min(delays[: number + 1]) + (number + 1) * MS // 2


def test_the_robots_clock_is_known_once_it_was_heard() -> None:
    clock = RobotClock()
    assert clock.stamp_ns(5 * S) == 0
    clock.measured_ns(1700 * S, 10 * S)
    assert clock.stamp_ns(12 * S) == 1702 * S


@pytest.mark.parametrize("by_ns", [-100 * MS, -3600 * S, 100 * MS, 3600 * S])
def test_a_clock_that_is_set_is_followed_at_once(by_ns: int) -> None:
    clock = RobotClock()
    for number in range(20):
        ahead_ns = 10_000 * S + (by_ns if number >= 10 else 0)
        measured_ns = clock.measured_ns(number * 50 * MS + ahead_ns, number * 50 * MS)
        assert abs(measured_ns - number * 50 * MS) <= MS


def test_a_clock_of_a_slow_simulation_is_never_more_than_a_second_off() -> None:
    clock = RobotClock()
    for number in range(1, 2000):
        arrived_ns = number * 50 * MS
        assert 0 <= arrived_ns - clock.measured_ns(arrived_ns // 2, arrived_ns) <= S


def test_messages_without_a_stamp_were_measured_when_they_came() -> None:
    clock = RobotClock()
    assert clock.measured_ns(0, 77) == 77
    assert clock.stamp_ns(78) == 0


def said(pace: Pace, now_ns: int) -> list[tuple[float, float]]:
    speeds = []
    while (each := pace.advance(now_ns)) is not None:
        speeds.append(each)
    return speeds


def test_zero_comes_first_then_the_newest_command_at_once_and_again_at_its_rate() -> None:
    pace = Pace(10.0, 0.5)
    assert pace.stopped == NOT_YET
    pace.command(0.1, 0.0, 0)
    pace.command(0.2, 0.1, 0)
    assert said(pace, 0) == [ZERO_SPEEDS, (0.2, 0.1)]
    assert pace.due_ns == 100 * MS
    assert said(pace, 99 * MS) == []
    assert said(pace, 100 * MS) == [(0.2, 0.1)]
    pace.command(0.3, 0.0, 120 * MS)
    assert pace.due_ns == 0
    assert said(pace, 120 * MS) == [(0.3, 0.0)]


def test_without_commands_it_says_zero_and_goes_on_saying_it() -> None:
    pace = Pace(1.0, 0.5)
    pace.command(0.2, 0.1, 0)
    said(pace, 0)
    assert pace.due_ns == 500 * MS
    assert said(pace, 500 * MS) == [ZERO_SPEEDS]
    assert pace.stopped == "no command for 0.5 s"
    assert said(pace, 1500 * MS) == [ZERO_SPEEDS]


def test_a_stop_is_said_ahead_of_the_command_that_follows() -> None:
    pace = Pace(10.0, 0.5)
    pace.command(0.2, 0.0, 0)
    said(pace, 0)
    pace.command(0.4, 0.0, MS)
    pace.stop("enough")
    pace.command(0.1, 0.0, 2 * MS)
    assert said(pace, 2 * MS) == [ZERO_SPEEDS, (0.1, 0.0)]
    assert pace.stopped == ""


def test_a_robot_is_there_while_it_is_heard_and_hears() -> None:
    presence = Presence(1.0)
    assert presence.missing(0) == (True, True)
    assert presence.hear(b"a", 0)
    presence.listen(True, 0)
    assert presence.missing(S - 1) == (False, False)
    assert presence.due_ns(0) == S
    assert presence.missing(S) == (True, False)
    presence.hear(b"a", 9 * S)
    presence.listen(False, 9 * S)  # such as when a router is started anew
    assert presence.missing(10 * S - 1) == (False, False)
    presence.hear(b"a", 10 * S)
    assert presence.missing(10 * S) == (False, True)
    assert presence.due_ns(10 * S) == 11 * S


def test_one_node_is_followed_until_it_is_silent() -> None:
    presence = Presence(1.0)
    assert [presence.hear(each, 0) for each in (b"a", b"b", b"a")] == [True, False, True]
    assert not presence.hear(b"b", S - 1)
    assert presence.hear(b"b", S)
    assert not presence.hear(b"a", S)
