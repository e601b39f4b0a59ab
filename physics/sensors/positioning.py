"""The positioning system of `physics.sensors.positioning_system`, as a sensor among the others: a fix with a heading."""

from dataclasses import dataclass

import numpy as np

from vcmvsp.cosim.types import Fix, NonNegative, Probability, VehicleState
from vcmvsp.physics.sensors.positioning_system import Positioning
from vcmvsp.physics.sensors.sensor import Sensor
from vcmvsp.physics.world.scene import Scene


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
        """The same fixes from the same draws as those of a `Positioning`."""
        x, y, z = scene.position[row].tolist()
        w, i, j, k = scene.attitude[row].tolist()
        return self._system.measure(scene.now_ns, VehicleState(position=(x, y, z), attitude=(w, i, j, k)), rng)
