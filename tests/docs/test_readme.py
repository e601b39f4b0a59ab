"""The examples of the README work as shown."""

import re
import shlex
import tomllib
from pathlib import Path

import pytest

import vcmvsp
from tests.support.paths import ROOT
from vcmvsp.cosim.cli.app import main
from vcmvsp.cosim.config import builtin_kinds
from vcmvsp.cosim.scenario import loader
from vcmvsp.cosim.testing import check_agent

README, WORLDS = ((ROOT / page).read_text("utf-8") for page in ("README.md", "docs/howto/worlds.md"))
pytestmark = [pytest.mark.processes, pytest.mark.usefixtures("figures")]
BLOCKS: list[tuple[str, str]] = re.findall(r"```(\w*)\n(.*?)```", README + WORLDS, re.DOTALL)


def block(language: str, words: str) -> str:
    return next(text for kind, text in BLOCKS if kind == language and words in text)


def test_the_readme_fits_in_a_terminal() -> None:
    lines = README.splitlines()
    assert len(lines) <= 150
    assert [line for line in lines if len(line) > 100 and not line.startswith("![")] == []


def vcmvsp_command(*arguments: str) -> None:
    with pytest.raises(SystemExit) as ended:
        main(list(arguments))
    assert ended.value.code == 0


@pytest.fixture
def gap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "keep_gap.py").write_text(block("python", "class KeepGap"))
    (tmp_path / "gap.toml").write_text(block("toml", "gap.toml"))
    return tmp_path


def test_the_twenty_lines_keep_the_gap(gap: Path, capsys: pytest.CaptureFixture[str]) -> None:
    vcmvsp_command("run", "gap.toml", "--out", "gap")
    printed = capsys.readouterr().out
    assert "gap: 2 agents (inprocess), 30 s simulated" in printed
    assert "error 0.5" in printed
    states = vcmvsp.run("gap.toml").states.to_pandas()
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


def test_the_lines_for_python_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    space: dict[str, object] = {}
    exec(block("python", "import vcmvsp\n\nr = "), space)
    assert len(capsys.readouterr().out.split()) == 2
    names = {"scenario.toml", "run.mcap", "radio.parquet", "states.parquet", "metrics.json", "about.json", "report.html"}
    names |= {"errors.parquet"}
    assert {path.name for path in (tmp_path / "lossy").iterdir()} == names | {"trajectory.png", "formation_error.png"}


def test_the_demo_prints_the_output_in_the_readme(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    vcmvsp_command("demo", "-q")
    assert capsys.readouterr().out == block("", "dead-reckoning  52 %")
    assert (tmp_path / "runs/demo/comparison.png").stat().st_size > 20_000


def test_commands_for_worlds_and_vehicles_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    commands = re.findall(r"^    vcmvsp ((?:list|show|world|drive) .*)$", WORLDS, re.MULTILINE)
    for command in commands:
        vcmvsp_command(*shlex.split(command, comments=True))
    assert len(commands) == 4
    assert (tmp_path / "city.png").stat().st_size > 10_000
    printed = capsys.readouterr().out
    assert "uav1 (quadrotor), vx=2, 4 s:" in printed
    named = [name for name in builtin_kinds.KINDS["world"] if name in printed]
    assert named == list(builtin_kinds.KINDS["world"])


def test_the_vehicles_of_the_readme_are_valid() -> None:
    raw = tomllib.loads(block("toml", "count = 100"))
    parsed, _ = loader.load({"name": "many", "duration_s": 1.0, **raw})
    assert len(parsed.vehicle) == 100
    assert parsed.vehicle[-1].start == ((45.0, 45.0, 10.0), 0.0)
    assert all(each["kind"] in builtin_kinds.KINDS["sensor"] for each in parsed.vehicle[0].sensors.values())
