"""Inertial measurement: specific force and angular velocity in the body frame."""

import math
from dataclasses import dataclass

import msgspec
import numpy as np

from vcmvsp.cosim.types import Imu, NonNegative, Positive, Rate
from vcmvsp.physics.sensors.noise import Errors, Noise
from vcmvsp.physics.sensors.sensor import Sensor
from vcmvsp.physics.world.scene import Scene

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
        """Readings of all six."""
        x, y, z = scene.acceleration[row].tolist()
        force = (x, y, z + scene.gravity) @ scene.rotation(row)
        read = self._errors.read(np.concatenate([force, scene.angular_velocity[row]]), scene.now_ns, rng)
        a, b, c, p, q, r = np.minimum(np.maximum(read, -self._limits), self._limits).tolist()
        return Imu(acceleration=(a, b, c), angular_velocity=(p, q, r), time_ns=scene.now_ns)
