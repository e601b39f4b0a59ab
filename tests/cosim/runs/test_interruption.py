"""Files of a cut run: a recording that begins like the whole one, and no other traces."""

import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import vcmvsp
from tests.support.cosim.studies import two
from vcmvsp.cosim.errors import AgentError, Interrupted
from vcmvsp.cosim.recording.mcap_reader import messages
from vcmvsp.cosim.runs.figures import Draws
from vcmvsp.cosim.runs.result import Result

pytestmark = pytest.mark.processes

FOLLOWS = {"kind": "leader_follower", "leader": "car1"}
FAILING = """
from vcmvsp import Agent, Velocity

class Failing(Agent):
    def __init__(self, at_s: float = 99.0) -> None:
        self.at_s = at_s

    def act(self, obs, radio):
        if obs.time_ns >= self.at_s * 1e9:
            raise RuntimeError
        return Velocity(linear=(0.1, 0.0, 0.0))
"""


def team(folder: Path, at_s: float) -> dict[str, Any]:
    """A leader, followers, and between them an agent that fails at ``at_s``."""
    (folder / "failing.py").write_text(FAILING)
    failing = {"kind": f"{folder / 'failing.py'}:Failing", "at_s": at_s}
    cars = [{"name": f"car{number}", "pose": [-float(number), 0.0, 0.0], "agent": FOLLOWS} for number in range(2, 6)]
    cars[1] = {**cars[1], "agent": failing}
    leader = {"name": "car1", "agent": {"kind": "trajectory", "path": "slalom"}}
    return two(
        duration_s=1.0, world={"kind": "empty", "targets": [{"name": "x", "way": [[0.0, 5.0], [4.0, 5.0]], "speed": 0.5}]}
    ) | {"vehicle": [leader, *cars]}


def recorded_messages(folder: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Messages of each topic except the log."""
    topics: dict[str, list[tuple[int, bytes]]] = {}
    with (folder / "run.mcap").open("rb") as stream:
        for topic, time_ns, data in messages(stream):
            topics.setdefault(topic, []).append((time_ns, data))
    del topics["log"]
    return topics


@pytest.mark.usefixtures("figures")
@pytest.mark.parametrize("at_s", [0.0, 0.5])
def test_the_recording_of_a_cut_run_is_the_beginning_of_the_whole_one(at_s: float, tmp_path: Path) -> None:
    vcmvsp.run(team(tmp_path, 99.0), out=tmp_path / "whole")
    with pytest.raises(AgentError):
        vcmvsp.run(team(tmp_path, at_s), out=tmp_path / "cut")
    whole, cut = recorded_messages(tmp_path / "whole"), recorded_messages(tmp_path / "cut")
    presences = cut.pop("car3/host", [])
    assert len(presences) <= 1
    for topic, beginning in cut.items():
        assert whole[topic][: len(beginning)] == beginning, topic
    assert ("world/scene" in cut) == (at_s > 0.0)


KILLED = """
import os, signal, sys, tempfile
tempfile.tempdir = sys.argv[1]
from vcmvsp.cosim.processes import fork_server
fork_server.ForkServer = lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL)
import vcmvsp
vcmvsp.run("formation-circle", agents="process")
"""


def test_a_run_that_is_killed_before_its_children_have_joined_leaves_nothing(tmp_path: Path) -> None:
    killed = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], stderr=subprocess.DEVNULL, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("figures")
def test_ctrl_c_during_writing_is_reported_and_files_are_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write, lines = Result.write, list[str]()

    def interrupted(result: Result, folder: Path, draw: Draws) -> None:
        signal.raise_signal(signal.SIGINT)
        write(result, folder, draw)

    monkeypatch.setattr(Result, "write", interrupted)
    vcmvsp.run(two(), out=tmp_path / "run", tell=lines.append)
    words = f"run.mcap in {tmp_path / 'run'} is whole"
    assert lines == [f"the run has ended and its files are being written; another Ctrl-C stops that: {words}"]
    assert (tmp_path / "run" / "report.html").exists()


@pytest.mark.usefixtures("figures")
def test_ctrl_c_twice_during_writing_leaves_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(result: Result, folder: Path, draw: Draws) -> None:
        for _ in range(2):
            signal.raise_signal(signal.SIGINT)

    vcmvsp.run(two(), out=tmp_path / "whole")
    monkeypatch.setattr(Result, "write", interrupted)
    words = f"interrupted while the files of the run were written: run.mcap in {tmp_path / 'run'} is whole"
    with pytest.raises(Interrupted) as error:
        vcmvsp.run(two(), out=tmp_path / "run")
    assert str(error.value) == words
    assert (tmp_path / "run" / "run.mcap").read_bytes() == (tmp_path / "whole" / "run.mcap").read_bytes()
