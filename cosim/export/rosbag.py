"""Exports a recording as a ROS 2 bag (rosbag2, MCAP storage), for RViz, PlotJuggler, Foxglove and user nodes.

=============================  ================================  ====================================================
topic of the recording         topic of the bag                  type
=============================  ================================  ====================================================
``/tf``, ``world/moving``      ``/tf``, and ``/clock``           tf2_msgs/TFMessage, rosgraph_msgs/Clock
``<vehicle>/state``            the same, and ``.../path``        nav_msgs/Odometry, the truth; nav_msgs/Path at the start
``<vehicle>/estimate``         the same                          nav_msgs/Odometry
wheel odometry                 the same                          nav_msgs/Odometry
``<vehicle>/command``          the same; ``.../waypoint``        geometry_msgs/TwistStamped, PoseStamped
positions                      the same                          geometry_msgs/PoseWithCovarianceStamped
IMU, scans                     the same                          sensor_msgs/Imu, sensor_msgs/LaserScan
pictures                       ``.../image_raw``                 sensor_msgs/Image, and ``.../camera_info`` with each
pictures of sightings          ``.../compressed``                sensor_msgs/CompressedImage
``<vehicle>/map``              the same                          nav_msgs/OccupancyGrid, in percent
``world/solids``, ``/scene``   the same                          visualization_msgs/MarkerArray
``log``                        ``/rosout``                       rcl_interfaces/Log
mosaics                        none
all others, ``radio/frame``    the same                          std_msgs/String: the JSON of the recording
=============================  ================================  ====================================================

Topic names are those of the recording, with ``_`` for characters that ROS does not allow. The recording does not contain the
mounting of cameras: frames of pictures, ``<vehicle>/<sensor>``, are not in ``/tf``. It does not mark flying vehicles: the
header of a commanded velocity names the vehicle's frame, although the axes of a flying vehicle's command are the world's.
Messages carry their time of measurement, and their log time in the bag is the time of arrival.
"""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.recording import foxglove as messages
from vcmvsp.cosim.recording import ros_messages as ros
from vcmvsp.cosim.recording.foxglove import CompressedImage, Grid
from vcmvsp.cosim.recording.mcap_reader import Recorded
from vcmvsp.cosim.recording.recorded_run import Source, Values
from vcmvsp.cosim.recording.run_mcap import CALIBRATION
from vcmvsp.cosim.types import Imu, Odometry, VehicleState, Velocity, Waypoint
from vcmvsp.cosim.util import limits

LATCHED = ("world/solids", "world/scene")  # latched: late subscribers receive the newest message
_FOREVER = QosTime(2147483647, 4294967295)


class Bag:
    """Writes one bag."""

    def __init__(self, writer: Writer) -> None:
        self._writer, self._values = writer, Values()
        self._connections: dict[str, tuple[str, Any]] = {}  # by topic of the bag: topic of the recording, connection
        self._calibrations: dict[str, messages.CameraCalibration] = {}  # by topic of the pictures
        self._clock_ns = -1
        self._takers: dict[type, Callable[[Recorded, Any], None]] = {
            VehicleState: lambda said, value: self._put(said, ros.state(value, _vehicle(said.topic), said.time_ns)),
            Odometry: lambda said, value: self._put(said, ros.odometry(value, _vehicle(said.topic), said.time_ns)),
            Velocity: lambda said, value: self._put(said, ros.velocity(value, _vehicle(said.topic), said.time_ns)),
            Waypoint: lambda said, value: self._put(said, ros.waypoint(value, said.time_ns), "/waypoint"),
            Imu: lambda said, value: self._put(said, ros.imu(value, _vehicle(said.topic), said.time_ns)),
            messages.PoseInFrame: lambda said, value: self._put(said, ros.fix(value)),
            messages.LaserScan: lambda said, value: self._put(said, ros.scan(value)),
            messages.SceneUpdate: lambda said, value: self._put(said, ros.markers(value, said.time_ns)),
            messages.FrameTransforms: self._take_transforms,
            messages.RawImage: self._take_image,
            messages.CameraCalibration: self._take_calibration,
            messages.Log: lambda said, value: self._write("rosout", ros.log(value, said.time_ns), said.time_ns),
            CompressedImage: lambda said, value: self._put(said, ros.compressed_image(value, said.topic), "/compressed"),
            Grid: self._take_grid,
        }

    @property
    def topics(self) -> int:
        """Number of topics so far."""
        return len(self._connections)

    def path(self, vehicle: str, places: list[tuple[int, VehicleState]]) -> None:
        """Write the complete track of a vehicle at the beginning."""
        self._write(f"{vehicle}/state/path", ros.path(places), 0, latched=True)

    def take(self, record: Recorded) -> None:
        """Convert and write a message."""
        value = self._values.of(record)
        taker = self._takers.get(type(value))
        if taker is None:
            self._put(record, ros.string(record.data.decode(errors="replace")))
        else:
            taker(record, value)

    def _put(self, record: Recorded, message: ros.RosMessage, more: str = "") -> None:
        self._write(record.topic + more, message, record.time_ns, latched=record.topic in LATCHED)

    def _write(self, topic: str, message: ros.RosMessage, time_ns: int, *, latched: bool = False) -> None:
        kind, name = message.__msgtype__, ros.ros_name(topic)
        if name not in self._connections:
            qos = [_qos()] if latched else []
            store = ros.store()
            new_connection = self._writer.add_connection(name, kind, typestore=store, offered_qos_profiles=qos)
            self._connections[name] = topic, new_connection
        of, connection = self._connections[name]
        if of != topic and name not in {"/tf", "/rosout"}:
            raise UsageError(f"--rosbag2: {of} and {topic} would both become the ROS topic {name}: rename a vehicle")
        try:
            data = ros.store().serialize_cdr(message, kind)
        except (struct.error, OverflowError) as error:
            raise UsageError(f"--rosbag2: {topic} at {time_ns} ns does not fit into {kind}: {error}") from error
        self._writer.write(connection, time_ns, data)

    def _take_transforms(self, record: Recorded, value: messages.FrameTransforms) -> None:
        if record.time_ns != self._clock_ns:
            self._clock_ns = record.time_ns
            self._write("clock", ros.clock(record.time_ns), record.time_ns)
        self._write("tf", ros.transforms(value, record.time_ns), record.time_ns)

    def _take_image(self, record: Recorded, value: messages.RawImage) -> None:
        self._put(record, ros.image(value, record.topic), "/image_raw")
        if record.topic in self._calibrations:
            calibration = ros.camera_info(self._calibrations[record.topic], value.timestamp.ns, record.topic)
            self._put(record, calibration, "/camera_info")

    def _take_calibration(self, record: Recorded, value: messages.CameraCalibration) -> None:
        self._calibrations[record.topic.removesuffix(f"/{CALIBRATION}")] = value

    def _take_grid(self, record: Recorded, value: Grid) -> None:
        if value.fields[0].name == "probability":
            self._put(record, ros.grid(value, record.time_ns))


def write_bag(source: Source, folder: Path) -> None:
    """Write a bag into ``folder``, which must not exist.

    Raises:
        UsageError: two topics would have the same name in ROS, or there are more than `limits` allow.
    """
    values = Values()
    ways: dict[str, list[tuple[int, VehicleState]]] = {name: [] for name in source.vehicles}
    for record in source.only(lambda topic, _: topic.endswith("/state")):
        vehicle, _, subtopic = record.topic.partition("/")
        if subtopic == "state" and vehicle in ways:
            ways[vehicle].append((record.time_ns, values.of(record)))
    writer = Writer(folder, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        bag = Bag(writer)
        for vehicle, places in ways.items():
            bag.path(vehicle, places)
        for record in source:
            bag.take(record)
            try:
                limits.within(bag.topics, limits.TOPICS, "topics")
            except ValueError as error:
                raise UsageError(f"--rosbag2: {error}") from error


def _vehicle(topic: str) -> str:
    return topic.partition("/")[0]


def _qos() -> Qos:
    return Qos(
        QosHistory.KEEP_LAST,
        1,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL,
        _FOREVER,
        _FOREVER,
        QosLiveliness.AUTOMATIC,
        _FOREVER,
        avoid_ros_namespace_conventions=False,
    )
