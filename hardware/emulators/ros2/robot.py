"""Emulated ROS 2 robot: takes Twist or TwistStamped, has two driven wheels, publishes Odometry.

It serves ``vcmvsp emulate ros2`` and tests of the driver.
"""

import queue
import threading
import time
from typing import Literal, Self

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.frames import arc, quaternion_from_yaw
from vcmvsp.cosim.types import ORIGIN, Positive, Rate, Vec3
from vcmvsp.hardware.drivers.ros2.cdr_messages import (
    ODOMETRY,
    TWIST,
    TWIST_STAMPED,
    OdometryMessage,
    Twist,
    decode_twist,
    encode_odometry,
)
from vcmvsp.hardware.drivers.ros2.node import Mode, Node, ReceivedMessage
from vcmvsp.hardware.drivers.ros2.zenoh_keys import Endpoint, Mapping, Release, RmwZenoh, Ros2Dds, topic_of

STEP_S = 0.01  # of the motion


class Ros2Robot:
    """A differential drive that obeys within its acceleration, and stops without commands; a context manager.

    Args:
        endpoint: see `hardware.drivers.ros2.driver.Ros2Driver`, also for other parameters of the same name.
        pose: x m, y m, yaw rad, in its odometry's frame.
        max_speed: m/s.
        max_yaw_rate: rad/s.
        accel: m/s2.
        yaw_accel: rad/s2.
        odometry_hz: messages a second.
        watchdog_s: time without a command until it stops.
        clock_ahead_s: of its clock, against the monotonic one of this machine.

    Attributes:
        heard: received commands, with monotonic arrival times, ns.
        silent: it publishes no odometry.
    """

    def __init__(
        self,
        *,
        endpoint: str = "tcp/127.0.0.1:7447",
        mode: Mode = "listen",
        mapping: Literal["rmw_zenoh", "ros2dds"] = "rmw_zenoh",
        domain: int = 0,
        release: Release = "later",
        namespace: str = "",
        command_topic: str = "cmd_vel",
        odometry_topic: str = "odom",
        stamped: bool = False,
        pose: Vec3 = ORIGIN,
        max_speed: Positive = 1.0,
        max_yaw_rate: Positive = 2.0,
        accel: Positive = 2.0,
        yaw_accel: Positive = 4.0,
        odometry_hz: Rate = 20.0,
        watchdog_s: Positive = 1.0,
        clock_ahead_s: float = 1.7e9,
        name: str = "robot",
    ) -> None:
        self.heard: list[tuple[int, Twist]] = []
        self.silent = False
        self.pose = pose
        self.speeds = (0.0, 0.0)  # m/s, rad/s
        self._endpoint, self._mode, self._stamped = endpoint, mode, stamped
        self._mapping: Mapping = RmwZenoh(domain, name, release) if mapping == "rmw_zenoh" else Ros2Dds()
        self._commands = Endpoint("MS", topic_of(namespace, command_topic), TWIST_STAMPED if stamped else TWIST)
        self._odometry = Endpoint("MP", topic_of(namespace, odometry_topic), ODOMETRY)
        self._most, self._accels = (max_speed, max_yaw_rate), (accel, yaw_accel)
        self._period_ns, self._watchdog_ns = round(SECOND_NS / odometry_hz), seconds_to_ns(watchdog_s)
        self._ahead_ns = seconds_to_ns(clock_ahead_s)
        self._wanted, self._told_ns = (0.0, 0.0), 0
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
        stamp_ns = time.monotonic_ns() + self._ahead_ns
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
            if now_ns >= odometry_ns + self._period_ns:
                odometry_ns = max(odometry_ns + self._period_ns, now_ns - self._period_ns)
                if not self.silent:
                    self._publish(encode_odometry(self.message()))

    def _obey(self, message: ReceivedMessage) -> None:
        if message.type not in ("", self._commands.type):
            return
        try:
            twist = decode_twist(message.data, stamped=self._stamped)
        except ValueError:
            return
        self.heard.append((message.arrived_ns, twist))
        self._wanted, self._told_ns = (twist.linear[0], twist.angular[2]), message.arrived_ns

    def _move(self, now_ns: int, dt: float) -> None:
        goals = self._wanted if now_ns < self._told_ns + self._watchdog_ns else (0.0, 0.0)
        v, w = (
            speed + min(max(min(max(goal, -most), most) - speed, -accel * dt), accel * dt)
            for speed, goal, most, accel in zip(self.speeds, goals, self._most, self._accels, strict=True)
        )
        self.speeds = (v, w)
        self.pose = arc(self.pose, v, w, dt)
