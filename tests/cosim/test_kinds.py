"""What there is to build scenarios of: list, show, world, drive."""

import json
import math
from pathlib import Path
from typing import Any

import cv2
import pytest

from cosim import drive, registry
from cosim.errors import UsageError
from cosim.types import Velocity, Waypoint
from tests.cosim.command import vcmvsp

HALL = """
boxes = [{ center = [2.0, 0.0, 1.0], size = [0.2, 4.0, 2.0], material = "brick" }]
cylinders = [{ center = [-1.0, 1.0, 0.5], radius = 0.2, height = 1.0 }]
"""
PAIR = """
name = "pair"
duration_s = 1.0
[[vehicle]]
name = "car"
kind = "p2dx"
[[vehicle]]
name = "uav"
kind = "quadrotor"
position = [5.0, 0.0, 3.0]
heading = 1.0
"""


@pytest.mark.parametrize("group", ["worlds", "vehicles", "sensors", "agents"])
def test_every_kind_is_listed_and_each_of_its_parameters_is_shown_with_a_meaning(group: str) -> None:
    about = json.loads(vcmvsp("list", group, "--json").out)
    word = group.removesuffix("s")
    assert list(about) == list(registry.KINDS[word])
    for kind, summary in about.items():
        shown = vcmvsp("show", word, kind)
        assert shown.code == 0
        assert shown.out.startswith(f"{kind}: {summary}")
        parameters = json.loads(vcmvsp("show", word, kind, "--json").out)["parameters"]
        assert all(name in shown.out for name in parameters)
        if word != "agent":
            assert [name for name, each in parameters.items() if not each["meaning"]] == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("list", "cars"), "allowed: agents, scenarios, sensors, vehicles, worlds"),
        (("show", "vehicle"), "which one? (p2dx,"),
        (("show", "vehicle", "p2dy"), "did you mean 'p2dx'?"),
        (("show", "vehicle", "p2dx", "--resolved"), "go with a scenario"),
        (("world", "labratory"), "did you mean 'laboratory'?"),
        (("world", "pillar", "--set", "radios=1"), "world.radios: unknown key 'radios'; did you mean 'radius'?"),
        (("world", "pillar", "--png", "p.jpg"), "must end in .png"),
        (("world", "pillar", "--png", "nowhere/p.png"), "cannot be written"),
    ],
)
def test_what_cannot_be_shown_is_refused_by_name(tmp_path: Path, arguments: tuple[str, ...], words: str) -> None:
    outcome = vcmvsp(*arguments)
    assert (outcome.code, outcome.out) == (2, "")
    assert words in outcome.err
    assert outcome.err.count("\n") == 1


def test_a_world_is_counted_and_drawn_from_a_kind_a_file_and_a_scenario(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("hall.toml").write_text(HALL)
    Path("s.toml").write_text(PAIR + "[world]\nkind = 'file'\npath = 'hall.toml'\n")
    for what, name in (("hall.toml", "hall"), ("s.toml", "pair")):
        about = json.loads(vcmvsp("world", what, "--json").out)
        assert (about["world"], about["solids"], about["kinds"]) == (name, 2, {"box": 1, "cylinder": 1})
        assert about["materials"] == {"brick": 1, "concrete": 1}
        picture = cv2.imread(about["png"])
        assert picture is not None
        assert picture.std() > 5.0
    for seed in ("1", "2"):
        vcmvsp("world", "urban", "--set", f"seed={seed}", "--png", f"{seed}.png")
    assert Path("1.png").read_bytes() != Path("2.png").read_bytes()


def test_commands_are_read_in_the_frame_of_the_vehicle() -> None:
    assert drive.command_of("v=0.3,w=0.5", 1.0, flies=False) == Velocity(linear=(0.3, 0.0, 0.0), yaw_rate=0.5)
    flying = drive.command_of("v=2", math.pi / 2, flies=True)
    assert isinstance(flying, Velocity)
    assert flying.linear == pytest.approx((0.0, 2.0, 0.0))
    assert drive.command_of("vx=1,vz=0.5", 1.0, flies=True) == Velocity(linear=(1.0, 0.0, 0.5))
    assert drive.command_of("x=1, y=2, z=3, speed=4", 0.0, flies=True) == Waypoint(position=(1.0, 2.0, 3.0), speed=4.0)


@pytest.mark.parametrize("text", ["", "v", "v=fast", "v=nan", "u=1", "v=1,vx=1", "x=1,y=2", "v=1,x=1,y=1,z=1"])
def test_what_is_no_command_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="--command"):
        drive.command_of(text, 0.0, flies=True)


def test_a_step_response_is_that_of_the_vehicle(tmp_path: Path) -> None:
    scenario = tmp_path / "pair.toml"
    scenario.write_text(PAIR)

    def response(vehicle: str, command: str) -> Any:
        given = ("--vehicle", vehicle, "--command", command, "--seconds", "6", "--json")
        return json.loads(vcmvsp("drive", str(scenario), *given).out)

    about = response("car", "v=0.3,w=0.5")
    assert about["v"]["steady"] == pytest.approx(0.3, rel=2e-3)
    assert about["w"]["steady"] == pytest.approx(0.5, rel=2e-3)
    assert about["v"]["rise_time_s"] == pytest.approx(0.9, abs=0.11)  # 0.3 m/s2, seen ten times a second
    assert (about["series"]["time_s"][-1], about["contacts"]) == (6.0, 0)
    about = response("uav", "v=2")
    x, y = about["series"]["x"][-1] - 5.0, about["series"]["y"][-1]
    assert math.atan2(y, x) == pytest.approx(1.0, abs=0.02)
    assert about["v"]["steady"] == pytest.approx(2.0, rel=0.02)
    outcome = vcmvsp("drive", str(scenario), "--vehicle", "cat", "--command", "v=2")
    assert (outcome.code, "unknown vehicle 'cat'" in outcome.err) == (2, True)


def test_a_ground_robot_cannot_be_sent_to_a_point(tmp_path: Path) -> None:
    scenario = tmp_path / "pair.toml"
    scenario.write_text(PAIR)
    outcome = vcmvsp("drive", str(scenario), "--vehicle", "car", "--command", "x=1,y=2,z=3")
    assert outcome.code != 0
    assert "car was given a Waypoint but cannot fly" in outcome.err
