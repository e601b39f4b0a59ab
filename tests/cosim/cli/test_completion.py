"""Completion through the environment variables that shells set."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.cosim.command_line import answer_of, vcmvsp_command
from tests.support.paths import ROOT
from vcmvsp.cosim.cli import completion
from vcmvsp.cosim.scenario import loader as scenarios

pytestmark = pytest.mark.processes

HEAVY = ("numpy", "rich", "matplotlib", "pybullet", "zenoh")


@pytest.fixture(autouse=True)
def folder(here: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setitem(sys.modules, "rich", sys.modules.get("rich"))  # completion hides it; restored after the test
    return here


@pytest.fixture
def bash(monkeypatch: pytest.MonkeyPatch) -> "Shell":
    return Shell(monkeypatch, "bash")


class Shell:
    """Completions that a shell shows for these words and TAB."""

    def __init__(self, patch: pytest.MonkeyPatch, name: str) -> None:
        self._patch, self._name = patch, name

    def __call__(self, *words: str) -> list[str]:
        self._patch.setenv("_VCMVSP_COMPLETE", f"complete_{self._name}")
        self._patch.setenv("COMP_WORDS", "\n".join(["vcmvsp", *words]))
        self._patch.setenv("COMP_CWORD", str(len(words)))
        self._patch.setenv("_TYPER_COMPLETE_ARGS", " ".join(["vcmvsp", *words]))
        self._patch.setenv("_TYPER_COMPLETE_FISH_ACTION", "get-args")
        return answer_of().splitlines()


def test_commands_and_their_options(bash: Shell) -> None:
    assert {"run", "new", "reference", "study", "keys"} <= {*bash("")}
    assert bash("ru") == ["run"]
    assert bash("keys", "ob") == ["observer"]
    assert {"--set", "--seed"} == {*bash("run", "--se")}


def test_scenarios_and_user_files(bash: Shell, folder: Path) -> None:
    assert bash("run", "formation-c") == ["formation-circle"]
    assert {*scenarios.names()} <= {*bash("check", "")}
    (folder / "formation-mine.toml").touch()
    (folder / "formation.txt").touch()
    (folder / "formations").mkdir()
    (folder / "formations" / "deep.toml").touch()
    own = {"formation-mine.toml", "formations/"}
    assert own == {each for each in bash("study", "form") if each not in scenarios.names()}
    assert bash("run", "formations/d") == ["formations/deep.toml"]


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (("list", "ve"), ["vehicles"]),
        (("show", "sen"), ["sensor"]),
        (("show", "vehicle", "p"), ["p2dx", "point"]),
        (("new", "s"), ["scenario", "sensor"]),
        (("reference", "radio.loss.b"), ["radio.loss.bernoulli", "radio.loss.bursts"]),
        (("reference", "agents.leader"), ["agents.leader_follower"]),
        (("world", "urb"), ["urban"]),
        (("run", "--agents", "p"), ["process"]),
        (("per", "--preset", "zig"), ["zigbee"]),
        (("drive", "formation-circle", "--vehicle", ""), ["car1", "car2", "car3"]),
    ],
)
def test_kinds_parts_presets_and_vehicles(bash: Shell, words: tuple[str, ...], offered: list[str]) -> None:
    assert [each for each in bash(*words) if each not in scenarios.names()] == offered


@pytest.mark.parametrize("words", [("run", "--out", ""), ("plot", ""), ("run", "nothing-begins-so")])
def test_without_candidates_the_shell_completes_files(bash: Shell, words: tuple[str, ...]) -> None:
    assert bash(*words) == []


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        (["rad"], ["radio.path_loss.", "radio.walls.", "radio.loss.", "radio.preset="]),
        (["radio.loss.prob"], ["radio.loss.probability="]),
        (["radio.loss.kind"], ["radio.loss.kind=", "radio.loss.kind=bernoulli"]),
        (["radio.loss.kind", "="], ["bernoulli", "gilbert_elliott", "bursts", "none"]),
        (["radio.loss.kind", "=", "b"], ["bernoulli", "bursts"]),
        (["agents.run"], ["agents.runs=process", "agents.runs=zenoh"]),
        (["record.vid"], ["record.video=true", "record.video=false"]),
        (["vehicle."], ["vehicle.car1.", "vehicle.car2.", "vehicle.car3."]),
        (["vehicle.car2.agent.k"], ["vehicle.car2.agent.k1=", "vehicle.car2.agent.kind="]),
        (["vehicles.ki"], ["vehicles.kind=p2dx"]),
        (["agents.formation.passage.pol"], ["agents.formation.passage.policy="]),
    ],
)
def test_keys_are_offered_down_to_the_next_dot_and_then_values(bash: Shell, typed: list[str], offered: list[str]) -> None:
    assert {*offered} <= {*bash("run", "formation-circle", "--set", *typed)}


def test_keys_of_a_user_scenario_have_its_names(bash: Shell, folder: Path) -> None:
    (folder / "own.toml").write_text("[[vehicle]]\nname = 'bus'\nsensors = { eye = { kind = 'lms' } }\n")
    assert bash("run", "own.toml", "--set", "veh") == ["vehicle.", "vehicles."]
    assert "vehicle.bus.sensors.eye.beams=" in bash("run", "own.toml", "--set", "vehicle.bus.sensors.eye.")
    (folder / "own.toml").write_text("[[vehicle")
    assert "vehicles.kind=" in bash("run", "own.toml", "--set", "vehicles.")
    assert bash("run", "own.toml", "--set", "vehicle.") == []


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (("world", "urban", "--set", "bloc"), "block="),
        (("world", "mixed-50", "--set", "world.bloc"), "world.block="),
        (("pathloss", "--set", "path_loss.exp"), "path_loss.exponent="),
        (("agent", "--set", "k1"), "k1="),
        (("robot", "--set", "bau"), "baud="),
    ],
)
def test_keys_fit_the_set_option_of_the_command(bash: Shell, words: tuple[str, ...], offered: str) -> None:
    assert offered in bash(*words)


def test_zsh_and_fish_receive_descriptions(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Shell(monkeypatch, "zsh")("ru")[0].startswith("""_arguments '*: :(("run":"Run a scenario""")
    assert Shell(monkeypatch, "fish")("ru")[0].startswith("run\tRun a scenario")
    assert Shell(monkeypatch, "zsh")("run", "--set", "radio.loss.kind=be")[0].endswith('(("radio.loss.kind=bernoulli"))\'')
    assert Shell(monkeypatch, "zsh")("run", "--out", "x") == ["_files"]


def test_the_exit_code_for_fish_is_0_if_there_are_completions(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("_VCMVSP_COMPLETE", "complete_fish")
    monkeypatch.setenv("_TYPER_COMPLETE_FISH_ACTION", "is-args")
    for words, code in (("vcmvsp ru", 0), ("vcmvsp run --out x", 1)):
        monkeypatch.setenv("_TYPER_COMPLETE_ARGS", words)
        assert vcmvsp_command() == (code, "", "")


def test_without_an_index_there_is_no_output(monkeypatch: pytest.MonkeyPatch, bash: Shell) -> None:
    monkeypatch.setattr(completion, "INDEX", Path("/nowhere"))
    monkeypatch.setenv("_VCMVSP_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", "vcmvsp\nrun\n--set\nrad")
    monkeypatch.setenv("COMP_CWORD", "3")
    assert (vcmvsp_command().out, vcmvsp_command().err) == ("", "")


def output_of(*arguments: str, **variables: str) -> str:
    """Output of the real command, in a process of its own."""
    command = [sys.executable, *arguments]
    environment = {**os.environ, **variables}
    return subprocess.run(command, capture_output=True, text=True, timeout=500, check=True, env=environment).stdout


def test_it_loads_nothing_heavy() -> None:
    code = (
        "import sys\nfrom vcmvsp.cosim.cli.app import main\n"
        f"try: main()\nfinally: print([each for each in {HEAVY} if sys.modules.get(each)])"
    )
    variables = {"COMP_WORDS": "vcmvsp\nrun\nformation-circle\n--set\nradio.mac.a", "COMP_CWORD": "4"}
    out = output_of("-c", code, _VCMVSP_COMPLETE="complete_bash", **variables)
    assert out.splitlines() == ["radio.mac.attempts=", "radio.mac.acknowledge=", "[]"]


@pytest.mark.needs("bash")
def test_bash_itself_completes(folder: Path) -> None:
    (folder / "vcmvsp").write_text(f'#!/bin/sh\nexec "{sys.executable}" -m vcmvsp.cosim.cli.app "$@"\n')
    (folder / "vcmvsp").chmod(0o755)
    script = """
        eval "$(_VCMVSP_COMPLETE=source_bash vcmvsp)"
        COMP_WORDS=(vcmvsp run formation-circle --set radio.loss.kind = b); COMP_CWORD=6
        _vcmvsp_completion vcmvsp
        echo "${COMPREPLY[@]}"
    """
    environment = {**os.environ, "PATH": f"{folder}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    process = subprocess.run(["bash", "-c", script], check=True, capture_output=True, text=True, timeout=500, env=environment)
    assert (process.stdout.split(), process.stderr) == (["bernoulli", "bursts"], "")
