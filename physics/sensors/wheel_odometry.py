"""Wheel odometry: the pose from the turns of the wheels."""

import math
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.frames import arc, yaw_of
from vcmvsp.cosim.types import Count, NonNegative, Odometry, Positive
from vcmvsp.physics.sensors.sensor import Sensor
from vcmvsp.physics.world.scene import Scene

Relative = Annotated[float, msgspec.Meta(gt=-1, le=1)]

_NO_WHEELS = "has no two driven wheels (wheel_radius_m, track_m) whose turns could be counted"


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
        """Without wheels."""
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
