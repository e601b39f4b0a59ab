"""Trajectories in a Crazyflie's memory: pieces of polynomials of 7th degree for x, y, z and yaw.

Both formats, and the rules of evaluation, follow Bitcraze's firmware (``pptraj.c``, ``pptraj_compressed.c``, ``planner.c``,
2024).
"""

import math
import struct
from collections.abc import Iterator
from itertools import accumulate
from typing import NamedTuple

from vcmvsp.cosim.frames import rotate2, wrap
from vcmvsp.cosim.types import ORIGIN, Vec3

DEGREE = 7
PIECE = struct.Struct("<33f")  # coefficients of x, y, z and yaw, ascending; duration, s
START, HEADER = struct.Struct("<4h"), struct.Struct("<BH")  # of the compressed format
POINTS = 0, 1, 3, 7  # control points of a compressed axis, by its type
SCALES = 1e-3, 1e-3, 1e-3, math.radians(0.1)  # of compressed numbers: mm, tenths of degrees

Memory = bytes | bytearray
Polynomial = tuple[float, ...]
"""Coefficients by ascending powers of the time in s."""


class Piece(NamedTuple):
    """A part of a trajectory."""

    duration_s: float
    axes: tuple[Polynomial, ...]  # x, y, z in m, yaw in rad


class Pose(NamedTuple):
    """Position, yaw and velocity on a trajectory at one time."""

    position: Vec3  # m
    yaw: float  # rad
    velocity: Vec3 = ORIGIN  # m/s
    yaw_rate: float = 0.0  # rad/s


class Trajectory(NamedTuple):
    """Pieces that are flown one after the other."""

    pieces: tuple[Piece, ...]
    time_scale: float = 1.0  # above 1 it takes longer
    reversed: bool = False
    shift: Vec3 = ORIGIN  # m
    turn: float = 0.0  # rad, about the origin, before the shift

    @property
    def duration_s(self) -> float:
        """How long it takes, s."""
        return self.time_scale * sum(piece.duration_s for piece in self.pieces)

    def at(self, time_s: float) -> Pose:
        """Pose some time after the beginning; at rest after the end."""
        forward = -1.0 if self.reversed else 1.0
        ends = [*accumulate(piece.duration_s for piece in self.pieces)]
        own_s = min(max(time_s / self.time_scale, 0.0), ends[-1])
        if self.reversed:
            own_s = ends[-1] - own_s
        number = next(place for place, end in enumerate(ends) if own_s <= end)
        piece = self.pieces[number]
        own_s -= ends[number] - piece.duration_s
        x, y, z, yaw = (_value(axis, own_s) for axis in piece.axes)
        speed = forward / self.time_scale if 0.0 <= time_s < self.duration_s else 0.0
        vx, vy, vz, rate = (speed * _value(_derivative(axis), own_s) for axis in piece.axes)
        x, y = rotate2(x, y, self.turn)
        vx, vy = rotate2(vx, vy, self.turn)
        dx, dy, dz = self.shift
        return Pose((x + dx, y + dy, z + dz), yaw + self.turn, (vx, vy, vz), rate)

    def moved_to(self, position: Vec3, yaw: float | None) -> "Trajectory":
        """The trajectory that begins at a place and, unless it is reversed, at this yaw.

        As in the firmware, the shift is found before the turn: a turned trajectory begins at the place if it began at the
        origin.
        """
        begin = self.at(0.0)
        dx, dy, dz = (to - of for to, of in zip(position, begin.position, strict=True))
        turn = 0.0 if yaw is None or self.reversed else wrap(yaw - begin.yaw)
        return self._replace(shift=(dx, dy, dz), turn=turn)


def uncompressed(memory: Memory, offset: int, count: int) -> tuple[Piece, ...]:
    """Pieces with all coefficients. Raises `struct.error`: they reach beyond the memory."""
    pieces = []
    for number in range(count):
        numbers = PIECE.unpack_from(memory, offset + number * PIECE.size)
        axes = tuple(numbers[first : first + DEGREE + 1] for first in range(0, 4 * (DEGREE + 1), DEGREE + 1))
        pieces.append(Piece(numbers[-1], axes))
    return tuple(pieces)


def compressed(memory: Memory, offset: int) -> tuple[Piece, ...]:
    """Pieces of the compressed format, up to one without a duration. Raises `struct.error`: they reach beyond the memory.

    An axis has the control points of a Bezier curve behind its last value.
    """
    begin: list[float] = [scale * number for scale, number in zip(SCALES, START.unpack_from(memory, offset), strict=True)]
    return tuple(_pieces_from(memory, offset + START.size, begin))


def _pieces_from(memory: Memory, offset: int, begin: list[float]) -> Iterator[Piece]:
    while offset < len(memory):
        types, duration_ms = HEADER.unpack_from(memory, offset)
        offset += HEADER.size
        if duration_ms == 0:
            return
        axes = []
        for axis, scale in enumerate(SCALES):
            count = POINTS[types >> 2 * axis & 3]
            numbers = struct.unpack_from(f"<{count}h", memory, offset)
            offset += 2 * count
            points = [begin[axis], *(scale * number for number in numbers)]
            axes.append(_of_bezier(points, 1e-3 * duration_ms))
            begin[axis] = points[-1]
        yield Piece(1e-3 * duration_ms, tuple(axes))


def _of_bezier(points: list[float], duration_s: float) -> Polynomial:
    """Coefficients of a Bezier curve over a duration: c_j = C(n, j) sum_i (-1)^(i + j) C(j, i) P_i / duration^j."""
    n = len(points) - 1
    coefficients = []
    for j in range(n + 1):
        difference = sum((-1) ** (i + j) * math.comb(j, i) * points[i] for i in range(j + 1))
        coefficients.append(math.comb(n, j) * difference / duration_s**j)
    return tuple(coefficients)


def _value(polynomial: Polynomial, time_s: float) -> float:
    value = 0.0
    for coefficient in reversed(polynomial):
        value = value * time_s + coefficient
    return value


def _derivative(polynomial: Polynomial) -> Polynomial:
    return tuple(power * coefficient for power, coefficient in enumerate(polynomial))[1:]
