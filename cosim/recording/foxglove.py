"""Message types that Foxglove and Lichtblick display, and conversion of agents' maps and sightings to them.

Names and fields follow Foxglove's published schemas (https://docs.foxglove.dev/docs/sdk/schemas); of the primitives of a scene
entity only those drawn here. Further fields hold what those schemas lack; viewers ignore them. Messages are written as JSON
(`cosim.recording.mcap_writer`): Foxglove's own Python packages support Protobuf alone and no further fields. Lengths m, angles
rad, world frame ``world`` (x east, y north, z up), a frame per vehicle (x forward, y left, z up).

===============================  ===========================  =====================================================
``<vehicle>/map``                `Grid`                       ``probability`` in 255ths and ``seen``, 0 or 1, per cell
``<vehicle>/mosaic``             `Grid`                       ``red``, ``green``, ``blue``; ``alpha`` 0: not seen
``<vehicle>/sightings``          `ImageAnnotations`           turned boxes with names, and the sightings
``<vehicle>/sightings/picture``  `CompressedImage`            the picture of the sightings, if kept
===============================  ===========================  =====================================================
"""

import math
from collections.abc import Iterator
from operator import attrgetter
from typing import Literal

import msgspec
import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.federate import vehicle_of
from vcmvsp.cosim.frames import yaw_of
from vcmvsp.cosim.types import Array, Image, Mosaic, ProbabilityMap, Scan, Sighting, Sightings, frozen
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.util.palette import rgb_of

LEVELS = {"debug": 1, "info": 2, "warning": 3, "error": 4, "fatal": 5}  # foxglove.LogLevel
UINT8 = 1  # foxglove.NumericType
LINE_LOOP = 2  # foxglove.PointsAnnotationType
PICTURE = "picture"  # suffix of the key of the sightings
MAP, MOSAIC = ("probability", "seen"), ("red", "green", "blue", "alpha")  # fields of a `Grid`
FONT_PX = 16.0


class FoxgloveMessage(msgspec.Struct, frozen=True, gc=False):
    """Base of the Foxglove message types."""


class Time(FoxgloveMessage, frozen=True):
    """A simulated instant, counted from the start of the run."""

    sec: int
    nsec: int

    @classmethod
    def of(cls, time_ns: int) -> "Time":
        """Create from ns."""
        return cls(*divmod(time_ns, SECOND_NS))

    @property
    def ns(self) -> int:
        """The instant in ns."""
        return self.sec * SECOND_NS + self.nsec


class Duration(FoxgloveMessage, frozen=True):
    """A length of time; zero as an entity's lifetime means no limit."""

    sec: int = 0
    nsec: int = 0


class Vector3(FoxgloveMessage, frozen=True):
    """A point or a direction."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


class Quaternion(FoxgloveMessage, frozen=True):
    """A rotation in Foxglove's order x, y, z, w."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 1.0


class Pose(FoxgloveMessage, frozen=True):
    """Position and orientation in the frame of the message."""

    position: Vector3 = Vector3()
    orientation: Quaternion = Quaternion()


class Stamped(FoxgloveMessage, frozen=True):
    """A message with its time of measurement and its frame."""

    timestamp: Time
    frame_id: str


class PoseInFrame(Stamped, frozen=True):
    """A pose that a sensor measured; the standard deviations extend Foxglove's fields."""

    pose: Pose
    sigma_m: float
    sigma_rad: float

    @property
    def yaw(self) -> float | None:
        """The heading, rad; None if not measured, encoded as exactly east without uncertainty."""
        turn = self.pose.orientation
        yaw = yaw_of((turn.w, turn.x, turn.y, turn.z))
        return yaw if yaw or self.sigma_rad else None


class FrameTransform(FoxgloveMessage, frozen=True):
    """Pose of a child frame in its parent frame."""

    timestamp: Time
    parent_frame_id: str
    child_frame_id: str
    translation: Vector3
    rotation: Quaternion


class FrameTransforms(FoxgloveMessage, frozen=True):
    """Frames of all vehicles at one instant."""

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
    """A cuboid centred on its pose."""

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
    """A line through points: 0 a strip, 1 a closed loop, 2 separate segments."""

    type: Literal[0, 1, 2]
    pose: Pose
    thickness: float
    scale_invariant: bool  # thickness in screen pixels
    points: list[Vector3]
    color: Color


class TextPrimitive(FoxgloveMessage, frozen=True):
    """A text label."""

    pose: Pose
    billboard: bool
    font_size: float
    scale_invariant: bool
    color: Color
    text: str


class TriangleListPrimitive(FoxgloveMessage, frozen=True):
    """Triangles of one colour: three point indices each, counter-clockwise seen from outside."""

    pose: Pose
    points: list[Vector3]
    color: Color
    indices: list[int]
    colors: list[Color] = []

    def __post_init__(self) -> None:
        """Refuse indices that are not three per triangle, or name no point."""
        lowest, highest = min(self.indices, default=0), max(self.indices, default=-1)
        if len(self.indices) % 3 or lowest < 0 or highest >= len(self.points):
            raise ValueError(f"{len(self.indices)} indices of {len(self.points)} points")


class SceneEntity(Stamped, frozen=True):
    """An object to draw that moves with its frame."""

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
    """Removes entities drawn before this time: 0 the entity of that name, 1 all of the topic."""

    timestamp: Time
    type: Literal[0, 1] = 1
    id: str = ""


class SceneUpdate(FoxgloveMessage, frozen=True):
    """The complete scene: a viewer that jumps in time reads only the newest message of a topic."""

    entities: list[SceneEntity]
    deletions: list[SceneEntityDeletion] = []

    def __post_init__(self) -> None:
        """Refuse more triangles than `limits.TRIANGLES`."""
        indices = sum(len(part.indices) for entity in self.entities for part in entity.triangles)
        limits.within(indices // 3, limits.TRIANGLES, "triangles")


class Log(FoxgloveMessage, frozen=True):
    """A line of the recording's log."""

    timestamp: Time
    level: int
    message: str
    name: str = "vcmvsp"
    file: str = ""
    line: int = 0


class LaserScan(Stamped, frozen=True):
    """One sweep; a beam without return is null, as JSON has no infinity. The range extends Foxglove's fields."""

    pose: Pose
    start_angle: float
    end_angle: float
    ranges: list[float | None]
    intensities: list[float] = []
    range_max: float | None = None  # m

    @classmethod
    def of(cls, scan: Scan, vehicle: str, time_ns: int) -> "LaserScan":
        """Create from a sweep of the scanner at the vehicle's centre."""
        end = scan.angle_min + (len(scan.ranges) - 1) * scan.angle_step
        return cls(Time.of(time_ns), vehicle, Pose(), scan.angle_min, end, scan.ranges.tolist(), range_max=scan.range_max)


class RawImage(Stamped, frozen=True):
    """One uncompressed picture, rows from top to bottom."""

    width: int
    height: int
    encoding: str
    step: int  # bytes per row
    data: bytes

    def __post_init__(self) -> None:
        """Refuse data that are not ``height`` rows of ``width`` pixels."""
        if self.width < 0 or self.step != 3 * self.width or len(self.data) != self.step * self.height:
            raise ValueError(f"{self.width} x {self.height} pixels in {len(self.data)} bytes")

    @classmethod
    def of(cls, image: Image, vehicle: str, time_ns: int) -> "RawImage":
        """Create from a picture of the vehicle's camera."""
        height, width, _ = image.pixels.shape
        return cls(Time.of(time_ns), vehicle, width, height, "rgb8", 3 * width, image.pixels.tobytes())

    @property
    def pixels(self) -> Array:
        """The pixels, (height, width, 3) uint8, RGB."""
        return np.frombuffer(self.data, np.uint8).reshape(self.height, self.width, 3)


class CameraCalibration(Stamped, frozen=True):
    """Calibration of a pinhole camera without distortion; matrices row by row."""

    width: int
    height: int
    K: list[float]  # 3 x 3, px: focal lengths and principal point
    P: list[float]  # 3 x 4: K and a zero column
    distortion_model: str = "plumb_bob"
    D: tuple[float, ...] = (0.0,) * 5
    R: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)

    @classmethod
    def of(cls, image: Image, vehicle: str, time_ns: int) -> "CameraCalibration":
        """Calibration of the camera that took a picture; its principal point is the centre of the picture."""
        height, width, _ = image.pixels.shape
        f, u, v = image.focal_px, 0.5 * (width - 1), 0.5 * (height - 1)  # the centre of the first pixel is (0, 0)
        matrix, projection = [f, 0.0, u, 0.0, f, v, 0.0, 0.0, 1.0], [f, 0.0, u, 0.0, 0.0, f, v, 0.0, 0.0, 0.0, 1.0, 0.0]
        return cls(Time.of(time_ns), vehicle, width, height, matrix, projection)


_NUMPY = (np.ndarray, np.generic)  # created once: frames have many arrays


def to_json(value: object) -> object:
    """Convert NumPy arrays and numbers to JSON types (for ``enc_hook``)."""
    if isinstance(value, _NUMPY):
        return value.tolist()
    raise TypeError(f"cannot record a {type(value).__name__}; use numbers, strings, bytes, lists and mappings")


class Vector2(FoxgloveMessage, frozen=True):
    """A size; or a position in a picture, px: columns and rows from the top left corner of the top left pixel."""

    x: float
    y: float


class PackedElementField(FoxgloveMessage, frozen=True):
    """Name, type and offset of a value in a cell."""

    name: str
    offset: int  # bytes
    type: int = UINT8


class Grid(Stamped, frozen=True):
    """Square cells on the ground, row by row from the south, each row from the west; the pose is at the south-west corner."""

    pose: Pose
    column_count: int
    cell_size: Vector2  # m
    row_stride: int  # bytes
    cell_stride: int
    fields: list[PackedElementField]
    data: bytes

    def __post_init__(self) -> None:
        """Refuse fields of neither a map nor a mosaic, and data that are not whole rows of cells with one byte per field."""
        names, row_bytes = tuple(each.name for each in self.fields), self.column_count * self.cell_stride
        if names not in (MAP, MOSAIC) or self.cell_stride != len(names) or row_bytes <= 0 or len(self.data) % row_bytes:
            raise ValueError(f"rows of {self.column_count} cells with {len(names)} fields in {len(self.data)} bytes")

    @property
    def cells(self) -> Array:
        """The cell values, (rows, columns, fields) uint8."""
        return np.frombuffer(self.data, np.uint8).reshape(-1, self.column_count, self.cell_stride)

    @property
    def content(self) -> ProbabilityMap | Mosaic:
        """The vehicle's map or mosaic that the grid was made from."""
        place = {"left": self.pose.position.x, "bottom": self.pose.position.y, "cell_m": self.cell_size.x}
        if len(self.fields) == len(MAP):
            return ProbabilityMap(**place, probability=frozen(self.cells[..., 0]), seen=frozen(self.cells[..., 1] != 0))
        return Mosaic(**place, pixels=frozen(self.cells[..., :3]))


WHITE, SHADE = Color(1.0, 1.0, 1.0), Color(0.0, 0.0, 0.0, 0.6)


class PointsAnnotation(FoxgloveMessage, frozen=True):
    """Points of a picture connected by lines."""

    timestamp: Time
    type: int
    points: list[Vector2]
    outline_color: Color
    outline_colors: list[Color]
    fill_color: Color
    thickness: float  # px


class TextAnnotation(FoxgloveMessage, frozen=True):
    """Text in a picture; the position is its bottom left."""

    timestamp: Time
    position: Vector2
    text: str
    font_size: float  # px
    text_color: Color
    background_color: Color


class CircleAnnotation(FoxgloveMessage, frozen=True):
    """A circle in a picture; unused, but Foxglove's schema requires the list."""

    timestamp: Time
    position: Vector2
    diameter: float
    thickness: float
    fill_color: Color
    outline_color: Color


class ImageAnnotations(FoxgloveMessage, frozen=True):
    """Detections in a picture; fields after the three lists extend Foxglove's."""

    circles: list[CircleAnnotation]
    points: list[PointsAnnotation]
    texts: list[TextAnnotation]
    sensor: str = ""
    time_ns: int = 0  # when the picture was taken
    width: int = 0  # px
    height: int = 0
    found: tuple[Sighting, ...] = ()

    def sightings(self, jpeg: bytes = b"") -> Sightings:
        """The sightings, with their picture if given."""
        values = {name: getattr(self, name) for name in ("sensor", "time_ns", "width", "height", "found")}
        return Sightings(**values, jpeg=jpeg)


class CompressedImage(Stamped, frozen=True):
    """A picture in JPEG format."""

    data: bytes
    format: str = "jpeg"


def messages_of(
    key: str, value: ProbabilityMap | Sightings | Mosaic, time_ns: int, color: int = 0
) -> Iterator[tuple[str, FoxgloveMessage]]:
    """Topic and messages for data that a vehicle shows; ``color`` is the number of the vehicle."""
    if isinstance(value, ProbabilityMap):
        yield key, _grid(value, MAP, np.dstack((value.probability, value.seen)), time_ns)
    elif isinstance(value, Mosaic):
        alpha = np.uint8(255) * value.pixels.any(axis=2)
        yield key, _grid(value, MOSAIC, np.dstack((value.pixels, alpha)), time_ns)
    else:
        yield key, _annotations(value, Color(*rgb_of(color)))
        if value.jpeg:
            yield f"{key}/{PICTURE}", CompressedImage(Time.of(value.time_ns), vehicle_of(key), value.jpeg)


def corners_of(sighting: Sighting) -> list[tuple[float, float]]:
    """The corners of a target in its picture, px, with the centre of the first pixel at (0, 0); the first two are its top."""
    (u, v), half = sighting.centre_px, 0.5 * sighting.side_px
    c, s = half * math.cos(sighting.angle), half * math.sin(sighting.angle)  # rows count downwards
    return [(u + x * c + y * s, v - x * s + y * c) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]


def label_of(sighting: Sighting) -> str:
    """Label of a detection: name and score."""
    return f"{sighting.target} {sighting.score:.2f}".strip()


def _grid(ground: ProbabilityMap | Mosaic, names: tuple[str, ...], cells: Array, time_ns: int) -> Grid:
    _, columns, depth = cells.shape
    corner, size = Pose(Vector3(ground.left, ground.bottom)), Vector2(ground.cell_m, ground.cell_m)
    fields = [PackedElementField(name, offset) for offset, name in enumerate(names)]
    return Grid(Time.of(time_ns), "world", corner, columns, size, columns * depth, depth, fields, cells.tobytes())


def _annotations(sightings: Sightings, color: Color) -> ImageAnnotations:
    """Annotations with the time of the picture, by which viewers match the two."""
    at, clear = Time.of(sightings.time_ns), Color(0.0, 0.0, 0.0, 0.0)
    points, texts = [], []
    for each in sightings.found:
        corners = [Vector2(u + 0.5, v + 0.5) for u, v in corners_of(each)]
        points.append(PointsAnnotation(at, LINE_LOOP, corners, color, [], clear, 2.0))
        left, top = min(corner.x for corner in corners), min(map(attrgetter("y"), corners))
        texts.append(TextAnnotation(at, Vector2(left, top - 2.0), label_of(each), FONT_PX, WHITE, SHADE))
    sizes = sightings.width, sightings.height
    return ImageAnnotations([], points, texts, sightings.sensor, sightings.time_ns, *sizes, sightings.found)
