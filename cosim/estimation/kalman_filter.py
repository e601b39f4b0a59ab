"""Steps of an extended Kalman filter of a wheeled robot's pose: prediction by odometry, correction by a position.

The state is (x m, y m, heading rad, scale, veer rad/m, bias rad/s): true distances are ``(1 + scale)`` times odometry, and
the robot turns ``veer`` per metre (unequal wheels) and ``bias`` per second (bias of a gyro) more than odometry says.
"""

import math
from typing import Any

import msgspec
import numpy as np

from vcmvsp.cosim.types import Array, NonNegative

SIZE = 6
HEADING = 2


class OdometryMotion(msgspec.Struct, frozen=True):
    """Motion in an interval, from odometry or, if it is silent, from the last speeds."""

    distance_m: float  # along the path, negative backwards
    turn_rad: float
    seconds: float
    measured: bool = True


class MeasuredPosition(msgspec.Struct, frozen=True):
    """A measured position."""

    x: float  # m
    y: float  # m
    sigma_m: float  # standard deviation of each


class OdometryNoise(msgspec.Struct, frozen=True, kw_only=True):
    """Uncertainty of odometry: random walks, so that variances grow with the path and do not depend on its division.

    The defaults are of the size that Borenstein and Feng 1996 ("Measurement and correction of systematic odometry errors in
    mobile robots", IEEE Trans. RA 12(6)) report after calibration on smooth floors: some centimetres and degrees in 10 m.
    """

    distance: NonNegative = 0.02  # m per sqrt(m) driven
    turn: NonNegative = 0.03  # rad per sqrt(rad) turned
    veer: NonNegative = 0.01  # rad per sqrt(m) driven
    time_m: NonNegative = 0.002  # m per sqrt(s), always: pushes and vibration
    time_rad: NonNegative = 0.001  # rad per sqrt(s), always
    untold_m: NonNegative = 0.3  # m per sqrt(s) while odometry is silent
    untold_rad: NonNegative = 0.3  # rad per sqrt(s) while odometry is silent


def moved(mean: Array, motion: OdometryMotion, noise: OdometryNoise) -> tuple[Array, Array, Array]:
    """The mean (6,) after a motion along an arc, its Jacobian (6, 6), and the covariance (6, 6) that the motion adds.

    The chord of an arc of length d and angle a is ``d sin(a/2) / (a/2)``, in the direction ``heading + a/2``.
    """
    x, y, heading, scale, veer, bias = mean.tolist()
    distance, seconds = motion.distance_m, motion.seconds
    length, angle = (1.0 + scale) * distance, motion.turn_rad + veer * distance + bias * seconds
    half = 0.5 * angle
    ratio, slope = _sinc(half)
    cos, sin = math.cos(heading + half), math.sin(heading + half)
    chord, chord_by_angle = length * ratio, 0.5 * length * slope
    dx, dy = chord * cos, chord * sin
    by_angle = np.array([chord_by_angle * cos - 0.5 * dy, chord_by_angle * sin + 0.5 * dx, 1.0, 0.0, 0.0, 0.0])
    by_length = np.array([ratio * cos, ratio * sin, 0.0, 0.0, 0.0, 0.0])

    jacobian = np.eye(SIZE)
    jacobian[0, 2], jacobian[1, 2] = -dy, dx
    jacobian[:, 3] += distance * by_length
    jacobian[:, 4] += distance * by_angle
    jacobian[:, 5] += seconds * by_angle
    angle_var = noise.turn**2 * abs(motion.turn_rad) + noise.veer**2 * abs(distance)
    added = noise.distance**2 * abs(distance) * np.outer(by_length, by_length) + angle_var * np.outer(by_angle, by_angle)
    added[0, 0] += (at := (noise.time_m**2 + (0.0 if motion.measured else noise.untold_m**2)) * seconds)
    added[1, 1] += at
    added[2, 2] += (noise.time_rad**2 + (0.0 if motion.measured else noise.untold_rad**2)) * seconds
    return np.array([x + dx, y + dy, heading + angle, scale, veer, bias]), jacobian, added


def grown(covariance: Array, jacobian: Array, added: Array) -> Array:
    """The covariance after a motion."""
    return symmetric(jacobian @ covariance @ jacobian.T + added)


def innovation(mean: Array, covariance: Array, position: MeasuredPosition) -> tuple[Array, Array, float]:
    """Measured minus expected (2,), the inverse of its covariance (2, 2), its squared Mahalanobis length (chi-square, 2)."""
    xx, xy, yy = covariance[0, 0] + position.sigma_m**2, covariance[0, 1], covariance[1, 1] + position.sigma_m**2
    inverse = np.array([[yy, -xy], [-xy, xx]]) / (xx * yy - xy * xy)
    difference = np.array([position.x - mean[0], position.y - mean[1]])
    return difference, inverse, float(difference @ inverse @ difference)


def corrected(covariance: Array, inverse: Array, position: MeasuredPosition) -> tuple[Array, Array]:
    """Gain (6, 2), and the covariance after a position, in Joseph's form, which stays positive definite."""
    gain = covariance[:, :2] @ inverse
    complement = np.eye(SIZE)
    complement[:, :2] -= gain
    return gain, symmetric(complement @ covariance @ complement.T + position.sigma_m**2 * gain @ gain.T)


def symmetric(matrix: Array) -> Array:
    """The matrix without asymmetry from rounding."""
    result: Any = 0.5 * (matrix + matrix.T)
    return result  # type: ignore[no-any-return]


def _sinc(half: float) -> tuple[float, float]:
    """``sin(h) / h`` and its derivative; by series for small h."""
    if abs(half) < 1e-3:
        return 1.0 - half * half / 6.0, -half / 3.0
    ratio = math.sin(half) / half
    return ratio, (math.cos(half) - ratio) / half
