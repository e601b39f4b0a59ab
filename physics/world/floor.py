"""Appearance of the floor: a colour, a picture file, and marks painted on it: lawns, lanes."""

import math
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import msgspec
import numpy as np

from vcmvsp.cosim.types import Array, FileName, Positive
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.util.pictures import decoded
from vcmvsp.physics.world.solids import Color, Point2, rectangle

MOST_PIXELS = 1 << 24  # of a painted picture: 48 MiB
_SHIFT = 6  # bits of a pixel's fraction in OpenCV's drawing functions


class Mark(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A mark on the floor: exactly one of an outline, a line, a disc or a picture."""

    name: str = ""  # its label
    color: Color = (255, 255, 255)  # red, green, blue, 0 to 255
    outline: tuple[Point2, ...] = ()  # corners of a filled polygon, x, y, m
    line: tuple[Point2, ...] = ()  # points of a line, x, y, m; ``width`` wide
    width: float = 0.0  # of the line, m; 0: one pixel
    center: Point2 = (0.0, 0.0)  # of the disc or picture, x, y, m
    radius: float = 0.0  # of the disc, m
    picture: FileName = ""  # an image file; its upper edge is north before it is turned
    size: tuple[Positive, Positive] = (1.0, 1.0)  # of the picture, east-west and north-south, m, before it is turned
    yaw_rad: float = 0.0  # the picture is turned by this

    def __post_init__(self) -> None:
        count = sum(map(bool, (self.outline, self.line, self.radius, self.picture)))
        if count != 1 or self.radius < 0.0 or self.width < 0.0 or len(self.outline) in (1, 2) or len(self.line) == 1:
            raise ValueError("a mark needs one of: outline (three points or more), line (two or more), radius (> 0), picture")

    def points(self) -> Array:
        """Corners of its outline, (k, 2) m; of a picture counter-clockwise from its upper right."""
        if self.outline or self.line:
            return np.array(self.outline or self.line, float)
        half_length, half_width = (self.radius, self.radius) if self.radius else (0.5 * self.size[0], 0.5 * self.size[1])
        return rectangle(*self.center, half_length, half_width, self.yaw_rad)


class GroundPicture(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, dict=True):
    """Appearance of the floor from above."""

    picture: FileName = ""  # an image file; its upper edge is north. Empty: the plain color
    center: Point2 = (0.0, 0.0)  # of the picture, x, y, m
    size: tuple[Positive, Positive] = (1.0, 1.0)  # of the picture, east-west and north-south, m
    color: Color = (196, 196, 188)  # of all that the picture does not cover
    resolution_m: Positive = 0.1  # edge of a pixel, where there is no picture file but marks
    marks: tuple[Mark, ...] = ()  # painted over it, one after the other, as far as the picture reaches

    def __post_init__(self) -> None:
        pixels = self.size[0] * self.size[1] / self.resolution_m**2
        if self.marks and not self.picture and pixels > 4 * MOST_PIXELS:
            raise ValueError(
                f"resolution_m = {self.resolution_m:g} makes {pixels / 1e6:.0f} million pixels of {self.size[0]:g} x "
                f"{self.size[1]:g} m: at most {4 * MOST_PIXELS / 1e6:.0f}"
            )

    @property
    def plain(self) -> bool:
        """Whether the floor has one colour and no picture."""
        return not (self.picture or self.marks)

    def image(self) -> Array | None:
        """The picture, (h, w, 3) uint8 red, green, blue, read-only; row 0 is the north edge. None: one colour.

        Painted at the first call.

        Raises:
            ValueError: a file is no picture.
        """
        return self._image

    @cached_property
    def _image(self) -> Array | None:
        if self.plain:
            return None
        if self.picture:
            pixels = read_picture(self.picture)
        else:
            columns, rows = (max(1, round(edge / self.resolution_m)) for edge in self.size)
            pixels = np.full((rows, columns, 3), self.color, np.uint8)
        for mark in self.marks:
            self._paint(pixels, mark)
        pixels.flags.writeable = False
        return pixels

    def _paint(self, pixels: Array, mark: Mark) -> None:
        import cv2

        def fixed(points: Array) -> Array:
            """Places on the floor as OpenCV draws them: the middle of the first pixel is (0, 0), in 64ths of a pixel."""
            pixel: Array = np.rint(self._pixel(points, pixels.shape) * (1 << _SHIFT)).astype(np.int32)
            return pixel

        per_metre = pixels.shape[1] / self.size[0]
        if mark.outline:
            cv2.fillPoly(pixels, [fixed(mark.points())], mark.color, cv2.LINE_AA, _SHIFT)
        elif mark.line:
            thickness = max(1, round(mark.width * per_metre))
            cv2.polylines(pixels, [fixed(mark.points())], False, mark.color, thickness, cv2.LINE_AA, _SHIFT)
        elif mark.radius:
            (middle,) = fixed(np.array([mark.center]))
            radius = round(mark.radius * per_metre * (1 << _SHIFT))
            cv2.circle(pixels, middle.tolist(), radius, mark.color, cv2.FILLED, cv2.LINE_AA, _SHIFT)
        else:
            _stick(pixels, read_picture(mark.picture), self._pixel(mark.points(), pixels.shape))

    def _pixel(self, points: Array, shape: tuple[int, ...]) -> Array:
        """Columns and rows (k, 2) of places (k, 2) m; whole numbers are middles of pixels."""
        (x, y), (length, width) = self.center, self.size
        right, down = points[:, 0] - (x - 0.5 * length), (y + 0.5 * width) - points[:, 1]
        pixel: Array = np.column_stack([right * shape[1] / length - 0.5, down * shape[0] / width - 0.5])
        return pixel


def read_picture(path: str) -> Array:
    """Read a picture file, (h, w, 3) uint8 red, green, blue.

    Raises:
        ValueError: there is no such file, or no picture in it.
    """
    import cv2

    problem, pixels = problem_of_picture(path), None
    if not problem:
        try:
            pixels = decoded(limits.read_bytes(Path(path), limits.FILE_BYTES), cv2.IMREAD_COLOR_RGB)
        except OSError as error:
            problem = f"{path} cannot be read: {error.strerror or error}"
    if pixels is None:
        raise ValueError(problem or f"{path} is a picture, but broken: save it again{limits.PICTURE}")
    found: Array = pixels
    return found


def problem_of_picture(path: str) -> str:
    """Reason why a file is no readable picture, by its first bytes; empty: none."""
    import cv2

    if not Path(path).is_file():
        return f"there is no picture file {path}"
    return (
        "" if cv2.haveImageReader(path) else f"{path} is no picture that OpenCV can read: use PNG, JPEG, TIFF, BMP, PGM or PPM"
    )


def _stick(pixels: Array, picture: Array, corners: Array) -> None:
    """Lay a picture over another; columns and rows of its corners, upper right first and counter-clockwise."""
    import cv2

    low = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(corners.max(axis=0)).astype(int) + 2, pixels.shape[1::-1])
    if (low >= high).any():
        return
    height, width = picture.shape[:2]
    shrink = max(width / max(math.dist(corners[0], corners[1]), 1.0), height / max(math.dist(corners[1], corners[2]), 1.0))
    if shrink > 1.0:  # pixels that fall together are averaged first
        less = max(1, round(width / shrink)), max(1, round(height / shrink))
        picture = cv2.resize(picture, less, interpolation=cv2.INTER_AREA)
        height, width = picture.shape[:2]
    edges = np.array([[width, 0], [0, 0], [0, height]], np.float32) - np.float32(0.5)
    turn = cv2.getAffineTransform(edges, (corners[:3] - low).astype(np.float32))
    part = pixels[low[1] : high[1], low[0] : high[0]]
    size = (part.shape[1], part.shape[0])
    warped = cv2.warpAffine(picture, turn, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    inside = np.zeros(part.shape[:2], np.uint8)
    cv2.fillPoly(inside, [np.rint((corners - low) * (1 << _SHIFT)).astype(np.int32)], 255, cv2.LINE_8, _SHIFT)
    part[inside > 0] = warped[inside > 0]


def around(marks: Sequence[Mark], color: Color) -> GroundPicture:
    """A floor of one colour just large enough for the marks."""
    points = np.concatenate([mark.points() for mark in marks])
    low, high = points.min(axis=0), points.max(axis=0)
    size, center = np.maximum(high - low, 0.1), 0.5 * (low + high)
    resolution = max(0.02, math.sqrt(float(size.prod()) / MOST_PIXELS))
    return GroundPicture(
        center=(float(center[0]), float(center[1])),
        size=(float(size[0]), float(size[1])),
        color=color,
        resolution_m=resolution,
        marks=tuple(marks),
    )
