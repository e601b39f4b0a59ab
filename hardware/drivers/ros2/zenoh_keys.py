"""Zenoh keys of ROS 2 topics, nodes and endpoints in two mappings, and attachments of messages.

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
from hashlib import blake2b
from typing import Literal, NamedTuple, Protocol

from vcmvsp.hardware.drivers.ros2.cdr_messages import type_hash

Kind = Literal["MP", "MS"]
"""A publisher of messages, or a subscriber."""
Release = Literal["humble", "later"]

NO_HASH = "TypeHashNotSupported"  # in place of the hash in Humble, which has none
DEPTH = 10  # of both queues, as rclpy and rclcpp examples have it

_NAME = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(?:/[A-Za-z_][A-Za-z0-9_]*)*")
_ATTACHMENT = struct.Struct("<qqB16s")
_NAMED = struct.Struct("<16sq17sq11sB16s")
_NAMES = (b"\x0fsequence_number", b"\x10source_timestamp", b"\x0asource_gid")


class Endpoint(NamedTuple):
    """A publisher or a subscriber of a node."""

    kind: Kind
    topic: str  # without the leading slash
    type: str  # such as geometry_msgs/msg/Twist


class Origin(NamedTuple):
    """Content of an attachment."""

    number: int
    time_ns: int  # since 1970, by the sender's clock
    gid: bytes  # 16 bytes, the sender's


class Mapping(Protocol):
    """Names of ROS 2 as Zenoh keys."""

    graph: str  # all tokens

    def publishes(self, topic: str, name: str) -> str:
        """The key for messages of this type."""

    def hears(self, topic: str) -> str:
        """Key expression for a topic, of any type."""

    def type_of(self, key: str) -> str | None:
        """Type of the messages under this key; empty: unknown; None: no key for data."""

    def tokens(self, session: str, endpoints: tuple[Endpoint, ...]) -> list[str]:
        """Tokens of a node: one for each endpoint, in their order, then those of the node."""

    def endpoint(self, token: str) -> Endpoint | None:
        """Endpoint of a token; None: no publisher or subscriber of messages."""

    def attachment(self, origin: Origin) -> bytes | None:
        """Attachment of a message."""


class RmwZenoh:
    """Keys of rmw_zenoh.

    Args:
        domain: ROS_DOMAIN_ID.
        node: its name.
        release: of the robot; Humble has no type hashes.
    """

    def __init__(self, domain: int, node: str, release: Release = "later") -> None:
        self._domain, self._node, self._release = domain, node, release
        self.graph = f"@ros2_lv/{domain}/**"

    def publishes(self, topic: str, name: str) -> str:
        """Domain, topic, type, hash."""
        return f"{self._domain}/{topic}/{_dds_type(name)}/{self._hash(name)}"

    def hears(self, topic: str) -> str:
        """Any type and any hash; ``**`` would also catch topics below this one."""
        return f"{self._domain}/{topic}/*/*"

    def type_of(self, key: str) -> str | None:
        """The last part but one."""
        parts = key.split("/")
        return None if "*" in key or len(parts) < 4 else _ros_type(parts[-2])

    def tokens(self, session: str, endpoints: tuple[Endpoint, ...]) -> list[str]:
        """Node 0 in the enclave and namespace ``/``; the quality of service is the default with a queue of `DEPTH`."""
        lead = f"@ros2_lv/{self._domain}/{session}/0"
        tokens = []
        for number, (kind, topic, name) in enumerate(endpoints, start=1):
            what = f"%{topic.replace('/', '%')}/{_dds_type(name)}/{self._hash(name)}/::,{DEPTH}:,:,:,,"
            tokens.append(f"{lead}/{number}/{kind}/%/%/{self._node}/{what}")
        return [*tokens, f"{lead}/0/NN/%/%/{self._node}"]

    def endpoint(self, token: str) -> Endpoint | None:
        """Parts 5, 9 and 10 of 0 to 12."""
        parts = token.split("/")
        if len(parts) != 13 or parts[5] not in ("MP", "MS"):
            return None
        kind: Kind = "MP" if parts[5] == "MP" else "MS"
        return Endpoint(kind, parts[9].replace("%", "/").lstrip("/"), _ros_type(parts[10]))

    def attachment(self, origin: Origin) -> bytes | None:
        """33 bytes; a node without an attachment drops the message, and an invalid one may end a node."""
        return _ATTACHMENT.pack(origin.number, origin.time_ns, 16, origin.gid)

    def _hash(self, name: str) -> str:
        return NO_HASH if self._release == "humble" else type_hash(name)


class Ros2Dds:
    """The keys of zenoh-bridge-ros2dds without a namespace of its own."""

    graph = "@/*/@ros2_lv/**"

    def publishes(self, topic: str, name: str) -> str:
        """The topic."""
        return topic

    def hears(self, topic: str) -> str:
        """The topic."""
        return topic

    def type_of(self, key: str) -> str | None:
        """Unknown."""
        return None if "*" in key else ""

    def tokens(self, session: str, endpoints: tuple[Endpoint, ...]) -> list[str]:
        """Reliable (1), with a queue (0) of `DEPTH`; a slash becomes a section sign."""
        lead = f"@/{session}/@ros2_lv"
        return [f"{lead}/{kind}/{_section(topic)}/{_section(name)}/:1::0,{DEPTH}" for kind, topic, name in endpoints] + [lead]

    def endpoint(self, token: str) -> Endpoint | None:
        """Parts 3, 4 and 5 of 0 to 6."""
        parts = token.split("/")
        if len(parts) != 7 or parts[3] not in ("MP", "MS"):
            return None
        kind: Kind = "MP" if parts[3] == "MP" else "MS"
        return Endpoint(kind, parts[4].replace("§", "/"), parts[5].replace("§", "/"))

    def attachment(self, origin: Origin) -> bytes | None:
        """None."""
        return None


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
    """Full name of a topic, without the leading slash; a topic with a leading slash is in no namespace.

    Raises:
        ValueError: an invalid name.
    """
    if not _NAME.fullmatch(topic):
        raise ValueError(f"'{topic}' is no topic: write letters, digits, _ and /, such as cmd_vel or /robot1/cmd_vel")
    if namespace.strip("/") and not _NAME.fullmatch(namespace.rstrip("/")):
        raise ValueError(f"'{namespace}' is no namespace: write letters, digits, _ and /, such as robot1")
    parts = [namespace.strip("/"), topic] if not topic.startswith("/") else [topic[1:]]
    return "/".join(part for part in parts if part)


def _dds_type(name: str) -> str:
    """``geometry_msgs/msg/Twist`` as ``geometry_msgs::msg::dds_::Twist_``."""
    package, folder, kind = name.split("/")
    return f"{package}::{folder}::dds_::{kind}_"


def _ros_type(name: str) -> str:
    """The reverse; a name of another form comes out as it is, slashes for colons."""
    return name.replace("::dds_::", "::").removesuffix("_").replace("::", "/")


def _section(name: str) -> str:
    return name.replace("/", "§")
