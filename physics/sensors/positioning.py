"""Positioning sensors: a complete system with heading, satellite receivers (`gps`), ultra-wideband tags (`uwb`)."""

import math
from dataclasses import dataclass

import numpy as np

from vcmvsp.cosim.frames import wrap
from vcmvsp.cosim.types import Array, Fix, NonNegative, Positive, Probability, Rate, Seconds, Vec3, VehicleState
from vcmvsp.physics.raycast.line_of_sight import sightline_of
from vcmvsp.physics.sensors.sensor import Errors, Noise, Sensor, jump
from vcmvsp.physics.world.proximity import NearestPoint
from vcmvsp.physics.world.world import Scene, World


@dataclass(frozen=True, kw_only=True)
class Positioning:
    """Independent Gaussian errors of x, y and yaw at every fix, and rare outliers.

    The defaults suit an ultra-wideband system indoors, such as that of Toh 2012: about 0.15 m.
    """

    rate_hz: Rate = 10.0  # fixes a second
    sigma_m: NonNegative = 0.15  # standard deviation of x and of y, m
    sigma_rad: NonNegative = 0.05  # standard deviation of the yaw, rad
    heading: bool = True  # whether fixes contain the yaw; fixes of a single tag do not
    outlier_probability: Probability = 0.0  # of a fix to be displaced (a reflection taken for the direct path)
    outlier_m: NonNegative = 2.0  # how far an outlier is displaced, m, in a random direction

    def measure(self, now_ns: int, truth: VehicleState, rng: np.random.Generator) -> Fix:
        """One fix. It takes three normal and two uniform draws for any parameters."""
        dx, dy, turn = rng.standard_normal(3).tolist()
        far_x, far_y = jump(self.outlier_probability, self.outlier_m, rng)
        x, y, z = truth.position
        place = (x + self.sigma_m * dx + far_x, y + self.sigma_m * dy + far_y, z)
        if not self.heading:
            return Fix(time_ns=now_ns, position=place, sigma_m=self.sigma_m)
        yaw = wrap(truth.yaw + self.sigma_rad * turn)
        return Fix(time_ns=now_ns, position=place, yaw=yaw, sigma_m=self.sigma_m, sigma_rad=self.sigma_rad)


@dataclass(kw_only=True)
class PositioningSensor(Sensor):
    """Pose with independent Gaussian errors of x, y and yaw at every fix, and rare outliers (see `Positioning`)."""

    sigma_m: NonNegative = 0.15  # standard deviation of x and of y, m
    sigma_rad: NonNegative = 0.05  # standard deviation of the yaw, rad
    outlier_probability: Probability = 0.0  # of a fix to be displaced
    outlier_m: NonNegative = 2.0  # how far an outlier is displaced, m, in a random direction

    def __post_init__(self) -> None:
        keys = ("rate_hz", "sigma_m", "sigma_rad", "outlier_probability", "outlier_m")
        self._system = Positioning(**{key: getattr(self, key) for key in keys})

    def measure(self, scene: Scene, row: int, rng: np.random.Generator) -> Fix:
        """The fix of a `Positioning`, from equal draws."""
        x, y, z = scene.position[row].tolist()
        w, i, j, k = scene.attitude[row].tolist()
        return self._system.measure(scene.now_ns, VehicleState(position=(x, y, z), attitude=(w, i, j, k)), rng)


@dataclass(kw_only=True)
class Gps(Sensor):
    """Position of an antenna, without heading.

    Each coordinate errs by a Gauss-Markov process (satellite geometry, ionosphere, slow multipath) and by white noise (see
    `Noise`). The defaults describe a low-cost receiver without correction: half of the fixes lie within 2.5 m (u-blox NEO-M8
    data sheet), which is 2.1 m in each horizontal coordinate, nearly all of it slow; heights err about 1.5 times as much. A fix
    contains the standard deviation of both errors together.
    """

    rate_hz: Rate = 5.0  # readings a second; receivers give 1 to 10
    latency_s: Seconds = 0.1  # from measuring to delivery, s; assumed
    drift_m: NonNegative = 2.1  # standard deviation of the slow error of x and of y, m
    drift_time_s: Positive = 100.0  # its correlation time, s; assumed, one to several minutes are usual
    sigma_m: NonNegative = 0.3  # standard deviation of the white noise of x and of y, m; assumed
    drift_z_m: NonNegative = 3.2  # as drift_m, of the height
    sigma_z_m: NonNegative = 0.5  # as sigma_m, of the height
    outlier_probability: Probability = 0.0  # of a fix to be displaced (a reflection taken for the direct path)
    outlier_m: NonNegative = 20.0  # how far an outlier is displaced, m, in a random direction
    mount: Vec3 = (0.0, 0.0, 0.0)  # of the antenna, m, body frame

    def __post_init__(self) -> None:
        flat = Noise(sigma=self.sigma_m, drift_sd=self.drift_m, drift_time_s=self.drift_time_s)
        up = Noise(sigma=self.sigma_z_m, drift_sd=self.drift_z_m, drift_time_s=self.drift_time_s)
        self._errors = Errors([flat, flat, up])

    def measure(self, scene: Scene, row: int, rng: np.random.Generator) -> Fix:
        """Measured position of the antenna."""
        x, y, z = self._errors.read(scene.point(row, self.mount), scene.now_ns, rng).tolist()
        dx, dy = jump(self.outlier_probability, self.outlier_m, rng)
        sigma_m, sigma_z_m = math.hypot(self.sigma_m, self.drift_m), math.hypot(self.sigma_z_m, self.drift_z_m)
        return Fix(time_ns=scene.now_ns, position=(x + dx, y + dy, z), sigma_m=sigma_m, sigma_z_m=sigma_z_m)


_TINY_M = 1e-6  # replaces an error of zero when errors are compared


@dataclass(kw_only=True)
class Uwb(Sensor):
    """Position of a tag, without heading.

    Reflections from solids nearby, and obstacles on the direct path, make ranges too long, never too short (D. Dardari
    et al., Ranging with ultrawide bandwidth signals in multipath environments, Proceedings of the IEEE 97, 2009).

    Without ``anchors`` the error is the same everywhere except near solids: there the fix is pushed away from the nearest one,
    by ``wall_bias_m`` at its face and linearly less up to ``wall_reach_m`` from it.

    With ``anchors`` the range to each of them errs by ``sigma_m``, by that bias, and by ``blocked_bias_m`` where a solid stands
    between; the error of the fix follows from a least-squares solution, linear about the truth, with these ranges and a prior
    height of standard deviation ``sigma_z_m``. So geometry dilutes the precision, most of all outside of the anchors; a fix
    contains the diluted standard deviations (R. B. Langley, Dilution of precision, GPS World 10(5), 1999).
    """

    sigma_m: NonNegative = 0.15  # standard deviation of x and of y, or of a range, m; 0.1 to 0.3 are usual indoors
    sigma_z_m: NonNegative = 0.3  # standard deviation of the height, m; with anchors: of what is known of it beforehand
    wall_bias_m: NonNegative = 0.3  # error at the face of a solid, m; assumed
    wall_reach_m: Positive = 1.0  # distance from a solid up to which there is an error, m; assumed
    outlier_probability: Probability = 0.0  # of a fix to be displaced (a reflection taken for the direct path)
    outlier_m: NonNegative = 2.0  # how far an outlier is displaced, m, in a random direction
    anchors: tuple[Vec3, ...] = ()  # positions of the anchors, m, world; none: uniform precision
    blocked_bias_m: NonNegative = 0.3  # error of a range through a solid, m; assumed
    mount: Vec3 = (0.0, 0.0, 0.0)  # of the tag, m, body frame

    def __post_init__(self) -> None:
        places = np.array(self.anchors, float).reshape(-1, 3)
        if self.anchors and np.linalg.matrix_rank(places[1:, :2] - places[0, :2]) < 2:
            raise ValueError("anchors: at least three are needed, not on one straight line as seen from above")
        self._places = places

    def measure(self, scene: Scene, row: int, rng: np.random.Generator) -> Fix:
        """Measured position of the tag. The number of draws depends on the number of anchors alone."""
        draws = rng.standard_normal(3 + len(self._places))
        dx, dy = jump(self.outlier_probability, self.outlier_m, rng)
        place = scene.point(row, self.mount)
        near = scene.world.clearance.nearest(place, self.wall_reach_m) if self.wall_bias_m else None
        bias_m = self.wall_bias_m * (1.0 - near.distance_m / self.wall_reach_m) if near else 0.0
        if self.anchors:
            error, sigma_m, sigma_z_m = self._located(scene.world, place, bias_m, draws)
        else:
            error = np.array([self.sigma_m, self.sigma_m, self.sigma_z_m]) * draws[:3] + _away(place, near, bias_m)
            sigma_m, sigma_z_m = self.sigma_m, self.sigma_z_m
        x, y, z = (place + error).tolist()
        return Fix(time_ns=scene.now_ns, position=(x + dx, y + dy, z), sigma_m=sigma_m, sigma_z_m=sigma_z_m)

    def _located(self, world: World, place: Array, bias_m: float, draws: Array) -> tuple[Array, float, float]:
        """Error of a fix from ranges, (3,) m, and its standard deviations without biases: horizontal, vertical, m."""
        run = place - self._places
        directions = run / np.maximum(np.linalg.norm(run, axis=1), _TINY_M)[:, None]
        errors = self.sigma_m * draws[3:] + bias_m
        if self.blocked_bias_m:
            passes, _ = sightline_of(world).crossings(place, self._places)
            errors = errors + self.blocked_bias_m * passes.any(axis=1)
        weight = (max(self.sigma_m, _TINY_M) / max(self.sigma_z_m, _TINY_M)) ** 2  # of the known height, beside a range
        normal = directions.T @ directions
        normal[2, 2] += weight
        spread = np.linalg.inv(normal)
        right = directions.T @ errors
        right[2] += weight * self.sigma_z_m * draws[2]
        x, y, z = np.diag(spread).tolist()
        error: Array = spread @ right
        return error, self.sigma_m * math.sqrt(0.5 * (x + y)), self.sigma_m * math.sqrt(z)


def _away(place: Array, near: NearestPoint | None, bias_m: float) -> Array:
    if near is None or near.distance_m == 0.0:
        return np.zeros(3)
    return np.asarray((place - near.point) * (bias_m / near.distance_m))
