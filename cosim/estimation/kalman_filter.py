"""Steps of an extended Kalman filter of a wheeled robot's pose, and its start with unknown heading.

The state is (x m, y m, heading rad, scale, veer rad/m, bias rad/s): true distances are ``(1 + scale)`` times odometry, and
the robot turns ``veer`` per metre (unequal wheels) and ``bias`` per second (bias of a gyro) more than odometry says.

At the start odometry gives the shape of the path, positions its place, neither the heading. The best rotation is the closed
form of the plane Procrustes problem. About it, one linear Kalman pass with unknown heading (uniform: variance pi^2 / 3) gives
mean and covariance: the noise of positions and of odometry counts once each.
"""

import math
from collections.abc import Sequence

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
    return np.asarray(0.5 * (matrix + matrix.T))


def _sinc(half: float) -> tuple[float, float]:
    """``sin(h) / h`` and its derivative; by series for small h."""
    if abs(half) < 1e-3:
        return 1.0 - half * half / 6.0, -half / 3.0
    ratio = math.sin(half) / half
    return ratio, (math.cos(half) - ratio) / half


UNKNOWN = math.pi**2 / 3.0  # rad^2, variance of an unknown direction
LEAST = 4  # positions; three are needed, one more lets them contradict each other
MOST = 40  # positions
LONGEST = 2000  # items

Items = tuple[OdometryMotion | MeasuredPosition, ...]  # in order of time; the first is a position


class AlignedStart(msgspec.Struct, frozen=True):
    """State of the robot after the items."""

    mean: Array  # (6,)
    covariance: Array  # (6, 6)
    chi2: float  # of the fit
    count: int  # of the positions

    def fits(self, gate: float) -> bool:
        """Whether the positions agree with each other and with odometry: two degrees each, less pose and heading."""
        return self.chi2 <= chi2_quantile(gate, max(2 * self.count - 3, 1))


def chi2_quantile(probability: float, degrees: int) -> float:
    """Quantile of the chi-square distribution."""
    from scipy.special import gammaincinv

    return 2.0 * float(gammaincinv(0.5 * degrees, probability))


def trimmed(items: Items, most: int = MOST) -> Items:
    """The items from the last ``most`` positions on."""
    places = _places(items)
    return items[places[-most] :] if 0 < most < len(places) else items


def extended(items: Items, motion: OdometryMotion) -> Items:
    """The items and a motion; in a list that is too long, the oldest positions and their motions are dropped."""
    last = items[-1]
    if isinstance(last, OdometryMotion) and last.measured == motion.measured and _rests(last) and _rests(motion):
        return (*items[:-1], OdometryMotion(0.0, 0.0, last.seconds + motion.seconds, motion.measured))
    if len(items) < LONGEST:
        return (*items, motion)
    remaining = trimmed(items, count(items) - 1)
    return (*remaining, motion) if remaining is not items else ()


def count(items: Items) -> int:
    """Number of positions in the items."""
    return len(_places(items))


def _places(items: Items) -> list[int]:
    return [index for index, item in enumerate(items) if isinstance(item, MeasuredPosition)]


def aligned(items: Items, prior: Array, noise: OdometryNoise, sigma_rad: float, gate: float) -> AlignedStart | None:
    """The start, if the path gives the heading to ``sigma_rad`` and the positions agree; else None.

    If they do not agree, up to a quarter is dropped: each time the position without which the others fit best.
    """
    path, positions = _path(items)
    remaining = list(range(len(positions)))
    while len(remaining) >= max(LEAST, len(positions) - len(positions) // 4):
        heading, sigma, _ = _rotation(path[remaining], [positions[each] for each in remaining])
        if sigma > sigma_rad:
            return None
        dropped = sorted(set(range(len(positions))) - set(remaining))
        start = fitted(_without(items, dropped), prior, noise, heading)
        if start.fits(gate):
            return start
        residuals = []
        for each in range(len(remaining)):
            rest = remaining[:each] + remaining[each + 1 :]
            residuals.append(_rotation(path[rest], [positions[number] for number in rest])[2])
        remaining.pop(int(np.argmin(residuals)))
    return None


def fitted(items: Items, prior: Array, noise: OdometryNoise, heading: float | None = None) -> AlignedStart:
    """Least-squares start: a Kalman pass over the differences from the path that starts with ``heading``.

    ``prior`` has the variances of scale, veer and bias in its diagonal.
    """
    path, positions = _path(items)
    if heading is None:
        heading = _rotation(path, positions)[0]
    nominal = np.zeros(SIZE)
    nominal[:3] = positions[0].x, positions[0].y, heading
    covariance = prior.copy()
    covariance[0, 0] = covariance[1, 1] = positions[0].sigma_m ** 2
    covariance[2, 2] = UNKNOWN
    difference, chi2 = np.zeros(SIZE), 0.0
    for item in items[1:]:
        if isinstance(item, OdometryMotion):
            nominal, jacobian, added = moved(nominal, item, noise)
            difference, covariance = jacobian @ difference, grown(covariance, jacobian, added)
        else:
            residual, inverse, length2 = innovation(nominal + difference, covariance, item)
            gain, covariance = corrected(covariance, inverse, item)
            difference, chi2 = difference + gain @ residual, chi2 + length2
    return AlignedStart(nominal + difference, covariance, chi2, len(positions))


def rough(items: Items, prior: Array, noise: OdometryNoise) -> tuple[Array, Array]:
    """Mean and covariance with unknown heading: the last position, and the distance driven since, in any direction."""
    mean, covariance, end = np.zeros(SIZE), np.zeros((SIZE, SIZE)), np.zeros(SIZE)
    for item in trimmed(items, 1):
        if isinstance(item, MeasuredPosition):
            mean[:2] = item.x, item.y
            covariance[0, 0] = covariance[1, 1] = item.sigma_m**2
        else:
            end, jacobian, added = moved(end, item, noise)
            covariance = grown(covariance, jacobian, added)
    spread = 0.5 * float(end[0] ** 2 + end[1] ** 2)  # variance of each coordinate of a vector of random direction
    covariance[:HEADING, HEADING:] = covariance[HEADING:, :HEADING] = 0.0
    covariance[0, 0] += spread
    covariance[1, 1] += spread
    covariance[HEADING:, HEADING:] = prior[HEADING:, HEADING:]
    covariance[HEADING, HEADING] = UNKNOWN
    return mean, covariance


def _path(items: Items) -> tuple[Array, list[MeasuredPosition]]:
    """Path by odometry at each position, (n, 2) m, from the origin with heading 0; and the positions."""
    at, noise = np.zeros(SIZE), OdometryNoise()
    places, positions = [], []
    for item in items:
        if isinstance(item, OdometryMotion):
            at, _, _ = moved(at, item, noise)
        else:
            places.append(at[:2])
            positions.append(item)
    return np.array(places), positions


def _rotation(path: Array, positions: Sequence[MeasuredPosition]) -> tuple[float, float, float]:
    """Heading that fits the path to the positions, its standard deviation, and the weighted squared residual.

    Centred paths u and positions z with weights w = 1 / sigma^2: the heading is the argument of the sum of
    ``w conj(u) z`` (as complex numbers), its variance ``1 / sum w |u|^2``, its residual
    ``sum w (|u|^2 + |z|^2) - 2 |sum w conj(u) z|``.
    """
    weight = np.array([each.sigma_m**-2 for each in positions])
    u = path[:, 0] + 1j * path[:, 1]
    z = np.array([complex(each.x, each.y) for each in positions])
    u, z = u - weight @ u / weight.sum(), z - weight @ z / weight.sum()
    product = complex(weight @ (u.conj() * z))
    spread = float(weight @ np.abs(u) ** 2)
    residual = spread + float(weight @ np.abs(z) ** 2) - 2.0 * abs(product)
    return math.atan2(product.imag, product.real), spread**-0.5 if spread > 0.0 else math.inf, residual


def _rests(motion: OdometryMotion) -> bool:
    return motion.distance_m == 0.0 and motion.turn_rad == 0.0


def _without(items: Items, dropped: list[int]) -> Items:
    """The items without some positions, from the first remaining position on."""
    places = _places(items)
    left_out = {places[number] for number in dropped}
    first = next(place for place in places if place not in left_out)
    return tuple(item for index, item in enumerate(items) if index >= first and index not in left_out)
