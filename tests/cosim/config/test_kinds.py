"""Commands around the kinds of a scenario: list, show, world, drive."""

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import vcmvsp
from tests.support.cosim.command_line import assert_refused, vcmvsp_command
from vcmvsp.cosim.config import builtin_kinds
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.runs import step_response
from vcmvsp.cosim.types import Velocity, Waypoint

pytestmark = pytest.mark.slow

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
    about = json.loads(vcmvsp_command("list", group, "--json").out)
    word = group.removesuffix("s")
    assert list(about) == list(builtin_kinds.KINDS[word])
    for kind, summary in about.items():
        shown = vcmvsp_command("show", word, kind)
        assert shown.code == 0
        assert shown.out.startswith(f"{kind}: {summary}")
        parameters = json.loads(vcmvsp_command("show", word, kind, "--json").out)["parameters"]
        assert all(name in shown.out for name in parameters)
        if word != "agent":
            assert [name for name, each in parameters.items() if not each["meaning"]] == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("list", "cars"), "allowed: agents, drivers, localisations, scenarios, sensors, vehicles, worlds"),
        (("show", "vehicle"), "which one? (p2dx,"),
        (("show", "vehicle", "p2dy"), "did you mean 'p2dx'?"),
        (("show", "vehicle", "p2dx", "--resolved"), "need a scenario"),
        (("world", "labratory"), "did you mean 'laboratory'?"),
        (("world", "pillar", "--set", "radios=1"), "world.radios: unknown key 'radios'; did you mean 'radius'?"),
        (("world", "pillar", "--png", "p.jpg"), "must end in .png"),
        (("world", "pillar", "--png", "nowhere/p.png"), "cannot be written"),
    ],
)
def test_wrong_arguments_are_refused_by_name(arguments: tuple[str, ...], words: str) -> None:
    assert_refused(vcmvsp_command(*arguments), words)


@pytest.mark.usefixtures("here")
def test_a_world_is_counted_and_drawn_from_a_kind_a_file_and_a_scenario() -> None:
    Path("hall.toml").write_text(HALL)
    Path("s.toml").write_text(PAIR + "[world]\nkind = 'file'\npath = 'hall.toml'\n")
    for file, name in (("hall.toml", "hall"), ("s.toml", "pair")):
        about = json.loads(vcmvsp_command("world", file, "--json").out)
        assert (about["world"], about["solids"], about["kinds"]) == (name, 2, {"box": 1, "cylinder": 1})
        assert about["materials"] == {"brick": 1, "concrete": 1}
        picture = cv2.imread(about["png"])
        assert picture is not None
        assert picture.std() > 5.0
    for seed in ("1", "2"):
        vcmvsp_command("world", "urban", "--set", f"seed={seed}", "--png", f"{seed}.png")
    assert Path("1.png").read_bytes() != Path("2.png").read_bytes()


def test_commands_are_read_in_the_frame_of_the_vehicle() -> None:
    assert step_response.command_of("v=0.3,w=0.5", 1.0, flies=False) == Velocity(linear=(0.3, 0.0, 0.0), yaw_rate=0.5)
    flying = step_response.command_of("v=2", math.pi / 2, flies=True)
    assert isinstance(flying, Velocity)
    assert flying.linear == pytest.approx((0.0, 2.0, 0.0))
    assert step_response.command_of("vx=1,vz=0.5", 1.0, flies=True) == Velocity(linear=(1.0, 0.0, 0.5))
    assert step_response.command_of("x=1, y=2, z=3, speed=4", 0.0, flies=True) == Waypoint(position=(1.0, 2.0, 3.0), speed=4.0)


@pytest.mark.parametrize("text", ["", "v", "v=fast", "v=nan", "u=1", "v=1,vx=1", "x=1,y=2", "v=1,x=1,y=1,z=1"])
def test_invalid_commands_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match="--command"):
        step_response.command_of(text, 0.0, flies=True)


def response(folder: Path, vehicle: str, command: str, heading: float = 1.0) -> Any:
    """The response of a vehicle of the pair."""
    scenario = folder / "pair.toml"
    scenario.write_text(PAIR.replace("heading = 1.0", f"heading = {heading}"))
    options = ("--vehicle", vehicle, "--command", command, "--seconds", "6", "--json")
    return json.loads(vcmvsp_command("drive", str(scenario), *options).out)


def test_a_step_response_is_that_of_the_vehicle(tmp_path: Path) -> None:
    about = response(tmp_path, "car", "v=0.3,w=0.5")
    assert about["v"]["steady"] == pytest.approx(0.3, rel=2e-3)
    assert about["w"]["steady"] == pytest.approx(0.5, rel=2e-3)
    assert about["v"]["rise_time_s"] == pytest.approx(0.9, abs=0.11)  # 0.3 m/s2, sampled at 10 Hz
    assert (about["series"]["time_s"][-1], about["contacts"]) == (6.0, 0)
    about = response(tmp_path, "uav", "v=2")
    x, y = about["series"]["x"][-1] - 5.0, about["series"]["y"][-1]
    assert math.atan2(y, x) == pytest.approx(1.0, abs=0.02)
    assert about["v"]["steady"] == pytest.approx(2.0, rel=0.02)
    outcome = vcmvsp_command("drive", str(tmp_path / "pair.toml"), "--vehicle", "cat", "--command", "v=2")
    assert_refused(outcome, "unknown vehicle 'cat'")


@pytest.mark.parametrize("command", ["vx=1", "v=1", "vx=-1,vy=1", "v=-1", "vz=1"])
def test_a_quadrotor_is_judged_along_its_command_at_any_heading(tmp_path: Path, command: str) -> None:
    about = response(tmp_path, "uav", command, heading=-2.0)
    judged = about["vz" if command.startswith("vz") else "v"]
    assert abs(judged["error_percent"]) < 1.0


def test_files_that_a_scenario_names_are_found_beside_it_and_kept(here: Path) -> None:
    folder = here / "mine"
    folder.mkdir()
    cv2.imwrite(str(folder / "lawn.png"), np.full((8, 8, 3), (0, 200, 0), np.uint8))
    (folder / "plot.toml").write_text("[ground]\npicture = 'lawn.png'\nsize = [4.0, 4.0]\n")
    for number, world in enumerate(
        ("kind = 'file'\npath = 'plot.toml'", "kind = 'boxes'\nboxes = []\nground = { picture = 'lawn.png', size = [4, 4] }")
    ):
        (folder / "s.toml").write_text(f"{PAIR}[world]\n{world}\n")
        assert vcmvsp_command("run", "mine/s.toml", "--set", "duration_s=0.2", "--out", f"first{number}").code == 0
        again = vcmvsp_command("run", f"first{number}/scenario.toml", "--out", f"again{number}")
        assert (again.code, (here / f"again{number}" / "lawn.png").is_file()) == (0, True)


def test_one_of_many_has_the_line_of_its_table(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(
        "name = 's'\nduration_s = 1.0\n[[vehicle]]\nname = 'q'\ncount = 3\nkind = 'p2dx'\nspacing = [0.1, 0.1]\n"
    )
    outcome = vcmvsp_command("check", str(tmp_path / "s.toml"))
    assert_refused(outcome, "s.toml line 3: vehicle.q2.position: q2 and q1 overlap")


@pytest.mark.usefixtures("figures")
def test_solids_are_drawn_in_the_figure_of_the_paths_within_its_limits(tmp_path: Path) -> None:
    boxes = [{"center": [x, 2.0, 0.5], "size": [1.0, 1.0, 1.0]} for x in (3.0, 300.0)]
    (tmp_path / "s.toml").write_text(f"{PAIR}[world]\nkind = 'boxes'\nboxes = []\n")
    runs = [vcmvsp.run(tmp_path / "s.toml", set={"world.boxes": each}) for each in ([], boxes)]
    plain_axes, solid_axes = (run.plot()["trajectory"].axes[0] for run in runs)
    assert [len(each.collections[0].get_paths()) for each in (plain_axes, solid_axes)] == [0, 2]
    assert plain_axes.get_xlim() == solid_axes.get_xlim()
