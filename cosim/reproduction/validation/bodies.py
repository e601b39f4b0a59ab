"""Checks of bodies and sensors: response of wheels and rotors to commands and wind, readings of scanners and other sensors."""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from importlib.util import find_spec
from typing import Any

import numpy as np

from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.metrics.motion import motion
from vcmvsp.cosim.reproduction.figures.scenarios import V, W, fleet, scene
from vcmvsp.cosim.reproduction.row import Row, absolute, at_most, relative
from vcmvsp.cosim.runs.api import run
from vcmvsp.cosim.runs.step_response import drive
from vcmvsp.cosim.types import Array, Later, Scan

WEIGHT_N, DRAG = 0.8 * 9.81, 0.25  # of the quadrotor; N s/m
HEIGHT_M = 10.0
HALF_M = (4.0, 3.0)  # a room of 8 x 6 m with its centre at the origin
POSES = ((0.0, 0.0, 0.0), (1.5, -2.0, -2.2), (-3.0, 1.0, 3.1))  # x m, y m, yaw rad
GRAVITY_M_S2 = 9.81
SCANNER: Mapping[str, Any] = {"kind": "range_scanner", "position": (0.0, 0.0, 0.5)}
STILL: Mapping[str, Any] = {"speed": 0.0, "yaw_rate": 0.0}


def wheels() -> Iterator[Row]:
    """p2dx and amigobot bodies in PyBullet, and in MuJoCo if installed, on a circle and on a line, against their commands."""
    engines = ["bullet"] if find_spec("mujoco") is None else ["bullet", "mujoco"]
    for engine, kind in itertools.product(engines, ("p2dx", "amigobot")):
        scenario = fleet(20.0, [], kind=kind, physics={"kind": engine})
        beside = {"name": "car2", "pose": (0.0, -3.0, 0.0), "agent": {"kind": "trajectory", "path": "straight"}}
        scenario["vehicle"].append(beside)
        movement = motion(run(scenario, mcap=False).states)
        steady = movement.time_ns >= 5 * 10**9
        x, y, _ = movement.position
        span_s = (movement.time_ns[-1] - movement.time_ns[steady][0]) / 1e9
        way = np.hypot(np.diff(x[steady], axis=0), np.diff(y[steady], axis=0)).sum(axis=0) / span_s
        turned = np.ptp(np.unwrap(movement.yaw[steady], axis=0), axis=0) / span_s
        yield relative(f"{engine}, {kind}, circle: speed, m/s", V, way[0], 0.01)
        yield relative(f"{engine}, {kind}, circle: yaw rate, rad/s", W, turned[0], 0.01)
        yield relative(f"{engine}, {kind}, line: speed, m/s", V, way[1], 0.01)
        yield at_most(f"{engine}, {kind}, line: yaw rate, rad/s", 0.01 * W, turned[1])


def quadrotor() -> Iterator[Row]:
    """Steady flight: balance of weight, drag and wind by tilt; commanded speeds; limits; two step rates."""
    for hz in (120.0, 240.0):
        at = f"{hz:g} Hz"
        still = _fly("v=0,w=0", 6.0, hz)
        places = zip(still["x"], still["y"], still["z"], strict=True)
        off_m = max(math.dist(each, (0.0, 0.0, HEIGHT_M)) for each in places)
        yield absolute(f"{at}, hovering: off its place, m", 0.0, off_m, 1e-6)
        for speed in (2.0, 4.0):
            flight = _fly(f"v={speed:g},w=0", 16.0, hz)
            tilt = math.tan(flight["tilt"][-1])
            yield relative(f"{at}, {speed:g} m/s: speed, m/s", speed, flight["v"][-1], 0.002)
            yield relative(f"{at}, {speed:g} m/s: tan of the tilt, c v / (m g)", DRAG * speed / WEIGHT_N, tilt, 1e-3)
        wind = _fly("v=0,w=0", 16.0, hz, {"world.wind": {"velocity": [0.0, 6.0, 0.0]}})
        tilt = math.tan(wind["tilt"][-1])
        yield absolute(f"{at}, wind of 6 m/s: speed, m/s", 0.0, abs(wind["vy"][-1]), 0.01)
        yield relative(f"{at}, wind of 6 m/s: tan of the tilt, c u / (m g)", DRAG * 6.0 / WEIGHT_N, tilt, 1e-3)
        turn = _fly("v=0,w=1", 8.0, hz)
        rate = np.polyfit(turn["time_s"][80:], turn["yaw"][80:], 1)[0]
        yield relative(f"{at}, yaw rate of 1 rad/s: rate, rad/s", 1.0, rate, 0.01)
    limits = {"vehicle.uav.max_speed": 4.0, "vehicle.uav.max_climb": 1.0}
    fast = _fly("vx=30,vy=40,vz=9", 12.0, 120.0, limits)
    for axis, expected in (("vx", 2.4), ("vy", 3.2), ("vz", 1.0)):
        yield absolute(f"beyond its limits of 4 and 1 m/s: {axis}, m/s", expected, fast[axis][-1], 0.01)
    flights = [_fly("vx=2,vy=1,vz=0.5,w=0.5", 4.0, hz) for hz in (120.0, 240.0)]
    ends = [(each["x"][-1], each["y"][-1], each["z"][-1]) for each in flights]
    yield at_most("4 s at 120 and at 240 Hz: apart, m", 0.02, math.dist(*ends))


def _fly(command: str, seconds: float, hz: float, settings: dict[str, Any] | None = None) -> dict[str, Any]:
    """Columns over time of one quadrotor that starts at rest, 10 m above the ground."""
    scenario = {
        "name": "flight",
        "duration_s": seconds,
        "physics": {"kind": "bullet", "rate_hz": hz},
        "vehicle": [{"name": "uav", "kind": "quadrotor", "position": (0.0, 0.0, HEIGHT_M)}],
    }
    return drive(scenario, "uav", command, seconds, settings)["series"]


def scanner() -> Iterator[Row]:
    """Beams of three scanners in a room and among round pillars, against exact intersections with lines and circles."""
    wide, long = HALF_M[0] + 0.5, HALF_M[1] + 0.5
    room = [{"center": (side * wide, 0.0, 1.0), "size": (1.0, 9.0, 2.0)} for side in (-1, 1)]
    room += [{"center": (0.0, side * long, 1.0), "size": (9.0, 1.0, 2.0)} for side in (-1, 1)]
    for beams, view in ((32, 2.0 * math.pi), (181, math.pi), (512, 4.0)):
        sensor = {**SCANNER, "beams": beams, "field_of_view": view, "range_max": 20.0}
        for pose in POSES:
            scan = _readings({"kind": "boxes", "boxes": room}, pose, sensor)[-1]
            off = np.abs(np.asarray(scan.ranges, float) / _room(pose, _bearings(scan)) - 1.0).max()
            case = f"room, {beams} beams over {view:.3g} rad, from {pose}: largest share off"
            yield absolute(case, 0.0, off, 1e-6)
    centres = ((3.0, 0.0), (0.0, -2.0), (-4.0, 3.0))
    pillars = [{"center": (x, y, 1.0), "radius": 0.5, "height": 2.0} for x, y in centres]
    sensor = {**SCANNER, "beams": 720, "field_of_view": 2.0 * math.pi, "range_max": 9.0}
    scan = _readings({"kind": "empty", "cylinders": pillars}, (0.0, 0.0, 0.4), sensor)[-1]
    ranges, exact = np.asarray(scan.ranges, float), _pillars(centres, 0.5, 0.4 + _bearings(scan))
    both = np.isfinite(ranges) & np.isfinite(exact)
    yield absolute("pillars, 720 beams: seen or not by mistake", 0.0, np.sum(np.isfinite(ranges) != np.isfinite(exact)), 6.0)
    yield absolute("pillars, 720 beams: mean difference, m", 0.0, np.abs(ranges[both] - exact[both]).mean(), 0.01)


def _bearings(scan: Scan) -> Array:
    return np.asarray(scan.angle_min + scan.angle_step * np.arange(len(scan.ranges)))


def _room(pose: tuple[float, float, float], bearing: Array) -> Array:
    """Distances to the walls, m."""
    x, y, yaw = pose
    c, s = np.cos(bearing + yaw), np.sin(bearing + yaw)
    with np.errstate(divide="ignore"):
        return np.asarray(np.minimum((np.copysign(HALF_M[0], c) - x) / c, (np.copysign(HALF_M[1], s) - y) / s))


def _pillars(centres: Sequence[tuple[float, float]], radius: float, angle: Array) -> Array:
    """Distances from the origin to the nearest circle, m; inf: no hit."""
    nearest = np.full(len(angle), np.inf)
    for x, y in centres:
        along, aside = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        depth = np.sqrt(np.maximum(radius**2 - aside**2, 0.0))
        meets = (np.abs(aside) < radius) & (along > 0.0)
        nearest = np.where(meets, np.minimum(nearest, along - depth), nearest)
    return nearest


def inertial() -> Iterator[Row]:
    """An error-free inertial unit on a vehicle that drives a circle."""
    v, w = 0.3, 0.15
    sensor = {"kind": "imu", "rate_hz": 50.0, "accelerometer_density": 0.0, "gyroscope_density": 0.0}
    sensor |= {name: {"sigma": 0.0} for name in ("accelerometer", "gyroscope")}
    readings = _readings({"kind": "empty"}, (0.0, 0.0, 0.0), sensor, {"speed": v, "yaw_rate": w}, 10.0)
    force = np.mean([each.acceleration for each in readings[50:]], axis=0)
    turning = np.mean([each.angular_velocity for each in readings[50:]], axis=0)
    yield absolute("circle: specific force ahead, m/s2", 0.0, force[0], 1e-3)
    yield relative("circle: specific force inwards, v w, m/s2", v * w, force[1], 0.01)
    yield relative("circle: specific force upwards, g, m/s2", GRAVITY_M_S2, force[2], 1e-6)
    yield relative("circle: yaw rate, rad/s", w, turning[2], 1e-3)


def positions() -> Iterator[Row]:
    """Errors of fixes on a stationary vehicle: of the stated size, and independent of each other."""
    sensor = {"kind": "positioning", "rate_hz": 50.0, "sigma_m": 0.15, "sigma_rad": 0.05}
    readings = _readings({"kind": "empty"}, (2.0, -1.0, 0.3), sensor, STILL, 100.0)
    x = np.array([fix.position[0] for fix in readings]) - 2.0
    y = np.array([fix.position[1] for fix in readings]) + 1.0
    yaw = np.array([fix.yaw for fix in readings]) - 0.3
    for name, error, sigma in (("x, m", x, 0.15), ("y, m", y, 0.15), ("yaw, rad", yaw, 0.05)):
        yield relative(f"standard deviation of {name}", sigma, error.std(), 0.04)
        yield absolute(f"mean of {name}", 0.0, error.mean(), 4.0 * sigma / math.sqrt(len(error)))
        yield absolute(f"correlation from fix to fix of {name}", 0.0, np.corrcoef(error[1:], error[:-1])[0, 1], 0.06)


def _readings(
    world: Mapping[str, Any],
    pose: tuple[float, float, float],
    sensor: Mapping[str, Any],
    drives: Mapping[str, Any] = STILL,
    duration_s: float = 0.3,
) -> list[Any]:
    car = {"name": "car", "pose": pose, "agent": {"kind": "trajectory", **drives}}
    kind = {"kind": "kinematic", "sensors": {"it": {"rate_hz": 10.0, **sensor}}}
    scenario = scene("sensing", duration_s, [car], world=world, record={"sensors": ["it"]}, vehicles=kind)
    readings: list[Any] = []

    def observe(event: Event) -> None:
        if event.key == "car/it":
            readings.append(event.value.get() if isinstance(event.value, Later) else event.value)

    run(scenario, mcap=False, observe=observe)
    return readings
