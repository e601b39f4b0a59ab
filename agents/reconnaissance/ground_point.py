"""Conversion between pixels of a downward camera and places on the ground.

The picture is that of a pinhole whose principal point is the middle of the picture. The camera is fixed to its vehicle and
looks along the body's -z; the upper edge of the picture is ahead, its left edge on the left:

    forward = (v0 - v) h / f,   left = (u0 - u) h / f

at a height h over ground that is level, with a focal length f in pixels, for a vehicle that does not tilt. In general the ray
``R (v0 - v, u0 - u, -f)``, R the attitude, is followed to the ground.

Pixels are (column, row) as OpenCV counts them: the middle of the first pixel is (0, 0), that of the picture (u0, v0) =
((width - 1) / 2, (height - 1) / 2).
"""

import math
from typing import NamedTuple

from vcmvsp.cosim.frames import Quaternion
from vcmvsp.cosim.types import Image, Vec3, VehicleState

Point = tuple[float, float]  # m, world, on the ground
Pixel = tuple[float, float]  # column, row
Region = tuple[int, int, int, int]  # px: first column, first row, and those behind the last ones

MOUNT = (0.0, 0.0, -0.05)  # m, body frame: default of the sensor kind ``nadir_camera``
LEVEL = 1e-6  # how far the ray of a pixel that sees the ground points down, at least


class Nadir(NamedTuple):
    """Where a picture was taken from, and how. Use the pose of the instant in which it was taken, not of a later one."""

    position: Vec3  # of the pinhole, m, world
    attitude: Quaternion  # of the vehicle; w, x, y, z; world_from_body
    focal_px: float
    width: int  # px
    height: int
    ground_m: float = 0.0  # height of the ground, m, world

    @property
    def height_m(self) -> float:
        """Of the camera over the ground, m."""
        return self.position[2] - self.ground_m

    @property
    def upright(self) -> float:
        """The cosine of its tilt."""
        _, i, j, _ = self.attitude
        return 1.0 - 2.0 * (i * i + j * j)

    @property
    def middle(self) -> Pixel:
        """The principal point."""
        return 0.5 * (self.width - 1), 0.5 * (self.height - 1)

    def ground_point(self, pixel: Pixel) -> Point | None:
        """The place that a pixel shows; None where it shows none: the horizon and above, or a camera in the ground."""
        (u, v), (u0, v0) = pixel, self.middle
        x, y, z = turned(self.attitude, (v0 - v, u0 - u, -self.focal_px))
        if not (z < -LEVEL * self.focal_px and self.height_m > 0.0):  # not a number is no place either
            return None
        share = self.height_m / -z
        place = self.position[0] + share * x, self.position[1] + share * y
        return place if math.isfinite(place[0]) and math.isfinite(place[1]) else None

    def pixel(self, place: Point) -> Pixel | None:
        """Where a place on the ground appears, maybe beyond the edges; None: not in front of the camera."""
        x0, y0, _ = self.position
        w, i, j, k = self.attitude
        forward, left, up = turned((w, -i, -j, -k), (place[0] - x0, place[1] - y0, -self.height_m))
        if not up < -LEVEL:
            return None
        (u0, v0), scale = self.middle, self.focal_px / -up
        return u0 - scale * left, v0 - scale * forward

    def footprint(self, part: Region | None = None) -> tuple[Point, ...] | None:
        """The corners of the ground in the picture, or in a part of it, counter-clockwise from ahead on the left.

        None: it shows the horizon.
        """
        first, top, last, low = (edge - 0.5 for edge in part or (0, 0, self.width, self.height))  # outer edges of pixels
        ground_corners = [self.ground_point(corner) for corner in ((first, top), (first, low), (last, low), (last, top))]
        corners = tuple(corner for corner in ground_corners if corner is not None)
        return corners if len(corners) == len(ground_corners) else None

    def region(self, place: Point, reach_m: float) -> Region | None:
        """The pixels that show all of the ground within ``reach_m`` of a place, as far as the picture does; None: none do."""
        x, y = place
        corners = [self.pixel((x + i * reach_m, y + j * reach_m)) for i in (-1, 1) for j in (-1, 1)]
        columns, rows = zip(*(corner for corner in corners if corner is not None), strict=True) if any(corners) else ((), ())
        if len(columns) < len(corners):
            return (0, 0, self.width, self.height) if columns else None
        first, top = max(0, math.floor(min(columns))), max(0, math.floor(min(rows)))
        last, low = min(self.width, math.ceil(max(columns)) + 1), min(self.height, math.ceil(max(rows)) + 1)
        return (first, top, last, low) if first < last and top < low else None


def nadir_of(image: Image, state: VehicleState, *, mount: Vec3 = MOUNT, ground_m: float = 0.0) -> Nadir:
    """How a picture was taken by a vehicle that was in this state then; ``mount``: the pinhole, m, body frame."""
    x, y, z = turned(state.attitude, mount)
    height, width = image.pixels.shape[:2]
    x0, y0, z0 = state.position
    return Nadir((x0 + x, y0 + y, z0 + z), state.attitude, image.focal_px, width, height, ground_m)


def turned(attitude: Quaternion, vector: Vec3) -> Vec3:
    """A vector of the body in the world: ``v + 2 w (q x v) + 2 q x (q x v)`` for a unit quaternion (w, q)."""
    w, i, j, k = attitude
    x, y, z = vector
    a, b, c = 2.0 * (j * z - k * y), 2.0 * (k * x - i * z), 2.0 * (i * y - j * x)
    return x + w * a + j * c - k * b, y + w * b + k * a - i * c, z + w * c + i * b - j * a
