"""Appearance of the floor of a world (a colour, a picture, marks), and targets of searches on it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, pairwise
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
            raise ValueError("a mark needs exactly one of outline (3 points or more), line (2 or more), radius (> 0), picture")

    def points(self) -> Array:
        """Corners of the mark's outline, (k, 2) m; of a picture counter-clockwise from its upper right."""
        if self.outline or self.line:
            return np.array(self.outline or self.line, float)
        half_length, half_width = (self.radius, self.radius) if self.radius else (0.5 * self.size[0], 0.5 * self.size[1])
        return rectangle(*self.center, half_length, half_width, self.yaw_rad)


class GroundPicture(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, dict=True):
    """Appearance of the floor from above."""

    picture: FileName = ""  # an image file; its upper edge is north. Empty: the plain color
    center: Point2 = (0.0, 0.0)  # of the picture, x, y, m
    size: tuple[Positive, Positive] = (1.0, 1.0)  # of the picture, east-west and north-south, m
    color: Color = (196, 196, 188)  # of the floor outside the picture
    resolution_m: Positive = 0.1  # edge of a pixel, where there is no picture file but marks
    marks: tuple[Mark, ...] = ()  # painted over it, one after the other, as far as the picture reaches

    def __post_init__(self) -> None:
        pixels = self.size[0] * self.size[1] / self.resolution_m**2
        if self.marks and not self.picture and pixels > 4 * MOST_PIXELS:
            raise ValueError(
                f"resolution_m = {self.resolution_m:g} gives {pixels / 1e6:.0f} million pixels for {self.size[0]:g} x "
                f"{self.size[1]:g} m; make it coarser (at most {4 * MOST_PIXELS / 1e6:.0f} million)"
            )

    @property
    def plain(self) -> bool:
        """Whether the floor has one colour and no picture."""
        return not (self.picture or self.marks)

    @cached_property
    def image(self) -> Array | None:
        """The picture, (h, w, 3) uint8 red, green, blue, read-only; row 0 is the north edge. None: one colour.

        Raises:
            ValueError: a file is no picture.
        """
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
            return np.asarray(np.rint(self._pixel(points, pixels.shape) * (1 << _SHIFT)).astype(np.int32))

        per_metre = pixels.shape[1] / self.size[0]
        if mark.outline:
            cv2.fillPoly(pixels, [fixed(mark.points())], mark.color, cv2.LINE_AA, _SHIFT)
        elif mark.line:
            thickness = max(1, round(mark.width * per_metre))
            cv2.polylines(pixels, [fixed(mark.points())], False, mark.color, thickness, cv2.LINE_AA, _SHIFT)
        elif mark.radius:
            (middle,), radius = fixed(np.array([mark.center])), round(mark.radius * per_metre * (1 << _SHIFT))
            cv2.circle(pixels, middle.tolist(), radius, mark.color, cv2.FILLED, cv2.LINE_AA, _SHIFT)
        else:
            _stick(pixels, read_picture(mark.picture), self._pixel(mark.points(), pixels.shape))

    def _pixel(self, points: Array, shape: tuple[int, ...]) -> Array:
        """Columns and rows (k, 2) of places (k, 2) m; whole numbers are middles of pixels."""
        (x, y), (length, width) = self.center, self.size
        right, down = points[:, 0] - (x - 0.5 * length), (y + 0.5 * width) - points[:, 1]
        return np.asarray(np.column_stack([right * shape[1] / length - 0.5, down * shape[0] / width - 0.5]))


def read_picture(path: str) -> Array:
    """Read a picture file, (h, w, 3) uint8 red, green, blue.

    Raises:
        ValueError: there is no such file, or no picture in it.
    """
    import cv2

    if not Path(path).is_file():
        raise ValueError(f"there is no picture file {path}")
    if not cv2.haveImageReader(path):
        raise ValueError(f"{path} is not a picture that OpenCV can read: use PNG, JPEG, TIFF, BMP, PGM or PPM")
    try:
        pixels = decoded(limits.read_bytes(Path(path), limits.FILE_BYTES), cv2.IMREAD_COLOR_RGB)
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror or error}") from error
    if pixels is None:
        raise ValueError(f"{path} is a damaged picture: save it again{limits.PICTURE}")
    return np.asarray(pixels)


def _stick(pixels: Array, picture: Array, corners: Array) -> None:
    """Draw a picture into another.

    Args:
        corners: where its corners lie, (4, 2) column and row, from the upper right one counter-clockwise.
    """
    import cv2

    low = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(corners.max(axis=0)).astype(int) + 2, pixels.shape[1::-1])
    if (low >= high).any():
        return
    height, width = picture.shape[:2]
    shrink = max(width / max(math.dist(corners[0], corners[1]), 1.0), height / max(math.dist(corners[1], corners[2]), 1.0))
    if shrink > 1.0:  # coinciding pixels are averaged first
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
    (x, y), (length, width) = center.tolist(), size.tolist()
    return GroundPicture(center=(x, y), size=(length, width), color=color, resolution_m=resolution, marks=tuple(marks))


class GroundTarget(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A target of a search, flat on the ground: a picture or a disc, at rest or moving."""

    name: str = ""  # label; empty: target1, target2, ...
    picture: FileName = ""  # an image file, made square; its upper edge is north before it is turned. Empty: a disc
    color: Color = (224, 32, 160)  # of the disc
    size: Positive = 2.0  # edge of the picture or diameter of the disc, m
    place: Point2 | None = None  # where its middle lies, x, y, m; default: somewhere on a street of a town
    yaw_rad: float = 0.0  # the picture is turned by this, counter-clockwise, and stays so on its way
    way: tuple[Point2, ...] = ()  # places of a moving target, x, y, m: straight lines from one to the next
    speed: Positive | None = None  # along its way, m/s; default: it has none
    loop: bool = False  # true: from the last place back to the first, repeatedly; false: it stays at the last

    def __post_init__(self) -> None:
        numbers = (*(self.place or ()), self.yaw_rad, *(value for place in self.way for value in place))
        if not all(map(math.isfinite, numbers)):
            raise ValueError(f"place, yaw_rad and way of a target must be finite, not {numbers}")
        if self.way and self.place is not None:
            raise ValueError("a target has either a place or a way; leave one of them out")
        if self.way and (len(self.way) < 2 or any(a == b for a, b in pairwise(self.way))):
            raise ValueError("the way of a target needs at least two places, each different from the one before")
        if bool(self.way) != (self.speed is not None) or (self.loop and not self.way):
            raise ValueError("a moving target needs both way and speed; a target at rest has no way, speed or loop")


@dataclass(frozen=True)
class PlacedTarget:
    """A target in a world."""

    name: str  # unique among the targets of the world
    size_m: float  # edge of the picture, or diameter of the disc
    picture: str  # an image file; empty: a disc
    color: Color  # of the disc
    yaw_rad: float  # the picture is turned by this
    way: tuple[Point2, ...]  # corners of its way, x, y, m; the only one of a target at rest
    speed: float = 0.0  # along the way, m/s
    loop: bool = False  # it goes round

    def place(self, time_s: float) -> Point2:
        """Middle of the target at a time, x, y, m."""
        if len(self.way) == 1:
            return self.way[0]
        corners, run = self._corners, self.speed * max(time_s, 0.0)
        if self.loop:
            run %= self._runs[-1]
        x, y = (float(np.interp(run, self._runs, column)) for column in zip(*corners, strict=True))
        return x, y

    def yaw(self, time_s: float) -> float:
        """Yaw of the target at a time, rad."""
        return self.yaw_rad

    @cached_property
    def _corners(self) -> tuple[Point2, ...]:
        return (*self.way, self.way[0]) if self.loop else self.way

    @cached_property
    def _runs(self) -> list[float]:
        return [0.0, *accumulate(math.dist(a, b) for a, b in pairwise(self._corners))]


def names(targets: Sequence[GroundTarget]) -> list[str]:
    """Names of targets."""
    return [each.name or f"target{number}" for number, each in enumerate(targets, start=1)]


def placed(targets: Sequence[GroundTarget]) -> tuple[PlacedTarget, ...]:
    """Targets with a place or a way, as they lie in a world."""
    in_world = []
    for name, each in zip(names(targets), targets, strict=True):
        way, speed = each.way if each.place is None else (each.place,), each.speed or 0.0
        target = PlacedTarget(name, each.size, each.picture, each.color, each.yaw_rad, way, speed, each.loop)
        in_world.append(target)
    return tuple(in_world)
