"""Vehicles in the air through the whole platform: the figures of the potential field, and the scenarios with a pillar."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.paths import SCENARIOS
from vcmvsp.cosim.metrics.motion import motion
from vcmvsp.cosim.reproduction.figures.avoidance import potential_fields
from vcmvsp.cosim.reproduction.figures.figure import Figure, write
from vcmvsp.cosim.reproduction.runner import Runner
from vcmvsp.cosim.runs.api import run

BODY_M = 0.267  # of a quadrotor: from its centre to the tips of its propellers


def check(name: str, figure: Figure, panels: int, folder: Path) -> None:
    assert [row for row in figure.rows if not row.ok] == []
    assert len({row.case for row in figure.rows}) == len(figure.rows)
    assert len(figure.panels) == panels
    assert all(path.stat().st_size > 100 for path in write(name, figure, folder))


def test_the_stall(tmp_path: Path) -> None:
    check("stall", potential_fields.stall(Runner(1)), 2, tmp_path)


def test_quadrotors_pass_the_pillar_and_get_there() -> None:
    result = run(SCENARIOS / "pillar-triangle.toml", seed=7, mcap=False)
    x, y, z = motion(result.states).position
    assert result.metrics["safety"]["collisions"] == 0
    assert np.hypot(np.maximum(abs(x) - 0.25, 0.0), np.maximum(abs(y) - 0.25, 0.0)).min() > BODY_M + 0.1
    assert (x[-1, 0], y[-1, 0]) == pytest.approx((10.0, 0.3), abs=0.1)
    assert abs(z - 1.0).max() < 0.1
    assert result.metrics["formation"]["final_m"] < 0.1


def test_other_noise_is_another_flight() -> None:
    short: dict[str, Any] = {"duration_s": 8.0}
    flown = [motion(run(SCENARIOS / "pillar-single.toml", seed=seed, set=short, mcap=False).states) for seed in (1, 2)]
    assert abs(flown[0].position - flown[1].position).max() > 1e-3


def test_a_point_in_the_air_keeps_above_a_robot_on_a_circle() -> None:
    """The robot's reports know nothing of the air; on a circle dr makes no error, and the place goes round with the heading."""
    scenario = {
        "name": "above",
        "duration_s": 30.0,
        "physics": {"kind": "kinematic"},
        "radio": {"preset": "ideal"},
        "vehicle": [
            {"name": "car", "kind": "kinematic", "agent": {"kind": "trajectory", "path": "circle", "yaw_rate": 0.15}},
            {
                "name": "uav",
                "kind": "point",
                "position": [0.0, 0.0, 1.0],
                "agent": {"kind": "aerial_follower", "leader": "car", "slot": [-0.5, 0.5, 2.0]},
            },
        ],
    }
    result = run(scenario, mcap=False)
    # Held for a period, the velocity of a place that turns is off by w^2 r T / 2, which the gain of 0.8 1/s makes an error of.
    radius = np.hypot(0.5, 2.0 - 0.5)
    assert result.metrics["formation"]["final_m"] < 1.2 * 0.15**2 * radius * 0.1 / 2.0 / 0.8
    assert motion(result.states).position[2][-1, 1] == pytest.approx(2.0, abs=1e-6)
