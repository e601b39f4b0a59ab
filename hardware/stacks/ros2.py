"""ROS 2 nodes drive simulated vehicles, over the keys of rmw_zenoh; this side needs no ROS 2.

============================  =============================  =======================================================
topic                         type                           content
============================  =============================  =======================================================
``/clock``                    rosgraph_msgs/Clock            simulated time
``<vehicle>/cmd_vel``, in     geometry_msgs/Twist[Stamped]   forward and turning speeds; of flying vehicles all four
``<vehicle>/goal_pose``, in   geometry_msgs/PoseStamped      way-point of a flying vehicle, in the frame ``map``
``<vehicle>/radio/send``, in  vcmvsp_msgs/RadioSend          bytes for the emulated radio
``<vehicle>/radio/received``  vcmvsp_msgs/RadioReceived      bytes from it, at the vehicle's ticks
``<vehicle>/odom``            nav_msgs/Odometry              wheel odometry, without wheels the estimate; at ticks
``<vehicle>/tf``              tf2_msgs/TFMessage             ``map``, ``odom``, ``base_link``; at ticks
``<vehicle>/tf_static``       tf2_msgs/TFMessage             ``base_link`` and the sensors' frames; once, latched
``<vehicle>/<sensor>``        sensor_msgs/LaserScan, Imu     readings of scanners and inertial units
``<vehicle>/<sensor>/...``    sensor_msgs/Image, CameraInfo  pictures: ``image_raw`` and ``camera_info``
``<vehicle>/gps/fix``         sensor_msgs/NavSatFix          positions; of a named sensor ``<sensor>/fix``
============================  =============================  =======================================================

A message is made only if the topic has subscribers. Of one instant, ``odom`` is published last. Services of the run:
`hardware.stacks.simulation_services`.
"""

import queue
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Annotated, Any, Literal, NamedTuple

import msgspec

from vcmvsp.cosim.agent import Observation, check_body
from vcmvsp.cosim.errors import FederateError, ScenarioError
from vcmvsp.cosim.estimation.tangent_plane import TangentPlane
from vcmvsp.cosim.federate import Event, RunControl, RunInfo, StackAnswer, vehicle_of
from vcmvsp.cosim.frames import Quaternion, product, quaternion_from_yaw, rotate2, yaw_of
from vcmvsp.cosim.hosts.remote_host import LinkError
from vcmvsp.cosim.recording import ros_messages as ros
from vcmvsp.cosim.types import ORIGIN, Fix, Image, Imu, Later, Name, Odometry, Positive, Reading, Scan, Vec3, Velocity, Waypoint
from vcmvsp.hardware.drivers.base import PortError
from vcmvsp.hardware.drivers.ros2.node import Mode, Node, ReceivedMessage
from vcmvsp.hardware.drivers.ros2.protocol import TWIST, TWIST_STAMPED, Endpoint, RefusedMessage, RmwZenoh, decode_twist
from vcmvsp.hardware.stacks.simulation_services import SimulationServices

POSE = "geometry_msgs/msg/PoseStamped"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
SEND, RECEIVED = ros.OWN_TYPES
MAP, ODOM, BASE = "map", "odom", "base_link"
INPUTS = {"cmd_vel": TWIST, "goal_pose": POSE, "radio/send": SEND}
OUTPUTS = {"odom": "nav_msgs/msg/Odometry", "tf": TRANSFORMS, "radio/received": RECEIVED}
DEFAULT = "tcp/127.0.0.1:7447"  # where rmw_zenoh looks for its router
LARGEST = 1e9  # m, m/s, rad/s
WAITING = 4096  # messages in the queue
LOOK_S = 0.1  # between two looks while the run waits

Domain = Annotated[int, msgspec.Meta(ge=0, le=232)]
Mount = tuple[Vec3, Quaternion]
"""Place (m) and attitude of a sensor's frame in the vehicle's."""


class _News(NamedTuple):
    """What a callback of Zenoh passes on: a message of an input, or a publisher of commands that came or went."""

    vehicle: str
    topic: str
    message: ReceivedMessage | None = None
    token: str = ""
    there: bool = True


class Outlet:
    """A topic that is published while it has subscribers."""

    def __init__(self, node: Node, topic: str, kind: str, *, complete: bool) -> None:
        self.has_subscribers = False
        self._publish = node.publisher(Endpoint("MP", topic, kind), self._match, complete=complete)

    def put(self, make: Callable[[], ros.RosMessage]) -> None:
        """Publish a message, if the topic has subscribers."""
        if self.has_subscribers:
            self._publish(ros.encoded(make()))

    def _match(self, has_subscribers: bool) -> None:
        self.has_subscribers = has_subscribers


class _Program:
    """Newest commands and messages of the nodes of one vehicle."""

    def __init__(self, *, flies: bool) -> None:
        self.flies, self.yaw = flies, 0.0
        self.command: Velocity | Waypoint | None = None  # not taken yet
        self.messages: list[tuple[dict[str, Any] | bytes, str | None]] = []
        self.lost = ""  # why; empty: it is not lost
        self.publishers: set[str] = set()  # tokens of the publishers of commands
        self.sender: bytes | None = None  # that is followed
        self.moves_since_s: float | None = None  # wall-clock time of the newest command
        self.answered = True  # the observation of the present tick
        self.asked_ns = 0  # time of that observation
        self.refused: Counter[str] = Counter()  # messages, by cause


class Ros2Stack:
    """ROS 2 nodes drive simulated vehicles, each in a namespace of its name.

    Args:
        vehicles: which vehicles; the nodes replace their agents.
        pace: "wall": the run keeps the pace of the wall clock, and commands take effect at the vehicle's next tick;
            "lockstep": at each tick the run waits for a command, the answer to ``odom``, for up to ``agents.deadline_s``.
        endpoint: of Zenoh: where the run listens as the router of rmw_zenoh, or where rmw_zenohd listens.
        mode: "listen": be the router; "connect": to another one.
        domain: ROS_DOMAIN_ID.
        origin: latitude and longitude, degrees, and height, m, of the world's origin, for ``gps/fix``.
        command_timeout_s: in "wall", wall-clock time without a command after which a vehicle stops.
        flying: vehicles that fly. It comes from the program, like all that follow.
        mounts: frames of sensors, by ``vehicle/sensor``.
        deadline_s: wall-clock time within which an answer must come.
        join_timeout_s: wall-clock time within which nodes must have come, in "lockstep".
        tell: receives lines for the user.
    """

    def __init__(
        self,
        *,
        vehicles: tuple[Name, ...],
        pace: Literal["wall", "lockstep"] = "wall",
        endpoint: str = DEFAULT,
        mode: Mode = "listen",
        domain: Domain = 0,
        origin: Vec3 = ORIGIN,
        command_timeout_s: Positive = 0.5,
        flying: frozenset[str] = frozenset(),
        mounts: Mapping[str, Mount] | None = None,
        deadline_s: float = 2.0,
        join_timeout_s: float = 60.0,
        tell: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.vehicles, self.paced = vehicles, pace == "wall"
        self._endpoint, self._mode, self._domain = endpoint, mode, domain
        try:
            self._plane = TangentPlane(*origin)
        except ValueError as error:
            raise ScenarioError(str(error), key="origin") from None
        self._timeout_s, self._deadline_s, self._join_s = command_timeout_s, deadline_s, join_timeout_s
        self._mounts, self._tell = mounts or {}, tell
        self._programs = {name: _Program(flies=name in flying) for name in vehicles}
        self._names = {ros.ros_name(name)[1:]: name for name in vehicles}  # by namespace
        self._news: queue.SimpleQueue[_News] = queue.SimpleQueue()
        self._node: Node | None = None
        self._services: SimulationServices | None = None
        self._outlets: dict[str, Outlet] = {}  # by topic
        self._sensors: dict[str, list[tuple[Outlet, Callable[[Any], ros.RosMessage]]]] = {}  # by key of the reading
        self._now_ns = -1
        self._until_s = 0.0

    def start(self, run: RunInfo) -> None:
        """Open the session and its topics; in lock-step wait until each vehicle's commands have a publisher."""
        self._others = run.vehicles
        mapping = RmwZenoh(self._domain, "vcmvsp")
        try:
            self._node = node = Node(self._endpoint, self._mode, mapping, ())
        except PortError as error:
            raise FederateError("stack.ros2", f"{self._endpoint}: {error.happened}; {error.advice}") from error
        self._open("clock", "rosgraph_msgs/msg/Clock")
        for namespace, vehicle in self._names.items():
            for topic, kind in OUTPUTS.items():
                self._open(f"{namespace}/{topic}", kind)
            for topic, kind in INPUTS.items():
                endpoint = Endpoint("MS", f"{namespace}/{topic}", kind)
                node.add(endpoint)
                node.hear(endpoint, partial(self._hand_over, vehicle, topic), any_type=True)
            if mounted := self._mounted(vehicle):
                latched = Endpoint("MP", f"{namespace}/tf_static", TRANSFORMS, latched=True)
                node.add(latched)
                node.latch(latched, ros.encoded(mounted))
        self._services = SimulationServices(node)
        node.watch(self._watched)
        self._tell(self._how_to_reach())
        if not self.paced:
            self._await_nodes()

    def show(self, now_ns: int, readings: Sequence[Event]) -> None:
        """Publish the time, and the readings of sensors."""
        self._outlets["clock"].put(lambda: ros.clock(now_ns))
        self._now_ns = now_ns
        for event in readings:
            if event.key not in self._sensors:
                self._sensors[event.key] = self._outlets_of(event.key, _computed(event.value))
            for outlet, message in self._sensors[event.key]:
                outlet.put(lambda: message(_computed(event.value)))  # noqa: B023  called at once

    def ask(self, observations: Mapping[str, Observation]) -> None:
        """Publish observations; in lock-step, commands from now on answer them."""
        if not observations:
            return
        self._take_all()
        for vehicle, observation in observations.items():
            program = self._programs[vehicle]
            program.answered, program.asked_ns, program.yaw = False, observation.time_ns, observation.state.yaw
        for namespace, vehicle in self._names.items():
            if vehicle in observations:
                self._publish(namespace, vehicle, observations[vehicle])
        for namespace, vehicle in self._names.items():
            if vehicle in observations:
                self._outlets[f"{namespace}/odom"].put(partial(_odometry, observations[vehicle]))
        self._until_s = time.monotonic() + self._deadline_s

    def answer(self, vehicle: str) -> StackAnswer:
        """The newest command; in lock-step the one that answers the observation."""
        program = self._programs[vehicle]
        if self.paced or program.lost:
            self._take_all()
        while not (self.paced or program.lost or program.command):
            left_s = self._until_s - time.monotonic()
            if left_s <= 0.0:
                program.lost = f"no command on /{vehicle}/cmd_vel within {self._deadline_s:g} s"
                if program.refused:
                    program.lost += f"; {_counted(program.refused)}"
            else:
                self._take(min(left_s, LOOK_S))
        command, program.command = program.command, None
        if command is None and program.lost:
            raise LinkError(program.lost)
        if command is None and program.moves_since_s and time.monotonic() > program.moves_since_s + self._timeout_s:
            command, program.moves_since_s = Velocity(), None
        messages, program.messages = program.messages, []
        return StackAnswer(command, messages)

    def attend(self, control: RunControl) -> None:
        """Answer the calls of services."""
        if self._services is not None:
            self._services.attend(control)

    def close(self) -> None:
        """Close the session, and tell what was refused."""
        if self._services is not None:
            self._services.close()
            self._services = None
        if self._node is not None:
            self._node.close()
            self._node = None
            for vehicle, program in self._programs.items():
                if program.refused:
                    self._tell(f"stack.ros2: {vehicle}: {_counted(program.refused)}")

    # --- messages to nodes ----------------------------------------------------------------------------------------------------

    def _open(self, topic: str, kind: str) -> Outlet:
        assert self._node is not None  # noqa: S101
        self._node.add(Endpoint("MP", topic, kind))
        self._outlets[topic] = Outlet(self._node, topic, kind, complete=not self.paced)
        return self._outlets[topic]

    def _publish(self, namespace: str, vehicle: str, observation: Observation) -> None:
        self._outlets[f"{namespace}/tf"].put(partial(_transforms, observation))
        received = self._outlets[f"{namespace}/radio/received"]
        for each in observation.heard if received.has_subscribers else ():
            received.put(partial(ros.radio_received, each))

    def _mounted(self, vehicle: str) -> ros.RosMessage | None:
        """The frames of a vehicle's sensors; None: it has none."""
        own = {key: mount for key, mount in self._mounts.items() if vehicle_of(key) == vehicle}
        parts = [ros.transform(0, BASE, key.partition("/")[2], *mount) for key, mount in own.items()]
        return ros.make("tf2_msgs/TFMessage", parts) if parts else None

    def _outlets_of(self, key: str, reading: Reading) -> list[tuple[Outlet, Callable[[Any], ros.RosMessage]]]:
        """Topics of a sensor, from its first reading."""
        vehicle, _, sensor = key.partition("/")
        topic, frame = ros.ros_name(key)[1:], sensor if key in self._mounts else BASE
        match reading:
            case Scan():
                return [(self._open(topic, "sensor_msgs/msg/LaserScan"), lambda said: ros.laser_scan(said, frame))]
            case Imu():
                return [(self._open(topic, "sensor_msgs/msg/Imu"), lambda said: ros.imu(said, frame, self._now_ns))]
            case Fix():
                where = f"{ros.ros_name(vehicle)[1:]}/gps/fix" if sensor == "fix" else f"{topic}/fix"
                return [(self._open(where, "sensor_msgs/msg/NavSatFix"), lambda said: self._fix(said, frame))]
            case Image():
                image = self._open(f"{topic}/image_raw", "sensor_msgs/msg/Image")
                camera = self._open(f"{topic}/camera_info", "sensor_msgs/msg/CameraInfo")
                return [(image, lambda said: ros.picture(said, frame)), (camera, lambda said: ros.pinhole(said, frame))]
        return []

    def _fix(self, fix: Fix, frame: str) -> ros.RosMessage:
        up_m = fix.sigma_m if fix.sigma_z_m is None else fix.sigma_z_m
        place = self._plane.geodetic(*fix.position)
        return ros.satellite_fix(fix.time_ns, frame, place, (fix.sigma_m, fix.sigma_m, up_m))

    # --- messages from nodes --------------------------------------------------------------------------------------------------

    def _hand_over(self, vehicle: str, topic: str, message: ReceivedMessage) -> None:
        """Queue a message for the run; called in Zenoh's thread."""
        if self._news.qsize() < WAITING:
            self._news.put(_News(vehicle, topic, message))

    def _watched(self, token: str, endpoint: Endpoint, there: bool) -> None:
        """Queue the coming or going of a publisher of commands; called in Zenoh's thread."""
        namespace, _, topic = endpoint.topic.partition("/")
        if endpoint.kind == "MP" and topic in ("cmd_vel", "goal_pose") and namespace in self._names:
            self._news.put(_News(self._names[namespace], topic, token=token, there=there))

    def _take_all(self) -> None:
        while self._take(0.0):
            pass

    def _take(self, wait_s: float) -> bool:
        """Take the next news, if there is some by then."""
        try:
            news = self._news.get(timeout=wait_s) if wait_s else self._news.get_nowait()
        except queue.Empty:
            return False
        program = self._programs[news.vehicle]
        if news.message is None:
            self._note_publisher(program, news)
            return True
        try:
            self._hear(program, news.topic, news.message)
        except RefusedMessage as refused:
            program.refused[refused.cause] += 1
            if program.refused[refused.cause] == 1:
                self._tell(f"stack.ros2: a message on /{news.vehicle}/{news.topic} is refused: {refused}")
        return True

    def _note_publisher(self, program: _Program, news: _News) -> None:
        if news.there:
            program.publishers.add(news.token)
            return
        program.publishers.discard(news.token)
        program.sender = None
        driven = not self.paced or program.moves_since_s is not None
        if driven and not program.publishers:
            program.lost = f"the node that published /{news.vehicle}/{news.topic} has gone"

    def _hear(self, program: _Program, topic: str, message: ReceivedMessage) -> None:
        if topic == "radio/send":
            _check_type(message, SEND)
            program.messages.append(self._radio_message(program, _decoded(message)))
            return
        command, stamp_ns = _command(program, topic, message)
        if program.sender not in (None, message.sender):
            raise RefusedMessage("second publisher", "another node publishes it, too, and is followed; end one of them")
        program.sender = message.sender
        if not self.paced and not program.lost:
            if 0 < stamp_ns < program.asked_ns:
                raise RefusedMessage("older", f"its stamp, {1e-9 * stamp_ns:g} s, is that of an earlier observation")
            if program.answered:
                raise RefusedMessage("surplus", "the observation was answered already; publish one command for each")
        program.command, program.answered, program.lost = command, True, ""
        program.moves_since_s = time.monotonic() if self.paced else None

    def _radio_message(self, program: _Program, message: Any) -> tuple[dict[str, Any] | bytes, str | None]:
        to = message.to or None
        if to is not None and (to not in self._others or self._programs.get(to) is program):
            raise RefusedMessage("receiver", f"there is no other vehicle '{to}'")
        return _body(message), to

    # --- the way in -----------------------------------------------------------------------------------------------------------

    def _how_to_reach(self) -> str:
        topics = [f"/{each}/cmd_vel" for each in self._names]
        if len(topics) > 3:
            topics[3:] = ["..."]
        config = "" if self._endpoint == DEFAULT else f" ZENOH_CONFIG_OVERRIDE='connect/endpoints=[\"{self._endpoint}\"]'"
        where = f"RMW_IMPLEMENTATION=rmw_zenoh_cpp ROS_DOMAIN_ID={self._domain}{config}"
        return f"stack.ros2: nodes with {where} drive by {', '.join(topics)}"

    def _await_nodes(self) -> None:
        until_s = time.monotonic() + self._join_s
        while missing := [f"/{name}/cmd_vel" for name, each in self._programs.items() if not each.publishers]:
            if time.monotonic() > until_s:
                raise FederateError("stack.ros2", f"no node publishes {', '.join(missing)} within {self._join_s:g} s")
            self._take(LOOK_S)
        for program in self._programs.values():
            program.lost = ""


def _computed(value: Any) -> Reading:
    return value.get() if isinstance(value, Later) else value


def _transforms(observation: Observation) -> ros.RosMessage:
    """``map`` to ``odom`` to ``base_link``, which is where the estimate is."""
    odometry = observation.readings.get("odometry")
    place, turn = observation.state.position, observation.state.attitude
    parts = [(MAP, ODOM, ORIGIN, (1.0, 0.0, 0.0, 0.0)), (ODOM, BASE, place, turn)]
    if isinstance(odometry, Odometry):
        x, y, yaw = odometry.pose
        off = product(turn, quaternion_from_yaw(-yaw))
        dx, dy, dz = ros.rotated(off, (x, y, 0.0))
        corrected = place[0] - dx, place[1] - dy, place[2] - dz
        parts = [(MAP, ODOM, corrected, off), (ODOM, BASE, (x, y, 0.0), quaternion_from_yaw(yaw))]
    return ros.make("tf2_msgs/TFMessage", [ros.transform(observation.time_ns, *part) for part in parts])


def _odometry(observation: Observation) -> ros.RosMessage:
    odometry = observation.readings.get("odometry")
    if isinstance(odometry, Odometry):
        return ros.odometry(odometry, BASE, observation.time_ns, ODOM)
    return ros.state(observation.state, BASE, observation.time_ns, ODOM)


def _command(program: _Program, topic: str, message: ReceivedMessage) -> tuple[Velocity | Waypoint, int]:
    """The command of a message, and its stamp (ns); 0: it has none."""
    if topic == "goal_pose":
        _check_type(message, POSE)
        if not program.flies:
            raise RefusedMessage("goal_pose", "only flying vehicles follow it; publish cmd_vel")
        content = _decoded(message)
        place, turn = content.pose.position, content.pose.orientation
        numbers = place.x, place.y, place.z, yaw_of((turn.w, turn.x, turn.y, turn.z))
        _check_size(*numbers)
        return Waypoint(position=numbers[:3], yaw=numbers[3]), ros.nanoseconds(content.header.stamp)
    _check_type(message, TWIST, TWIST_STAMPED)
    try:
        twist = decode_twist(message.data, stamped=message.type == TWIST_STAMPED)
    except ValueError as error:
        raise RefusedMessage("content", str(error)) from None
    x, y, z = twist.linear
    _check_size(x, y, z, twist.angular[2])
    if program.flies:  # a Twist is along the body's axes, a command in the world's
        x, y = rotate2(x, y, program.yaw)
    return Velocity(linear=(x, y, z), yaw_rate=twist.angular[2]), twist.stamp_ns


def _check_size(*numbers: float) -> None:
    if not all(abs(each) <= LARGEST for each in numbers):  # also refuses NaN
        raise RefusedMessage("content", f"numbers must be from {-LARGEST:g} to {LARGEST:g}")


def _check_type(message: ReceivedMessage, *types: str) -> None:
    if message.type not in types:
        raise RefusedMessage("type", f"it is {message.type}, not {' or '.join(types)}")


def _decoded(message: ReceivedMessage) -> Any:
    try:
        return ros.decoded(message.data, message.type)
    except ValueError as error:
        raise RefusedMessage("content", str(error)) from None


def _body(message: Any) -> dict[str, Any] | bytes:
    """The content of a RadioSend: bytes, or what agents receive as a mapping."""
    if not message.msgpack:
        return bytes(message.data.tobytes())
    try:
        body: dict[str, Any] = msgspec.msgpack.decode(message.data.tobytes(), type=dict[str, Any])
        check_body(body)
    except (msgspec.MsgspecError, TypeError, ValueError) as error:
        raise RefusedMessage("content", f"its data are not the MessagePack of a map that can be recorded: {error}") from None
    return body


def _counted(refused: Counter[str]) -> str:
    """The refused messages in words."""
    return f"refused messages: {', '.join(f'{count} {cause}' for cause, count in refused.items())}"
