"""Positioning systems (indoor UWB, GNSS): a vehicle's pose at fixed instants, with noise and rare outliers."""

from dataclasses import dataclass

import numpy as np

from vcmvsp.cosim.frames import wrap
from vcmvsp.cosim.types import Fix, NonNegative, Probability, Rate, VehicleState
from vcmvsp.physics.sensors.noise import jump
from vcmvsp.physics.sensors.sensor import Sensor
from vcmvsp.physics.world.scene import Scene


@dataclass(frozen=True, kw_only=True)
class Positioning:
    """Independent Gaussian errors of x, y and yaw at every fix, and rare outliers.

    The defaults are those of an ultra-wideband system indoors such as the one of Toh 2012: about 0.15 m.
    """

    rate_hz: Rate = 10.0  # fixes a second
    sigma_m: NonNegative = 0.15  # standard deviation of x and of y, m
    sigma_rad: NonNegative = 0.05  # standard deviation of the yaw, rad
    heading: bool = True  # whether a fix tells the yaw; that of a single tag does not
    outlier_probability: Probability = 0.0  # of a fix to be displaced (a reflection taken for the direct path)
    outlier_m: NonNegative = 2.0  # how far an outlier is displaced, m, in a random direction

    def measure(self, now_ns: int, truth: VehicleState, rng: np.random.Generator) -> Fix:
        """One fix. It takes three normal and two uniform draws for any parameters."""
        dx, dy, turn = rng.standard_normal(3).tolist()
        far_x, far_y = jump(self.outlier_probability, self.outlier_m, rng)
        x, y, z = truth.position
        yaw = wrap(truth.yaw + self.sigma_rad * turn) if self.heading else None
        return Fix(
            time_ns=now_ns,
            position=(x + self.sigma_m * dx + far_x, y + self.sigma_m * dy + far_y, z),
            yaw=yaw,
            sigma_m=self.sigma_m,
            sigma_rad=0.0 if yaw is None else self.sigma_rad,
        )


@dataclass(kw_only=True)
class PositioningSensor(Sensor):
    """Pose with independent Gaussian errors of x, y and yaw at every fix, and rare outliers (see `Positioning`)."""

    sigma_m: NonNegative = 0.15  # standard deviation of x and of y, m
    sigma_rad: NonNegative = 0.05  # standard deviation of the yaw, rad
    outlier_probability: Probability = 0.0  # of a fix to be displaced
    outlier_m: NonNegative = 2.0  # how far an outlier is displaced, m, in a random direction

    def __post_init__(self) -> None:
        self._system = Positioning(
            rate_hz=self.rate_hz,
            sigma_m=self.sigma_m,
            sigma_rad=self.sigma_rad,
            outlier_probability=self.outlier_probability,
            outlier_m=self.outlier_m,
        )

    def measure(self, scene: Scene, row: int, rng: np.random.Generator) -> Fix:
        """The fix of a `Positioning`, from equal draws."""
        x, y, z = scene.position[row].tolist()
        w, i, j, k = scene.attitude[row].tolist()
        return self._system.measure(scene.now_ns, VehicleState(position=(x, y, z), attitude=(w, i, j, k)), rng)
