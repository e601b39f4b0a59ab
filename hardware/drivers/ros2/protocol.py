"""ROS 2 messages as CDR bytes, and their names as Zenoh keys, in two mappings, with attachments of messages.

CDR as rmw implementations send it: the header ``00 01 00 00`` (little-endian; ``00 00``, big-endian, is read, too), then the
fields aligned from behind it. The definitions are from ROS 2 Jazzy, unchanged since Foxy.

``rmw_zenoh`` (the middleware of ROS 2 itself; its ``docs/design.md`` and ``liveliness_utils.cpp``)::

    <domain>/<topic>/<type>/<hash of the type>                 data; the attachment has number, time and sender
    @ros2_lv/<domain>/<session>/<node>/<endpoint>/<kind>/...   liveliness tokens

``ros2dds`` (zenoh-bridge-ros2dds beside robots with DDS; ``liveliness_mgt.rs`` of zenoh-plugin-ros2dds)::

    <topic>                                                    data; no attachment
    @/<session>/@ros2_lv/<kind>/<topic>/<type>/<qos>           liveliness tokens

Data needs no tokens; ``ros2 topic list`` shows them, and they show the types of a robot.
"""

import re
import struct
from functools import cache
from hashlib import blake2b
from math import isfinite, sqrt
from typing import Any, Literal, NamedTuple

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.frames import Quaternion
from vcmvsp.cosim.recording import ros_messages as ros
from vcmvsp.cosim.types import ORIGIN, Vec3

TWIST, TWIST_STAMPED, ODOMETRY = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped", "nav_msgs/msg/Odometry"
NO_COVARIANCE = (0.0,) * 36
STAMPS_END_NS = 2**31 * SECOND_NS  # stamps have 32-bit signed seconds: until 2038, for clocks since 1970
UNIT_WITHIN = 0.01  # maximum error of a quaternion's norm


class RefusedMessage(Exception):
    """A message that is not followed: its kind of cause, and the cause in words."""

    def __init__(self, cause: str, why: str) -> None:
        self.cause = cause
        super().__init__(why)


class Twist(NamedTuple):
    """A velocity in the frame of the body; with a stamp and a frame where it is a TwistStamped."""

    linear: Vec3  # m/s
    angular: Vec3  # rad/s
    stamp_ns: int = 0  # of the sender's clock
    frame: str = ""


class OdometryMessage(NamedTuple):
    """nav_msgs/Odometry: the pose in ``frame``, the velocity in ``child_frame``."""

    position: Vec3  # m
    attitude: Quaternion  # w, x, y, z; frame_from_child
    linear: Vec3 = ORIGIN  # m/s
    angular: Vec3 = ORIGIN  # rad/s
    stamp_ns: int = 0  # of the robot's clock; 0: none
    frame: str = "odom"
    child_frame: str = "base_link"
    pose_covariance: tuple[float, ...] = NO_COVARIANCE  # row by row: x, y, z, rotations about x, y, z
    twist_covariance: tuple[float, ...] = NO_COVARIANCE


@cache
def type_hash(name: str) -> str:
    """The hash of a type's definition (REP 2011), ``RIHS01_...``."""
    return ros.store().hash_rihs01(name)


def encode_twist(twist: Twist, *, stamped: bool) -> bytes:
    """CDR bytes of a Twist or TwistStamped."""
    message = ros.twist(twist.linear, twist.angular)
    if stamped:
        message = ros.make("geometry_msgs/TwistStamped", ros.header(twist.stamp_ns, twist.frame), message)
    return ros.encoded(message)


def decode_twist(data: bytes, *, stamped: bool) -> Twist:
    """Twist or TwistStamped of CDR bytes; raises `ValueError`."""
    message = ros.decoded(data, TWIST_STAMPED if stamped else TWIST)
    twist = message.twist if stamped else message
    stamp_ns, frame = (ros.nanoseconds(message.header.stamp), message.header.frame_id) if stamped else (0, "")
    linear, angular = _tuple(twist.linear), _tuple(twist.angular)
    _check_finite("the velocity", *linear, *angular)
    return Twist(linear, angular, stamp_ns, frame)


def encode_odometry(odometry: OdometryMessage) -> bytes:
    """CDR bytes of an Odometry message."""
    head = ros.header(odometry.stamp_ns, odometry.frame)
    pose, twist = (odometry.position, odometry.attitude), (odometry.linear, odometry.angular)
    covariances = np.array(odometry.pose_covariance), np.array(odometry.twist_covariance)
    return ros.encoded(ros.moving(head, odometry.child_frame, *pose, *twist, *covariances))


def decode_odometry(data: bytes) -> OdometryMessage:
    """Odometry of CDR bytes; raises `ValueError` for invalid bytes, NaN, infinity, and a quaternion that is no rotation.

    Covariances may have any value: nodes without covariances send zero or NaN.
    """
    message = ros.decoded(data, ODOMETRY)
    pose, twist, orientation = message.pose.pose, message.twist.twist, message.pose.pose.orientation
    position, linear, angular = _tuple(pose.position), _tuple(twist.linear), _tuple(twist.angular)
    w, x, y, z = orientation.w, orientation.x, orientation.y, orientation.z
    _check_finite("the pose", *position, w, x, y, z)
    _check_finite("the velocity", *linear, *angular)
    norm = sqrt(w * w + x * x + y * y + z * z)
    if not abs(norm - 1.0) <= UNIT_WITHIN:  # written so that infinity is refused
        raise ValueError("its orientation is not a rotation")
    return OdometryMessage(
        position=position,
        attitude=(w / norm, x / norm, y / norm, z / norm),
        linear=linear,
        angular=angular,
        stamp_ns=ros.nanoseconds(message.header.stamp),
        frame=message.header.frame_id,
        child_frame=message.child_frame_id,
        pose_covariance=tuple(message.pose.covariance.tolist()),
        twist_covariance=tuple(message.twist.covariance.tolist()),
    )


def _tuple(vector: Any) -> Vec3:
    return vector.x, vector.y, vector.z


def _check_finite(what: str, *numbers: float) -> None:
    if not all(map(isfinite, numbers)):
        raise ValueError(f"{what} is not finite")


_KINDS = ("MP", "MS")
Release = Literal["humble", "later"]

NO_HASH = "TypeHashNotSupported"  # in place of the hash in Humble, which has none
DEPTH = 10  # of both queues, as rclpy and rclcpp examples have it

_NAME = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(?:/[A-Za-z_][A-Za-z0-9_]*)*")
_ATTACHMENT = struct.Struct("<qqB16s")
_NAMED = struct.Struct("<16sq17sq11sB16s")
_NAMES = (b"\x0fsequence_number", b"\x10source_timestamp", b"\x0asource_gid")


class Endpoint(NamedTuple):
    """A publisher, a subscriber or a service of a node."""

    kind: str  # MP: a publisher of messages, MS: a subscriber, SS: a service
    topic: str  # or name of the service, without the leading slash
    type: str  # such as geometry_msgs/msg/Twist
    latched: bool = False  # transient-local: late subscribers get the last message


class Origin(NamedTuple):
    """Content of an attachment."""

    number: int
    time_ns: int  # since 1970, by the sender's clock
    gid: bytes  # 16 bytes, the sender's


class RmwZenoh:
    """Keys of rmw_zenoh, for a domain (ROS_DOMAIN_ID), a node's name and the robot's release: Humble has no type hashes."""

    def __init__(self, domain: int, node: str, release: Release = "later") -> None:
        self._domain, self._node, self._release = domain, node, release
        self.graph = f"@ros2_lv/{domain}/**"

    def publishes(self, topic: str, name: str) -> str:
        """The key for messages of this type."""
        return f"{self._domain}/{topic}/{_dds_type(name)}/{self._hash(name)}"

    def subscription_key(self, topic: str) -> str:
        """Key expression for a topic, of any type and any hash; ``**`` would also catch topics below this one."""
        return f"{self._domain}/{topic}/*/*"

    def type_of(self, key: str) -> str | None:
        """Type of the messages under this key; empty: unknown; None: no key for data."""
        parts = key.split("/")
        return None if "*" in key or len(parts) < 4 else _ros_type(parts[-2])

    def tokens(self, session: str, endpoints: tuple[Endpoint, ...]) -> list[str]:
        """Tokens of a node: one for each endpoint, in their order, then the tokens of the node itself.

        It is node 0 in the enclave and namespace ``/``; the quality of service is the default with a queue of `DEPTH`, or
        transient-local (1) with the last message.
        """
        lead = f"@ros2_lv/{self._domain}/{session}/0"
        tokens = []
        for number, (kind, topic, name, latched) in enumerate(endpoints, start=1):
            quality = ":1:,1" if latched else f"::,{DEPTH}"
            topic_info = f"%{topic.replace('/', '%')}/{_dds_type(name)}/{self._hash(name)}/{quality}:,:,:,,"
            tokens.append(f"{lead}/{number}/{kind}/%/%/{self._node}/{topic_info}")
        return [*tokens, f"{lead}/0/NN/%/%/{self._node}"]

    def endpoint(self, token: str) -> Endpoint | None:
        """Endpoint of a token; None: no publisher or subscriber of messages."""
        parts = token.split("/")
        if len(parts) != 13 or parts[5] not in _KINDS:
            return None
        return Endpoint(parts[5], parts[9].replace("%", "/").lstrip("/"), _ros_type(parts[10]))

    def attachment(self, origin: Origin) -> bytes | None:
        """Attachment of a message, 33 bytes; a node drops messages without one, and an invalid one may end a node."""
        return _ATTACHMENT.pack(origin.number, origin.time_ns, 16, origin.gid)

    def _hash(self, name: str) -> str:
        return NO_HASH if self._release == "humble" else type_hash(name)


class Ros2Dds:
    """The keys of zenoh-bridge-ros2dds without a namespace of its own."""

    graph = "@/*/@ros2_lv/**"

    def publishes(self, topic: str, name: str) -> str:
        """Key of a topic: the topic itself."""
        return topic

    def subscription_key(self, topic: str) -> str:
        """Key expression of a topic: the topic itself."""
        return topic

    def type_of(self, key: str) -> str | None:
        """Type of messages under a key: unknown."""
        return None if "*" in key else ""

    def tokens(self, session: str, endpoints: tuple[Endpoint, ...]) -> list[str]:
        """Tokens of endpoints: reliable (1), with a queue (0) of `DEPTH`; a slash becomes a section sign."""
        lead = f"@/{session}/@ros2_lv"
        names = [(kind, topic.replace("/", "§"), name.replace("/", "§")) for kind, topic, name, _ in endpoints]
        return [f"{lead}/{kind}/{topic}/{name}/:1::0,{DEPTH}" for kind, topic, name in names] + [lead]

    def endpoint(self, token: str) -> Endpoint | None:
        """Endpoint of a token, from its parts 3, 4 and 5."""
        parts = token.split("/")
        if len(parts) != 7 or parts[3] not in _KINDS:
            return None
        return Endpoint(parts[3], parts[4].replace("§", "/"), parts[5].replace("§", "/"))

    def attachment(self, origin: Origin) -> bytes | None:
        """Attachment of a message: none."""
        return None


Mapping = RmwZenoh | Ros2Dds


def origin_of(attachment: bytes) -> Origin | None:
    """Content of an attachment: 33 bytes, or 77 with field names (rmw_zenoh 0.2.0 to 0.2.3, Jazzy); None: neither."""
    if len(attachment) == _ATTACHMENT.size:
        number, time_ns, length, gid = _ATTACHMENT.unpack(attachment)
    elif len(attachment) == _NAMED.size:
        first, number, second, time_ns, third, length, gid = _NAMED.unpack(attachment)
        if (first, second, third) != _NAMES:
            return None
    else:
        return None
    return Origin(number, time_ns, gid) if length == 16 else None


def gid_of(token: str) -> bytes:
    """Unique 16 bytes of an endpoint."""
    return blake2b(token.encode(), digest_size=16).digest()


def topic_of(namespace: str, topic: str) -> str:
    """Name of a topic, without leading slash; one with a leading slash is in no namespace. `ValueError`: it is invalid."""
    if not _NAME.fullmatch(topic):
        raise ValueError(f"'{topic}' is not a topic: use letters, digits, _ and /, such as cmd_vel or /robot1/cmd_vel")
    if namespace.strip("/") and not _NAME.fullmatch(namespace.rstrip("/")):
        raise ValueError(f"'{namespace}' is not a namespace: use letters, digits, _ and /, such as robot1")
    parts = [namespace.strip("/"), topic] if not topic.startswith("/") else [topic[1:]]
    return "/".join(part for part in parts if part)


def _dds_type(name: str) -> str:
    """``geometry_msgs/msg/Twist`` as ``geometry_msgs::msg::dds_::Twist_``."""
    package, folder, kind = name.split("/")
    return f"{package}::{folder}::dds_::{kind}_"


def _ros_type(name: str) -> str:
    """Reverse of `_dds_type`; a name of another form is unchanged, with slashes for colons."""
    return name.replace("::dds_::", "::").removesuffix("_").replace("::", "/")
