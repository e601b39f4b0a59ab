"""Messages and scenes of a recording as ROS 2 messages (the definitions are those of Jazzy, which have not changed since Foxy).

Frames and units are the same on both sides: ``world`` is east, north, up, a vehicle's own frame forward, left, up; SI units,
radians. Time is that of the run, which begins at 0. The functions are quick to call and hold no state.
"""

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, ClassVar, Protocol

import numpy as np
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from vcmvsp.cosim.frames import Quaternion, product, quaternion_from_yaw
from vcmvsp.cosim.recording.foxglove import messages
from vcmvsp.cosim.recording.foxglove.agent_displays import CompressedImage, Grid
from vcmvsp.cosim.types import Imu, Odometry, Vec3, VehicleState, Velocity, Waypoint

WORLD = "world"
LOG_LEVELS = {1: 10, 2: 20, 3: 30, 4: 40, 5: 50}  # foxglove.LogLevel -> rcl_interfaces/Log
ANY_HEADING = math.pi**2 / 3.0  # rad2, variance of one that may be any: ROS would take 0 for certainty
UNKNOWN = -1.0  # first element of a covariance: this part of the message says nothing
ARROW, CUBE, CYLINDER, LINE_STRIP, LINE_LIST, TEXT, TRIANGLES = 0, 1, 3, 4, 5, 9, 11  # visualization_msgs/Marker
DELETE_ALL = 3  # an action
LINE_M = 0.03  # width of lines that have no width in metres
TEXT_M = 0.3  # height of letters, likewise


class RosMessage(Protocol):
    """A message; rosbags makes the classes at run time, from their definitions."""

    __msgtype__: ClassVar[str]


@cache
def store() -> Typestore:
    """The definitions of the messages."""
    return get_typestore(Stores.ROS2_JAZZY)  # 0.1 s


def make(name: str, /, **fields: object) -> RosMessage:
    """A message: ``package/Name``."""
    package, _, kind = name.partition("/")
    message: Callable[..., RosMessage] = store().types[f"{package}/msg/{kind}"]
    return message(**fields)


def stamp(time_ns: int) -> RosMessage:
    """A time."""
    sec, nanosec = divmod(time_ns, 1_000_000_000)
    return make("builtin_interfaces/Time", sec=sec, nanosec=nanosec)


def header(time_ns: int, frame: str) -> RosMessage:
    """Time and frame."""
    return make("std_msgs/Header", stamp=stamp(time_ns), frame_id=frame)


def transforms(said: messages.FrameTransforms, time_ns: int) -> RosMessage:
    """tf2_msgs/TFMessage."""
    listed = [
        make(
            "geometry_msgs/TransformStamped",
            header=header(time_ns, each.parent_frame_id),
            child_frame_id=each.child_frame_id,
            transform=make(
                "geometry_msgs/Transform",
                translation=vector(each.translation.x, each.translation.y, each.translation.z),
                rotation=_turn(each.rotation.w, each.rotation.x, each.rotation.y, each.rotation.z),
            ),
        )
        for each in said.transforms
    ]
    return make("tf2_msgs/TFMessage", transforms=listed)


def state(said: VehicleState, vehicle: str, time_ns: int) -> RosMessage:
    """nav_msgs/Odometry: the pose in the world; velocities in the vehicle's frame, as ROS wants them."""
    linear = _into_body(said.attitude, said.velocity)
    return _odometry(time_ns, vehicle, said.position, said.attitude, linear, said.angular_velocity)


def odometry(said: Odometry, vehicle: str, time_ns: int) -> RosMessage:
    """nav_msgs/Odometry: what the wheels say."""
    x, y, yaw = said.pose
    turn = quaternion_from_yaw(yaw)
    return _odometry(time_ns, vehicle, (x, y, 0.0), turn, (said.v, 0.0, 0.0), (0.0, 0.0, said.w))


def path(places: Sequence[tuple[int, VehicleState]]) -> RosMessage:
    """nav_msgs/Path: the whole way of a vehicle."""
    poses = [
        make("geometry_msgs/PoseStamped", header=header(time_ns, WORLD), pose=pose(each.position, each.attitude))
        for time_ns, each in places
    ]
    return make("nav_msgs/Path", header=header(0, WORLD), poses=poses)


def velocity(said: Velocity, vehicle: str, time_ns: int) -> RosMessage:
    """geometry_msgs/TwistStamped: a command; along whose axes, `cosim.export.rosbag` says."""
    twist = make("geometry_msgs/Twist", linear=vector(*said.linear), angular=vector(0.0, 0.0, said.yaw_rate))
    return make("geometry_msgs/TwistStamped", header=header(time_ns, vehicle), twist=twist)


def waypoint(said: Waypoint, time_ns: int) -> RosMessage:
    """geometry_msgs/PoseStamped: where a vehicle is sent; a heading that it may choose is 0."""
    there = pose(said.position, quaternion_from_yaw(said.yaw or 0.0))
    return make("geometry_msgs/PoseStamped", header=header(time_ns, WORLD), pose=there)


def fix(said: messages.PoseInFrame) -> RosMessage:
    """geometry_msgs/PoseWithCovarianceStamped, at the time at which it was measured; a heading that was not told may be any."""
    at, turn = said.pose.position, said.pose.orientation
    covariance = np.zeros(36)
    covariance[[0, 7, 14]], covariance[35] = said.sigma_m**2, ANY_HEADING if said.yaw is None else said.sigma_rad**2
    there = pose((at.x, at.y, at.z), (turn.w, turn.x, turn.y, turn.z))
    return make(
        "geometry_msgs/PoseWithCovarianceStamped",
        header=header(said.timestamp.ns, said.frame_id),
        pose=make("geometry_msgs/PoseWithCovariance", pose=there, covariance=covariance),
    )


def imu(said: Imu, vehicle: str, time_ns: int) -> RosMessage:
    """sensor_msgs/Imu without an orientation, which it says, at the time at which it was measured, where it says that."""
    unknown = np.zeros(9)
    unknown[0] = UNKNOWN
    return make(
        "sensor_msgs/Imu",
        header=header(said.time_ns or time_ns, vehicle),
        orientation=_turn(1.0, 0.0, 0.0, 0.0),
        orientation_covariance=unknown,
        angular_velocity=vector(*said.angular_velocity),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector(*said.acceleration),
        linear_acceleration_covariance=np.zeros(9),
    )


def scan(said: messages.LaserScan) -> RosMessage:
    """sensor_msgs/LaserScan, at the time at which it was measured; a beam without return is infinite (REP 117)."""
    ranges = np.array([math.inf if each is None else each for each in said.ranges], np.float32)
    finite = ranges[np.isfinite(ranges)]
    most = said.range_max if said.range_max is not None else float(finite.max(initial=0.0))
    return make(
        "sensor_msgs/LaserScan",
        header=header(said.timestamp.ns, said.frame_id),
        angle_min=said.start_angle,
        angle_max=said.end_angle,
        angle_increment=(said.end_angle - said.start_angle) / max(1, len(ranges) - 1),
        time_increment=0.0,
        scan_time=0.0,
        range_min=0.0,
        range_max=most,
        ranges=ranges,
        intensities=np.zeros(0, np.float32),
    )


def image(said: messages.RawImage, frame: str) -> RosMessage:
    """sensor_msgs/Image, at the time at which it was taken."""
    return make(
        "sensor_msgs/Image",
        header=header(said.timestamp.ns, frame),
        height=said.height,
        width=said.width,
        encoding=said.encoding,
        is_bigendian=0,
        step=said.step,
        data=np.frombuffer(said.data, np.uint8),
    )


def compressed_image(said: CompressedImage, frame: str) -> RosMessage:
    """sensor_msgs/CompressedImage, likewise."""
    data = np.frombuffer(said.data, np.uint8)
    return make("sensor_msgs/CompressedImage", header=header(said.timestamp.ns, frame), format=said.format, data=data)


def camera_info(said: messages.CameraCalibration, time_ns: int, frame: str) -> RosMessage:
    """sensor_msgs/CameraInfo of a sensor_msgs/Image, with time and frame of its header."""
    whole = make("sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return make(
        "sensor_msgs/CameraInfo",
        header=header(time_ns, frame),
        height=said.height,
        width=said.width,
        distortion_model=said.distortion_model,
        d=np.array(said.D),
        k=np.array(said.K),
        r=np.array(said.R),
        p=np.array(said.P),
        binning_x=0,
        binning_y=0,
        roi=whole,
    )


def grid(said: Grid, time_ns: int) -> RosMessage:
    """nav_msgs/OccupancyGrid of a map's probabilities, in percent; cells that the vehicle has not seen itself count, too."""
    corner = said.pose.position
    cells = said.cells[..., 0]
    info = make(
        "nav_msgs/MapMetaData",
        map_load_time=stamp(0),
        resolution=said.cell_size.x,
        width=cells.shape[1],
        height=cells.shape[0],
        origin=pose((corner.x, corner.y, corner.z), (1.0, 0.0, 0.0, 0.0)),
    )
    percent = np.rint(cells.ravel() * (100.0 / 255.0)).astype(np.int8)
    return make("nav_msgs/OccupancyGrid", header=header(time_ns, said.frame_id), info=info, data=percent)


def log(said: messages.Log, time_ns: int) -> RosMessage:
    """rcl_interfaces/Log."""
    level = LOG_LEVELS.get(said.level, 20)
    return make(
        "rcl_interfaces/Log", stamp=stamp(time_ns), level=level, name=said.name, msg=said.message, file="", function="", line=0
    )


def string(text: str) -> RosMessage:
    """std_msgs/String."""
    return make("std_msgs/String", data=text)


def clock(time_ns: int) -> RosMessage:
    """rosgraph_msgs/Clock."""
    return make("rosgraph_msgs/Clock", clock=stamp(time_ns))


def _odometry(time_ns: int, vehicle: str, position: Vec3, attitude: Sequence[float], linear: Vec3, angular: Vec3) -> RosMessage:
    twist = make("geometry_msgs/Twist", linear=vector(*linear), angular=vector(*angular))
    return make(
        "nav_msgs/Odometry",
        header=header(time_ns, WORLD),
        child_frame_id=vehicle,
        pose=make("geometry_msgs/PoseWithCovariance", pose=pose(position, attitude), covariance=np.zeros(36)),
        twist=make("geometry_msgs/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )


def _into_body(attitude: Quaternion, vector: Vec3) -> Vec3:
    """A vector of the world in the frame of a body."""
    w, x, y, z = attitude
    _, *turned = product(product((w, -x, -y, -z), (0.0, *vector)), attitude)
    return turned[0], turned[1], turned[2]


def vector(x: float, y: float, z: float) -> RosMessage:
    """geometry_msgs/Vector3."""
    return make("geometry_msgs/Vector3", x=x, y=y, z=z)


def point(x: float, y: float, z: float) -> RosMessage:
    """geometry_msgs/Point."""
    return make("geometry_msgs/Point", x=x, y=y, z=z)


def _turn(w: float, x: float, y: float, z: float) -> RosMessage:
    return make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w)


def pose(position: Vec3, attitude: Sequence[float]) -> RosMessage:
    """geometry_msgs/Pose; the attitude is w, x, y, z."""
    w, x, y, z = attitude
    return make("geometry_msgs/Pose", position=point(*position), orientation=_turn(w, x, y, z))


def markers(said: messages.SceneUpdate, time_ns: int) -> RosMessage:
    """visualization_msgs/MarkerArray: a marker for each primitive; first, one that deletes those of the scene before."""
    listed: list[RosMessage] = [_marker(header=header(time_ns, WORLD), **_nothing(), action=DELETE_ALL) for _ in said.deletions]
    for entity in said.entities:
        parts = [_arrow(each) for each in entity.arrows]
        parts += [_solid(CUBE, each) for each in entity.cubes] + [_solid(CYLINDER, each) for each in entity.cylinders]
        parts += [_line(each) for each in entity.lines] + [_triangles(each) for each in entity.triangles]
        parts += [_text(each) for each in entity.texts]
        for number, fields in enumerate(parts):
            fixed = {"ns": entity.id, "id": number, "frame_locked": entity.frame_locked}
            listed.append(_marker(header=header(time_ns, entity.frame_id), **fixed, **fields))
    return make("visualization_msgs/MarkerArray", markers=listed)


def _marker(**fields: object) -> RosMessage:
    empty = make("sensor_msgs/CompressedImage", header=header(0, ""), format="", data=np.zeros(0, np.uint8))
    usual = {
        "action": 0,
        "lifetime": make("builtin_interfaces/Duration", sec=0, nanosec=0),
        "points": [],
        "colors": [],
        "texture_resource": "",
        "texture": empty,
        "uv_coordinates": [],
        "text": "",
        "mesh_resource": "",
        "mesh_file": make("visualization_msgs/MeshFile", filename="", data=np.zeros(0, np.uint8)),
        "mesh_use_embedded_materials": False,
    }
    return make("visualization_msgs/Marker", **{**usual, **fields})


def _nothing() -> dict[str, Any]:
    """Of a marker that draws nothing."""
    shape = {"type": ARROW, "pose": pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)), "scale": vector(0.0, 0.0, 0.0)}
    return {"ns": "", "id": 0, "frame_locked": False, "color": make("std_msgs/ColorRGBA", r=0.0, g=0.0, b=0.0, a=0.0), **shape}


def _arrow(said: messages.ArrowPrimitive) -> dict[str, Any]:
    size = vector(said.shaft_length + said.head_length, said.shaft_diameter, said.shaft_diameter)
    return {"type": ARROW, "pose": _posed(said.pose), "scale": size, "color": _color(said.color)}


def _solid(kind: int, said: messages.CubePrimitive | messages.CylinderPrimitive) -> dict[str, Any]:
    size = vector(said.size.x, said.size.y, said.size.z)
    return {"type": kind, "pose": _posed(said.pose), "scale": size, "color": _color(said.color)}


def _line(said: messages.LinePrimitive) -> dict[str, Any]:
    points = [point(each.x, each.y, each.z) for each in said.points]
    if said.type == 1:  # closed
        points.append(points[0])
    width = LINE_M if said.scale_invariant else said.thickness
    kind = LINE_LIST if said.type == 2 else LINE_STRIP
    scale, color = vector(width, 0.0, 0.0), _color(said.color)
    return {"type": kind, "pose": _posed(said.pose), "scale": scale, "color": color, "points": points}


def _triangles(said: messages.TriangleListPrimitive) -> dict[str, Any]:
    points = [point(each.x, each.y, each.z) for each in said.points]
    listed, color = [points[index] for index in said.indices], _color(said.color)
    return {"type": TRIANGLES, "pose": _posed(said.pose), "scale": vector(1.0, 1.0, 1.0), "color": color, "points": listed}


def _text(said: messages.TextPrimitive) -> dict[str, Any]:
    scale, color = vector(0.0, 0.0, TEXT_M if said.scale_invariant else said.font_size), _color(said.color)
    return {"type": TEXT, "pose": _posed(said.pose), "scale": scale, "color": color, "text": said.text}


def _posed(said: messages.Pose) -> RosMessage:
    at, turn = said.position, said.orientation
    return pose((at.x, at.y, at.z), (turn.w, turn.x, turn.y, turn.z))


def _color(said: messages.Color) -> RosMessage:
    return make("std_msgs/ColorRGBA", r=said.r, g=said.g, b=said.b, a=said.a)
