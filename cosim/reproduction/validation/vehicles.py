"""Bodies: what wheels and rotors make of commands and wind."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vcmvsp.cosim.metrics.motion import motion
from vcmvsp.cosim.reproduction.figures.scenarios import V, W, fleet
from vcmvsp.cosim.reproduction.row import Row, absolute, at_most, relative
from vcmvsp.cosim.runs.api import run
from vcmvsp.cosim.runs.step_response import drive

WEIGHT_N, DRAG = 0.8 * 9.81, 0.25  # of the quadrotor; N s/m
HEIGHT_M = 10.0


def wheels() -> Sequence[Row]:
    """p2dx and amigobot bodies in PyBullet on a circle and on a line, against what was commanded."""
    rows = []
    for kind in ("p2dx", "amigobot"):
        scenario = fleet(20.0, [], kind=kind, physics={"kind": "bullet"})
        beside = {"name": "car2", "pose": (0.0, -3.0, 0.0), "agent": {"kind": "trajectory", "path": "straight"}}
        scenario["vehicle"].append(beside)
        movement = motion(run(scenario, mcap=False).states)
        steady = movement.time_ns >= 5 * 10**9
        x, y, _ = movement.position
        span_s = (movement.time_ns[-1] - movement.time_ns[steady][0]) / 1e9
        way = np.hypot(np.diff(x[steady], axis=0), np.diff(y[steady], axis=0)).sum(axis=0) / span_s
        turned = np.ptp(np.unwrap(movement.yaw[steady], axis=0), axis=0) / span_s
        rows += [
            relative(f"{kind}, circle: speed, m/s", V, way[0], 0.01),
            relative(f"{kind}, circle: yaw rate, rad/s", W, turned[0], 0.01),
            relative(f"{kind}, line: speed, m/s", V, way[1], 0.01),
            at_most(f"{kind}, line: yaw rate, rad/s", 0.01 * W, turned[1]),
        ]
    return rows


def quadrotor() -> Sequence[Row]:
    """Steady flight: balance of weight, drag and wind by the tilt; commanded speeds; limits; two rates of steps."""
    rows = []
    for hz in (120.0, 240.0):
        at = f"{hz:g} Hz"
        still = _fly("v=0,w=0", 6.0, hz)
        rows.append(absolute(f"{at}, hovering: off its place, m", 0.0, _off(still, (0.0, 0.0, HEIGHT_M)), 1e-6))
        for speed in (2.0, 4.0):
            flight = _fly(f"v={speed:g},w=0", 16.0, hz)
            tilt = math.tan(flight["tilt"][-1])
            rows += [
                relative(f"{at}, {speed:g} m/s: speed, m/s", speed, flight["v"][-1], 0.002),
                relative(f"{at}, {speed:g} m/s: tan of the tilt, c v / (m g)", DRAG * speed / WEIGHT_N, tilt, 1e-3),
            ]
        wind = _fly("v=0,w=0", 16.0, hz, {"world.wind": {"velocity": [0.0, 6.0, 0.0]}})
        tilt = math.tan(wind["tilt"][-1])
        rows += [
            absolute(f"{at}, wind of 6 m/s: speed, m/s", 0.0, abs(wind["vy"][-1]), 0.01),
            relative(f"{at}, wind of 6 m/s: tan of the tilt, c u / (m g)", DRAG * 6.0 / WEIGHT_N, tilt, 1e-3),
        ]
        turn = _fly("v=0,w=1", 8.0, hz)
        rate = np.polyfit(turn["time_s"][80:], turn["yaw"][80:], 1)[0]
        rows.append(relative(f"{at}, yaw rate of 1 rad/s: rate, rad/s", 1.0, rate, 0.01))
    limits = {"vehicle.uav.max_speed": 4.0, "vehicle.uav.max_climb": 1.0}
    fast = _fly("vx=30,vy=40,vz=9", 12.0, 120.0, limits)
    for axis, expected in (("vx", 2.4), ("vy", 3.2), ("vz", 1.0)):
        rows.append(absolute(f"beyond its limits of 4 and 1 m/s: {axis}, m/s", expected, fast[axis][-1], 0.01))
    ends = [_fly("vx=2,vy=1,vz=0.5,w=0.5", 4.0, hz) for hz in (120.0, 240.0)]
    apart = math.dist(*([each[axis][-1] for axis in "xyz"] for each in ends))
    rows.append(at_most("4 s at 120 and at 240 Hz: apart, m", 0.02, apart))
    return rows


def _fly(command: str, seconds: float, hz: float, settings: dict[str, Any] | None = None) -> dict[str, Any]:
    """Columns over time of one quadrotor that starts at rest, 10 m above the ground."""
    scenario = {
        "name": "flight",
        "duration_s": seconds,
        "physics": {"kind": "bullet", "rate_hz": hz},
        "vehicle": [{"name": "uav", "kind": "quadrotor", "position": (0.0, 0.0, HEIGHT_M)}],
    }
    series: dict[str, Any] = drive(scenario, "uav", command, seconds, settings)["series"]
    return series


def _off(series: Mapping[str, Sequence[float]], place: tuple[float, float, float]) -> float:
    return max(math.dist(each, place) for each in zip(series["x"], series["y"], series["z"], strict=True))
