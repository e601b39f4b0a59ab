"""Recognition in pictures of the simulated camera: targets in a town, from a quadrotor that tilts, and while hovering over a
target.
"""

import math
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest

import vcmvsp
from tests.support.paths import SCENARIOS
from vcmvsp import Agent, Observation, Radio, Velocity
from vcmvsp.agents.reconnaissance.watch import Watch, Watching
from vcmvsp.cosim.metrics.motion import motion

pytestmark = pytest.mark.slow

TARGETS = SCENARIOS / "targets"
SIZE_M = 2.0
PLACES = {"alpha": ((0.0, 23.0), 0.4), "bravo": ((-23.0, 0.0), -2.0)}  # x, y, m, at crossroads; yaw, rad


def town(folder: Path) -> dict[str, Any]:
    """Low buildings with coloured roofs, two targets, and beside each its mirror image, which is no target."""
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


class BackAndForth(Agent):
    """Moves back and forth over the first target."""

    def __init__(self, watching: Watching) -> None:
        self.watch = Watch(watching)
        self.sensors = self.watch.sensors
        self.records: list[tuple[float, tuple[float, float]]] = []  # tilt, rad, and place, m

    def start(self, info: vcmvsp.VehicleInfo) -> None:
        self.watch.start(info)

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        shown = self.watch.look(obs)
        if shown is not None:
            tilt = math.acos(min(1.0, shown.nadir.upright))
            self.records += [(tilt, each.place) for each in shown.sightings if each.target == "alpha"]
        right = obs.time_s % 3.0 < 1.5
        return Velocity(linear=(2.5 if right else -2.5, 0.0, 0.0), yaw_rate=0.8)


def test_an_accelerating_quadrotor_sees_its_target_in_place(tmp_path: Path) -> None:
    """Motion at 3 m/s2 and more, tilted by up to 25 deg; detections within a decimetre of the target."""
    agent = BackAndForth(msgspec.convert(watching(), Watching))
    camera = {"kind": "nadir_camera", "width": 640, "height": 480, "rate_hz": 8.0, "field_of_view": 1.35, "latency_s": 0.15}
    uav = {"name": "uav", "kind": "quadrotor", "position": [0.0, 23.0, 20.0], "sensors": {"camera": camera}}
    vcmvsp.run(
        {"name": "darting", "duration_s": 9.0, "seed": 3, "world": town(tmp_path), "vehicle": [uav]}, agents={"uav": agent}
    )
    assert max(tilt for tilt, _ in agent.records) > math.atan(3.0 / 9.81)
    assert len(agent.records) > 45
    assert max(math.dist(place, PLACES["alpha"][0]) for _, place in agent.records) < 0.1


def test_a_quadrotor_finds_a_moving_target_and_stays_over_it(tmp_path: Path) -> None:
    """The agent ``track``, the simulated camera and the autopilot: within centimetres of a target that moves at 0.5 m/s."""
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
