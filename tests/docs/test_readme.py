"""The examples of the README work as shown."""

import re
import shlex
import tomllib
from pathlib import Path

import pytest
from pandas import read_parquet

import vcmvsp
from tests.support.cosim.command_line import vcmvsp_command
from tests.support.docs import readme_pages
from tests.support.docs.readme_pages import PAGES
from vcmvsp.cosim.config import builtin_kinds
from vcmvsp.cosim.scenario import loader
from vcmvsp.cosim.testing import check_agent

WORLDS = "docs/howto/worlds.md"
pytestmark = [pytest.mark.processes, pytest.mark.usefixtures("figures")]


def block(words: str) -> str:
    return readme_pages.block("README.md", words)


def test_the_readme_fits_in_a_terminal() -> None:
    lines = PAGES["README.md"].splitlines()
    assert len(lines) <= 150
    assert [line for line in lines if len(line) > 100 and not line.startswith("![")] == []


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def gap(folder: Path) -> Path:
    (folder / "keep_gap.py").write_text(block("class KeepGap"))
    (folder / "gap.toml").write_text(block("# gap.toml"))
    return folder


@pytest.mark.usefixtures("gap")
def test_the_twenty_lines_keep_the_gap() -> None:
    printed = vcmvsp_command("run", "gap.toml", "--out", "gap").out
    assert "gap: 2 agents (inprocess), 30 s simulated" in printed
    assert "error 0.5" in printed
    states = read_parquet("gap/states.parquet")
    last = states[states.time_ns == states.time_ns.max()].set_index("vehicle")
    # On a straight line at v the gap grows by v (1/gain + mean age): the follower has no speed of the leader.
    assert last.x["car1"] - last.x["car2"] == pytest.approx(2.0 + 0.3 * (1 / 0.8 + 0.1 + 0.1 * 0.3 / 0.7), abs=0.1)


def test_agent_objects_and_files_give_equal_metrics(gap: Path) -> None:
    space: dict[str, object] = {}
    exec((gap / "keep_gap.py").read_text(), space)
    keep_gap: type[vcmvsp.Agent] = space["KeepGap"]  # type: ignore[assignment]
    as_file, as_object = vcmvsp.run("gap.toml"), vcmvsp.run("gap.toml", agents={"car2": keep_gap("car1")})  # type: ignore[call-arg]
    assert as_object.metrics == as_file.metrics
    with pytest.raises(AssertionError, match="KeyError"):  # it does not check messages; a real agent should
        check_agent(lambda: keep_gap("car1"))  # type: ignore[call-arg]


def test_the_lines_for_python_run(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    exec(block("import vcmvsp\n\nr = "), {})
    assert len(capsys.readouterr().out.split()) == 2
    names = {"scenario.toml", "run.mcap", "radio.parquet", "states.parquet", "metrics.json", "about.json", "report.html"}
    names |= {"errors.parquet"}
    assert {path.name for path in (folder / "lossy").iterdir()} == names | {"trajectory.png", "formation_error.png"}


def test_the_demo_prints_the_output_in_the_readme(folder: Path) -> None:
    assert vcmvsp_command("demo", "-q").out == block("dead-reckoning  52 %")
    assert (folder / "runs/demo/comparison.png").stat().st_size > 20_000


def test_commands_for_worlds_and_vehicles_work(folder: Path) -> None:
    commands = re.findall(r"^    vcmvsp ((?:list|show|world|drive) .*)$", PAGES[WORLDS], re.MULTILINE)
    outcomes = [vcmvsp_command(*shlex.split(command, comments=True)) for command in commands]
    assert [outcome.code for outcome in outcomes] == [0] * 4
    assert (folder / "city.png").stat().st_size > 10_000
    printed = "".join(outcome.out for outcome in outcomes)
    assert "uav1 (quadrotor), vx=2, 4 s:" in printed
    named = [name for name in builtin_kinds.KINDS["world"] if name in printed]
    assert named == list(builtin_kinds.KINDS["world"])


def test_the_vehicles_of_the_readme_are_valid() -> None:
    raw = tomllib.loads(readme_pages.block(WORLDS, "count = 100"))
    parsed, _ = loader.load({"name": "many", "duration_s": 1.0, **raw})
    assert len(parsed.vehicle) == 100
    assert parsed.vehicle[-1].start == ((45.0, 45.0, 10.0), 0.0)
    assert all(each["kind"] in builtin_kinds.KINDS["sensor"] for each in parsed.vehicle[0].sensors.values())
