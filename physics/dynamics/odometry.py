"""Odometry of wheels: the arcs that two wheels have rolled, added up at each reading of their encoders."""

from collections.abc import Iterable, Sequence

import numpy as np

from vcmvsp.cosim.frames import arc
from vcmvsp.cosim.types import Array, Vec3
from vcmvsp.physics.dynamics.kinematic import wrapped
from vcmvsp.physics.vehicles.specification import VehicleSpec

ENCODER_HZ = 40.0


class DifferentialOdometry:
    """Odometry of n robots from the angles of their left and right wheels, (n, 2) rad; forwards is positive.

    ``wheels`` are the radius and half the track of each robot, m; ``starts`` its place.
    """

    def __init__(self, wheels: Sequence[tuple[float, float]], starts: Iterable[VehicleSpec]) -> None:
        self._wheels = wheels
        self._radius, self._half_track = np.array(wheels, float).reshape(-1, 2).T
        self._angles = [(0.0, 0.0)] * len(wheels)  # last readings
        self._poses = [(*spec.start[:2], spec.heading) for spec in starts]  # at these readings

    def encode(self, angles: Array) -> None:
        """Read the encoders."""
        read = angles.tolist()
        self._poses, self._angles = self._reckoned(read), read

    def now(self, angles: Array, rates: Array) -> Array:
        """Odometry (n, 5) at the present angles and rates (n, 2) rad/s: x m, y m, yaw rad, v m/s, w rad/s; changes nothing."""
        odometry = np.empty((len(self._poses), 5))
        odometry[:, :3] = np.array(self._reckoned(angles.tolist())).reshape(-1, 3)
        odometry[:, 2] = wrapped(odometry[:, 2])
        odometry[:, 3] = 0.5 * self._radius * (rates[:, 1] + rates[:, 0])
        odometry[:, 4] = 0.5 * self._radius * (rates[:, 1] - rates[:, 0]) / self._half_track
        return odometry

    def _reckoned(self, angles: Sequence[Sequence[float]]) -> list[Vec3]:
        """Poses at the last readings, continued by the arcs that the wheels have rolled since."""
        poses = []
        for (radius, half_track), pose, before, now in zip(self._wheels, self._poses, self._angles, angles, strict=True):
            left, right = radius * (now[0] - before[0]), radius * (now[1] - before[1])
            poses.append(arc(pose, 0.5 * (left + right), 0.5 * (right - left) / half_track, 1.0))
        return poses
