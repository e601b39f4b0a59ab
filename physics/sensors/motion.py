"""Sensors of a vehicle's own motion: altimeter, compass, magnetometer, inertial unit, wheel odometry."""

import math
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.frames import arc, wrap, yaw_of
from vcmvsp.cosim.types import Count, Imu, Measured, NonNegative, Odometry, Positive, Rate, Vec3
from vcmvsp.physics.sensors.sensor import Errors, Noise, Sensor
from vcmvsp.physics.world.world import Scene

_BAROMETER = Noise(sigma=0.1, drift_sd=0.5, drift_time_s=600.0)  # assumed


@dataclass(kw_only=True)
class Altimeter(Sensor):
    """``height_m`` of the vehicle's reference point, of a barometer: it drifts with the weather."""

    rate_hz: Rate = 20.0  # readings a second
    noise: Noise = _BAROMETER  # of the height, m

    def __post_init__(self) -> None:
        self._errors = Errors([self.noise])

    def measure(self, scene: Scene, row: int, rng: np.random.Generator) -> Measured:
        """The height."""
        (height,) = self._errors.read(scene.position[row, 2:], scene.now_ns, rng).tolist()
        return Measured(time_ns=scene.now_ns, values={"height_m": height})


_MAGNETIC = Noise(sigma=0.02, bias_sd=0.05)  # assumed


@dataclass(kw_only=True)
class Compass(Sensor):
    """``yaw_rad`` of the body x axis seen from above, counter-clockwise from east, in [-pi, pi).

    The turn-on bias stands for iron on the vehicle and an uncertain declination.
    """

    noise: Noise = _MAGNETIC  # of the yaw, rad

    def __post_init__(self) -> None:
        self._errors = Errors([self.noise])

    def measure(self, scene: Scene, row: int, rng: np.random.Generator) -> Measured:
        """The yaw."""
        w, x, y, z = scene.attitude[row].tolist()
        (yaw,) = self._errors.read(np.array([yaw_of((w, x, y, z))]), scene.now_ns, rng).tolist()
        return Measured(time_ns=scene.now_ns, values={"yaw_rad": wrap(yaw)})


_FIELD = Noise(sigma=0.3, bias_sd=1.0)  # assumed, as after a calibration


@dataclass(kw_only=True)
class Magnetometer(Sensor):
    """``x_ut``, ``y_ut``, ``z_ut``: the magnetic field of the earth along the body axes, microtesla.

    The default field is that near Zurich: 48 uT, 3 degrees east of north, 63.5 degrees downwards (geo_magnetic_tables.hpp of
    PX4).
    """

    rate_hz: Rate = 60.0  # readings a second
    field_ut: Vec3 = (1.1, 21.4, -43.0)  # of the earth, uT, east, north, up
    noise: Noise = _FIELD  # of each component, uT

    def __post_init__(self) -> None:
        self._errors, self._field = Errors([self.noise] * 3), np.array(self.field_ut)

    def measure(self, scene: Scene, row: int, rng: np.random.Generator) -> Measured:
        """The field."""
        x, y, z = self._errors.read(self._field @ scene.rotation(row), scene.now_ns, rng).tolist()
        return Measured(time_ns=scene.now_ns, values={"x_ut": x, "y_ut": y, "z_ut": z})


_FORCE = Noise(bias_sd=0.05, drift_sd=0.01, drift_time_s=300.0, quantum=9.81 / 4096)  # m/s2; quantum: MPU-6000 at 8 g
_TURN = Noise(bias_sd=0.005, drift_sd=0.001, drift_time_s=300.0, quantum=math.radians(1 / 32.8))  # rad/s; ... at 1000 deg/s


@dataclass(kw_only=True)
class InertialUnit(Sensor):
    """Three accelerometers and three gyroscopes along the body axes, at the vehicle's reference point.

    Specific force is acceleration less that of gravity: (0, 0, 9.81) m/s2 for a vehicle that stands level, 0 in free fall. The
    acceleration is the mean over the last step of physics, as after an accelerometer's filter.

    A noise density of N gives readings of a standard deviation of ``N sqrt(rate_hz)``: their integral then walks away by
    ``N sqrt(t)``, at any rate (IEEE Std 952-1997, angle random walk). Defaults: densities, limits and steps of the MPU-6000
    data sheet at 8 g and 1000 deg/s; biases assumed, as after a calibration at rest.
    """

    rate_hz: Rate = 60.0  # readings a second
    accelerometer_density: NonNegative = 0.0039  # white noise, m/s2 per root Hz: 400 ug
    accelerometer: Noise = _FORCE  # other errors, m/s2
    accelerometer_limit: Positive = 78.5  # readings end here, m/s2
    gyroscope_density: NonNegative = 8.7e-5  # white noise, rad/s per root Hz: 0.005 deg/s
    gyroscope: Noise = _TURN  # other errors, rad/s
    gyroscope_limit: Positive = 17.45  # readings end here, rad/s

    def __post_init__(self) -> None:
        root = self.rate_hz**0.5
        force, turn = (
            msgspec.structs.replace(noise, sigma=float(np.hypot(noise.sigma, density * root)))
            for noise, density in ((self.accelerometer, self.accelerometer_density), (self.gyroscope, self.gyroscope_density))
        )
        self._errors = Errors([force] * 3 + [turn] * 3)
        self._limits = np.repeat([self.accelerometer_limit, self.gyroscope_limit], 3)

    def measure(self, scene: Scene, row: int, rng: np.random.Generator) -> Imu:
        """Readings of all six channels."""
        x, y, z = scene.acceleration[row].tolist()
        force = (x, y, z + scene.gravity) @ scene.rotation(row)
        read = self._errors.read(np.concatenate([force, scene.angular_velocity[row]]), scene.now_ns, rng)
        a, b, c, p, q, r = np.minimum(np.maximum(read, -self._limits), self._limits).tolist()
        return Imu(acceleration=(a, b, c), angular_velocity=(p, q, r), time_ns=scene.now_ns)


Relative = Annotated[float, msgspec.Meta(gt=-1, le=1)]

_NO_WHEELS = "has no two driven wheels (wheel_radius_m, track_m), which wheel odometry needs"


@dataclass(kw_only=True)
class WheelOdometry(Sensor):
    """Pose and speeds of a differential drive by its encoders; it begins with the true pose at its first reading.

    Between readings both wheels turn steadily in the model, so the path is an arc. Slip is not measured. Too large a wheel
    radius in the model makes distances longer; unequal radii, or a wrong track, make it turn (J. Borenstein, L. Feng,
    Measurement and correction of systematic odometry errors in mobile robots, IEEE Trans. Robotics and Automation 12, 1996).
    """

    wheel_radius_m: Positive | None = None  # true radius of its wheels, m; default: that of the vehicle
    # true distance between the points where they touch the floor, m; default: that of the vehicle
    track_m: Positive | None = None
    left_radius_error: Relative = 0.0  # relative error of the left radius in its model; 0.01: 1 % too large
    right_radius_error: Relative = 0.0  # relative error of the right radius
    track_error: Relative = 0.0  # relative error of the track; 0.01: 1 % too wide
    ticks_per_turn: Count = 0  # of the encoder, at the wheel; 0: exact angles
    # standard deviation of each wheel's way after 1 m, m, growing as the root of the way (K. S. Chong, L. Kleeman, Accurate
    # odometry and error modelling for a mobile robot, 1997)
    walk_m: NonNegative = 0.0

    def __post_init__(self) -> None:
        self._pose = (0.0, 0.0, 0.0)
        self._last: tuple[int, float, float] | None = None  # ns; encoder readings, rad

    def misfit(self, model: object) -> str:
        """Reason to refuse a vehicle: it has no wheels."""
        return "" if hasattr(model, "wheel_radius_m") and hasattr(model, "track_m") else _NO_WHEELS

    def measure(self, scene: Scene, row: int, rng: np.random.Generator) -> Odometry:
        """The pose, and mean speeds since the last reading. Two normal draws.

        Raises:
            ScenarioError: the vehicle has no wheels.
        """
        if self.wheel_radius_m is None or self.track_m is None or math.isnan(scene.wheels[row, 0]):
            name = scene.vehicles[row]
            raise ScenarioError(f"{name} {_NO_WHEELS}", key=f"vehicle.{name}.sensors")
        left, right = (self._counted(angle) for angle in scene.wheels[row].tolist())
        noise_left, noise_right = rng.standard_normal(2).tolist()
        if self._last is None:
            x, y, _ = scene.position[row].tolist()
            w, i, j, k = scene.attitude[row].tolist()
            self._pose, self._last = (x, y, yaw_of((w, i, j, k))), (scene.now_ns, left, right)
        then_ns, left_then, right_then = self._last
        dt, self._last = 1e-9 * (scene.now_ns - then_ns), (scene.now_ns, left, right)
        if dt == 0.0:
            return Odometry(pose=self._pose, v=0.0, w=0.0)
        way_left = self._way((left - left_then) * (1.0 + self.left_radius_error) * self.wheel_radius_m, noise_left)
        way_right = self._way((right - right_then) * (1.0 + self.right_radius_error) * self.wheel_radius_m, noise_right)
        v, w = 0.5 * (way_left + way_right) / dt, (way_right - way_left) / (dt * self.track_m * (1.0 + self.track_error))
        self._pose = arc(self._pose, v, w, dt)
        return Odometry(pose=self._pose, v=v, w=w)

    def _counted(self, angle: float) -> float:
        per_turn = self.ticks_per_turn
        return math.floor(angle / math.tau * per_turn) * math.tau / per_turn if per_turn else angle

    def _way(self, way_m: float, draw: float) -> float:
        return way_m + self.walk_m * math.sqrt(abs(way_m)) * draw
