"""Emulated ROS 2 robot: takes Twist or TwistStamped, has two driven wheels, publishes Odometry."""

import queue
import threading
import time
from typing import Any, Literal, Self

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.frames import arc, quaternion_from_yaw
from vcmvsp.cosim.types import ORIGIN, Positive, Vec3
from vcmvsp.hardware.drivers.base import PortError
from vcmvsp.hardware.drivers.ros2 import protocol
from vcmvsp.hardware.drivers.ros2.node import Mode, Node, ReceivedMessage
from vcmvsp.hardware.drivers.ros2.protocol import ODOMETRY, TWIST, TWIST_STAMPED, Endpoint, Mapping, OdometryMessage, topic_of
from vcmvsp.hardware.emulators.device_server import Ready, duration_of, until_interrupted, wait

STEP_S = 0.01  # of the motion
PERIOD_NS = SECOND_NS // 20  # of odometry
MOST, ACCELS = (1.0, 2.0), (2.0, 4.0)  # m/s and rad/s, m/s2 and rad/s2
AHEAD_NS = 1_700_000_000 * SECOND_NS  # its clock, against this machine's monotonic one


class Ros2Robot:
    """A differential drive that follows commands within its acceleration, and stops without commands; a context manager.

    Parameters as of `hardware.drivers.ros2.driver.Ros2Driver`; the pose is x m, y m, yaw rad, in the frame of odometry.
    ``heard``: received commands, with arrival times, ns; ``silent``: it publishes no odometry.
    """

    def __init__(
        self,
        *,
        endpoint: str = "tcp/127.0.0.1:7447",
        mode: Mode = "listen",
        mapping: Literal["rmw_zenoh", "ros2dds"] = "rmw_zenoh",
        domain: int = 0,
        namespace: str = "",
        stamped: bool = False,
        pose: Vec3 = ORIGIN,
        watchdog_s: Positive = 1.0,
        name: str = "robot",
    ) -> None:
        self.heard: list[tuple[int, protocol.Twist]] = []
        self.silent = False
        self.pose = pose
        self.speeds = (0.0, 0.0)  # m/s, rad/s
        self._endpoint, self._mode, self._stamped = endpoint, mode, stamped
        self._mapping: Mapping = protocol.RmwZenoh(domain, name) if mapping == "rmw_zenoh" else protocol.Ros2Dds()
        self._commands = Endpoint("MS", topic_of(namespace, "cmd_vel"), TWIST_STAMPED if stamped else TWIST)
        self._odometry = Endpoint("MP", topic_of(namespace, "odom"), ODOMETRY)
        self._watchdog_ns = seconds_to_ns(watchdog_s)
        self._command, self._command_ns = (0.0, 0.0), 0
        self._news: queue.SimpleQueue[ReceivedMessage | None] = queue.SimpleQueue()

    def __enter__(self) -> Self:
        self._node = Node(self._endpoint, self._mode, self._mapping, (self._commands, self._odometry))
        self._publish = self._node.publisher(self._odometry, lambda _: None)
        self._node.hear(self._commands, self._news.put)
        self._thread = threading.Thread(target=self._run, name=f"robot on {self._endpoint}", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._news.put(None)
        self._thread.join(5.0)
        self._node.close()

    def say(self, data: bytes) -> None:
        """Publish these bytes in place of odometry."""
        self._publish(data)

    def message(self) -> OdometryMessage:
        """Present odometry message."""
        x, y, yaw = self.pose
        v, w = self.speeds
        stamp_ns = time.monotonic_ns() + AHEAD_NS
        return OdometryMessage((x, y, 0.0), quaternion_from_yaw(yaw), (v, 0.0, 0.0), (0.0, 0.0, w), stamp_ns)

    def _run(self) -> None:
        motion_ns = odometry_ns = time.monotonic_ns()
        while True:
            try:
                news = self._news.get(timeout=STEP_S)
                if news is None:
                    return
                self._obey(news)
            except queue.Empty:
                pass
            now_ns = time.monotonic_ns()
            self._move(now_ns, (now_ns - motion_ns) / SECOND_NS)
            motion_ns = now_ns
            if now_ns >= odometry_ns + PERIOD_NS:
                odometry_ns = max(odometry_ns + PERIOD_NS, now_ns - PERIOD_NS)
                if not self.silent:
                    self._publish(protocol.encode_odometry(self.message()))

    def _obey(self, message: ReceivedMessage) -> None:
        if message.type not in ("", self._commands.type):
            return
        try:
            twist = protocol.decode_twist(message.data, stamped=self._stamped)
        except ValueError:
            return
        self.heard.append((message.arrived_ns, twist))
        self._command, self._command_ns = (twist.linear[0], twist.angular[2]), message.arrived_ns

    def _move(self, now_ns: int, dt: float) -> None:
        goals = self._command if now_ns < self._command_ns + self._watchdog_ns else (0.0, 0.0)
        v, w = (
            speed + min(max(min(max(goal, -most), most) - speed, -accel * dt), accel * dt)
            for speed, goal, most, accel in zip(self.speeds, goals, MOST, ACCELS, strict=True)
        )
        self.speeds = (v, w)
        self.pose = arc(self.pose, v, w, dt)


def emulate(
    endpoint: str, ready: Ready, *, stamped: bool = False, pose: Vec3 | None = None, duration_s: float | None = None
) -> dict[str, Any]:
    """Serve a differential drive on an empty floor, and its router, until it is interrupted; its final state.

    It listens at ``tcp/HOST:PORT``; its odometry begins at the pose (x m, y m, yaw rad); stamped: it takes TwistStamped, not
    Twist. `UsageError`: the endpoint cannot be opened.
    """
    duration_of(duration_s)
    robot = Ros2Robot(endpoint=endpoint, stamped=stamped, pose=pose or ORIGIN)
    with until_interrupted():
        try:
            with robot:
                ready({"url": endpoint, "positioning": {}})
                wait(duration_s, lambda: None)
        except PortError as error:
            raise UsageError(f"--port {endpoint}: {error.happened}") from None
    x, y, yaw = robot.pose
    return {"messages": len(robot.heard), "x_m": x, "y_m": y, "yaw_rad": yaw, "fixes": {}}
