"""Conversion of values, recorded messages and scenes to ROS 2 messages (definitions of Jazzy, unchanged since Foxy).

Frames and units are the same in both: ``world`` is east, north, up, a vehicle's own frame forward, left, up; SI units, radians.
Time is simulated, from 0. The functions are fast and stateless.

`OWN_TYPES` are the messages of the emulated radio, for which ROS has none; nodes need a package with these definitions.
"""

import math
import re
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, ClassVar, Protocol

import msgspec
import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from vcmvsp.cosim.frames import Quaternion, product, quaternion_from_yaw
from vcmvsp.cosim.recording import foxglove as messages
from vcmvsp.cosim.recording.foxglove import CompressedImage, Grid
from vcmvsp.cosim.types import Array, Image, Imu, Odometry, Reception, Scan, Vec3, VehicleState, Velocity, Waypoint

WORLD = "world"
LOG_LEVELS = {1: 10, 2: 20, 3: 30, 4: 40, 5: 50}  # foxglove.LogLevel -> rcl_interfaces/Log
ANY_HEADING = math.pi**2 / 3.0  # rad2, variance of an unknown heading: ROS would take 0 for certainty
UNKNOWN = -1.0  # first element of a covariance: no data in this part of the message
ARROW, CUBE, CYLINDER, LINE_STRIP, LINE_LIST, TEXT, TRIANGLES = 0, 1, 3, 4, 5, 9, 11  # visualization_msgs/Marker
DELETE_ALL = 3  # a marker action
LINE_M = 0.03  # width of lines without a width in metres
TEXT_M = 0.3  # height of letters without a height in metres
NO_COVARIANCE = np.zeros(36)
OWN_TYPES = {
    "vcmvsp_msgs/msg/RadioSend": "string to\nbool msgpack\nuint8[] data\n",
    "vcmvsp_msgs/msg/RadioReceived": "std_msgs/Header header\nstring sender\nfloat64 rssi_dbm\n"
    "builtin_interfaces/Duration age\nbool msgpack\nuint8[] data\n",
}


class RosMessage(Protocol):
    """A ROS message; rosbags creates the classes at run time, from their definitions."""

    __msgtype__: ClassVar[str]


@cache
def store() -> Typestore:
    """The message definitions."""
    typestore = get_typestore(Stores.ROS2_JAZZY)  # 0.1 s
    for name, definition in OWN_TYPES.items():
        typestore.register(get_types_from_msg(definition, name))
    return typestore


def encoded(message: RosMessage) -> bytes:
    """CDR bytes of a message, little-endian, with their header of 4 bytes."""
    return bytes(store().serialize_cdr(message, message.__msgtype__, little_endian=True))


def decoded(data: bytes, name: str) -> Any:
    """The message ``package/msg/Name`` of CDR bytes; raises `ValueError`."""
    try:
        return store().deserialize_cdr(data, name)
    except SerdeError:
        raise ValueError(f"{len(data)} bytes are not a valid {name}") from None


@cache
def _kind(name: str) -> Callable[..., RosMessage]:
    package, _, kind = name.partition("/")
    return store().types[f"{package}/msg/{kind}"]


def make(name: str, /, *fields: object, **more: object) -> RosMessage:
    """Create a message: ``package/Name``, with its fields in the order of the definition, or by name."""
    return _kind(name)(*fields, **more)


def stamp(time_ns: int) -> RosMessage:
    """builtin_interfaces/Time."""
    return make("builtin_interfaces/Time", *divmod(time_ns, 1_000_000_000))


def header(time_ns: int, frame: str) -> RosMessage:
    """std_msgs/Header: time and frame."""
    return make("std_msgs/Header", stamp(time_ns), frame)


def transforms(message: messages.FrameTransforms, time_ns: int) -> RosMessage:
    """tf2_msgs/TFMessage."""
    listed = [
        transform(time_ns, each.parent_frame_id, each.child_frame_id, _xyz(each.translation), _wxyz(each.rotation))
        for each in message.transforms
    ]
    return make("tf2_msgs/TFMessage", listed)


def transform(time_ns: int, parent: str, child: str, place: Vec3, turn: Quaternion) -> RosMessage:
    """geometry_msgs/TransformStamped: parent_from_child."""
    parent_from_child = make("geometry_msgs/Transform", vector(*place), _turn(*turn))
    return make("geometry_msgs/TransformStamped", header(time_ns, parent), child, parent_from_child)


def state(value: VehicleState, vehicle: str, time_ns: int, frame: str = WORLD) -> RosMessage:
    """nav_msgs/Odometry: pose in the world; velocities in the vehicle's frame, as ROS requires."""
    w, x, y, z = value.attitude
    linear = rotated((w, -x, -y, -z), value.velocity)
    return moving(header(time_ns, frame), vehicle, value.position, value.attitude, linear, value.angular_velocity)


def odometry(value: Odometry, vehicle: str, time_ns: int, frame: str = WORLD) -> RosMessage:
    """nav_msgs/Odometry: wheel odometry."""
    x, y, yaw = value.pose
    turn = quaternion_from_yaw(yaw)
    return moving(header(time_ns, frame), vehicle, (x, y, 0.0), turn, (value.v, 0.0, 0.0), (0.0, 0.0, value.w))


def moving(
    head: RosMessage,
    child: str,
    position: Vec3,
    attitude: Quaternion,
    linear: Vec3,
    angular: Vec3,
    pose_covariance: Array = NO_COVARIANCE,
    twist_covariance: Array = NO_COVARIANCE,
) -> RosMessage:
    """nav_msgs/Odometry: the velocities are along the child's axes."""
    place = make("geometry_msgs/PoseWithCovariance", pose(position, attitude), pose_covariance)
    speeds = make("geometry_msgs/TwistWithCovariance", twist(linear, angular), twist_covariance)
    return make("nav_msgs/Odometry", head, child, place, speeds)


def twist(linear: Vec3, angular: Vec3) -> RosMessage:
    """geometry_msgs/Twist."""
    return make("geometry_msgs/Twist", vector(*linear), vector(*angular))


def path(places: Sequence[tuple[int, VehicleState]]) -> RosMessage:
    """nav_msgs/Path: the complete track of a vehicle."""
    poses = [_posed(time_ns, each.position, each.attitude) for time_ns, each in places]
    return make("nav_msgs/Path", header(0, WORLD), poses)


def velocity(value: Velocity, vehicle: str, time_ns: int) -> RosMessage:
    """geometry_msgs/TwistStamped: a command; for its axes see `cosim.export.rosbag`."""
    return make("geometry_msgs/TwistStamped", header(time_ns, vehicle), twist(value.linear, (0.0, 0.0, value.yaw_rate)))


def waypoint(value: Waypoint, time_ns: int) -> RosMessage:
    """geometry_msgs/PoseStamped: a way-point; a free heading is 0."""
    return _posed(time_ns, value.position, quaternion_from_yaw(value.yaw or 0.0))


def fix(message: messages.PoseInFrame) -> RosMessage:
    """geometry_msgs/PoseWithCovarianceStamped, at the time of measurement; variance of an unmeasured heading: `ANY_HEADING`."""
    covariance = np.zeros(36)
    covariance[[0, 7, 14]], covariance[35] = message.sigma_m**2, ANY_HEADING if message.yaw is None else message.sigma_rad**2
    place = make("geometry_msgs/PoseWithCovariance", _pose_of(message.pose), covariance)
    return make("geometry_msgs/PoseWithCovarianceStamped", header(message.timestamp.ns, message.frame_id), place)


def imu(value: Imu, vehicle: str, time_ns: int) -> RosMessage:
    """sensor_msgs/Imu, marked as without orientation, at the time of measurement if known."""
    unknown = np.array([UNKNOWN, *[0.0] * 8])
    turning, force = (vector(*value.angular_velocity), np.zeros(9)), (vector(*value.acceleration), np.zeros(9))
    head = header(value.time_ns or time_ns, vehicle)
    return make("sensor_msgs/Imu", head, _turn(1.0, 0.0, 0.0, 0.0), unknown, *turning, *force)


def scan(message: messages.LaserScan) -> RosMessage:
    """sensor_msgs/LaserScan, at the time of measurement; a beam without return is infinite (REP 117)."""
    ranges = np.array(message.ranges, np.float32)  # None becomes NaN
    ranges[np.isnan(ranges)] = math.inf
    most = message.range_max
    if most is None:
        most = float(ranges[np.isfinite(ranges)].max(initial=0.0))
    step = (message.end_angle - message.start_angle) / max(1, len(ranges) - 1)
    return _scan(header(message.timestamp.ns, message.frame_id), message.start_angle, message.end_angle, step, most, ranges)


def laser_scan(value: Scan, frame: str) -> RosMessage:
    """sensor_msgs/LaserScan of a reading, at the time of measurement."""
    last = value.angle_min + (len(value.ranges) - 1) * value.angle_step
    return _scan(header(value.time_ns, frame), value.angle_min, last, value.angle_step, value.range_max, value.ranges)


def _scan(head: RosMessage, first: float, last: float, step: float, most: float, ranges: Array) -> RosMessage:
    return make("sensor_msgs/LaserScan", head, first, last, step, 0.0, 0.0, 0.0, most, ranges, np.zeros(0, np.float32))


def image(message: messages.RawImage, frame: str) -> RosMessage:
    """sensor_msgs/Image, at the time of exposure."""
    look = {
        "encoding": message.encoding,
        "is_bigendian": 0,
        "step": message.step,
        "data": np.frombuffer(message.data, np.uint8),
    }
    return make("sensor_msgs/Image", header(message.timestamp.ns, frame), message.height, message.width, **look)


def picture(value: Image, frame: str) -> RosMessage:
    """sensor_msgs/Image of a reading, at the time of exposure."""
    height, width, _ = value.pixels.shape
    return make("sensor_msgs/Image", header(value.time_ns, frame), height, width, "rgb8", 0, 3 * width, np.ravel(value.pixels))


def pinhole(value: Image, frame: str) -> RosMessage:
    """sensor_msgs/CameraInfo of a reading: a pinhole without distortion, whose principal point is the centre."""
    return camera_info(messages.CameraCalibration.of(value, frame, value.time_ns), value.time_ns, frame)


def satellite_fix(time_ns: int, frame: str, geodetic: Vec3, sigmas_m: Vec3) -> RosMessage:
    """sensor_msgs/NavSatFix: latitude and longitude (deg), height (m); standard deviations east, north, up."""
    status = make("sensor_msgs/NavSatStatus", 0, 1)  # STATUS_FIX, SERVICE_GPS
    covariance = np.diag(np.square(sigmas_m)).ravel()
    return make("sensor_msgs/NavSatFix", header(time_ns, frame), status, *geodetic, covariance, 2)  # DIAGONAL_KNOWN


def radio_received(value: Reception) -> RosMessage:
    """vcmvsp_msgs/RadioReceived, at the time of arrival; its age is the time since it was sent."""
    body = value.message.body
    data = body if isinstance(body, bytes) else msgspec.msgpack.encode(body)
    age = make("builtin_interfaces/Duration", *divmod(value.received_ns - value.sent_ns, 1_000_000_000))
    head = header(value.received_ns, "")
    content = np.frombuffer(data, np.uint8)
    return make("vcmvsp_msgs/RadioReceived", head, value.message.sender, value.rssi_dbm, age, data is not body, content)


def compressed_image(message: CompressedImage, frame: str) -> RosMessage:
    """sensor_msgs/CompressedImage, at the time of exposure."""
    return _jpeg(header(message.timestamp.ns, frame), message.format, message.data)


def camera_info(message: messages.CameraCalibration, time_ns: int, frame: str) -> RosMessage:
    """sensor_msgs/CameraInfo for a sensor_msgs/Image, with the same time and frame."""
    whole = make("sensor_msgs/RegionOfInterest", 0, 0, 0, 0, False)
    lens = message.distortion_model, *map(np.array, (message.D, message.K, message.R, message.P))
    return make("sensor_msgs/CameraInfo", header(time_ns, frame), message.height, message.width, *lens, 0, 0, whole)


def grid(message: Grid, time_ns: int) -> RosMessage:
    """nav_msgs/OccupancyGrid of a map's probabilities, in percent; includes cells that the vehicle has not seen itself."""
    cells = message.cells[..., 0]
    rows, columns = cells.shape
    corner = pose(_xyz(message.pose.position), (1.0, 0.0, 0.0, 0.0))
    info = make("nav_msgs/MapMetaData", stamp(0), message.cell_size.x, columns, rows, corner)
    percent = np.rint(cells.ravel() * (100.0 / 255.0)).astype(np.int8)
    return make("nav_msgs/OccupancyGrid", header(time_ns, message.frame_id), info, percent)


def log(message: messages.Log, time_ns: int) -> RosMessage:
    """rcl_interfaces/Log."""
    return make(
        "rcl_interfaces/Log", stamp(time_ns), LOG_LEVELS.get(message.level, 20), message.name, message.message, "", "", 0
    )


def string(text: str) -> RosMessage:
    """std_msgs/String."""
    return make("std_msgs/String", text)


def clock(time_ns: int) -> RosMessage:
    """rosgraph_msgs/Clock."""
    return make("rosgraph_msgs/Clock", stamp(time_ns))


def vector(x: float, y: float, z: float) -> RosMessage:
    """geometry_msgs/Vector3."""
    return make("geometry_msgs/Vector3", x, y, z)


def rotated(turn: Quaternion, vector: Vec3) -> Vec3:
    """A vector rotated by a quaternion (w, x, y, z)."""
    w, x, y, z = turn
    _, *turned = product(product(turn, (0.0, *vector)), (w, -x, -y, -z))
    return turned[0], turned[1], turned[2]


def nanoseconds(message: Any) -> int:
    """Nanoseconds of a builtin_interfaces/Time."""
    return int(message.sec) * 1_000_000_000 + int(message.nanosec)


def ros_name(topic: str) -> str:
    """Valid ROS name for a topic: letters, digits and ``_``, no digit first."""
    name = "".join("/" + re.sub(r"\W", "_", part, flags=re.ASCII) for part in topic.strip("/").split("/"))
    return re.sub(r"/(?=[0-9])", "/_", name)


def point(x: float, y: float, z: float) -> RosMessage:
    """geometry_msgs/Point."""
    return make("geometry_msgs/Point", x, y, z)


def pose(position: Vec3, attitude: Sequence[float]) -> RosMessage:
    """geometry_msgs/Pose; the attitude is w, x, y, z."""
    return make("geometry_msgs/Pose", point(*position), _turn(*attitude))


def _turn(w: float, x: float, y: float, z: float) -> RosMessage:
    return make("geometry_msgs/Quaternion", x, y, z, w)


def _xyz(at: messages.Vector3) -> Vec3:
    return at.x, at.y, at.z


def _wxyz(turn: messages.Quaternion) -> Quaternion:
    return turn.w, turn.x, turn.y, turn.z


def _pose_of(message: messages.Pose) -> RosMessage:
    return pose(_xyz(message.position), _wxyz(message.orientation))


def _posed(time_ns: int, position: Vec3, attitude: Sequence[float]) -> RosMessage:
    return make("geometry_msgs/PoseStamped", header(time_ns, WORLD), pose(position, attitude))


def _jpeg(head: RosMessage, name: str, data: bytes) -> RosMessage:
    return make("sensor_msgs/CompressedImage", head, name, np.frombuffer(data, np.uint8))


def markers(message: messages.SceneUpdate, time_ns: int) -> RosMessage:
    """visualization_msgs/MarkerArray: a marker for each primitive, after one that deletes the markers of the previous scene."""
    nothing = _marker_of(ARROW, messages.Pose(), (0.0, 0.0, 0.0), messages.Color(0.0, 0.0, 0.0, 0.0))
    listed: list[RosMessage] = [_marker(header(time_ns, WORLD), "", 0, action=DELETE_ALL, **nothing) for _ in message.deletions]
    for entity in message.entities:
        parts = list(map(_arrow, entity.arrows))
        parts += [_marker_of(CUBE, each.pose, _xyz(each.size), each.color) for each in entity.cubes]
        parts += [_marker_of(CYLINDER, each.pose, _xyz(each.size), each.color) for each in entity.cylinders]
        parts += [*map(_line, entity.lines), *map(_triangles, entity.triangles), *map(_text, entity.texts)]
        for number, fields in enumerate(parts):
            head = header(time_ns, entity.frame_id)
            listed.append(_marker(head, entity.id, number, frame_locked=entity.frame_locked, **fields))
    return make("visualization_msgs/MarkerArray", listed)


def _marker(head: RosMessage, name: str, number: int, **fields: object) -> RosMessage:
    usual = {
        "action": 0,
        "lifetime": make("builtin_interfaces/Duration", 0, 0),
        "frame_locked": False,
        "points": [],
        "colors": [],
        "texture_resource": "",
        "texture": _jpeg(header(0, ""), "", b""),
        "uv_coordinates": [],
        "text": "",
        "mesh_resource": "",
        "mesh_file": make("visualization_msgs/MeshFile", "", np.zeros(0, np.uint8)),
        "mesh_use_embedded_materials": False,
    }
    return make("visualization_msgs/Marker", header=head, ns=name, id=number, **{**usual, **fields})


def _marker_of(kind: int, at: messages.Pose, scale: Vec3, color: messages.Color, **more: object) -> dict[str, Any]:
    paint = make("std_msgs/ColorRGBA", color.r, color.g, color.b, color.a)
    return {"type": kind, "pose": _pose_of(at), "scale": vector(*scale), "color": paint, **more}


def _arrow(message: messages.ArrowPrimitive) -> dict[str, Any]:
    size = message.shaft_length + message.head_length, message.shaft_diameter, message.shaft_diameter
    return _marker_of(ARROW, message.pose, size, message.color)


def _line(message: messages.LinePrimitive) -> dict[str, Any]:
    points = [point(*_xyz(each)) for each in message.points]
    if message.type == 1:  # closed
        points.append(points[0])
    width = LINE_M if message.scale_invariant else message.thickness
    kind = LINE_LIST if message.type == 2 else LINE_STRIP
    return _marker_of(kind, message.pose, (width, 0.0, 0.0), message.color, points=points)


def _triangles(message: messages.TriangleListPrimitive) -> dict[str, Any]:
    points = [point(*_xyz(each)) for each in message.points]
    return _marker_of(
        TRIANGLES, message.pose, (1.0, 1.0, 1.0), message.color, points=[points[index] for index in message.indices]
    )


def _text(message: messages.TextPrimitive) -> dict[str, Any]:
    height = TEXT_M if message.scale_invariant else message.font_size
    return _marker_of(TEXT, message.pose, (0.0, 0.0, height), message.color, text=message.text)
