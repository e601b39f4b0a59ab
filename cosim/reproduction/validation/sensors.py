"""Sensors in whole runs: scanners against exact geometry, inertial units on a circle, errors of positions."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.reproduction.row import Row, absolute, relative
from vcmvsp.cosim.runs.api import run
from vcmvsp.cosim.types import Array, Later, Scan

HALF_M = (4.0, 3.0)  # a room of 8 x 6 m, in its middle
POSES = ((0.0, 0.0, 0.0), (1.5, -2.0, -2.2), (-3.0, 1.0, 3.1))  # x m, y m, yaw rad
GRAVITY_M_S2 = 9.81
ABOVE: Mapping[str, Any] = {"position": (0.0, 0.0, 0.5)}  # the floor
STILL: Mapping[str, Any] = {"speed": 0.0, "yaw_rate": 0.0}


def scanner() -> Sequence[Row]:
    """Beams of three scanners in a room, and among round pillars, against where a ray meets a line or a circle."""
    wide, long = HALF_M[0] + 0.5, HALF_M[1] + 0.5
    room = [{"center": (side * wide, 0.0, 1.0), "size": (1.0, 9.0, 2.0)} for side in (-1, 1)]
    room += [{"center": (0.0, side * long, 1.0), "size": (9.0, 1.0, 2.0)} for side in (-1, 1)]
    rows = []
    for beams, view in ((32, 2.0 * math.pi), (181, math.pi), (512, 4.0)):
        sensor = {
            "kind": "range_scanner",
            "beams": beams,
            "field_of_view": view,
            "range_max": 20.0,
            "position": (0.0, 0.0, 0.5),
        }
        for pose in POSES:
            scan = _readings({"kind": "boxes", "boxes": room}, pose, sensor)[-1]
            off = np.abs(np.asarray(scan.ranges, float) / _room(pose, _bearings(scan)) - 1.0).max()
            case = f"room, {beams} beams over {view:.3g} rad, from {pose}: largest share off"
            rows.append(absolute(case, 0.0, off, 1e-6))
    centres = ((3.0, 0.0), (0.0, -2.0), (-4.0, 3.0))
    pillars = [{"center": (x, y, 1.0), "radius": 0.5, "height": 2.0} for x, y in centres]
    sensor = {
        "kind": "range_scanner",
        "beams": 720,
        "field_of_view": 2.0 * math.pi,
        "range_max": 9.0,
        "position": (0.0, 0.0, 0.5),
    }
    scan = _readings({"kind": "empty", "cylinders": pillars}, (0.0, 0.0, 0.4), sensor)[-1]
    ranges, exact = np.asarray(scan.ranges, float), _pillars(centres, 0.5, 0.4 + _bearings(scan))
    both = np.isfinite(ranges) & np.isfinite(exact)
    rows += [
        absolute("pillars, 720 beams: seen or not by mistake", 0.0, np.sum(np.isfinite(ranges) != np.isfinite(exact)), 6.0),
        absolute("pillars, 720 beams: mean difference, m", 0.0, np.abs(ranges[both] - exact[both]).mean(), 0.01),
    ]
    return rows


def _bearings(scan: Scan) -> Array:
    return np.asarray(scan.angle_min + scan.angle_step * np.arange(len(scan.ranges)))


def _room(pose: tuple[float, float, float], bearing: Array) -> Array:
    """Distances of the walls, m."""
    x, y, yaw = pose
    c, s = np.cos(bearing + yaw), np.sin(bearing + yaw)
    with np.errstate(divide="ignore"):
        return np.asarray(np.minimum((np.copysign(HALF_M[0], c) - x) / c, (np.copysign(HALF_M[1], s) - y) / s))


def _pillars(centres: Sequence[tuple[float, float]], radius: float, angle: Array) -> Array:
    """Distances of the nearest circles from the origin, m; inf: none is hit."""
    nearest = np.full(len(angle), np.inf)
    for x, y in centres:
        along, aside = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        depth = np.sqrt(np.maximum(radius**2 - aside**2, 0.0))
        meets = (np.abs(aside) < radius) & (along > 0.0)
        nearest = np.where(meets, np.minimum(nearest, along - depth), nearest)
    return nearest


def inertial() -> Sequence[Row]:
    """A unit without errors on a vehicle that drives a circle."""
    v, w = 0.3, 0.15
    sensor = {"kind": "imu", "rate_hz": 50.0, "accelerometer_density": 0.0, "gyroscope_density": 0.0}
    sensor |= {name: {"sigma": 0.0} for name in ("accelerometer", "gyroscope")}
    readings = _readings({"kind": "empty"}, (0.0, 0.0, 0.0), sensor, {"speed": v, "yaw_rate": w}, 10.0)
    force = np.mean([each.acceleration for each in readings[50:]], axis=0)
    turning = np.mean([each.angular_velocity for each in readings[50:]], axis=0)
    return [
        absolute("circle: specific force ahead, m/s2", 0.0, force[0], 1e-3),
        relative("circle: specific force inwards, v w, m/s2", v * w, force[1], 0.01),
        relative("circle: specific force upwards, g, m/s2", GRAVITY_M_S2, force[2], 1e-6),
        relative("circle: yaw rate, rad/s", w, turning[2], 1e-3),
    ]


def positions() -> Sequence[Row]:
    """Errors of fixes on a vehicle that stands: as large as stated, and independent from one to the next."""
    sensor = {"kind": "positioning", "rate_hz": 50.0, "sigma_m": 0.15, "sigma_rad": 0.05}
    readings = _readings({"kind": "empty"}, (2.0, -1.0, 0.3), sensor, STILL, 100.0)
    x = np.array([fix.position[0] for fix in readings]) - 2.0
    y = np.array([fix.position[1] for fix in readings]) + 1.0
    yaw = np.array([fix.yaw for fix in readings]) - 0.3
    rows = []
    for name, error, sigma in (("x, m", x, 0.15), ("y, m", y, 0.15), ("yaw, rad", yaw, 0.05)):
        rows += [
            relative(f"standard deviation of {name}", sigma, error.std(), 0.04),
            absolute(f"mean of {name}", 0.0, error.mean(), 4.0 * sigma / math.sqrt(len(error))),
            absolute(f"correlation from fix to fix of {name}", 0.0, np.corrcoef(error[1:], error[:-1])[0, 1], 0.06),
        ]
    return rows


def _readings(
    world: Mapping[str, Any],
    pose: tuple[float, float, float],
    sensor: Mapping[str, Any],
    drives: Mapping[str, Any] = STILL,
    duration_s: float = 0.3,
) -> list[Any]:
    """Readings of a sensor of one vehicle, in order."""
    scenario = {
        "name": "sensing",
        "duration_s": duration_s,
        "physics": {"kind": "kinematic"},
        "world": world,
        "record": {"sensors": ["it"]},
        "vehicles": {"kind": "kinematic", "sensors": {"it": {"rate_hz": 10.0, **sensor}}},
        "vehicle": [{"name": "car", "pose": pose, "agent": {"kind": "trajectory", **drives}}],
    }
    readings: list[Any] = []

    def observe(event: Event) -> None:
        if event.key == "car/it":
            readings.append(event.value.get() if isinstance(event.value, Later) else event.value)

    run(scenario, mcap=False, observe=observe)
    return readings
