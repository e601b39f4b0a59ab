"""Hosts started on other machines: their inputs, messages about failures, and their end with the run."""

import contextlib
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import vcmvsp
from tests.support.cosim.command_line import vcmvsp_command
from tests.support.cosim.run_processes import VCMVSP, Stage, exit_of, output_at_exit, staged, wait_for
from tests.support.cosim.ssh_hosts import Machine, scripted_ssh, ssh_server
from tests.support.cosim.teams import FOLLOWER, LEADER, team
from vcmvsp.cosim.errors import VcmvspError
from vcmvsp.cosim.hosts import ssh_hosts
from vcmvsp.cosim.scenario.loader import settings_of
from vcmvsp.cosim.util.documents import toml_line

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

ROCK = """
[[vehicle]]
name = "rock"
pose = [9.0, 9.0, 0.0]
"""
SCENARIO = team("far", LEADER + ', runs = "inprocess"', FOLLOWER, FOLLOWER, duration_s=3.0, loss=0.3) + ROCK
NOTED = """
import os, pathlib, sys
from vcmvsp import Agent, Velocity

class Noted(Agent):
    def __init__(self, word: str = "") -> None:
        self.word = word
        for each in (pathlib.Path(each) for each in sys.argv if each.endswith(".keys")):
            print(each.name, oct(each.stat().st_mode & 0o777), oct(each.parent.stat().st_mode & 0o777))
    def act(self, obs, radio):
        if obs.time_ns == 0:
            print(f"in {os.path.basename(os.getcwd())}: {self.word}")
        return Velocity()
"""
HOSTILE = "it's \"q\" $(touch hacked) `touch hacked`; touch hacked & \\ \\' !x\n~ end"


class LaunchStage(Stage):
    """A folder with a scenario and a hosts file."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        (folder / "far.toml").write_text(SCENARIO)
        self.environment: dict[str, str] = {}

    def hosts(self, text: str) -> None:
        (self.folder / "hosts.toml").write_text(text)

    def launch(self, *more: str) -> subprocess.Popen[str]:
        arguments = ["launch", "far.toml", "--hosts", "hosts.toml", "--out", "out", *more]
        if not {"--listen", "--keys"} & {*more}:  # with keys, the hosts file contains the address at which the run listens
            arguments += ["--listen", self.endpoint]
        return self.start(*arguments, more=self.environment)

    def log(self, name: str) -> str:
        return (self.out / "hosts" / f"{name}.log").read_text()


stage = staged(LaunchStage)


@pytest.fixture(params=["played", "sshd", "asyncssh"])
def machine(request: pytest.FixtureRequest, stage: LaunchStage) -> Iterator[Machine]:
    folder = stage.folder / "far"
    made = scripted_ssh(folder) if request.param == "played" else ssh_server(request.param, folder, stage.another_port())
    stage.environment = made.environment
    yield made
    if made.server:
        made.server.kill()
        made.server.wait()


def process_ended(pid_file: Path) -> bool:
    """Whether the process whose id is in the file ends within 30 s."""
    wait_for(pid_file)
    last = time.monotonic() + 30.0
    while time.monotonic() < last:
        with contextlib.suppress(ValueError):  # not written yet
            try:
                os.kill(int(pid_file.read_text()), 0)
            except ProcessLookupError:
                return True
        time.sleep(0.05)
    return False


def table(machine: Machine, **more: Any) -> str:
    """A ``[[host]]`` table for ``machine``."""
    lines = [f"{name} = {toml_line(value)}" for name, value in {**more, "ssh_options": machine.options}.items()]
    return "\n".join(["[[host]]", f"ssh = {json.dumps(machine.ssh)}", *lines, ""])


BOTH: dict[str, Any] = {"name": "far", "vehicles": ["car2", "car3"]}


def noting(pid_file: Path) -> tuple[str, ...]:
    """A command that runs vcmvsp and writes its process id."""
    return ("sh", "-c", 'echo $$ >"$0"; exec "$@"', str(pid_file), *VCMVSP)


def test_hosts_of_this_machine_give_the_bytes_of_one_process(stage: LaunchStage) -> None:
    stage.hosts('[[host]]\nvehicles = ["car2"]\n[[host]]\nname = "two"\nvehicles = ["car3"]\nset = { k1 = 0.7 }\n')
    output = output_at_exit(0, stage.launch())
    assert "[two] joined; waiting for the run to begin" in output
    assert stage.log("two") == stage.log("car2") == "joined; waiting for the run to begin\nthe run is over\n"
    alone = vcmvsp.run(stage.folder / "far.toml", set={"vehicle.car3.agent.k1": 0.7}, agents="inprocess", mcap=False)
    assert stage.written() == alone.metrics
    assert tomllib.loads((stage.out / "scenario.toml").read_text()) == tomllib.loads(alone.scenario)
    assert stage.written("about.json")["agents"] == {"car1": "inprocess", "car2": "zenoh", "car3": "zenoh"}


def test_a_host_on_another_machine_gets_its_keys_its_class_and_its_values_unharmed(
    stage: LaunchStage, machine: Machine
) -> None:
    there = stage.folder / "a b"
    there.mkdir()
    (there / "noted.py").write_text(NOTED)
    assert vcmvsp_command("keys", "init", str(stage.folder / "keys")).code == 0
    endpoint = f"tls/127.0.0.1:{stage.port}"
    both: dict[str, Any] = {"command": tuple(VCMVSP), "copy": True}
    noted = {"agent": "noted.py:Noted", "set": {"word": HOSTILE}, "folder": str(there)}
    far, near = (
        table(machine, name="far", vehicles=["car2"], **noted, **both),
        table(machine, name="near", vehicles=["car3"], **both),
    )
    stage.hosts(f'connect = "{endpoint}"\n{far}{near}')
    output_at_exit(0, stage.launch("--keys", "keys"))
    log = stage.log("far").splitlines()
    assert "far.keys 0o600 0o700" in log
    assert f"in a b: {HOSTILE.splitlines()[0]}" in log
    assert not [*stage.folder.rglob("hacked")]
    assert tomllib.loads((stage.out / "scenario.toml").read_text())["vehicle"][1]["agent"]["word"] == HOSTILE
    shutil.copy(there / "noted.py", stage.out)  # the run's machine did not have it
    again = vcmvsp.run(stage.out / "scenario.toml", agents="inprocess", mcap=False)
    assert stage.digest() == again.metrics["digest"]
    if not machine.server:
        assert [each.name for each in (stage.folder / "far").iterdir()] == ["ssh-was-told"]  # no keys are left
        arguments = (stage.folder / "far" / "ssh-was-told").read_text().splitlines()
        assert arguments[-3:] == ["--", machine.ssh, "sh"]
        assert "BatchMode=yes" in arguments


@pytest.mark.parametrize("machine", ["sshd"], indirect=True)
def test_a_tunnel_of_ssh_needs_neither_certificates_nor_an_open_port(stage: LaunchStage, machine: Machine) -> None:
    """The far end of the tunnel is another port of this machine, at which no other program listens."""
    far, near = f"127.0.0.1:{stage.another_port()}", f"127.0.0.1:{stage.port}"
    tunnel = (*machine.options, "-R", f"{far}:{near}", "-o", "ExitOnForwardFailure=yes")
    machine = machine._replace(options=tunnel)
    stage.hosts(table(machine, vehicles=["car2", "car3"], command=tuple(VCMVSP), connect=f"tcp/{far}"))
    output_at_exit(0, stage.launch())


@pytest.mark.parametrize(
    ("machine", "end"),
    [
        ("played", signal.SIGINT),
        ("played", signal.SIGTERM),
        ("played", signal.SIGKILL),
        ("sshd", signal.SIGKILL),  # the other end only detects the closed connection
        ("asyncssh", signal.SIGTERM),
    ],
    indirect=["machine"],
)
def test_no_host_outlives_its_run(stage: LaunchStage, machine: Machine, end: signal.Signals) -> None:
    pid = stage.folder / "pid"
    assert vcmvsp_command("keys", "init", str(stage.folder / "keys")).code == 0
    address = f'connect = "tls/127.0.0.1:{stage.port}"\n'
    stage.hosts(address + table(machine, command=noting(pid), copy=True, **BOTH))
    launch = stage.launch("--keys", "keys", "--realtime", "--set", "duration_s=3600")
    wait_for(stage.out / "run.mcap")
    launch.send_signal(end)
    code, _ = exit_of(launch)
    assert code == (-signal.SIGKILL if end == signal.SIGKILL else 130)
    assert process_ended(pid)
    if end != signal.SIGKILL:
        assert "joined" in stage.log("far")
    if not machine.server:
        last = time.monotonic() + 30.0
        while [name for _, _, names in os.walk(stage.folder / "far") for name in names if name.endswith(".keys")]:
            assert time.monotonic() < last
            time.sleep(0.05)


@pytest.mark.parametrize("machine", ["sshd", "asyncssh"], indirect=True)
def test_a_host_whose_connection_breaks_is_ended(stage: LaunchStage, machine: Machine) -> None:
    pid = stage.folder / "pid"
    stage.hosts(table(machine, command=noting(pid), connect=stage.endpoint, **BOTH))
    launch = stage.launch("--realtime", "--set", "duration_s=3600")
    wait_for(stage.out / "run.mcap")
    (client,) = (each for each in psutil.Process(launch.pid).children() if each.name() == "ssh")
    client.kill()
    output = output_at_exit(3, launch)
    assert "[far] was killed by SIGKILL" in output
    assert process_ended(pid)


def test_a_host_that_ignores_signals_is_ended_too(stage: LaunchStage) -> None:
    deaf = "import os, signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); "
    deaf += "print(os.getpid(), file=open('pid', 'w')); time.sleep(1e4)"
    # A grandchild of the started shell: with setsid the whole group ends.
    inner = f"{sys.executable} -c {json.dumps(deaf)}" + ("; true" if shutil.which("setsid") else "")
    stage.hosts(f'[[host]]\nvehicles = ["car2", "car3"]\ncommand = ["sh", "-c", {json.dumps(inner)}]\n')
    launch = stage.launch()
    wait_for(stage.folder / "pid")
    launch.send_signal(signal.SIGINT)
    assert exit_of(launch)[0] == 130
    assert process_ended(stage.folder / "pid")


@pytest.mark.parametrize("machine", ["played"], indirect=True)  # ssh passes on the exit code of the command
def test_a_host_that_cannot_start_ends_the_wait_with_its_cause(stage: LaunchStage, machine: Machine) -> None:
    where, late = f"host far (ssh {machine.ssh})", ["sh", "-c", "echo one; echo it is late >&2; exit 9"]
    for more, why in (
        ({"command": "~/nowhere/vcmvsp"}, f"{where}: has no '~/nowhere/vcmvsp' (exit code 127; command = in its [[host]] says"),
        ({"folder": "/nowhere at all"}, f"{where}: ended with exit code 1 before the run began"),
        ({"command": late}, "exit code 9 before the run began: one | it is late"),
    ):
        stage.hosts(table(machine, connect=stage.endpoint, **BOTH, **more))
        output = output_at_exit(3, stage.launch())
        assert why in output
        assert "agent host of vehicles car2, car3: host far" in output
        assert not stage.out.exists()


@pytest.mark.needs("ssh")
def test_a_machine_that_ssh_cannot_reach_ends_the_wait(stage: LaunchStage) -> None:
    unreachable = Machine("127.0.0.1", ("-F", "none", "-p", "1"), {}, None)
    stage.hosts(table(unreachable, connect=stage.endpoint, vehicles=["car2", "car3"]))
    output = output_at_exit(3, stage.launch())
    assert "host 127-0-0-1 (ssh 127.0.0.1): ssh cannot connect, or lost the connection (exit code 255): ssh: " in output


def test_a_host_that_is_killed_later_is_named(stage: LaunchStage) -> None:
    command = toml_line(noting(stage.folder / "pid"))
    stage.hosts(f'[[host]]\nname = "far"\nvehicles = ["car2", "car3"]\ncommand = {command}\n')
    launch = stage.launch("--realtime", "--set", "duration_s=3600", "--set", "agents.deadline_s=1.0")
    wait_for(stage.out / "run.mcap")
    os.kill(int((stage.folder / "pid").read_text()), signal.SIGKILL)
    output = output_at_exit(3, launch)
    assert "[far] ended with exit code 137" in output
    assert "joined" in stage.log("far")


@pytest.mark.parametrize(
    ("text", "more", "problem"),
    [
        ("[[host]", (), "hosts.toml: is not valid TOML"),
        ("connect = 3\n[[host]]\nvehicles = ['car2']", (), "hosts.toml line 1: connect: must be a string, not 3"),
        ("conect = ''", (), "line 1: conect: unknown key 'conect'; did you mean 'connect'?"),
        ("host = []", (), "hosts.toml: needs at least one [[host]]"),
        ("", (), "host: is missing"),
        (
            "[[host]]\nvehicles = ['car2']\n[[host]]\nvehicels = []",
            (),
            "line 3: host[1]: unknown key 'vehicels'; did you mean 'vehicles'?",
        ),
        ("[[host]]\nvehicles = ['car2']\nset = 3", (), "line 3: host[0].set: must be a table, not 3"),
        ("[[host]]\nvehicles = []", (), "line 2: host[0].vehicles: must contain at least one"),
        ("[[host]]\nvehicles = ['a/b']", (), "line 2: host[0].vehicles"),
        (
            "[[host]]\nvehicles = ['car2']\n[[host]]\nname = 'x'\nvehicles = ['car2']",
            (),
            "line 5: host[1].vehicles: 'car2' already has a host, 'car2'",
        ),
        (
            "[[host]]\nname = 'x'\nvehicles = ['car2']\n[[host]]\nname = 'x'\nvehicles = ['car3']",
            (),
            "line 5: host[1].name: host[0] is also named 'x'",
        ),
        ("[[host]]\nvehicles = ['car2']\nssh = '-oProxyCommand=x'", (), "line 3: host[0].ssh: must be a destination"),
        ("[[host]]\nvehicles = ['car2']\nkeys = 'x'\ncopy = true", (), "line 3: host[0].keys: names a file on the host"),
        ("[[host]]\nvehicles = ['car2']\ncommand = []", (), "line 3: host[0].command: must name a program"),
        ("[[host]]\nvehicles = ['car2', 'car4']", (), "unknown vehicle 'car4'; did you mean"),
        ("[[host]]\nvehicles = ['car2']", (), "hosts.toml: no host runs the agents of car3: add them to a [[host]]"),
        ("[[host]]\nvehicles = ['car2', 'car3', 'rock']", (), "'rock' has no agent in the scenario"),
        (
            "[[host]]\nvehicles = ['car2', 'car3']\nssh = 'far'",
            (),
            "host far (ssh far) cannot connect to tcp/127.0.0.1:7447: set the address",
        ),
        ("[[host]]\nvehicles = ['car2', 'car3']", ("--listen", "tcp/127.0.0.1:0"), "hosts need a known port"),
        ("[[host]]\nvehicles = ['car2', 'car3']", ("--listen", "tcp/0.0.0.0:7447"), "or add --insecure"),
        ("[[host]]\nvehicles = ['car2', 'car3']\ncopy = true", (), "host car2 has keys, but the run has none: add --keys DIR"),
        (
            "[[host]]\nvehicles = ['car2', 'car3']\nname = 'a'\ncopy = true",
            ("--keys", "none"),
            "none: contains no authority; make one",
        ),
        (
            "[[host]]\nvehicles = ['car2', 'car3']\nconnect = 'tls/x:1'",
            ("--listen", "tcp/127.0.0.1:7447"),
            "connects to tls/x:1, but the run listens at tcp/",
        ),
    ],
)
def test_errors_of_a_hosts_file_are_reported_before_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, more: tuple[str, ...], problem: str
) -> None:
    monkeypatch.setattr(ssh_hosts, "Far", None)
    monkeypatch.chdir(tmp_path)
    Path("far.toml").write_text(SCENARIO)
    Path("hosts.toml").write_text(text)
    code, out, err = vcmvsp_command("launch", "far.toml", "--hosts", "hosts.toml", "--out", "out", *more)
    assert (code, out) == (2, "")
    assert problem in err
    assert err.count("\n") == 1
    assert not Path("out").exists()


SHELLS = [pytest.param(each, marks=pytest.mark.needs(each)) for each in ("sh", "bash", "zsh", "mksh", "yash", "busybox")]
WORDS = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=20)


def heard(shell: str, script: str) -> tuple[int | None, str]:
    """Exit code and output of a script."""
    log = io.BytesIO()
    far = ssh_hosts.Far([shell, "sh"] if shell.endswith("busybox") else [shell], script, log, lambda _: None)
    assert far.wait(60.0)
    code = far.code
    far.release()
    return code, log.getvalue().decode()


@pytest.mark.parametrize("shell", SHELLS)
@settings(max_examples=10, deadline=None)
@given(
    words=st.lists(WORDS, max_size=5),
    folder=WORDS.filter(lambda each: each.strip() and each[0] != "~"),
    bundle=st.just("-----BEGIN\n$HOME `id`\n-----END\n"),
)
def test_words_reach_the_other_machine_unchanged(shell: str, words: list[str], folder: str, bundle: str) -> None:
    show = "import json, sys; print(json.dumps([sys.argv[1:-2], open(sys.argv[-2]).read()])); sys.exit(7)"
    script = ssh_hosts.script([sys.executable, "-c", show, folder], words, last=["last"], bundle=bundle, name="far")
    script = script.replace(" -- last", " last")
    code, output = heard(shell, script)
    assert code == 7, output
    assert json.loads(output) == [[folder, *words, "--keys"], bundle]


@pytest.mark.parametrize(
    ("path", "word"),
    [
        ("~", "~"),
        ("~/a b", "~/'a b'"),
        ("~anna/x", "~anna/x"),
        ("~+/x", "'~+/x'"),
        ("~$(x)/y", "'~$(x)/y'"),
        ("a;b", "'a;b'"),
        ("", "''"),
    ],
)
def test_only_a_tilde_is_expanded(path: str, word: str) -> None:
    assert ssh_hosts.path(path) == word


SCALARS = st.booleans() | st.integers(-(2**60), 2**60) | st.floats(allow_nan=False, allow_infinity=False) | WORDS
VALUES = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(WORDS, inner, max_size=3), max_leaves=5
)


@given(VALUES)
def test_a_value_is_read_back_as_it_was_written(value: Any) -> None:
    with contextlib.suppress(VcmvspError):
        assert settings_of([f"key={toml_line(value)}"]) == {"key": value}
