"""The README's examples run unchanged."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

import vcmvsp
from tests.support.paths import ROOT
from vcmvsp import physics
from vcmvsp.cosim.assembly.worlds import world_of
from vcmvsp.cosim.config import builtin_kinds
from vcmvsp.cosim.runs import api
from vcmvsp.physics.world.solids import Cylinder

README = (Path(physics.__path__[0]) / "README.md").read_text(encoding="utf-8")
PAGES = [README, *(path.read_text("utf-8") for path in sorted((ROOT / "docs" / "howto").glob("own-*.md")))]
BLOCKS: list[tuple[str, str]] = re.findall(r"```(\w*)\n(.*?)```", "\n".join(PAGES), re.DOTALL)
HEAD = 'name = "example"\nduration_s = 0.5\n'


def block(language: str, words: str) -> str:
    (found,) = [text for kind, text in BLOCKS if kind == language and words in text]
    return found


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_scenario(folder: Path) -> None:
    (folder / "all.toml").write_text(HEAD + block("toml", '[world]\nkind = "laboratory"'))
    assert {*vcmvsp.run("all.toml").states.to_pandas().vehicle} == {"ugv", "uav"}


def test_the_custom_vehicle(folder: Path) -> None:
    robot = block("xml", "<robot")
    assert len(robot.splitlines()) + len(block("toml", "cart.urdf").splitlines()) <= 30
    (folder / "cart.urdf").write_text(robot)
    (folder / "cart.toml").write_text(HEAD + block("toml", "cart.urdf"))
    assert api.check("cart.toml")["vehicle"][0]["max_speed"] == 1.2


def test_the_custom_sensor(folder: Path) -> None:
    code = block("python", "class Sonar")
    assert len(code.splitlines()) <= 20
    (folder / "my_sensors.py").write_text(code)
    own = tomllib.loads(code.splitlines()[0].partition(": ")[2])["sensors"]
    places = {"a": 0.0, "b": 3.0, "c": 50.0}
    cars = [{"name": name, "kind": "kinematic", "position": [x, 0.0, 0.0]} for name, x in places.items()]
    scenario: dict[str, Any] = {"name": "s", "duration_s": 0.5, "vehicles": {"sensors": own}, "vehicle": cars}
    distances: dict[str, float] = {}

    class Look(vcmvsp.Agent):
        def __init__(self, name: str) -> None:
            self.name = name

        def act(self, obs: vcmvsp.Observation, radio: vcmvsp.Radio) -> None:
            distances[self.name] = obs.readings["sonar"].values["nearest_m"]  # type: ignore[union-attr]

    vcmvsp.run(scenario, agents={name: Look(name) for name in places})
    assert distances == pytest.approx({"a": 3.0, "b": 3.0, "c": 4.0}, abs=0.1)


def test_the_custom_world(folder: Path) -> None:
    (folder / "my_worlds.py").write_text(block("python", "class Orchard"))
    world, name = world_of("my_worlds.py:Orchard", {"rows": 4, "boxes": [{"center": [9, 9, 1], "size": [1, 1, 1]}]})
    assert name == "Orchard"
    assert sum(isinstance(each, Cylinder) for each in world.solids) == 40
    assert len(world.solids) == 41


def test_every_named_file_and_kind_exists() -> None:
    home = Path(physics.__path__[0])
    for path in re.findall(r"[\w/]+\.py\b|\b\w+/(?=[\s;,:])", block("", "federate.py ")):
        assert (home / path).exists(), path
    for group in ("vehicle", "sensor"):
        for kind in builtin_kinds.KINDS[group]:
            assert f"`{kind}`" in README, kind
    for target in re.findall(r"\]\(([^)#h][^)#]*)", README):
        assert (home / target).exists(), target
