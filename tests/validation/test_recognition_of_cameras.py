"""Recognition in pictures of the simulated camera: targets in a town, from all heights, and from a vehicle that tilts."""

import math
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

import vcmvsp
from tests.support.paths import SCENARIOS
from vcmvsp import Agent, Observation, Radio, Velocity
from vcmvsp.agents.reconnaissance.watch import Watch, Watching
from vcmvsp.cosim.frames import wrap
from vcmvsp.cosim.metrics.motion import motion
from vcmvsp.cosim.types import Sighting, Vec3

TARGETS = SCENARIOS / "targets"
SIZE_M = 2.0
PLACES = {"alpha": ((0.0, 23.0), 0.4), "bravo": ((-23.0, 0.0), -2.0)}  # x, y, m, on crossroads of the town; turned by, rad
HEIGHTS = (10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0)
EACH = 10  # pictures at each height


def town(folder: Path) -> dict[str, Any]:
    """Low buildings with coloured roofs, two targets, and beside each its mirror image, which is none."""
    targets = []
    for name, ((x, y), yaw) in PLACES.items():
        picture = TARGETS / f"{name}.png"
        mirrored = folder / f"mirrored-{name}.png"
        read = cv2.imread(str(picture), cv2.IMREAD_COLOR_BGR)
        assert read is not None
        cv2.imwrite(str(mirrored), cv2.flip(read, 1))
        targets.append({"name": name, "picture": str(picture), "size": SIZE_M, "place": [x, y], "yaw_rad": yaw})
        targets.append({"name": f"no-{name}", "picture": str(mirrored), "size": SIZE_M, "place": [x + 2.0, y + 3.5]})
    return {"kind": "urban", "size": [102.0, 102.0], "height_min": 4.0, "height_max": 6.0, "targets": targets, "seed": 1}


def watching() -> dict[str, Any]:
    return {"targets": [{"name": name, "picture": str(TARGETS / f"{name}.png"), "size_m": SIZE_M} for name in PLACES]}


class Photographer(Agent):
    """Takes one picture a second, each from elsewhere, and keeps what is recognised."""

    period = 1.0

    def __init__(self, watching: Watching) -> None:
        self.watch = Watch(watching)
        self.sensors = self.watch.sensors
        self.taken: list[tuple[str, Vec3, float, tuple[Sighting, ...]]] = []  # over which target, from where, yaw

    def start(self, info: vcmvsp.VehicleInfo) -> None:
        self.watch.start(info)
        self._rng = info.stream("places")
        self._over = ""

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        shown = self.watch.look(obs)
        if shown is not None and self._over:
            self.taken.append((self._over, obs.state.position, obs.state.yaw, shown.sightings))
        number = len(self.taken)
        height, self._over = HEIGHTS[number % len(HEIGHTS)], list(PLACES)[number % 2]
        away, about = 0.35 * height * math.sqrt(self._rng.uniform()), self._rng.uniform(-math.pi, math.pi)
        x, y = PLACES[self._over][0]
        to = x + away * math.cos(about), y + away * math.sin(about), height + 0.05  # where the camera is below the vehicle
        linear = tuple(b - a for a, b in zip(obs.state.position, to, strict=True))
        return Velocity(linear=linear, yaw_rate=float(self._rng.uniform(-3.0, 3.0)))  # type: ignore[arg-type]


class Darting(Agent):
    """Back and forth over the first target."""

    def __init__(self, watching: Watching) -> None:
        self.watch = Watch(watching)
        self.sensors = self.watch.sensors
        self.seen: list[tuple[float, tuple[float, float]]] = []  # tilt, rad, and place, m

    def start(self, info: vcmvsp.VehicleInfo) -> None:
        self.watch.start(info)

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        shown = self.watch.look(obs)
        if shown is not None:
            tilt = math.acos(min(1.0, shown.nadir.upright))
            self.seen += [(tilt, each.place) for each in shown.sightings if each.target == "alpha"]
        right = obs.time_s % 3.0 < 1.5
        return Velocity(linear=(2.5 if right else -2.5, 0.0, 0.0), yaw_rate=0.8)


def test_targets_are_recognised_from_10_to_40_m_and_nothing_else(tmp_path: Path) -> None:
    """Precision at least 0.95; at every height recall at least 0.90, median errors at most 1 deg and 0.05 sides."""
    agent = Photographer(msgspec.convert(watching(), Watching))
    camera = {"kind": "nadir_camera", "width": 640, "height": 480, "rate_hz": 1.0, "field_of_view": 1.35, "noise": 6.0}
    jumps = {"tau_s": 0.0, "max_speed": 1000.0, "max_climb": 1000.0, "max_yaw_rate": 10.0}
    scenario = {
        "name": "photographs",
        "duration_s": float(EACH * len(HEIGHTS) + 1),
        "seed": 3,
        "world": town(tmp_path),
        "vehicle": [{"name": "uav", "kind": "point", "position": [0.0, 0.0, 20.0], "sensors": {"camera": camera}, **jumps}],
    }
    vcmvsp.run(scenario, agents={"uav": agent})
    assert len(agent.taken) == EACH * len(HEIGHTS)
    right, false = 0, 0
    for height in HEIGHTS:
        there = [each for each in agent.taken if abs(each[1][2] - height) < 1.0]
        found, places, angles = 0, [], []
        for over, _, yaw, sightings in there:
            place, turned = PLACES[over]
            hits = [each for each in sightings if each.target == over and math.dist(each.place, place) < 0.25 * SIZE_M]
            found += bool(hits)
            false += sum(math.dist(each.place, PLACES[each.target][0]) >= 0.25 * SIZE_M for each in sightings)
            places += [math.dist(each.place, place) / SIZE_M for each in hits]
            # its upper edge is north before it is turned, the picture's upper edge is where the vehicle heads
            angles += [abs(wrap(each.angle - (0.5 * math.pi + turned - yaw))) for each in hits]
        assert len(there) == EACH
        assert found >= 0.9 * EACH, height
        assert np.median(places) <= 0.05
        assert math.degrees(np.median(angles)) <= 1.0
        right += found
    assert right / (right + false) >= 0.95


def test_a_quadrotor_that_accelerates_does_not_see_its_target_wander(tmp_path: Path) -> None:
    """It darts about at 3 m/s2 and more, tilted by up to 25 deg, and places what it sees within a decimetre."""
    agent = Darting(msgspec.convert(watching(), Watching))
    camera = {"kind": "nadir_camera", "width": 640, "height": 480, "rate_hz": 8.0, "field_of_view": 1.35, "latency_s": 0.15}
    uav = {"name": "uav", "kind": "quadrotor", "position": [0.0, 23.0, 20.0], "sensors": {"camera": camera}}
    vcmvsp.run(
        {"name": "darting", "duration_s": 9.0, "seed": 3, "world": town(tmp_path), "vehicle": [uav]}, agents={"uav": agent}
    )
    assert max(tilt for tilt, _ in agent.seen) > math.atan(3.0 / 9.81)
    assert len(agent.seen) > 45
    assert max(math.dist(place, PLACES["alpha"][0]) for _, place in agent.seen) < 0.1


def test_a_quadrotor_finds_a_target_that_moves_and_keeps_over_it(tmp_path: Path) -> None:
    """With the agent ``track`` alone, the simulated camera, the autopilot: centimetres behind a target at 0.5 m/s."""
    world = {
        "kind": "empty",
        "targets": [{"name": "alpha", "picture": str(TARGETS / "alpha.png"), "way": [[2, -1], [20, 5]], "speed": 0.5}],
    }
    camera = {"kind": "nadir_camera", "width": 640, "height": 480, "rate_hz": 5.0, "field_of_view": 1.35}
    agent = {"kind": "track", "watching": watching()}
    uav = {"name": "uav", "kind": "quadrotor", "position": [0.0, 0.0, 20.0], "sensors": {"camera": camera}, "agent": agent}
    result = vcmvsp.run({"name": "over", "duration_s": 20.0, "seed": 3, "world": world, "vehicle": [uav]}, mcap=False)
    moved = motion(result.states)
    x, y, z = (each[:, 0] for each in moved.position)
    time_s = moved.time_ns / 1e9
    way = 0.5 * time_s
    unit = np.array([18.0, 6.0]) / math.hypot(18.0, 6.0)
    offset = np.hypot(2.0 + unit[0] * way - x, -1.0 + unit[1] * way - y)
    assert offset[0] > 2.0
    assert offset[time_s > 12.0].max() < 0.02
    assert abs(z - 20.0).max() < 0.2
