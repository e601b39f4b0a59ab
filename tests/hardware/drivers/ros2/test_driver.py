"""Ros2Driver against the simulated robot, over Zenoh sessions on this machine."""

import contextlib
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from math import cos, hypot, nan, sin
from typing import Any

import msgspec
import pytest

from tests.support.hardware import driver_runs
from tests.support.hardware.driver_runs import drive, error_of, eventually, rest
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Vec3, Velocity
from vcmvsp.hardware.drivers.base import Driver, DriverError, HandshakeError, LinkLost, PortError, Sample
from vcmvsp.hardware.drivers.ros2 import node
from vcmvsp.hardware.drivers.ros2.driver import WAITING, Ros2Driver
from vcmvsp.hardware.drivers.ros2.node import Node, ReceivedMessage
from vcmvsp.hardware.drivers.ros2.protocol import TWIST, Endpoint, RmwZenoh, Twist, encode_odometry, encode_twist
from vcmvsp.hardware.drivers.threaded import NOT_YET
from vcmvsp.hardware.emulators.ros2 import Ros2Robot

pytestmark = [pytest.mark.sockets, pytest.mark.usefixtures("steady")]
START = (1.0, 2.0, 0.5)


@pytest.fixture
def endpoint(port: int) -> str:
    return f"tcp/127.0.0.1:{port}"


@pytest.fixture(autouse=True)
def no_sessions_left() -> Iterator[None]:
    before = set(threading.enumerate())
    yield
    eventually(lambda: set(threading.enumerate()) <= before)


def connected(endpoint: str, start: Vec3 = START, **options: Any) -> contextlib.AbstractContextManager[Ros2Driver]:
    return driver_runs.open_driver(Ros2Driver(endpoint=endpoint, **options), start)


def notices_of(driver: Driver) -> list[tuple[str, str]]:
    return [(each.what, each.cause) for each in driver.notices()]


def distance_m(sample: Sample) -> float:
    """Distance from the start, m."""
    return hypot(sample.odometry.pose[0] - START[0], sample.odometry.pose[1] - START[1])


def is_moving(robot: Ros2Robot) -> bool:
    return robot.speeds != (0.0, 0.0)


@pytest.mark.parametrize("mapping", ["rmw_zenoh", "ros2dds"])
@pytest.mark.parametrize("stamped", [False, True])
def test_it_drives_from_the_start_pose(endpoint: str, mapping: Any, stamped: bool) -> None:
    options: dict[str, Any] = {"mapping": mapping, "stamped": stamped, "namespace": "robot1"}
    with Ros2Robot(endpoint=endpoint, pose=(-7.0, 3.0, 2.0), **options) as robot:
        with connected(endpoint, silence_s=10.0, command_timeout_s=2.0, **options) as driver:
            assert isinstance(driver, Driver)
            samples = drive(driver, 0.2, v=0.4)
            while distance_m(samples[-1]) <= 0.1 or samples[-1].odometry.v < 0.39 or samples[-1].stopped:
                samples += drive(driver, 0.1, v=0.4)
        eventually(lambda: robot.heard[-1][1].linear == (0.0, 0.0, 0.0))
        assert robot.heard[0][1].linear == (0.0, 0.0, 0.0)
        driven = hypot(robot.pose[0] + 7.0, robot.pose[1] - 3.0)
    x, y, yaw = samples[-1].odometry.pose
    covered = distance_m(samples[-1])
    assert covered <= driven + 1e-9
    assert (x - 1.0, y - 2.0) == pytest.approx((covered * cos(0.5), covered * sin(0.5)), abs=1e-6)
    assert yaw == pytest.approx(0.5)
    assert max(each.odometry.v for each in samples) == pytest.approx(0.4)
    assert all(each.measured_ns <= each.arrived_ns <= time.monotonic_ns() for each in samples)
    assert samples[0].link == samples[-1].link == 1
    assert samples[-1].stopped == ""
    if stamped:  # by the robot's clock, 1.7e9 s ahead
        arrived_ns, twist = next(each for each in reversed(robot.heard) if each[1].linear[0])
        assert 0 <= arrived_ns + 1_700_000_000 * 10**9 - twist.stamp_ns < 10**9 * 5
        assert twist.frame == "base_link"
        assert robot.heard[-1][1].stamp_ns == 0  # the last zero has no stamp


def test_it_is_the_router_by_option(endpoint: str) -> None:
    driver = Ros2Driver(endpoint=endpoint, mode="listen", reconnect_s=60.0, connect_s=30.0)
    deadline = time.monotonic() + 20.0
    with ThreadPoolExecutor(1) as pool, contextlib.ExitStack() as stack:
        opening = pool.submit(driver.open)
        while True:
            try:
                robot = stack.enter_context(Ros2Robot(endpoint=endpoint, mode="connect"))
                break
            except PortError:
                assert time.monotonic() < deadline
        stack.callback(driver.close)
        opening.result(40.0)
        eventually(lambda: drive(driver, 0.05, v=0.2) is not None and is_moving(robot))


@pytest.mark.parametrize("cause", ["geofence", "no command for 0.2 s"])
def test_a_stop_or_a_lack_of_commands_stops_it_until_the_next_command(endpoint: str, cause: str) -> None:
    with (
        Ros2Robot(endpoint=endpoint, watchdog_s=60.0) as robot,
        connected(endpoint, command_timeout_s=0.2, silence_s=10.0) as driver,
    ):
        drive(driver, 0.3, v=0.3)
        if cause == "geofence":
            driver.stop(cause)
        eventually(lambda: (sample := driver.read()) is not None and sample.stopped == cause)
        eventually(lambda: not is_moving(robot))
        assert ("stopped", cause) in notices_of(driver)
        count = len(robot.heard)
        eventually(lambda: drive(driver, 0.1, v=0.3) and any(twist.linear[0] == 0.3 for _, twist in robot.heard[count:]))
        for bad in nan, float("inf"):
            with pytest.raises(ValueError, match="finite"):
                driver.write(Velocity(linear=(bad, 0.0, 0.0)))


def test_silence_is_a_loss_and_a_return_a_new_link(endpoint: str) -> None:
    with (
        Ros2Robot(endpoint=endpoint, watchdog_s=60.0) as robot,
        connected(endpoint, silence_s=0.8, command_timeout_s=60.0) as driver,
    ):
        eventually(lambda: any(distance_m(each) > 0.0 for each in drive(driver, 0.1, v=0.3)))
        robot.silent = True
        eventually(lambda: isinstance(error_of(driver), LinkLost))
        with pytest.raises(LinkLost, match=r"no odometry on odom for 0\.8 s"):
            driver.write(Velocity(linear=(0.5, 0.0, 0.0)))
        eventually(lambda: not is_moving(robot))  # the robot still receives
        count = len(robot.heard)
        robot.silent = False
        eventually(lambda: error_of(driver) is None)
        samples = drive(driver, 0.3, v=0.1)
        assert samples[-1].link == 2
        assert distance_m(samples[-1]) > 0.0  # same node: the distance travelled is kept
        eventually(lambda: any(twist.linear[0] == 0.1 for _, twist in robot.heard))
        assert robot.heard[count][1].linear[0] == 0.0
        assert [kind for kind, _ in notices_of(driver) if kind != "stopped"] == ["connected", "lost", "connected"]


def test_a_restarted_robot_gets_zero_first(endpoint: str) -> None:
    """Its router ends with it; the session reconnects by itself."""
    with Ros2Robot(endpoint=endpoint, name="one") as old, connected(endpoint, silence_s=0.3, reconnect_s=60.0) as driver:
        drive(driver, 0.4, v=0.3)
        old.__exit__()
        eventually(lambda: any(kind == "lost" for kind, _ in notices_of(driver)))
        with Ros2Robot(endpoint=endpoint, name="two") as robot:
            driver.write(Velocity(linear=(0.3, 0.0, 0.0)))
            eventually(lambda: (sample := driver.read()) is not None and sample.link >= 2)
            eventually(lambda: drive(driver, 0.05, v=0.2) and any(twist.linear[0] == 0.2 for _, twist in robot.heard))
            assert robot.heard[0][1].linear[0] == 0.0


def test_bad_messages_are_counted_with_one_notice(endpoint: str) -> None:
    with Ros2Robot(endpoint=endpoint) as robot, connected(endpoint, frame="odom", silence_s=30.0) as driver:
        good = robot.message()
        robot.silent = True
        bad = [
            encode_odometry(good._replace(position=(nan, 0.0, 0.0))),
            encode_odometry(good)[:100],
            b"",
            encode_odometry(good._replace(frame="map")),
            encode_odometry(good._replace(stamp_ns=-1)),
        ]

        def refuse(data: bytes) -> None:
            """One at a time: Zenoh drops messages of a burst if its queue is full."""
            before = driver.refused.total()
            robot.say(data)
            eventually(lambda: driver.refused.total() > before)

        for data in bad * 3:
            refuse(data)
        other = Endpoint("MP", "odom", TWIST)
        stranger = Node(endpoint, "connect", RmwZenoh(0, "stranger"), (other,))
        try:
            say = stranger.publisher(other, lambda _: None)
            wrong = encode_twist(Twist((1.0, 0.0, 0.0), (0.0, 0.0, 0.0)), stamped=False)
            eventually(lambda: say(wrong) or driver.refused["type"] > 3)
            second = Ros2Robot(endpoint=endpoint, mode="connect", name="second")
            robot.silent = False
            with second:
                eventually(lambda: driver.refused["sender"] > 2)
        finally:
            stranger.close()
        assert {key: driver.refused[key] for key in ("content", "frame", "stamp")} == {"content": 9, "frame": 3, "stamp": 3}
        causes = [cause for _, cause in notices_of(driver) if "is ignored" in cause]
        assert len(causes) == 5
        assert any("geometry_msgs/msg/Twist, not nav_msgs/msg/Odometry" in cause for cause in causes)
        eventually(lambda: driver.read() is not None)


def test_a_new_subscriber_gets_zero_first(endpoint: str) -> None:
    with Ros2Robot(endpoint=endpoint), connected(endpoint, silence_s=10.0, command_timeout_s=60.0) as driver:
        eventually(lambda: any(each.stopped == "" for each in drive(driver, 0.1, v=0.3)))
        driver._news.put(True)  # as reported by Zenoh
        eventually(lambda: (sample := driver.read()) is not None and sample.stopped == NOT_YET)


def test_another_node_is_followed_only_after_a_reported_loss(endpoint: str) -> None:
    """The driver's thread is blocked while one node goes silent and another one begins to send."""
    with (
        Ros2Robot(endpoint=endpoint, name="one") as one,
        Ros2Robot(endpoint=endpoint, name="two", mode="connect", pose=(15.0, 0.0, 0.0)) as two,
    ):
        two.silent = True
        rest(0.2)
        with connected(endpoint, silence_s=0.5, reconnect_s=60.0) as driver:
            eventually(driver.read)
            with driver._lock:
                one.silent = True
                rest(0.8)
                while not driver._news.empty():
                    driver._news.get()
                two.silent = False
                eventually(lambda: not driver._news.empty())
            eventually(lambda: (sample := driver.read()) is not None and sample.link == 2)
            assert ("lost", "no odometry on odom for 0.5 s") in notices_of(driver)


def test_the_message_queue_is_limited(endpoint: str) -> None:
    with Ros2Robot(endpoint=endpoint) as robot, connected(endpoint, silence_s=30.0) as driver:
        message = ReceivedMessage("", encode_odometry(robot.message()), b"another", time.monotonic_ns())
        with driver._lock:
            for _ in range(WAITING + 100):
                driver._hand_over(message)
            assert driver._news.qsize() <= WAITING + 1


def test_any_end_of_its_thread_is_a_driver_error(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object, **__: object) -> None:
        raise LookupError("boom")

    with Ros2Robot(endpoint=endpoint, watchdog_s=60.0) as robot, connected(endpoint, command_timeout_s=60.0) as driver:
        eventually(lambda: drive(driver, 0.05, v=0.3) is not None and is_moving(robot))
        monkeypatch.setattr(driver, "_decode_odometry", fails)
        eventually(lambda: error_of(driver))
        assert "the driver failed (LookupError: boom)" in str(error_of(driver))
        eventually(lambda: not is_moving(robot))
    monkeypatch.setattr(Node, "hear", fails)
    with pytest.raises(DriverError, match=r"the driver failed \(LookupError: boom\)"):
        Ros2Driver(endpoint=endpoint, mode="listen").open()


def test_no_robot(endpoint: str) -> None:
    driver = Ros2Driver(endpoint=endpoint)
    with pytest.raises(PortError, match="start rmw_zenohd"):
        driver.open()
    with pytest.raises(RuntimeError, match="not open"):
        driver.read()
    driver.close()
    with pytest.raises(PortError, match=r"no session \(.*nonsense"):
        Ros2Driver(endpoint="nonsense").open()


def test_the_wrong_robot_and_advice(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(node, "GRAPH_S", 5.0)  # the answer is immediate except on a loaded machine
    with Ros2Robot(endpoint=endpoint, stamped=True, domain=3) as robot:
        with pytest.raises(PortError, match="end the other router"):
            Ros2Driver(endpoint=endpoint, mode="listen").open()
        with pytest.raises(HandshakeError, match="set stamped = true"):
            Ros2Driver(endpoint=endpoint, domain=3, connect_s=0.5).open()
        with pytest.raises(
            HandshakeError, match=r"no odometry was received on x/odom .* another node publishes odom \(nav_msgs"
        ):
            Ros2Driver(endpoint=endpoint, domain=3, connect_s=0.3, namespace="x").open()
        with pytest.raises(HandshakeError, match="with this domain"):
            Ros2Driver(endpoint=endpoint, connect_s=0.3).open()
        assert not is_moving(robot)


def test_parameters_are_checked() -> None:
    for key in "command_topic", "odometry_topic":
        options: Any = {key: "no topic"}
        with pytest.raises(ScenarioError, match=f"{key}: 'no topic' is not a topic"):
            Ros2Driver(**options)
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(233, Ros2Driver.__init__.__annotations__["domain"])
