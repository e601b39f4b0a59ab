"""Readings of sensors as numbers of an observation."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vcmvsp.cosim.agent import Observation
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.learning.task import SPEED_BOUND, YAW_RATE_BOUND, Floats
from vcmvsp.cosim.types import Fix, Imu, Measured, Odometry, Reading, Scan

FAR = 1e6  # bound of numbers that have no other


class SensorVector:
    """Readings of some sensors of a vehicle as one vector; its size is that of the first readings of all vehicles.

    A scan gives its ranges (no return: the greatest; below the minimum: 0), a `Measured` its values in the order of names, an
    `Imu` acceleration and angular velocity, an `Odometry` pose and speeds, a `Fix` its position. Before its first reading a
    sensor's numbers are 0.

    Args:
        names: of the sensors.
        first: observations of all vehicles.

    Raises:
        UsageError: a vehicle has no reading of a sensor at its first tick, or one of another size or of no such kind.
    """

    def __init__(self, names: Sequence[str], first: Mapping[str, Observation]) -> None:
        self._sizes: dict[str, int] = {}
        bounds: list[Floats] = [np.zeros((2, 0))]
        for name in names:
            for vehicle, observation in first.items():
                reading = observation.readings.get(name)
                if reading is None:
                    raise UsageError(f"sensors: {vehicle} has no reading of '{name}' at its first tick")
                size = len(_numbers(reading))
                if self._sizes.setdefault(name, size) != size:
                    raise UsageError(f"sensors: '{name}' of {vehicle} has {size} numbers, not {self._sizes[name]} as of others")
            bounds.append(_bounds(first[next(iter(first))].readings[name]))
        self.bounds: Floats = np.concatenate(bounds, axis=1)
        self.size: int = self.bounds.shape[1]

    def values(self, readings: Mapping[str, Any]) -> Floats:
        """The numbers (size,), within their bounds."""
        parts = [_numbers(readings[name]) for name in self._sizes]
        return np.clip(np.concatenate(parts), *self.bounds)


def _numbers(reading: Reading) -> Floats:
    match reading:
        case Scan(ranges=ranges, range_max=greatest):
            return np.clip(np.nan_to_num(ranges.astype(float), posinf=greatest, neginf=0.0), 0.0, greatest)
        case Measured(values=values):
            return np.nan_to_num(np.array([values[name] for name in sorted(values)], float), posinf=FAR, neginf=-FAR)
        case Imu(acceleration=acceleration, angular_velocity=angular_velocity):
            return np.array([*acceleration, *angular_velocity])
        case Odometry(pose=pose, v=v, w=w):
            return np.array([*pose, v, w])
        case Fix(position=position):
            return np.array(position)
    raise UsageError(
        f"sensors: a {type(reading).__name__} is no vector; use scans, ranges, inertial readings, odometry or fixes"
    )


def _bounds(reading: Reading) -> Floats:
    """Least and greatest numbers of such a reading, (2, size)."""
    size = len(_numbers(reading))
    if isinstance(reading, Scan):
        return np.array([np.zeros(size), np.full(size, reading.range_max)])
    greatest = np.full(size, FAR)
    if isinstance(reading, Imu):
        greatest[:3], greatest[3:] = 10.0 * SPEED_BOUND, YAW_RATE_BOUND
    return np.array([-greatest, greatest])
