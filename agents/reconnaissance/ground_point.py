"""Conversion between pixels of a downward camera and places on the ground, by the pose of the instant of the picture.

The picture is that of a pinhole whose principal point is the middle of the picture. The camera is fixed to its vehicle and
looks along the body's -z; the upper edge of the picture is ahead, its left edge on the left:

    forward = (v0 - v) h / f,   left = (u0 - u) h / f

at a height h over ground that is level, with a focal length f in pixels, for a vehicle that does not tilt. In general the ray
``R (v0 - v, u0 - u, -f)``, R the attitude, is followed to the ground.

Pixels are (column, row) as OpenCV counts them: the middle of the first pixel is (0, 0), that of the picture (u0, v0) =
((width - 1) / 2, (height - 1) / 2).

Between two ticks a cubic (Hermite) leads from pose to pose, with the speeds at both: exact where position and attitude change
with a constant acceleration, about one axis. With linear interpolation, the pose of an accelerating quadrotor would be off by a
degree and more half-way between ticks of 0.1 s, and places in its picture by half a metre at 20 m.
"""

import math
from collections import deque
from typing import NamedTuple

from vcmvsp.cosim.agent import Observation
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.frames import Quaternion, product
from vcmvsp.cosim.types import Image, Vec3, VehicleState

Point = tuple[float, float]  # m, world, on the ground
Pixel = tuple[float, float]  # column, row
Region = tuple[int, int, int, int]  # px: first column, first row, and those behind the last ones

MOUNT = (0.0, 0.0, -0.05)  # m, body frame: default of the sensor kind ``nadir_camera``
LEVEL = 1e-6  # how far the ray of a pixel that sees the ground points down, at least


class Nadir(NamedTuple):
    """Pose and optics of a downward camera, at the instant of the picture, not a later one."""

    position: Vec3  # of the pinhole, m, world
    attitude: Quaternion  # of the vehicle; w, x, y, z; world_from_body
    focal_px: float
    width: int  # px
    height: int
    ground_m: float = 0.0  # height of the ground, m, world

    @property
    def height_m(self) -> float:
        """Height of the camera above the ground, m."""
        return self.position[2] - self.ground_m

    @property
    def upright(self) -> float:
        """Cosine of the camera's tilt."""
        _, i, j, _ = self.attitude
        return 1.0 - 2.0 * (i * i + j * j)

    @property
    def middle(self) -> Pixel:
        """Principal point of the picture, px."""
        return 0.5 * (self.width - 1), 0.5 * (self.height - 1)

    def ground_point(self, pixel: Pixel) -> Point | None:
        """Place on the ground that a pixel shows; None: none (the horizon and above, or a camera in the ground)."""
        (u, v), (u0, v0) = pixel, self.middle
        x, y, z = turned(self.attitude, (v0 - v, u0 - u, -self.focal_px))
        if not (z < -LEVEL * self.focal_px and self.height_m > 0.0):  # NaN gives no place either
            return None
        share = self.height_m / -z
        place = self.position[0] + share * x, self.position[1] + share * y
        return place if math.isfinite(place[0]) and math.isfinite(place[1]) else None

    def pixel(self, place: Point) -> Pixel | None:
        """Pixel of a place on the ground, maybe beyond the edges; None: it is not in front of the camera."""
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
        in_front = [corner for corner in corners if corner is not None]
        if len(in_front) < len(corners):
            return (0, 0, self.width, self.height) if in_front else None
        columns, rows = zip(*in_front, strict=True)
        first, top = max(0, math.floor(min(columns))), max(0, math.floor(min(rows)))
        last, low = min(self.width, math.ceil(max(columns)) + 1), min(self.height, math.ceil(max(rows)) + 1)
        return (first, top, last, low) if first < last and top < low else None


def nadir_of(image: Image, state: VehicleState, *, mount: Vec3 = MOUNT, ground_m: float = 0.0) -> Nadir:
    """View of a picture taken by a vehicle in this state; ``mount``: the pinhole, m, body frame."""
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


KEPT_NS = seconds_to_ns(10.0)
GAP = 1.5  # periods between poses; longer gaps are not interpolated


class Poses:
    """Recent poses of one vehicle; ``period_s``: from tick to tick."""

    def __init__(self, period_s: float) -> None:
        self._gap_ns = seconds_to_ns(GAP * period_s)
        self._states: deque[tuple[int, VehicleState]] = deque()

    def add(self, obs: Observation) -> None:
        """Add the pose at a tick; a pose that is not later than the last one is ignored."""
        if self._states and obs.clock_ns <= self._states[-1][0]:
            return
        self._states.append((obs.clock_ns, obs.state))
        while self._states[0][0] < obs.clock_ns - KEPT_NS:
            self._states.popleft()

    def at(self, time_ns: int) -> VehicleState | None:
        """Position and attitude at a time; None: unknown."""
        after: tuple[int, VehicleState] | None = None
        for before in reversed(self._states):
            if before[0] <= time_ns:
                return _between(before, after, time_ns, self._gap_ns)
            after = before
        return None


def _between(
    before: tuple[int, VehicleState], after: tuple[int, VehicleState] | None, time_ns: int, gap_ns: int
) -> VehicleState | None:
    (start_ns, start), (end_ns, end) = before, after or before
    if time_ns == start_ns:
        return start
    if after is None or end_ns - start_ns > gap_ns:
        return None
    period_s = (end_ns - start_ns) / 1e9
    share = (time_ns - start_ns) / (end_ns - start_ns)
    way: Vec3 = tuple(b - a for a, b in zip(start.position, end.position, strict=True))  # type: ignore[assignment]
    displacement = _cubic(way, start.velocity, end.velocity, period_s, share)
    w, x, y, z = start.attitude
    turn = _rotation_vector(product((w, -x, -y, -z), end.attitude))
    # q = q0 exp(r) turns at the rate J(r) r', J the right Jacobian, of which the inverse is about 1 + r/2 x
    (a, b, c), (p, q, r) = turn, end.angular_velocity
    rate = p + 0.5 * (b * r - c * q), q + 0.5 * (c * p - a * r), r + 0.5 * (a * q - b * p)
    turned = _cubic(turn, start.angular_velocity, rate, period_s, share)
    position: Vec3 = tuple(p + d for p, d in zip(start.position, displacement, strict=True))  # type: ignore[assignment]
    return VehicleState(position=position, attitude=product(start.attitude, _quaternion(turned)))


def _cubic(way: Vec3, begin: Vec3, end: Vec3, period_s: float, s: float) -> Vec3:
    """Cubic Hermite interpolation from 0 to ``way`` with end speeds, at a share ``s`` of the period."""
    x, y, z = (
        (3.0 - 2.0 * s) * s * s * w + period_s * s * (1.0 - s) * ((1.0 - s) * b - s * e)
        for w, b, e in zip(way, begin, end, strict=True)
    )
    return x, y, z


def _rotation_vector(turn: Quaternion) -> Vec3:
    """Axis times angle, rad, of the shorter rotation; q and -q are equivalent."""
    w, *axis = turn
    sine = math.hypot(*axis)
    angle = 2.0 * math.atan2(sine, abs(w))
    scale = math.copysign(angle / sine if sine > 1e-9 else 2.0, w)
    x, y, z = (scale * each for each in axis)
    return x, y, z


def _quaternion(rotation: Vec3) -> Quaternion:
    angle = math.hypot(*rotation)
    scale = math.sin(0.5 * angle) / angle if angle > 1e-9 else 0.5
    x, y, z = (scale * each for each in rotation)
    return math.cos(0.5 * angle), x, y, z
