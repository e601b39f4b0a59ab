"""ROS 2 messages as CDR bytes: Twist and TwistStamped to the robot, Odometry from it.

CDR as rmw implementations send it: the header ``00 01 00 00`` (little-endian; ``00 00``, big-endian, is read, too), then the
fields aligned from behind it. The definitions are those of ROS 2 Jazzy, unchanged since Foxy.
"""

from functools import cache
from math import isfinite, sqrt
from typing import Any, NamedTuple

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.frames import Quaternion
from vcmvsp.cosim.types import Vec3

TWIST, TWIST_STAMPED, ODOMETRY = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped", "nav_msgs/msg/Odometry"
ZERO: Vec3 = (0.0, 0.0, 0.0)
NO_COVARIANCE = (0.0,) * 36
STAMPS_END_NS = 2**31 * SECOND_NS  # stamps have 32-bit signed seconds: until 2038, for clocks since 1970
UNIT_WITHIN = 0.01  # maximum error of a quaternion's norm


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
    linear: Vec3 = ZERO  # m/s
    angular: Vec3 = ZERO  # rad/s
    stamp_ns: int = 0  # of the robot's clock; 0: none
    frame: str = "odom"
    child_frame: str = "base_link"
    pose_covariance: tuple[float, ...] = NO_COVARIANCE  # row by row: x, y, z, rotations about x, y, z
    twist_covariance: tuple[float, ...] = NO_COVARIANCE


@cache
def _store() -> Typestore:
    return get_typestore(Stores.ROS2_JAZZY)  # 0.1 s


@cache
def type_hash(name: str) -> str:
    """The hash of a type's definition (REP 2011), ``RIHS01_...``."""
    return _store().hash_rihs01(name)


def encode_twist(twist: Twist, *, stamped: bool) -> bytes:
    """Twist, or TwistStamped."""
    message = _make(TWIST, linear=_vector(twist.linear), angular=_vector(twist.angular))
    if not stamped:
        return _encoded(TWIST, message)
    header = _header(twist.stamp_ns, twist.frame)
    return _encoded(TWIST_STAMPED, _make(TWIST_STAMPED, header=header, twist=message))


def decode_twist(data: bytes, *, stamped: bool) -> Twist:
    """Twist or TwistStamped of CDR bytes; raises `ValueError`."""
    message = _decoded(data, TWIST_STAMPED if stamped else TWIST)
    twist = message.twist if stamped else message
    stamp_ns, frame = (_stamp(message.header.stamp), message.header.frame_id) if stamped else (0, "")
    linear, angular = _tuple(twist.linear), _tuple(twist.angular)
    _check_finite("the velocity", *linear, *angular)
    return Twist(linear, angular, stamp_ns, frame)


def encode_odometry(odometry: OdometryMessage) -> bytes:
    """Odometry."""
    w, x, y, z = odometry.attitude
    pose = _make(
        "geometry_msgs/msg/Pose",
        position=_make("geometry_msgs/msg/Point", **_xyz(odometry.position)),
        orientation=_make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
    )
    twist = _make(TWIST, linear=_vector(odometry.linear), angular=_vector(odometry.angular))
    pose_covariance, twist_covariance = np.array(odometry.pose_covariance), np.array(odometry.twist_covariance)
    message = _make(
        ODOMETRY,
        header=_header(odometry.stamp_ns, odometry.frame),
        child_frame_id=odometry.child_frame,
        pose=_make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=pose_covariance),
        twist=_make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=twist_covariance),
    )
    return _encoded(ODOMETRY, message)


def decode_odometry(data: bytes) -> OdometryMessage:
    """Odometry of CDR bytes; raises `ValueError` for invalid bytes, NaN, infinity, and a quaternion that is no rotation.

    Covariances may have any value: nodes without covariances send zero or NaN.
    """
    message = _decoded(data, ODOMETRY)
    pose, twist, orientation = message.pose.pose, message.twist.twist, message.pose.pose.orientation
    position, linear, angular = _tuple(pose.position), _tuple(twist.linear), _tuple(twist.angular)
    w, x, y, z = orientation.w, orientation.x, orientation.y, orientation.z
    _check_finite("the pose", *position, w, x, y, z)
    _check_finite("the velocity", *linear, *angular)
    norm = sqrt(w * w + x * x + y * y + z * z)
    if not abs(norm - 1.0) <= UNIT_WITHIN:  # written so that infinity is refused
        raise ValueError("its orientation is no rotation")
    return OdometryMessage(
        position=position,
        attitude=(w / norm, x / norm, y / norm, z / norm),
        linear=linear,
        angular=angular,
        stamp_ns=_stamp(message.header.stamp),
        frame=message.header.frame_id,
        child_frame=message.child_frame_id,
        pose_covariance=tuple(message.pose.covariance.tolist()),
        twist_covariance=tuple(message.twist.covariance.tolist()),
    )


def _make(name: str, **fields: Any) -> Any:
    return _store().types[name](**fields)


def _xyz(vector: Vec3) -> dict[str, float]:
    return dict(zip("xyz", vector, strict=True))


def _vector(vector: Vec3) -> Any:
    return _make("geometry_msgs/msg/Vector3", **_xyz(vector))


def _header(stamp_ns: int, frame: str) -> Any:
    sec, nanosec = divmod(stamp_ns, SECOND_NS)
    return _make("std_msgs/msg/Header", stamp=_make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec), frame_id=frame)


def _encoded(name: str, message: object) -> bytes:
    return bytes(_store().serialize_cdr(message, name, little_endian=True))


def _decoded(data: bytes, name: str) -> Any:
    try:
        return _store().deserialize_cdr(data, name)
    except SerdeError:
        raise ValueError(f"{len(data)} bytes are no {name}") from None


def _tuple(vector: Any) -> Vec3:
    return vector.x, vector.y, vector.z


def _stamp(time: Any) -> int:
    return int(time.sec) * SECOND_NS + int(time.nanosec)


def _check_finite(what: str, *numbers: float) -> None:
    if not all(map(isfinite, numbers)):
        raise ValueError(f"{what} is not finite")
