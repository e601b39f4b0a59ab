"""What agents show, as messages that Foxglove and Lichtblick draw: maps and mosaics as grids, sightings on their pictures.

As in `cosim.recording.foxglove.messages`, names and fields are those of Foxglove's published schemas. What those have no place
for stands in further fields, which viewers pass over, so that a recording has all that an agent showed.

===============================  ===========================  =====================================================
``<vehicle>/map``                `Grid`                       ``probability`` in 255ths and ``seen``, 0 or 1, per cell
``<vehicle>/mosaic``             `Grid`                       ``red``, ``green``, ``blue``; ``alpha`` 0: not seen
``<vehicle>/sightings``          `ImageAnnotations`           turned boxes with names, and the sightings themselves
``<vehicle>/sightings/picture``  `CompressedImage`            the picture that they are in, where it was kept
===============================  ===========================  =====================================================
"""

import math
from collections.abc import Iterator

import numpy as np

from vcmvsp.cosim.recording.foxglove.messages import Color, FoxgloveMessage, Pose, Time, Vector3
from vcmvsp.cosim.types import Array, Mosaic, ProbabilityMap, Sighting, Sightings
from vcmvsp.cosim.util.palette import rgb_of

UINT8 = 1  # foxglove.NumericType
LINE_LOOP = 2  # foxglove.PointsAnnotationType
PICTURE = "picture"  # under the key of the sightings
WHITE, SHADE = Color(1.0, 1.0, 1.0), Color(0.0, 0.0, 0.0, 0.6)
FONT_PX = 16.0


class Vector2(FoxgloveMessage, frozen=True):
    """A size."""

    x: float
    y: float


class Point2(FoxgloveMessage, frozen=True):
    """A place in a picture, px: columns and rows from the top left corner of the top left pixel."""

    x: float
    y: float


class PackedElementField(FoxgloveMessage, frozen=True):
    """What stands where in a cell."""

    name: str
    offset: int  # bytes
    type: int = UINT8


class Grid(FoxgloveMessage, frozen=True):
    """Square cells of the ground, row by row from the south, each row from the west; the pose is the south-west corner's."""

    timestamp: Time
    frame_id: str
    pose: Pose
    column_count: int
    cell_size: Vector2  # m
    row_stride: int  # bytes
    cell_stride: int
    fields: list[PackedElementField]
    data: bytes

    @property
    def cells(self) -> Array:
        """The numbers: (rows, columns, fields) uint8."""
        return np.frombuffer(self.data, np.uint8).reshape(-1, self.column_count, self.cell_stride)


class PointsAnnotation(FoxgloveMessage, frozen=True):
    """Points of a picture, joined by lines."""

    timestamp: Time
    type: int
    points: list[Point2]
    outline_color: Color
    outline_colors: list[Color]
    fill_color: Color
    thickness: float  # px


class TextAnnotation(FoxgloveMessage, frozen=True):
    """Words in a picture; the position is that of their bottom left."""

    timestamp: Time
    position: Point2
    text: str
    font_size: float  # px
    text_color: Color
    background_color: Color


class CircleAnnotation(FoxgloveMessage, frozen=True):
    """A circle in a picture: Foxglove asks for the list, and nothing here is round."""

    timestamp: Time
    position: Point2
    diameter: float
    thickness: float
    fill_color: Color
    outline_color: Color


class ImageAnnotations(FoxgloveMessage, frozen=True):
    """What was recognised in a picture; what stands behind the three lists is additional to Foxglove's fields."""

    circles: list[CircleAnnotation]
    points: list[PointsAnnotation]
    texts: list[TextAnnotation]
    sensor: str = ""
    time_ns: int = 0  # when the picture was taken
    width: int = 0  # px
    height: int = 0
    found: tuple[Sighting, ...] = ()


class CompressedImage(FoxgloveMessage, frozen=True):
    """A picture as a JPEG file."""

    timestamp: Time
    frame_id: str
    data: bytes
    format: str = "jpeg"


def messages_of(
    key: str, value: ProbabilityMap | Sightings | Mosaic, time_ns: int, color: int = 0
) -> Iterator[tuple[str, FoxgloveMessage]]:
    """Topic and message of each part of what a vehicle shows; ``color`` is the number of the vehicle."""
    if isinstance(value, ProbabilityMap):
        yield key, _grid(value, ("probability", "seen"), np.dstack((value.probability, value.seen)), time_ns)
    elif isinstance(value, Mosaic):
        alpha = np.uint8(255) * value.pixels.any(axis=2)
        yield key, _grid(value, ("red", "green", "blue", "alpha"), np.dstack((value.pixels, alpha)), time_ns)
    else:
        yield key, _annotations(value, Color(*rgb_of(color)))
        if value.jpeg:
            vehicle = key.partition("/")[0]
            yield f"{key}/{PICTURE}", CompressedImage(Time.of(value.time_ns), vehicle, value.jpeg)


def corners_of(sighting: Sighting) -> list[tuple[float, float]]:
    """The corners of a target in its picture, px, the middle of the first pixel being (0, 0); the first two are its top."""
    (u, v), half = sighting.centre_px, 0.5 * sighting.side_px
    c, s = half * math.cos(sighting.angle), half * math.sin(sighting.angle)  # rows count downwards
    return [(u + x * c + y * s, v - x * s + y * c) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]


def label_of(sighting: Sighting) -> str:
    """Name and score."""
    return f"{sighting.target} {sighting.score:.2f}".strip()


def _grid(shown: ProbabilityMap | Mosaic, names: tuple[str, ...], cells: Array, time_ns: int) -> Grid:
    _, columns, depth = cells.shape
    corner, size = Pose(Vector3(shown.left, shown.bottom)), Vector2(shown.cell_m, shown.cell_m)
    fields = [PackedElementField(name, offset) for offset, name in enumerate(names)]
    return Grid(Time.of(time_ns), "world", corner, columns, size, columns * depth, depth, fields, cells.tobytes())


def _annotations(sightings: Sightings, color: Color) -> ImageAnnotations:
    """The time is that of the picture, by which viewers put the two together."""
    at, clear = Time.of(sightings.time_ns), Color(0.0, 0.0, 0.0, 0.0)
    points, texts = [], []
    for each in sightings.found:
        corners = [Point2(u + 0.5, v + 0.5) for u, v in corners_of(each)]
        points.append(PointsAnnotation(at, LINE_LOOP, corners, color, [], clear, 2.0))
        above = Point2(min(corner.x for corner in corners), min(corner.y for corner in corners) - 2.0)
        texts.append(TextAnnotation(at, above, label_of(each), FONT_PX, WHITE, SHADE))
    sizes = sightings.width, sightings.height
    return ImageAnnotations([], points, texts, sightings.sensor, sightings.time_ns, *sizes, sightings.found)
