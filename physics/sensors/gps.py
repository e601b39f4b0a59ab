"""Satellite positioning outdoors: a slowly wandering error, white noise, and latency."""

import math
from dataclasses import dataclass

import numpy as np

from vcmvsp.cosim.types import Fix, NonNegative, Positive, Probability, Rate, Seconds, Vec3
from vcmvsp.physics.sensors.noise import Errors, Noise, jump
from vcmvsp.physics.sensors.sensor import Sensor
from vcmvsp.physics.world.scene import Scene


@dataclass(kw_only=True)
class Gps(Sensor):
    """Position of an antenna, without heading.

    Each coordinate errs by a Gauss-Markov process (satellite geometry, ionosphere, slow multipath) and by white noise (see
    `physics.sensors.noise`). The defaults are those of a low-cost receiver without correction: 2.5 m within which half of the
    fixes lie (u-blox NEO-M8 data sheet) is 2.1 m in each horizontal coordinate, nearly all of it slow; heights err about 1.5
    times as much. A fix contains the standard deviation of both errors together.
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
        return Fix(
            time_ns=scene.now_ns,
            position=(x + dx, y + dy, z),
            sigma_m=math.hypot(self.sigma_m, self.drift_m),
            sigma_z_m=math.hypot(self.sigma_z_m, self.drift_z_m),
        )
