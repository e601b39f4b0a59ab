"""MuJoCo: meshes, missing library, and equal bytes from agents in processes."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vcmvsp
from tests.support.physics.engines import engine
from vcmvsp.cosim.assembly.run import default_engine
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.physics.federate import MujocoPhysics
from vcmvsp.physics.vehicles.models import P2DX
from vcmvsp.physics.world.solids import Mesh, Prism
from vcmvsp.physics.world.world import World

SQUARE = np.array([[(2.0, -1.0, 0.0), (2.0, 1.0, 1.0), (2.0, 1.0, 0.0)], [(2.0, -1.0, 0.0), (2.0, -1.0, 1.0), (2.0, 1.0, 1.0)]])
NOTCHED = Prism(outline=((2.0, -1.0), (3.0, -1.0), (3.0, 1.0), (2.0, 1.0), (2.5, 0.0)), bottom=0.0, height=1.0)


@pytest.mark.parametrize(
    ("solid", "stops_m"), [(Mesh(triangles=SQUARE), 2.0), (NOTCHED, 2.0 + 0.5 * (1.0 - 0.5 * P2DX().width_m))]
)
def test_a_robot_stops_at_a_mesh_and_in_the_notch_of_a_prism(solid: Any, stops_m: float) -> None:
    """The notch narrows from 2 m to 0; the front corners meet its sides where it is as wide as the robot."""
    robot = P2DX()
    moved = engine((robot, (0.0, 0.0, 0.0)), world=World(solids=(solid,)), kind=MujocoPhysics)
    moved.command(0, (0.4, 0.0, 0.0), 0.0)
    moved.advance(9 * SECOND_NS)
    front_m = moved.read().position[0, 0] + 0.5 * robot.length_m - robot.axle_ahead_m
    assert front_m == pytest.approx(stops_m, abs=0.01)
    assert {touch.other for touch in moved.touching(passing=False)} == {None}


def test_too_many_triangles_are_refused_with_the_other_engine_named() -> None:
    corners = np.random.default_rng(1).uniform(size=(6000, 3, 3))
    with pytest.raises(ScenarioError, match=r'5000 .*kind = "bullet"') as caught:
        engine(world=World(solids=(Mesh(triangles=corners),)), kind=MujocoPhysics)
    assert caught.value.key == "physics.kind"


def test_a_missing_mujoco_error_names_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [each for each in sys.modules if each.startswith("vcmvsp.physics.dynamics.mujoco")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ScenarioError, match=r"vcmvsp\[mujoco\]"):
        vcmvsp.run("formation-circle", set={"physics.kind": "mujoco"}, agents="inprocess", mcap=False)


@pytest.mark.parametrize(
    ("missing", "default"),
    [((), "bullet"), (("pybullet",), "mujoco"), (("pybullet", "mujoco"), "bullet"), (("mujoco",), "bullet")],
)
def test_mujoco_is_the_default_where_only_it_is_installed(
    missing: tuple[str, ...], default: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vcmvsp.cosim.assembly.run.find_spec", lambda name: None if name in missing else name)
    assert default_engine() == default


def test_a_run_reports_mujoco_by_default(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vcmvsp.cosim.assembly.run.find_spec", lambda name: None if name == "pybullet" else name)
    lines: list[str] = []
    raw = {"name": "alone", "duration_s": 0.2, "vehicle": [{"name": "car", "kind": "p2dx", "agent": {"kind": "trajectory"}}]}
    vcmvsp.run(raw, agents="inprocess", mcap=False, tell=lines.append)
    assert lines == ['PyBullet is not installed: physics.kind is "mujoco"']


@pytest.mark.processes
def test_agents_in_processes_give_equal_bytes(tmp_path: Path) -> None:
    for runs in ("inprocess", "process"):
        keys = {"physics.kind": "mujoco", "duration_s": 3.0, "agents.deadline_s": 500.0}
        vcmvsp.run("lab-formation", set=keys, agents=runs, out=tmp_path / runs)
    for name in ("metrics.json", "states.parquet", "radio.parquet", "run.mcap"):
        assert (tmp_path / "inprocess" / name).read_bytes() == (tmp_path / "process" / name).read_bytes()
