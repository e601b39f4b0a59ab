"""Driver of robots with ROS 2: Twist or TwistStamped to the robot, Odometry from it, over Eclipse Zenoh, and its samples.

One thread takes what Zenoh's callbacks and the caller put into a queue, and publishes. A robot is connected while odometry
arrives and a node subscribes to the commands. A loss stops the robot, and each connection starts with zero speed; older
commands do not move it.
"""

import contextlib
import queue
import time
from collections import Counter
from typing import Annotated, Literal

import msgspec

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.estimation.clock_offset import ForeignClock
from vcmvsp.cosim.frames import product, quaternion_from_yaw, rotate2, wrap, yaw_of
from vcmvsp.cosim.recording.ros_messages import rotated
from vcmvsp.cosim.types import ORIGIN, NonNegative, Odometry, Positive, Rate, Vec3, VehicleState
from vcmvsp.hardware.drivers.base import COMMAND_TIMEOUT_S, CommandTimeout, HandshakeError, LinkLost, Sample
from vcmvsp.hardware.drivers.ros2 import protocol
from vcmvsp.hardware.drivers.ros2.node import GRAPH_S, Mode, Node, ReceivedMessage, RobotPresence
from vcmvsp.hardware.drivers.ros2.protocol import (
    ODOMETRY,
    STAMPS_END_NS,
    TWIST,
    TWIST_STAMPED,
    Endpoint,
    OdometryMessage,
    RefusedMessage,
)
from vcmvsp.hardware.drivers.threaded import NOT_YET, CommandRepeater, QueueDriver

Pose = Literal["odometry", "world"]
DRIFT_PPM = 500.0  # maximum drift: the largest slew of NTP
JUMP_S = 0.2  # smaller jumps of the clock make odometry seem older for a while
LEAP_S = 1.0  # longest step of the pose: greatest speed times (time since the last message + this)


class Ros2Sampler:
    """Converts odometry messages to samples, over reconnections.

    With ``pose`` "odometry" only differences count, from ``start``; with "world", ``origin`` (x m, y m, yaw rad) moves the pose
    into the world. Larger steps than ``max_speed`` (m/s) allows are ignored, and counted in ``leaps``.
    """

    def __init__(self, start: Vec3, pose: Pose, origin: Vec3, max_speed: float) -> None:
        self.leaps = 0
        self._clock = ForeignClock(drift_ppm=DRIFT_PPM, jump_s=JUMP_S)
        self._kind, self._origin, self._max_speed = pose, origin, max_speed
        self._number = self._link = 0
        self._pose = start
        self._base: Vec3 | None = None  # x m, y m, yaw rad of the last message
        self._arrived_ns = 0

    def connect(self, *, anew: bool) -> None:
        """Note that a connection begins; ``anew``: perhaps with another node, with another start and another clock."""
        self._link += 1
        if anew:
            self._base = None
            self._clock = ForeignClock(drift_ppm=DRIFT_PPM, jump_s=JUMP_S)

    def add(self, message: OdometryMessage, arrived_ns: int, stopped: str) -> Sample:
        """Sample of a message."""
        measured_ns = self._clock.local_time_ns(message.stamp_ns, arrived_ns) if message.stamp_ns else arrived_ns
        state = self._state(message) if self._kind == "world" else None
        if state is None:
            self._move(message, arrived_ns)
            pose = self._pose
        else:
            pose = (state.position[0], state.position[1], state.yaw)
        self._arrived_ns = arrived_ns
        self._number += 1
        return Sample(
            number=self._number,
            link=self._link,
            arrived_ns=arrived_ns,
            measured_ns=measured_ns,
            odometry=Odometry(pose=pose, v=message.linear[0], w=message.angular[2]),
            state=state,
            stopped=stopped,
        )

    def stamp_ns(self, now_ns: int) -> int:
        """Present time of the robot's clock; 0: unknown."""
        offset_ns = self._clock.offset_ns(now_ns)
        return 0 if offset_ns is None or not 0 <= now_ns - offset_ns < STAMPS_END_NS else now_ns - offset_ns

    def _move(self, message: OdometryMessage, arrived_ns: int) -> None:
        new = (message.position[0], message.position[1], yaw_of(message.attitude))
        last, self._base = self._base, new
        if last is None:
            return
        dx, dy = new[0] - last[0], new[1] - last[1]
        farthest = self._max_speed * ((arrived_ns - self._arrived_ns) / SECOND_NS + LEAP_S)
        if dx * dx + dy * dy > farthest * farthest:
            self.leaps += 1
            return
        x, y, yaw = self._pose
        dx, dy = rotate2(dx, dy, yaw - last[2])
        self._pose = (x + dx, y + dy, yaw + wrap(new[2] - last[2]))

    def _state(self, message: OdometryMessage) -> VehicleState:
        """State in the world; the velocity of odometry is in the body's frame."""
        x, y, yaw = self._origin
        dx, dy = rotate2(message.position[0], message.position[1], yaw)
        attitude = product(quaternion_from_yaw(yaw), message.attitude)
        return VehicleState(
            position=(x + dx, y + dy, message.position[2]),
            velocity=rotated(attitude, message.linear),
            attitude=attitude,
            angular_velocity=message.angular,
        )


OPEN_S = 5.0  # for a session: two seconds for a host that does not answer, and reserve
CLOSE_S = 2.0
WAITING = 256  # maximum length of the queue
ZERO_SPEEDS = (0.0, 0.0)  # m/s and rad/s
_SHOWN = 6  # endpoints in an error text

Domain = Annotated[int, msgspec.Meta(ge=0, le=232)]
ConnectTime = Annotated[float, msgspec.Meta(gt=0, le=30)]  # s; less than a station allows its driver


class Ros2Driver(QueueDriver):
    """A robot with ROS 2 (`hardware.drivers.base.Driver`).

    Args:
        endpoint: of Zenoh: where rmw_zenohd or zenoh-bridge-ros2dds listens, or this driver does.
        mode: "connect", or "listen": be the router for the robot's nodes.
        mapping: "rmw_zenoh", or "ros2dds" for zenoh-bridge-ros2dds.
        domain: ROS_DOMAIN_ID; not used by "ros2dds".
        release: of the robot's ROS 2, for "rmw_zenoh": "humble", without type hashes in keys, or "later".
        namespace: of the topics.
        command_topic: in the namespace, unless it begins with a slash.
        odometry_topic: in the namespace, unless it begins with a slash.
        stamped: publish TwistStamped, as ros2_control's diff_drive_controller needs since Jazzy; by the robot's own clock.
        command_frame: the frame in TwistStamped.
        frame: required frame of odometry; empty: any.
        pose: "odometry": relative to the start pose of `open`; "world": in the world (a localisation, or motion
            capture): samples have a ``state``.
        origin: x m, y m, yaw rad of the frame of odometry in the world, for "world".
        max_speed: m/s; larger steps of odometry are ignored: another program set it.
        rate_hz: repetition rate of a command.
        connect_s: for the first odometry and a subscriber to commands.
        silence_s: without odometry, or without a subscriber, the robot counts as lost.
        reconnect_s: time to wait for a lost robot without error; after it `read` and `write` raise `LinkLost` until it is back.
        command_timeout_s: without a command, the robot is stopped.
        name: of this driver's node.
    """

    ground_only = True

    def __init__(
        self,
        *,
        endpoint: str = "tcp/127.0.0.1:7447",
        mode: Mode = "connect",
        mapping: Literal["rmw_zenoh", "ros2dds"] = "rmw_zenoh",
        domain: Domain = 0,
        release: protocol.Release = "later",
        namespace: str = "",
        command_topic: str = "cmd_vel",
        odometry_topic: str = "odom",
        stamped: bool = False,
        command_frame: str = "base_link",
        frame: str = "",
        pose: Pose = "odometry",
        origin: Vec3 = ORIGIN,
        max_speed: Positive = 10.0,
        rate_hz: Rate = 10.0,
        connect_s: ConnectTime = 10.0,
        silence_s: Positive = 1.0,
        reconnect_s: NonNegative = 0.0,
        command_timeout_s: CommandTimeout = COMMAND_TIMEOUT_S,
        name: Annotated[str, msgspec.Meta(pattern=r"\A[A-Za-z_][A-Za-z0-9_]*\Z")] = "vcmvsp",
    ) -> None:
        self._command = Endpoint("MP", _topic("command_topic", namespace, command_topic), TWIST_STAMPED if stamped else TWIST)
        self._odometry = Endpoint("MS", _topic("odometry_topic", namespace, odometry_topic), ODOMETRY)
        super().__init__(
            f"{endpoint} ({self._command.topic})",
            open_deadline_s=OPEN_S + connect_s + GRAPH_S,
            close_deadline_s=CLOSE_S,
        )
        self._endpoint, self._mode = endpoint, mode
        self._mapping: protocol.Mapping = (
            protocol.RmwZenoh(domain, name, release) if mapping == "rmw_zenoh" else protocol.Ros2Dds()
        )
        self._stamped, self._command_frame, self._frame = stamped, command_frame, frame
        self._pose, self._origin, self._max_speed = pose, origin, max_speed
        self._rate_hz, self._timeout_s = rate_hz, command_timeout_s
        self._connect_s, self._reconnect_ns = connect_s, seconds_to_ns(reconnect_s)
        self._silence_s = silence_s

    def _prepare(self, start: Vec3) -> None:
        self.refused: Counter[str] = Counter()  # rejected messages, by cause
        self._news: queue.SimpleQueue[ReceivedMessage | bool | None] = queue.SimpleQueue()
        self._sampler = Ros2Sampler(start, self._pose, self._origin, self._max_speed)
        self._repeater = CommandRepeater(ZERO_SPEEDS, self._timeout_s, again_ns=round(SECOND_NS / self._rate_hz))
        self._presence = RobotPresence(self._silence_s)
        self._connected = False
        self._lost = ""  # reason of the loss
        self._last_sender: bytes | None = None  # node of the last connection's odometry
        self._lost_ns = 0

    def _check(self) -> None:
        super()._check()
        if self._lost and time.monotonic_ns() >= self._lost_ns + self._reconnect_ns:
            raise LinkLost(self.device, self._lost, "check the robot's nodes, router and radio")

    def _work(self) -> None:
        with contextlib.closing(Node(self._endpoint, self._mode, self._mapping, (self._command, self._odometry))) as node:
            self._publish = node.publisher(self._command, self._news.put)
            node.hear(self._odometry, self._hand_over, any_type=True)
            try:
                self._converse(node)
            finally:
                self._say(ZERO_SPEEDS, 0)  # without a stamp, which may be invalid

    def _hand_over(self, message: ReceivedMessage) -> None:
        if self._news.qsize() < WAITING:
            self._news.put(message)

    def _converse(self, node: Node) -> None:
        until_ns = time.monotonic_ns() + seconds_to_ns(self._connect_s)
        while not self._closing.is_set():
            command, due_ns = self._due_command()
            while command is not None:
                self._say(command, self._sampler.stamp_ns(time.monotonic_ns()))
                command, due_ns = self._due_command()
            now_ns = time.monotonic_ns()
            due_ns = min(due_ns, self._presence.due_ns(now_ns))
            if not self._ready.is_set():
                if now_ns >= until_ns:
                    raise self._nobody(node, *self._presence.missing(now_ns))
                due_ns = min(due_ns, until_ns)
            news = self._next_news(due_ns)
            now_ns = time.monotonic_ns()
            if isinstance(news, bool):  # a subscriber came or went; each new one gets zero speed first
                self._presence.listen(news, now_ns)
                if news:
                    with self._lock:
                        self._repeater.stop(self._repeater.stopped or NOT_YET)
            self._look(now_ns)  # before another node is followed: report the loss of the first
            message = self._decode_odometry(news) if isinstance(news, ReceivedMessage) else None
            if message is None:
                continue
            self._look(now_ns)
            if self._connected:
                with self._lock:
                    self._sample = self._sampler.add(*message, self._repeater.stopped)

    def _say(self, speeds: tuple[float, float], stamp_ns: int) -> None:
        v, w = speeds
        twist = protocol.Twist((v, 0.0, 0.0), (0.0, 0.0, w), stamp_ns, self._command_frame)
        self._publish(protocol.encode_twist(twist, stamped=self._stamped))

    def _decode_odometry(self, message: ReceivedMessage) -> tuple[OdometryMessage, int] | None:
        """Odometry of a message, and its arrival; the first rejected message of each cause is reported."""
        try:
            return self._checked(message), message.arrived_ns
        except RefusedMessage as refused:
            self.refused[refused.cause] += 1
            if self.refused[refused.cause] == 1:
                self._notice("warned", f"a message on {self._odometry.topic} is ignored: {refused}")
            return None

    def _checked(self, message: ReceivedMessage) -> OdometryMessage:
        if message.type not in ("", ODOMETRY):
            raise RefusedMessage("type", f"it is {message.type}, not {ODOMETRY}")
        try:
            odometry = protocol.decode_odometry(message.data)
        except ValueError as error:
            raise RefusedMessage("content", str(error)) from None
        if not 0 <= odometry.stamp_ns < STAMPS_END_NS:
            raise RefusedMessage("stamp", "its stamp is not a time")
        if self._frame and odometry.frame != self._frame:
            raise RefusedMessage("frame", f"it is in the frame '{odometry.frame}', not '{self._frame}'")
        if not self._presence.hear(message.sender, message.arrived_ns):
            raise RefusedMessage("sender", "a second node publishes it")
        return odometry

    def _look(self, now_ns: int) -> None:
        silent, unheard = self._presence.missing(now_ns)
        if self._connected and (silent or unheard):
            missing = f"odometry on {self._odometry.topic}" if silent else f"listener to {self._command.topic}"
            happened = f"no {missing} for {self._silence_s:g} s"
            with self._lock:
                self._connected, self._lost, self._lost_ns = False, happened, now_ns
                self._repeater.stop(happened)
            self._notice("lost", happened)
        elif not self._connected and not (silent or unheard):
            with self._lock:
                sender = self._presence.sender
                self._sampler.connect(anew=sender is None or sender != self._last_sender)
                self._connected, self._lost, self._last_sender = True, "", sender
                self._repeater.stop(NOT_YET)
            self._notice("connected", f"odometry on {self._odometry.topic}, commands to {self._command.topic}")
            self._ready.set()

    def _nobody(self, node: Node, silent: bool, unheard: bool) -> HandshakeError:
        missing = []
        if silent:
            refused = f" ({self.refused.total()} messages were ignored)" if self.refused else ""
            missing.append(f"no odometry was received on {self._odometry.topic}{refused}")
        if unheard:
            missing.append(f"no node subscribes to {self._command.topic} as {self._command.type}")
        others = node.others()
        if unheard and any(each.topic == self._command.topic and each.type == TWIST_STAMPED for each in others):
            advice = "the node expects TwistStamped: set stamped = true"
        elif unheard and any(each.topic == self._command.topic and each.type == TWIST for each in others):
            advice = "the node expects Twist: set stamped = false, or correct release"
        elif others:
            does = {"MP": "publishes", "MS": "hears"}
            nodes = ", ".join(f"another node {does[each.kind]} {each.topic} ({each.type})" for each in others[:_SHOWN])
            advice = f"check topics, namespace and release: {nodes}"
        else:
            advice = "check that the robot is running, with this domain, and connected to this router"
        return HandshakeError(self.device, f"{' and '.join(missing)} within {self._connect_s:g} s", advice)


def _topic(key: str, namespace: str, topic: str) -> str:
    try:
        return protocol.topic_of(namespace, topic)
    except ValueError as error:
        raise ScenarioError(str(error), key=key) from None
