"""Examples of several machines in the READMEs, all on this one, with its own address and port."""

import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

import vcmvsp
from tests.support.cosim.command_line import contents, vcmvsp_command
from tests.support.cosim.run_processes import PROGRAM, VCMVSP, Stage, exit_of
from tests.support.docs.readme_pages import block, command
from tests.support.docs.readme_sessions import BRIEF, KEEP_GAP

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

HOSTS = """
connect = "tls/127.0.0.1:{port}"
[[host]]
vehicles = ["car1"]
copy = true
command = {command}
[[host]]
vehicles = ["car2"]
copy = true
command = {command}
"""


class Machines(Stage):
    """A folder with all files of the first page."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        for name, text in KEEP_GAP.items():
            (folder / name).write_text(text)

    def words(self, beginning: str) -> list[str]:
        """Arguments of the command with that beginning, with files and addresses of this machine."""
        here = re.sub(r"(192\.168\.1\.10|0\.0\.0\.0):7447", f"127.0.0.1:{self.port}", command(beginning))
        here = re.sub(r"--keys (car2\.keys)", r"--keys keys/\1", here)  # instead of a copy to car2
        return shlex.split(here)[1:]

    def do(self, beginning: str, more: str = "") -> str:
        """Run a command in this process."""
        code, out, err = vcmvsp_command(*self.words(beginning), *more.split())
        assert code == 0, f"{beginning}\n{out}\n{err}"
        return out


@pytest.fixture
def machines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Machines]:
    monkeypatch.chdir(tmp_path)
    with Machines(tmp_path) as made:
        made.do("vcmvsp keys init keys --name 192.168.1.10")
        yield made


def test_a_run_a_host_and_an_observer_with_certificates(machines: Machines) -> None:
    """The observer and the doctor connect while the run waits for its host."""
    machines.do("vcmvsp keys vehicle car2")
    machines.do("vcmvsp keys observer anna")
    run = machines.start(*machines.words("vcmvsp run gap.toml --set vehicle.car2"), *shlex.split(BRIEF))
    observer = machines.start(*machines.words("vcmvsp watch tls/192.168.1.10:7447 --keys anna.keys --topic"))
    assert observer.stderr is not None
    assert any("watching" in line for line in observer.stderr)
    machines.do("vcmvsp doctor --connect")
    host = machines.start(*machines.words("vcmvsp agent keep_gap.py"))
    assert [exit_of(each)[0] for each in (host, run, observer)] == [0, 0, 0]
    vcmvsp.run("gap.toml", set={"duration_s": 1.0}, out="alone")
    far, near = contents(machines.folder / "runs" / "gap-0"), contents(machines.folder / "alone")
    assert far["metrics.json"] == near["metrics.json"]


def test_hosts_started_with_the_run(machines: Machines) -> None:
    """The file of hosts has the keys of the README's, for this machine."""
    (machines.folder / "hosts.toml").write_text(HOSTS.format(port=machines.port, command=json.dumps(VCMVSP)))
    for key in re.findall(r"^(\w+) =", HOSTS, re.MULTILINE):
        assert f"{key} = " in block("cosim/deploy/README.md", "robot7")
    code, output = exit_of(machines.python(*PROGRAM, *machines.words("vcmvsp launch gap.toml"), *BRIEF.split()))
    assert code == 0, output
    out = machines.folder / "runs" / "gap-0"
    assert json.loads((out / "about.json").read_text())["agents"] == {"car1": "zenoh", "car2": "zenoh"}
    assert {path.name for path in (out / "hosts").iterdir()} == {"car1.log", "car2.log"}
    assert command("vcmvsp launch my_scenario") == command("vcmvsp launch gap").replace("gap", "my_scenario")


def test_a_watched_run(machines: Machines) -> None:
    out = machines.do("vcmvsp run formation-circle --realtime", BRIEF)
    assert "3 agents (process), 1 s simulated" in out
