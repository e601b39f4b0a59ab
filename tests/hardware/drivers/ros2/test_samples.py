"""Laws of poses, times and presence, without a network."""

from math import cos, pi, sin
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.frames import quaternion_from_yaw, wrap
from vcmvsp.cosim.types import Vec3
from vcmvsp.hardware.drivers.ros2.driver import Pose, Ros2Sampler
from vcmvsp.hardware.drivers.ros2.node import RobotPresence
from vcmvsp.hardware.drivers.ros2.protocol import STAMPS_END_NS, OdometryMessage

pytestmark = pytest.mark.slow

MS, S = 10**6, 10**9
coordinates = st.floats(-50.0, 50.0)
angles = st.floats(-3.0, 3.0)
poses = st.tuples(coordinates, coordinates, angles)


def message(x: float, y: float, yaw: float, stamp_ns: int = 0, v: float = 0.0, w: float = 0.0) -> OdometryMessage:
    return OdometryMessage((x, y, 0.0), quaternion_from_yaw(yaw), (v, 0.0, 0.0), (0.0, 0.0, w), stamp_ns)


def track(start: Vec3 = (0.0, 0.0, 0.0), pose: Pose = "odometry", origin: Vec3 = (0.0, 0.0, 0.0)) -> Ros2Sampler:
    made = Ros2Sampler(start, pose, origin, 1000.0)
    made.connect(anew=True)
    return made


@given(poses, st.lists(poses, min_size=2, max_size=6))
def test_the_pose_is_the_start_pose_composed_with_odometry(start: Vec3, path: list[Vec3]) -> None:
    """start o first^-1 o last, in homogeneous matrices by hand."""
    made = track(start)
    samples = [made.add(message(*each), number * S, "") for number, each in enumerate(path)]
    assert samples[0].odometry.pose == start
    (x0, y0, yaw0), (x1, y1, yaw1) = path[0], path[-1]
    forward = cos(yaw0) * (x1 - x0) + sin(yaw0) * (y1 - y0)
    left = -sin(yaw0) * (x1 - x0) + cos(yaw0) * (y1 - y0)
    x, y, yaw = samples[-1].odometry.pose
    assert x == pytest.approx(start[0] + cos(start[2]) * forward - sin(start[2]) * left, abs=1e-9)
    assert y == pytest.approx(start[1] + sin(start[2]) * forward + cos(start[2]) * left, abs=1e-9)
    assert abs(wrap(yaw - start[2] - (yaw1 - yaw0))) < 1e-9


def test_the_heading_is_continuous_at_pi() -> None:
    made = track()
    yaws = [made.add(message(0.0, 0.0, wrap(0.5 * each)), each * S, "").odometry.pose[2] for each in range(30)]
    assert yaws == pytest.approx([0.5 * each for each in range(30)])


def test_a_leap_is_omitted_and_later_motion_counts() -> None:
    made = Ros2Sampler((0.0, 0.0, 0.0), "odometry", (0.0, 0.0, 0.0), 1.0)
    made.connect(anew=True)
    samples = [made.add(message(x, 0.0, 0.0), number * S // 10, "") for number, x in enumerate((0.0, 0.1, -40.0, -39.9))]
    assert [each.odometry.pose[0] for each in samples] == pytest.approx([0.0, 0.1, 0.1, 0.2])
    assert made.leaps == 1


def test_after_a_loss_odometry_continues_for_one_node_and_restarts_for_another() -> None:
    made = track()
    made.add(message(1.0, 0.0, 0.0), 0, "")
    made.connect(anew=False)
    assert made.add(message(3.0, 0.0, 0.0), S, "").odometry.pose == (2.0, 0.0, 0.0)
    made.connect(anew=True)
    sample = made.add(message(0.0, 0.0, 0.0), 2 * S, "")
    assert (sample.odometry.pose, sample.link, sample.number) == ((2.0, 0.0, 0.0), 3, 3)


@given(poses, poses, st.floats(-3.0, 3.0))
def test_in_the_world_the_state_is_the_frame_moved_by_its_origin(origin: Vec3, pose: Vec3, v: float) -> None:
    sample: Any = track((9.0, 9.0, 1.0), "world", origin).add(message(*pose, v=v, w=0.3), 0, "")
    heading = origin[2] + pose[2]
    x = origin[0] + cos(origin[2]) * pose[0] - sin(origin[2]) * pose[1]
    y = origin[1] + sin(origin[2]) * pose[0] + cos(origin[2]) * pose[1]
    assert sample.state.position == pytest.approx((x, y, 0.0), abs=1e-9)
    assert abs(wrap(sample.state.yaw - heading)) < 1e-9
    assert sample.state.velocity == pytest.approx((v * cos(heading), v * sin(heading), 0.0), abs=1e-9)
    assert sample.state.angular_velocity == (0.0, 0.0, 0.3)
    assert sample.odometry.pose == (*sample.state.position[:2], sample.state.yaw)


def test_in_the_world_all_three_axes_are_kept() -> None:
    """Nose down by a quarter turn about y: the body's x axis points to -z."""
    pitched = OdometryMessage((1.0, 2.0, 3.0), (cos(pi / 4), 0.0, sin(pi / 4), 0.0), linear=(1.0, 0.0, 0.0))
    state: Any = track(pose="world").add(pitched, 0, "").state
    assert state.position == (1.0, 2.0, 3.0)
    assert state.velocity == pytest.approx((0.0, 0.0, -1.0), abs=1e-12)


def times(made: Ros2Sampler, stamps_and_arrivals: list[tuple[int, int]]) -> list[int]:
    return [made.add(message(0.0, 0.0, 0.0, stamp), arrived, "").measured_ns for stamp, arrived in stamps_and_arrivals]


AHEAD = 1_700_000_000 * S  # the robot's clock


def test_delayed_messages_keep_their_age() -> None:
    """Two seconds of messages that arrive at once after a network stall."""
    true = [1000 * S + number * 50 * MS for number in range(1, 80)]
    arrivals = [each if number < 40 else 1004 * S + number for number, each in enumerate(true)]
    results_ns = times(track(), [(each + AHEAD, arrived) for each, arrived in zip(true, arrivals, strict=True)])
    for each, measured in zip(true, results_ns, strict=True):
        assert 0 <= measured - each <= 2 * MS  # 500 ppm of 4 s


@pytest.mark.parametrize("by_ns", [-500 * MS, -3600 * S, 100 * MS, 3600 * S])
def test_a_clock_step_is_followed_after_three_messages(by_ns: int) -> None:
    true = [10 * S + number * 50 * MS for number in range(20)]
    results_ns = times(track(), [(each + AHEAD + (by_ns if number >= 10 else 0), each) for number, each in enumerate(true)])
    for number, (each, measured) in enumerate(zip(true, results_ns, strict=True)):
        assert measured <= each
        assert number in (10, 11) or each - measured <= MS


def test_another_node_has_another_clock() -> None:
    made = track()
    times(made, [(AHEAD + number * S, number * S) for number in range(5)])
    made.connect(anew=True)
    assert times(made, [(7 * S, 10 * S)]) == [10 * S]


def test_the_robots_clock_is_known_after_a_stamp() -> None:
    made = track()
    assert made.stamp_ns(5 * S) == 0
    assert times(made, [(0, 77)]) == [77]  # a node without stamps
    assert made.stamp_ns(5 * S) == 0
    times(made, [(1700 * S, 10 * S)])
    assert made.stamp_ns(12 * S) == pytest.approx(1702 * S, abs=2 * MS)


def test_a_clock_at_the_stamp_limit_gives_none() -> None:
    made = track()
    times(made, [(STAMPS_END_NS - 1, 10 * S)])
    assert made.stamp_ns(12 * S) == 0


def test_a_robot_is_present_while_it_sends_and_listens() -> None:
    presence = RobotPresence(1.0)
    assert presence.missing(0) == (True, True)
    assert presence.hear(b"a", 0)
    presence.listen(True, 0)
    assert presence.missing(S - 1) == (False, False)
    assert presence.due_ns(0) == S
    assert presence.missing(S) == (True, False)
    presence.hear(b"a", 9 * S)
    presence.listen(False, 9 * S)  # for example after a restart of the router
    assert presence.missing(10 * S - 1) == (False, False)
    presence.hear(b"a", 10 * S)
    assert presence.missing(10 * S) == (False, True)
    assert presence.due_ns(10 * S) == 11 * S


def test_one_node_is_followed_until_it_is_silent() -> None:
    presence = RobotPresence(1.0)
    assert [presence.hear(each, 0) for each in (b"a", b"b", b"a")] == [True, False, True]
    assert not presence.hear(b"b", S - 1)
    assert presence.hear(b"b", S)
    assert not presence.hear(b"a", S)
