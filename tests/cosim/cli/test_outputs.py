"""``vcmvsp plot``: redraws the figures of a run."""

import tomllib
from pathlib import Path

import pytest

import vcmvsp
from tests.support.cosim.command_line import answer_of, assert_refused, contents, two_cars, vcmvsp_command
from vcmvsp.cosim.runs.result import compared

pytestmark = [pytest.mark.processes, pytest.mark.usefixtures("figures", "folder")]


@pytest.mark.parametrize("target", ["nowhere", "s.toml", "empty"])
def test_plot_refuses_a_path_without_a_run(folder: Path, target: str) -> None:
    (folder / "empty").mkdir()
    assert_refused(vcmvsp_command("plot", target), f"vcmvsp: {target}: ")
    assert list((folder / "empty").iterdir()) == []


@pytest.mark.parametrize("damage", [slice(-20, None), slice(1000, 3000)])
def test_plot_names_a_damaged_run(folder: Path, damage: slice) -> None:
    assert vcmvsp_command("run", "s.toml", "--out", "damaged").code == 0
    table = folder / "damaged" / "states.parquet"
    content = bytearray(table.read_bytes())
    content[damage] = bytes(len(content[damage]))
    table.write_bytes(content)
    assert_refused(vcmvsp_command("plot", "damaged"), "vcmvsp: damaged cannot be read: ")


def test_plot_draws_the_figures_of_the_run_again(folder: Path) -> None:
    vcmvsp_command("run", "formation-circle", "--set", "physics.kind=kinematic", "--set", "duration_s=2", "--out", "out")
    figures = {name: data for name, data in contents(folder / "out").items() if name.endswith(".png")}
    assert sorted(figures) == ["formation_error.png", "trajectory.png"]
    for _ in range(2):  # repeated: random differences are rare
        lines = answer_of("plot", "out", "--out", "again").splitlines()
        assert sorted(lines) == ["again/formation_error.png", "again/trajectory.png"]
        assert contents(folder / "again") == figures
    lines = answer_of("plot", "out", "--out", "drawn", "--svg").splitlines()
    assert sorted(lines) == ["drawn/formation_error.svg", "drawn/trajectory.svg"]
    assert (folder / "drawn" / "trajectory.svg").read_text().startswith("<?xml")
    assert vcmvsp_command("plot", "out", "--out", "one", "--pdf").code == 0
    assert all(data.startswith(b"%PDF") for data in contents(folder / "one").values())
    assert vcmvsp_command("plot", "out", "--out", "both", "--svg", "--pdf").code == 0
    assert contents(folder / "both") == contents(folder / "drawn") | contents(folder / "one")


def test_several_runs_are_drawn_side_by_side(folder: Path) -> None:
    for name in ("one", "two"):
        vcmvsp_command("run", "formation-circle", "--set", "physics.kind=kinematic", "--set", "duration_s=2", "--out", name)
    assert vcmvsp_command("plot", "one", "two", "--out", "both").out.splitlines() == ["both/comparison.png"]
    figure = compared([folder / "one", folder / "two"])
    assert [axes.get_title() for axes in figure.axes] == ["one", "two", ""]
    assert [line.get_label() for line in figure.axes[2].lines] == ["one", "two"]
    assert "two of these folders are called one" in vcmvsp_command("plot", "one", "../" + folder.name + "/one").err


def test_only_figures_of_a_mission_need_the_recording(folder: Path) -> None:
    """Without its recording, a run has all figures except the mission's; its metrics still contain the mission."""
    scenario = {**tomllib.loads(two_cars()), "world": {"kind": "empty", "targets": [{"name": "a", "place": [0.0, 0.0]}]}}
    (folder / "mine.py").write_text(
        "from vcmvsp import Agent\nclass Mine(Agent):\n    def act(self, obs, radio):\n        self.note(task='search')\n"
    )
    for each in scenario["vehicle"]:
        each["agent"] = {"kind": "mine.py:Mine"}
    scenario.pop("agents", None)
    result = vcmvsp.run({**scenario, "duration_s": 0.5}, out=folder / "out")
    assert "mission" in result.plot()
    assert (folder / "out" / "mission.png").is_file()
    (folder / "out" / "run.mcap").unlink()
    assert sorted(result.plot()) == ["trajectory"]  # no followers, thus no formation error
    assert answer_of("plot", "out", "--out", "again") == "again/trajectory.png\n"
    assert result.metrics["mission"]["targets_found"] == 0


@pytest.mark.parametrize("out", ["s.toml", "/proc/vcmvsp"])
def test_plot_refuses_a_folder_that_cannot_be_written(out: str) -> None:
    vcmvsp_command("run", "s.toml", "--out", "out")
    assert_refused(vcmvsp_command("plot", "out", "--out", out), out)
