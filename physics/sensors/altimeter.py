"""Height above the floor."""

from dataclasses import dataclass

import numpy as np

from vcmvsp.cosim.types import Measured, Rate
from vcmvsp.physics.sensors.noise import Errors, Noise
from vcmvsp.physics.sensors.sensor import Sensor
from vcmvsp.physics.world.scene import Scene

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
