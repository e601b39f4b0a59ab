"""However a run ends: one error, the right exit code, in time, nothing left behind, a readable recording."""

import contextlib
import json
import os
import signal
from pathlib import Path

import psutil
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader

from tests.support.cosim.command_line import vcmvsp_command
from tests.support.cosim.run_processes import Stage, output_at_exit, staged, wait_for
from tests.support.cosim.secure_hub import until

pytestmark = pytest.mark.processes

AGENTS = '''
import os, signal, sys, time
from vcmvsp import Agent, Velocity

class Failing(Agent):
    """Drives on, and at ``at`` seconds does what ``how`` says."""
    def __init__(self, how: str, at: float = 1.0) -> None:
        self.how, self.at = how, at

    def act(self, obs, radio):
        radio.send(x=obs.state.position[0])
        if obs.time_s >= self.at:
            {"raise": self.crash, "exit": self.leave, "kill": self.killed, "hang": self.sleep, "stop": self.stopped,
             "nan": lambda: None, "junk": lambda: None, "fine": self.tell}[self.how]()
        if obs.time_s >= self.at and self.how == "junk":
            return "forward"
        return Velocity(linear=(float("nan") if self.how == "nan" and obs.time_s >= self.at else 0.3, 0.0, 0.0))

    def crash(self): raise RuntimeError("lost my way")
    def leave(self): os._exit(7)
    def killed(self): os.kill(os.getpid(), signal.SIGKILL)
    def stopped(self): os.kill(os.getpid(), signal.SIGSTOP)
    def sleep(self): time.sleep(600)
    def tell(self): open(os.path.join(os.path.dirname(__file__), "got there"), "w").close()
'''
SCENARIO = """
name = "failing"
duration_s = {duration}
[physics]
kind = "kinematic"
[agents]
deadline_s = {deadline}
[[vehicle]]
name = "car1"
kind = "kinematic"
agent = {{ kind = "failing.py:Failing", how = "fine" }}
[[vehicle]]
name = "car2"
kind = "kinematic"
pose = [3.0, 0.0, 0.0]
agent = {{ kind = "failing.py:Failing", how = "{how}" }}
"""
MARK = "VCMVSP_TEST_FOLDER"  # a variable in the environment of all processes of a run
stage = staged(Stage)


def write(folder: Path, how: str, duration: float = 5.0) -> Path:
    (folder / "failing.py").write_text(AGENTS)
    scenario = folder / "failing.toml"
    deadline = 1.0 if how in ("hang", "stop") else 30.0
    scenario.write_text(SCENARIO.format(how=how, duration=duration, deadline=deadline))
    return scenario


def assert_readable(out: Path, until_s: float, tick_s: float = 0.0) -> dict[str, object]:
    """All files of the run can be read and reach the instant of the failure; states may end ``tick_s`` before it."""
    with (out / "run.mcap").open("rb") as stream:
        messages = [(channel.topic, message.log_time) for _, channel, message in make_reader(stream).iter_messages()]
    times, errors = [when for _, when in messages], [topic for topic, _ in messages if topic == "log"]
    assert max(times) >= until_s * 1e9
    states = pq.read_table(out / "states.parquet")
    assert states["time_ns"].to_numpy().max() == pytest.approx(until_s * 1e9, abs=1e3 + tick_s * 1e9)
    assert pq.read_table(out / "radio.parquet").num_rows > 0
    assert errors
    return json.loads((out / "about.json").read_text())


CAUSES = {
    "raise": "raised RuntimeError: lost my way (failing.py line",
    "nan": "returned a command that is not finite",
    "junk": "returned 'forward' from act(); it must return a Velocity",
    "exit": "ended with exit code 7",
    "kill": "was killed by SIGKILL",
    "hang": "did not answer within the deadline of 1 s",
    "stop": "did not answer within the deadline of 1 s",
}


@pytest.mark.parametrize(
    ("how", "where"), [(how, "process") for how in CAUSES] + [(how, "inprocess") for how in ("raise", "nan", "junk")]
)
def test_a_failing_agent_ends_the_run_with_one_error(how: str, where: str, stage: Stage) -> None:
    scenario = write(stage.folder, how)
    mark = f"{MARK}={stage.folder}"
    run = stage.start("run", scenario.name, "--agents", where, "--out", "out", more={MARK: str(stage.folder)})
    errors_said = output_at_exit(3, run)
    errors = [line for line in errors_said.splitlines() if line.startswith("vcmvsp: ")]
    assert "vehicle car2" in errors[0]
    assert "failing.py:Failing" in errors[0]
    assert CAUSES[how] in errors[0]
    about = assert_readable(stage.out, 1.0)
    assert CAUSES[how] in str(about["error"])
    until(lambda: not [pid for pid in psutil.pids() if mark.encode() in environment_of(pid)])


@pytest.mark.parametrize("where", ["inprocess", "process"])
def test_ctrl_c_keeps_the_recording_and_leaves_no_process(where: str, stage: Stage) -> None:
    scenario = write(stage.folder, "fine", duration=3600.0)
    run = stage.start("run", scenario.name, "--agents", where, "--out", "out", "--realtime")
    wait_for(stage.folder / "got there")
    children = psutil.Process(run.pid).children(recursive=True)
    assert sum(not each.children() for each in children) == (2 if where == "process" else 0)
    os.killpg(run.pid, signal.SIGINT)
    errors = output_at_exit(130, run)
    assert "interrupted at" in errors
    assert not psutil.wait_procs(children, timeout=500)[1]
    about = json.loads((stage.out / "about.json").read_text())
    assert_readable(stage.out, about["simulated_s"], 0.1)
    assert about["lateness"]["instants"] > 0


def test_hosts_end_with_a_run_that_is_killed(stage: Stage) -> None:
    scenario = write(stage.folder, "fine", duration=3600.0)
    run = stage.start("run", scenario.name, "--agents", "process", "--out", "out", "--realtime")
    wait_for(stage.out / "run.mcap")
    children = psutil.Process(run.pid).children(recursive=True)
    assert sum(not each.children() for each in children) == 2
    run.kill()
    run.wait()
    assert not psutil.wait_procs(children, timeout=500)[1]


def test_a_host_that_cannot_build_its_agent_is_bad_input(tmp_path: Path) -> None:
    scenario = write(tmp_path, "fine")
    settings = ("--agents", "process", "--set", "vehicle.car2.agent.at=soon")
    outcome = vcmvsp_command("run", str(scenario), *settings, "--out", str(tmp_path / "out"))
    assert outcome.code == 2
    assert "vehicle.car2.agent.at: must be a number, not 'soon'" in outcome.err
    assert "--set vehicle.car2.agent.at=soon" in outcome.err
    assert not (tmp_path / "out").exists()


def environment_of(pid: int) -> bytes:
    """The environment with which a process was started; empty: it has ended, or is another user's."""
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/environ").read_bytes()
    return b""
