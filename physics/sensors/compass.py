"""Heading against the magnetic field."""

from dataclasses import dataclass

import numpy as np

from vcmvsp.cosim.frames import wrap, yaw_of
from vcmvsp.cosim.types import Measured
from vcmvsp.physics.sensors.noise import Errors, Noise
from vcmvsp.physics.sensors.sensor import Sensor
from vcmvsp.physics.world.scene import Scene

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
