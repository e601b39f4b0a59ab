"""Messages that Foxglove and Lichtblick draw by themselves.

The structs carry the names and fields of Foxglove's published schemas
(https://docs.foxglove.dev/docs/sdk/schemas); of a scene entity's primitives only those drawn here. Lengths m, angles rad,
world frame ``world`` (x east, y north, z up), a frame of its own per vehicle (x forward, y left, z up). What agents show has
its messages in `cosim.recording.foxglove.agent_displays`; schemas are made in `cosim.recording.mcap_writer`.
"""

from typing import Literal

import msgspec
import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.frames import yaw_of
from vcmvsp.cosim.types import Array, Image, Scan

LEVELS = {"debug": 1, "info": 2, "warning": 3, "error": 4, "fatal": 5}  # foxglove.LogLevel


class FoxgloveMessage(msgspec.Struct, frozen=True, gc=False):
    """Base of the messages that Foxglove knows."""


class Time(FoxgloveMessage, frozen=True):
    """A simulated instant, counted from the start of the run."""

    sec: int
    nsec: int

    @classmethod
    def of(cls, time_ns: int) -> "Time":
        """The instant ``time_ns``."""
        return cls(*divmod(time_ns, SECOND_NS))

    @property
    def ns(self) -> int:
        """The same as a number."""
        return self.sec * SECOND_NS + self.nsec


class Duration(FoxgloveMessage, frozen=True):
    """A length of time; zero for an entity means that it stays."""

    sec: int = 0
    nsec: int = 0


class Vector3(FoxgloveMessage, frozen=True):
    """A point or a direction."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


class Quaternion(FoxgloveMessage, frozen=True):
    """A rotation. Here x, y, z come first, as Foxglove has it."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 1.0


class Pose(FoxgloveMessage, frozen=True):
    """Position and orientation in the frame of the message."""

    position: Vector3 = Vector3()
    orientation: Quaternion = Quaternion()


class PoseInFrame(FoxgloveMessage, frozen=True):
    """A pose that a sensor measured; the standard deviations are additional to Foxglove's fields."""

    timestamp: Time  # when it was measured
    frame_id: str
    pose: Pose
    sigma_m: float
    sigma_rad: float

    @property
    def yaw(self) -> float | None:
        """The heading, rad; one that is exactly east, and sure, was not told."""
        turn = self.pose.orientation
        yaw = yaw_of((turn.w, turn.x, turn.y, turn.z))
        return yaw if yaw or self.sigma_rad else None


class FrameTransform(FoxgloveMessage, frozen=True):
    """Where the child frame lies in its parent."""

    timestamp: Time
    parent_frame_id: str
    child_frame_id: str
    translation: Vector3
    rotation: Quaternion


class FrameTransforms(FoxgloveMessage, frozen=True):
    """All vehicles at one instant."""

    transforms: list[FrameTransform]


class Color(FoxgloveMessage, frozen=True):
    """Red, green, blue and opacity, 0 to 1."""

    r: float
    g: float
    b: float
    a: float = 1.0


class ArrowPrimitive(FoxgloveMessage, frozen=True):
    """An arrow along the x axis of its pose."""

    pose: Pose
    shaft_length: float
    shaft_diameter: float
    head_length: float
    head_diameter: float
    color: Color


class CubePrimitive(FoxgloveMessage, frozen=True):
    """A block about its pose."""

    pose: Pose
    size: Vector3
    color: Color


class CylinderPrimitive(FoxgloveMessage, frozen=True):
    """A cylinder about the z axis of its pose."""

    pose: Pose
    size: Vector3
    bottom_scale: float
    top_scale: float
    color: Color


class LinePrimitive(FoxgloveMessage, frozen=True):
    """Points joined by lines: 0 a strip, 1 a closed loop, 2 separate segments."""

    type: Literal[0, 1, 2]
    pose: Pose
    thickness: float
    scale_invariant: bool  # thickness in screen pixels
    points: list[Vector3]
    color: Color


class TextPrimitive(FoxgloveMessage, frozen=True):
    """A label."""

    pose: Pose
    billboard: bool
    font_size: float
    scale_invariant: bool
    color: Color
    text: str


class TriangleListPrimitive(FoxgloveMessage, frozen=True):
    """Triangles of one colour: three indices each into the points, counter-clockwise seen from outside."""

    pose: Pose
    points: list[Vector3]
    color: Color
    indices: list[int]
    colors: list[Color] = []


class SceneEntity(FoxgloveMessage, frozen=True):
    """Something to draw, moving with its frame."""

    timestamp: Time
    frame_id: str
    id: str
    lifetime: Duration
    frame_locked: bool
    arrows: list[ArrowPrimitive] = []
    cubes: list[CubePrimitive] = []
    cylinders: list[CylinderPrimitive] = []
    lines: list[LinePrimitive] = []
    triangles: list[TriangleListPrimitive] = []
    texts: list[TextPrimitive] = []


class SceneEntityDeletion(FoxgloveMessage, frozen=True):
    """What was drawn before this time is there no longer: 0 the entity of that name, 1 all of the topic."""

    timestamp: Time
    type: Literal[0, 1] = 1
    id: str = ""


class SceneUpdate(FoxgloveMessage, frozen=True):
    """The whole scene: a viewer that jumps in time reads only the newest message of a topic."""

    entities: list[SceneEntity]
    deletions: list[SceneEntityDeletion] = []


class Log(FoxgloveMessage, frozen=True):
    """A line of the recording's log."""

    timestamp: Time
    level: int
    message: str
    name: str = "vcmvsp"
    file: str = ""
    line: int = 0


class LaserScan(FoxgloveMessage, frozen=True):
    """One sweep; a beam without return is null, as JSON knows no infinity. The range is additional to Foxglove's fields."""

    timestamp: Time
    frame_id: str
    pose: Pose
    start_angle: float
    end_angle: float
    ranges: list[float | None]
    intensities: list[float] = []
    range_max: float | None = None  # m

    @classmethod
    def of(cls, scan: Scan, vehicle: str, time_ns: int) -> "LaserScan":
        """A sweep of the scanner at the vehicle's centre."""
        end = scan.angle_min + (len(scan.ranges) - 1) * scan.angle_step
        return cls(Time.of(time_ns), vehicle, Pose(), scan.angle_min, end, scan.ranges.tolist(), range_max=scan.range_max)


class RawImage(FoxgloveMessage, frozen=True):
    """One picture, rows from top to bottom."""

    timestamp: Time
    frame_id: str
    width: int
    height: int
    encoding: str
    step: int  # bytes a row
    data: bytes

    @classmethod
    def of(cls, image: Image, vehicle: str, time_ns: int) -> "RawImage":
        """A picture of the vehicle's camera."""
        height, width, _ = image.pixels.shape
        return cls(Time.of(time_ns), vehicle, width, height, "rgb8", 3 * width, image.pixels.tobytes())

    @property
    def pixels(self) -> Array:
        """(height, width, 3) uint8, RGB."""
        return np.frombuffer(self.data, np.uint8).reshape(self.height, self.width, 3)


class CameraCalibration(FoxgloveMessage, frozen=True):
    """A pinhole without distortion; the matrices are written row by row."""

    timestamp: Time
    frame_id: str
    width: int
    height: int
    K: list[float]  # 3 x 3, px: focal lengths and principal point
    P: list[float]  # 3 x 4: K, and nothing beside it
    distortion_model: str = "plumb_bob"
    D: tuple[float, ...] = (0.0,) * 5
    R: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)

    @classmethod
    def of(cls, image: Image, vehicle: str, time_ns: int) -> "CameraCalibration":
        """Of the camera that took a picture; its principal point is the middle of the picture."""
        height, width, _ = image.pixels.shape
        f, u, v = image.focal_px, 0.5 * (width - 1), 0.5 * (height - 1)  # the middle of the first pixel is (0, 0)
        matrix, projection = [f, 0.0, u, 0.0, f, v, 0.0, 0.0, 1.0], [f, 0.0, u, 0.0, 0.0, f, v, 0.0, 0.0, 0.0, 1.0, 0.0]
        return cls(Time.of(time_ns), vehicle, width, height, matrix, projection)


_NUMPY = (np.ndarray, np.generic)  # made once, as frames have many of them


def to_json(value: object) -> object:
    """NumPy arrays and numbers as JSON writes them (for ``enc_hook``)."""
    if isinstance(value, _NUMPY):
        return value.tolist()
    raise TypeError(f"cannot record a {type(value).__name__}; use numbers, strings, bytes, lists and mappings")
