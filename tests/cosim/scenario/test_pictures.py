"""Pictures of a scenario: found beside it or among the shipped ones, and kept with the run."""

import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest

import vcmvsp
from vcmvsp.cosim.config import registry
from vcmvsp.cosim.errors import ScenarioError

LOOKER = """
from pathlib import Path
import msgspec
from vcmvsp import Agent

class Target(msgspec.Struct):
    name: str
    picture: Path
    size_m: float = 1.0

class Watching(msgspec.Struct):
    targets: list[Target]

class Looker(Agent):
    period = 0.5

    def __init__(self, *, watching: Watching) -> None:
        for each in watching.targets:
            self.note(size=float(each.picture.stat().st_size), picture=each.name)

    def act(self, obs, radio):
        return None
"""
SCENARIO = """
name = "pictures"
duration_s = 1.0
[physics]
kind = "kinematic"
[world]
targets = [
    { name = "own", picture = "pics/own.png", place = [0, 0] },
    { name = "other", picture = "more/own.png", place = [5, 0] },
    { name = "alpha", picture = "targets/alpha.png", place = [9, 0] },
]
[agents]
watching = { targets = [{ name = "own", picture = "pics/own.png" }, { name = "alpha", picture = "targets/alpha.png" }] }
kind = "mine.py:Looker"
[vehicles]
kind = "point"
[[vehicle]]
name = "uav1"
position = [0, 0, 20]
agent = { watching = { targets = [{ name = "other", picture = "more/own.png" }] } }
[[vehicle]]
name = "uav2"
position = [5, 0, 20]
sensors = { camera = { kind = "nadir_camera", rate_hz = 1.0 } }
agent = {}
[record]
sensors = ["camera"]
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Folder of a scenario with its files."""
    for name, level in (("pics", 80), ("more", 200)):
        (tmp_path / name).mkdir()
        cv2.imwrite(str(tmp_path / name / "own.png"), np.full((16, 16, 3), level, np.uint8))
    (tmp_path / "mine.py").write_text(LOOKER)
    (tmp_path / "s.toml").write_text(SCENARIO)
    return tmp_path


def test_a_run_keeps_the_pictures_of_its_world_and_of_its_agents(folder: Path) -> None:
    first = folder / "first"
    vcmvsp.run(folder / "s.toml", out=first)
    resolved = tomllib.loads((first / "scenario.toml").read_text())
    named = [each["picture"] for each in resolved["world"]["targets"]]
    assert named == ["own.png", "own-2.png", "alpha.png"]
    assert [(first / each).read_bytes() for each in named] == [
        path.read_bytes()
        for path in (folder / "pics/own.png", folder / "more/own.png", registry.SHIPPED / "targets" / "alpha.png")
    ]
    listed = [resolved["agents"]["watching"], resolved["vehicle"][0]["agent"]["watching"]]
    assert [[each["picture"] for each in one["targets"]] for one in listed] == [["own.png", "alpha.png"], ["own-2.png"]]
    assert "watching" not in resolved["vehicle"][1].get("agent", {})  # default of all agents
    moved = folder / "elsewhere"
    first.rename(moved)  # the folder is self-contained
    for name in ("pics", "more"):
        (folder / name).rename(folder / f"{name}-gone")
    vcmvsp.run(moved / "scenario.toml", out=folder / "again")
    for name in ("run.mcap", "metrics.json", "scenario.toml"):
        assert (folder / "again" / name).read_bytes() == (moved / name).read_bytes(), name


def test_a_picture_beside_the_scenario_wins_over_a_shipped_one(folder: Path) -> None:
    assert registry.located("targets/alpha.png", folder) == registry.SHIPPED / "targets" / "alpha.png"
    (folder / "targets").mkdir()
    (folder / "targets" / "alpha.png").touch()
    assert registry.located("targets/alpha.png", folder) == folder / "targets" / "alpha.png"
    with registry.looking_in(folder):
        assert registry.located("targets/alpha.png") == folder / "targets" / "alpha.png"


def test_a_missing_picture_is_reported_beside_the_scenario(folder: Path) -> None:
    (folder / "pics" / "own.png").unlink()
    with pytest.raises(ScenarioError, match=f"there is no picture file {folder}/pics/own.png"):
        vcmvsp.run(folder / "s.toml")
