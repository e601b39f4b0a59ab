"""Laser range scanners: distances along beams that turn about an axis."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, ClassVar, Self

import msgspec
import numpy as np

from vcmvsp.cosim.types import Array, NonNegative, Positive, Probability, Reading, Scan, Vec3, frozen
from vcmvsp.physics.raycast.caster import caster_of
from vcmvsp.physics.raycast.sweep import Fan, sweep
from vcmvsp.physics.sensors.sensor import Sensor
from vcmvsp.physics.world.world import Scene

Beams = Annotated[int, msgspec.Meta(ge=1, le=100_000)]
Opening = Annotated[float, msgspec.Meta(gt=0, le=6.2832)]
Tilt = Annotated[float, msgspec.Meta(ge=-1.5708, le=1.5708)]

_FULL = math.tau - 1e-4  # larger angles count as a full turn: scenarios contain 6.2832
_AT_ONCE = 16384  # beams: larger calls save no more time


@dataclass(kw_only=True)
class RangeScanner(Sensor):
    """Measures the length of beams up to solids, the floor, other vehicles and bodies.

    The beams lie in a plane through the scanner, which tilts with the vehicle. They are spread evenly from the right to the
    left end of the field of view, both included; in a full turn they begin ahead and go round counter-clockwise. The surface
    has no effect, and all beams of a scan are measured at one instant.

    Ranges follow the convention of ROS (REP 117, Informational distance measurements): inf is no return within ``range_max``,
    and -inf a return nearer than ``range_min``. So both ``range_min <= r <= range_max`` finds the valid ones, and ``r < d``
    finds all beams with something nearer than d. There is never a NaN. Inside a solid or another body all beams measure 0.

    A beam's error is Gaussian, then rounded to whole steps; some beams measure something random instead, evenly distributed up
    to ``range_max``, and some return nothing (S. Thrun, W. Burgard, D. Fox, Probabilistic robotics, 2005, 6.3: the terms p_hit,
    p_rand and p_max of the beam model).
    """

    on_demand: ClassVar[bool] = True

    beams: Beams  # how many
    field_of_view: Opening  # angle from the first beam to the last, rad; 6.2832: all the way round
    range_min: NonNegative = 0.0  # minimum range, m
    range_max: Positive  # maximum range, m
    position: Vec3 = (0.0, 0.0, 0.0)  # of the scanner, from the vehicle's reference point, m, body frame
    # direction of the middle of the field of view (of the first beam of a full turn), rad, to the left of ahead
    yaw: float = 0.0
    pitch: Tilt = 0.0  # angle of that direction below the horizontal, rad
    sigma_m: NonNegative = 0.0  # standard deviation of a range, m
    quantum_m: NonNegative = 0.0  # ranges are whole multiples of this, m; 0: any
    no_return: Probability = 0.0  # probability of a beam to return nothing
    outlier_probability: Probability = 0.0  # probability of a beam to measure something random

    def __post_init__(self) -> None:
        if self.range_min >= self.range_max:
            raise ValueError(f"range_min = {self.range_min} must be less than range_max = {self.range_max}")

    @property
    def angle_step(self) -> float:
        """From beam to beam, rad."""
        if self.field_of_view >= _FULL:
            return math.tau / self.beams
        return self.field_of_view / max(self.beams - 1, 1)

    @property
    def first(self) -> float:
        """Angle of the first beam from the middle of the field of view, rad."""
        return 0.0 if self.field_of_view >= _FULL or self.beams == 1 else -0.5 * self.field_of_view

    @cached_property
    def mount(self) -> Array:
        """Position, the direction of angle 0, left of it, and up: columns (3, 4), body frame."""
        (cy, sy), (cp, sp) = ((math.cos(angle), math.sin(angle)) for angle in (self.yaw, self.pitch))
        return np.array([self.position, (cy * cp, sy * cp, -sp), (-sy, cy, 0.0), (cy * sp, sy * sp, cp)]).T

    @cached_property
    def circle(self) -> Array:
        """Cosine and sine of the angle of each beam, (2, beams)."""
        angle = self.first + self.angle_step * np.arange(self.beams)
        return np.array([np.cos(angle), np.sin(angle)])

    @cached_property
    def numbers(self) -> Array:
        """Columns of `Fan`: beams, reach and spread, (7, 1)."""
        step, last = self.angle_step, self.beams - 1.0
        spread = math.tau / step, self.first / step + 0.5 * last, last, 1.0 / step, 0.0
        return np.array([(self.beams, self.range_max, *spread)]).T

    def measure(self, scene: Scene, row: int, rng: np.random.Generator) -> Scan:
        """One scan; beam angles count from the body's x axis, in the plane of the beams."""
        (ranges,) = true_ranges([self], scene, [row])
        return self.scan(ranges, scene.now_ns, rng)

    @classmethod
    def measure_all(
        cls, sensors: Sequence[Self], scene: Scene, rows: Sequence[int], rngs: Sequence[np.random.Generator]
    ) -> list[Reading]:
        """Scans of several scanners, equal to the last bit, in less time."""
        ranges = true_ranges(sensors, scene, rows)
        return [sensor.scan(each, scene.now_ns, rng) for sensor, each, rng in zip(sensors, ranges, rngs, strict=True)]

    def scan(self, ranges: Array, now_ns: int, rng: np.random.Generator) -> Scan:
        """A scan of true ranges."""
        measured, start, step = frozen(self._noisy(ranges, rng).astype(np.float32)), self.yaw + self.first, self.angle_step
        return Scan(ranges=measured, angle_min=start, angle_step=step, range_max=self.range_max, time_ns=now_ns)

    def _noisy(self, ranges: Array, rng: np.random.Generator) -> Array:
        """Ranges with errors. Uniform draws come first, one for each beam: no parameter changes another's draws."""
        draws = rng.random(len(ranges)) if self.sigma_m or self.no_return or self.outlier_probability else None
        if self.sigma_m:
            ranges = np.maximum(ranges + self.sigma_m * rng.standard_normal(len(ranges)), 0.0)
        if draws is not None and self.outlier_probability:
            ranges = np.where(draws < self.outlier_probability, draws * (self.range_max / self.outlier_probability), ranges)
        if self.quantum_m:
            ranges = np.rint(ranges / self.quantum_m) * self.quantum_m
        ranges = np.where(ranges <= self.range_max, ranges, np.inf)
        if self.range_min:
            ranges = np.where(ranges < self.range_min, -np.inf, ranges)
        if draws is not None and self.no_return:
            ranges = np.where(draws >= 1.0 - self.no_return, np.inf, ranges)
        return ranges


@dataclass(kw_only=True)
class Lms(RangeScanner):
    """A scanner for ground vehicles: half a turn, 512 beams, 20 m, as the LMS of Toh 2012 (kind ``lms``).

    It is mounted low, so that it sees the bodies of robots of any height.
    """

    beams: Beams = 512  # how many
    field_of_view: Opening = math.pi  # angle from the first beam to the last, rad; 6.2832: all the way round
    range_max: Positive = 20.0  # maximum range, m
    position: Vec3 = (0.0, 0.0, 0.1)  # of the scanner, from the vehicle's reference point, m, body frame
    sigma_m: NonNegative = 0.008  # that of a SICK LMS5xx from 10 to 20 m (SICK support)
    quantum_m: NonNegative = 0.01  # assumed


@dataclass(kw_only=True)
class Ring(RangeScanner):
    """A small scanner for vehicles that fly: all the way round, 32 beams, 6 m (kind ``ring``)."""

    beams: Beams = 32  # how many
    field_of_view: Opening = math.tau  # angle from the first beam to the last, rad; 6.2832: all the way round
    range_max: Positive = 6.0  # maximum range, m
    sigma_m: NonNegative = 0.01  # assumed


def true_ranges(sensors: Sequence[RangeScanner], scene: Scene, rows: Sequence[int]) -> list[Array]:
    """Ranges of scanners on some vehicles without errors, m; inf: nothing within reach."""
    caster, hulls = caster_of(scene.world), scene.placed_hulls
    ranges, first = [], 0
    while first < len(sensors):
        last, beams = first + 1, sensors[first].beams
        while last < len(sensors) and beams + sensors[last].beams <= _AT_ONCE:
            beams += sensors[last].beams
            last += 1
        ranges += sweep(caster, fan_of(sensors[first:last], scene, rows[first:last]), hulls)
        first = last
    return ranges


def fan_of(sensors: Sequence[RangeScanner], scene: Scene, rows: Sequence[int]) -> Fan:
    """All beams of some scanners on their vehicles."""
    own = np.array(rows)
    if len(sensors) == 1:
        mounts, (cos, sin), numbers = sensors[0].mount[:, :, None], sensors[0].circle, sensors[0].numbers
    else:
        mounts = np.stack([each.mount for each in sensors], axis=-1)
        cos, sin = np.concatenate([each.circle for each in sensors], axis=1)
        numbers = np.concatenate([each.numbers for each in sensors], axis=1)
        numbers[6] = np.cumsum(numbers[0]) - numbers[0]
    turned = (scene.placed_hulls.rotation[:, :, None, own] * mounts).sum(axis=1)  # (x, y, z; columns; sensors)
    origin, frame = turned[:, 0] + scene.position[own].T, turned[:, 1:].swapaxes(0, 1)
    return Fan(origin, frame, numbers[0].astype(np.intp), cos, sin, numbers[2:], numbers[1], own, not frame[:2, 2].any())
