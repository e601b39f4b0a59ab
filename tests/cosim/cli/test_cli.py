"""Command line: folders of results, options, and output on stdout and stderr."""

import json
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.cosim.command_line import answer_of, assert_refused, contents, two_cars, vcmvsp_command
from tests.support.cosim.run_processes import VCMVSP
from vcmvsp.cosim.cli.app import PANELS, command, drawer_of
from vcmvsp.cosim.runs.figures import Drawer
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.terminal import progress

pytestmark = [pytest.mark.processes, pytest.mark.usefixtures("folder")]

FILES = ["about.json", "metrics.json", "radio.parquet", "report.html", "run.mcap", "scenario.toml", "states.parquet"]

CHATTY = """
import sys
from vcmvsp import Agent
print("on import")
class Chatty(Agent):
    def __init__(self) -> None:
        print("on construction")
    def start(self, info):
        print("at the start")
    def act(self, obs, radio):
        print("at a tick")
        radio.send(x=1)
    def close(self):
        print("at the end")
"""


def test_a_run_leaves_its_files(folder: Path) -> None:
    out = answer_of("run", "s.toml", "--out", "out")
    assert "two-cars: 2 agents (inprocess), 0.5 s simulated" in out
    assert out.endswith("results:   out\n")
    assert set(FILES) <= {path.name for path in (folder / "out").iterdir()}


def test_without_a_folder_results_go_into_a_new_one(folder: Path) -> None:
    names = ["two-cars-0", "two-cars-0-2", "two-cars-0-3"]
    for name in names:
        assert vcmvsp_command("run", "s.toml").out.endswith(f"results:   runs/{name}\n")
    vcmvsp_command("run", "s.toml", "--seed", "7", "--set", "name=other")
    assert sorted(path.name for path in (folder / "runs").iterdir()) == ["other-7", *names]
    assert len({str(contents(folder / "runs" / name)) for name in names}) == 1


def test_a_folder_that_is_not_empty_is_left_alone_unless_forced(folder: Path) -> None:
    (folder / "out").mkdir()
    assert vcmvsp_command("run", "s.toml", "--out", "out").code == 0  # empty
    (folder / "out" / "keep.txt").write_text("mine")
    before = contents(folder / "out")
    command = ("run", "s.toml", "--out", "out", "--seed", "9", "--set", "duration_s=0.2")
    assert_refused(vcmvsp_command(*command), "--out out: is not empty", "--force")
    assert contents(folder / "out") == before
    assert vcmvsp_command(*command, "--force").code == 0
    after = contents(folder / "out")
    assert after["keep.txt"] == b"mine"
    assert all(after[name] != before[name] for name in FILES if name != "about.json")


@pytest.mark.parametrize(
    ("out", "words"),
    [
        ("file", "--out file: is a file, not a folder"),
        ("file/below", "no write access to"),
        ("/proc/vcmvsp/out", "/proc/vcmvsp/out"),
        ("dangling", "dangling"),
        pytest.param("x" * 300, "xxx"),
    ],
)
@pytest.mark.parametrize("force", [False, True])
def test_a_folder_that_cannot_be_written_is_refused(folder: Path, out: str, words: str, force: bool) -> None:
    (folder / "file").write_text("mine")
    (folder / "dangling").symlink_to("nowhere")
    before = sorted(folder.iterdir())
    assert_refused(vcmvsp_command("run", "s.toml", "--out", out, *(["--force"] if force else [])), words)
    assert sorted(folder.iterdir()) == before
    assert (folder / "file").read_text() == "mine"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--realtime", "0"], "--realtime 0: must be from 1e-06"),
        (["--agents", "nonsense"], "agents: must be one of 'inprocess', 'process', 'zenoh', not 'nonsense'"),
        (["--seed", "-1"], "--seed -1: seed: must be a whole number >= 0 and"),
        (["--seed", "1.5"], "--seed"),
        (["--seed", "x"], "--seed"),
        (["--set"], "--set"),
        (["--nonsense"], "--nonsense"),
        (["more"], "more"),
        (["--agents", "zenoh", "--listen", "nonsense"], "'nonsense': must be tcp/HOST:PORT or tls/HOST:PORT"),
    ],
)
def test_a_bad_option_is_refused(folder: Path, options: list[str], words: str) -> None:
    before = sorted(folder.iterdir())
    code, out, err = vcmvsp_command("run", "s.toml", *options)
    assert (code, out) == (2, "")
    assert words in err
    assert "Traceback" not in err
    assert sorted(folder.iterdir()) == before


def test_realtime_takes_a_speed_or_none(folder: Path) -> None:
    for options in (["--realtime"], ["--realtime", "10"], ["--realtime=10"]):
        assert vcmvsp_command("run", "s.toml", *options, "--set", "duration_s=0.2", "--out", "out", "--force").code == 0
        speed = 10.0 if "10" in options[-1] else 1.0
        assert json.loads((folder / "out" / "about.json").read_text())["lateness"]["speed"] == speed


def test_the_pace_changes_no_result(folder: Path) -> None:
    vcmvsp_command("run", "s.toml", "--out", "fast")
    _, out, _ = vcmvsp_command("run", "s.toml", "--out", "paced", "--realtime", "5")
    assert "lateness:" in out
    assert contents(folder / "fast") == contents(folder / "paced")


def test_the_seed_option_is_the_seed(folder: Path) -> None:
    noisy = ["--set", "radio.loss.probability=0.5", "--set", "duration_s=3"]
    vcmvsp_command("run", "s.toml", *noisy, "--seed", "3", "--out", "a")
    vcmvsp_command("run", "s.toml", *noisy, "--set", "seed=3", "--out", "b")
    vcmvsp_command("run", "s.toml", *noisy, "--seed", "4", "--out", "c")
    assert contents(folder / "a") == contents(folder / "b")
    assert contents(folder / "a")["radio.parquet"] != contents(folder / "c")["radio.parquet"]


@pytest.mark.parametrize("command", ["run", "agent", "list", "show", "check", "plot", "doctor"])
def test_every_command_has_help(command: str) -> None:
    out = answer_of(command, "--help")
    assert f"{command} [OPTIONS]" in out
    if command not in ("list", "doctor"):
        assert "Example: vcmvsp" in out


def test_help_lists_every_command_once_in_a_whole_line() -> None:
    _, out, _ = vcmvsp_command("--help")
    commands = command().commands
    assert sorted(name for names in PANELS.values() for name in names) == sorted(commands)
    for text in (out, *(vcmvsp_command(group, "--help").out for group in ("keys", "net", "emulate"))):
        assert re.findall(r"[^\]]\.\.\.$", text, re.MULTILINE) == []


@pytest.mark.parametrize("where", ["inprocess", "process"])
def test_json_is_the_metrics_and_nothing_else_even_if_agents_print(folder: Path, where: str) -> None:
    (folder / "chatty.py").write_text(CHATTY)
    (folder / "s.toml").write_text(two_cars(agents="deadline_s = 20", agent="kind='chatty.py:Chatty'"))
    command = [*VCMVSP, "run", "s.toml", "--json", "--out", "out", "--agents", where]
    process = subprocess.run(command, capture_output=True, text=True, timeout=500, check=True)
    assert process.stdout == (folder / "out" / "metrics.json").read_text()
    assert json.loads(process.stdout)["scenario"] == "two-cars"
    words = {"on import", "on construction", "at the start", "at a tick", "at the end"}
    assert words <= {*process.stderr.splitlines()}


def test_json_is_clean_with_the_physics_engine_too() -> None:
    """PyBullet prints a greeting from C++, past Python's stdout."""
    settings = ["--set", "duration_s=0.5", "--agents", "inprocess"]
    command = [*VCMVSP, "run", "formation-circle", *settings, "--json", "--out", "out"]
    process = subprocess.run(command, capture_output=True, text=True, timeout=500, check=True)
    assert json.loads(process.stdout) == json.loads(Path("out/metrics.json").read_text())


def test_check_and_show_are_clean_too(folder: Path) -> None:
    (folder / "chatty.py").write_text(CHATTY)
    (folder / "s.toml").write_text(two_cars(agent="kind='chatty.py:Chatty'"))
    code, out, err = vcmvsp_command("check", "s.toml")
    assert (code, out) == (0, "s.toml: fine (2 vehicles, 0.5 s)\n")
    assert "on construction" in err
    assert "at a tick" not in err
    assert vcmvsp_command("show", "s.toml", "--resolved").out.startswith('name = "two-cars"\n')
    assert sorted(path.name for path in folder.iterdir() if path.name != "__pycache__") == ["chatty.py", "s.toml"]


def test_ctrl_c_while_a_process_ends_leaves_no_traceback() -> None:
    late = "import atexit, signal; atexit.register(signal.raise_signal, signal.SIGINT); "
    code = f"{late}from vcmvsp.cosim.cli.app import main; main()"
    process = subprocess.run([sys.executable, "-c", code, "list"], capture_output=True, text=True, timeout=500, check=False)
    assert (process.returncode, process.stderr) == (-signal.SIGINT, "")


@pytest.mark.parametrize(
    ("arguments", "early"),
    [
        ("run s.toml --seed 2", True),
        ("run s.toml --realtime", False),
        ("run s.toml --foxglove=0", False),
        ("run --view s.toml", False),
        ("check s.toml", False),
        ("", False),
    ],
)
def test_a_process_for_figures_starts_early_where_a_run_keeps_its_own_pace(arguments: str, early: bool) -> None:
    assert isinstance(drawer_of(arguments.split()), Drawer) is early


def test_progress_is_lines_on_stderr_in_a_log(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "LOG_EVERY_S", 0.0)
    code, out, err = vcmvsp_command("run", "s.toml", "--out", "out")
    lines = err.splitlines()
    assert code == 0
    assert len(lines) == 6  # 0, 0.1, ... 0.5 s
    assert all(re.fullmatch(r"0\.\d of 0\.5 s simulated \(\d+ %, [\d.]+x real time\)", line) for line in lines), lines
    assert [int(line.partition("(")[2].partition(" ")[0]) for line in lines] == [0, 20, 40, 60, 80, 100]
    assert "simulated (" not in out.partition("\n")[2]


def test_quiet_prints_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "LOG_EVERY_S", 0.0)
    assert vcmvsp_command("run", "s.toml", "--out", "out", "--quiet") == (0, "", "")
    assert vcmvsp_command("run", "s.toml", "--out", "out", "-q").err.startswith("vcmvsp: --out out: is not empty")


def test_an_agent_that_calls_exit_fails_like_any_other(folder: Path) -> None:
    (folder / "leaves.py").write_text(
        "from vcmvsp import Agent\nclass A(Agent):\n    def act(self, obs, radio):\n        exit(0)\n"
    )
    (folder / "s.toml").write_text(two_cars(agent="kind='leaves.py:A'"))
    code, _, err = vcmvsp_command("run", "s.toml", "--out", "out")
    assert code == 3
    assert "agent leaves.py:A of vehicle car2" in err
    assert (folder / "out" / "metrics.json").exists()


@pytest.mark.parametrize(
    ("returned", "words"),
    [
        ("3", "it must return a Velocity, a Waypoint, or None"),
        ("Velocity(linear=(float('inf'), 0.0, 0.0))", "not finite"),
        pytest.param("Velocity(linear=(1.0, 2.0))", "linear"),
        pytest.param("Velocity(linear='abc')", "linear"),
    ],
)
def test_an_invalid_command_names_agent_and_vehicle(folder: Path, returned: str, words: str) -> None:
    source = f"from vcmvsp import Agent, Velocity\nclass A(Agent):\n    def act(self, obs, radio):\n        return {returned}\n"
    (folder / "odd.py").write_text(source)
    (folder / "s.toml").write_text(two_cars(agent="kind='odd.py:A'"))
    code, _, err = vcmvsp_command("run", "s.toml", "--out", "out")
    assert code == 3
    assert err.startswith("vcmvsp: agent odd.py:A of vehicle car2: ")
    assert words in err
    assert err.splitlines()[1:] == ["vcmvsp: the recording until then is in out"]


def test_list_names_and_describes_every_scenario() -> None:
    code, out, _ = vcmvsp_command("list")
    about = json.loads(vcmvsp_command("list", "--json").out)
    assert code == 0
    assert list(about) == scenarios.names()
    assert all(re.search(rf"^{name} +{re.escape(description)}$", out, re.MULTILINE) for name, description in about.items())


def test_show_refuses_invalid_text(folder: Path) -> None:
    (folder / "s.toml").write_bytes(b"name = '\xff'")
    assert vcmvsp_command("show", "s.toml") == vcmvsp_command("check", "s.toml")


def test_check_accepts_an_agent_with_a_class_from_its_host(folder: Path) -> None:
    (folder / "s.toml").write_text(two_cars(agents="runs = 'zenoh'", agent=""))
    assert vcmvsp_command("check", "s.toml").code == 0


def test_doctor_finds_no_fault_here() -> None:
    out = answer_of("doctor")
    assert all(line.startswith("ok ") for line in out.splitlines())
    assert len(set(re.findall(r"digest (\w+)", out))) == 1  # same digest in one process and in many
