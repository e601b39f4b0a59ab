"""Manually started hosts: admission, their entries in the resolved scenario, and the end of hosts and run."""

import contextlib
import os
import socket
import subprocess
import tomllib
from pathlib import Path

import pytest

import vcmvsp
from tests.support.cosim.command_line import vcmvsp_command
from tests.support.cosim.run_processes import Stage, exit_of, output_at_exit, read_until, staged, wait_for
from tests.support.cosim.teams import FOLLOWER, team
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.transport.zenoh_session import threads

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

AGENTS = 'kind = "trajectory", path = "straight", runs = "inprocess"', FOLLOWER + ", k1 = 0.7"
STILL = """
from vcmvsp import Agent, Velocity

class Still(Agent):
    def __init__(self, leader: str = "nobody", patience: float = 1.0) -> None:
        self.leader, self.patience = leader, patience
    def act(self, obs, radio):
        return Velocity()
"""


class ByHand(Stage):
    """A scenario with car2 on a manually started host, and its processes."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        (folder / "still.py").write_text(STILL)

    def scenario(self, duration: float = 2.0, patience: float = 60.0, deadline: float = 30.0) -> Path:
        path = self.folder / "byhand.toml"
        times = {"join_timeout_s": patience, "deadline_s": deadline}
        path.write_text(team("byhand", *AGENTS, duration_s=duration, runs="zenoh", listen=self.endpoint, **times))
        return path

    def run(self, *more: str, **values: float) -> subprocess.Popen[str]:
        return self.start("run", str(self.scenario(**values)), "--out", str(self.out), *more)

    def host(self, *arguments: str, vehicle: str = "car2") -> subprocess.Popen[str]:
        return self.start("agent", *arguments, "--vehicle", vehicle, "--connect", self.endpoint)

    def resolved_agent(self) -> dict[str, object]:
        return tomllib.loads((self.out / "scenario.toml").read_text())["vehicle"][1]["agent"]


stage = staged(ByHand)


def test_parameters_of_a_host_are_in_the_result(stage: ByHand) -> None:
    run, host = stage.run(), stage.host("vcmvsp.agents.formation.followers.leader_follower:LeaderFollower", "--set", "k2=0.25")
    assert exit_of(run)[0] == 0
    code, output = exit_of(host)
    assert (code, output.splitlines()[-1]) == (0, "the run is over")
    agent = stage.resolved_agent()
    assert (agent["kind"], agent["k1"], agent["k2"]) == ("leader_follower", 0.7, 0.25)
    again = vcmvsp.run(str(stage.out / "scenario.toml"))
    assert again.metrics == vcmvsp.run(str(stage.scenario()), set={"vehicle.car2.agent.k2": 0.25}, agents="inprocess").metrics
    assert '"car2": "zenoh"' in (stage.out / "about.json").read_text()


def test_another_class_of_a_host_is_in_the_result(stage: ByHand) -> None:
    run, host = stage.run(), stage.host("still.py:Still", "--set", "patience=3.0")
    assert (exit_of(run)[0], exit_of(host)[0]) == (0, 0)
    agent = stage.resolved_agent()
    assert (agent["kind"], agent["leader"], agent["patience"]) == ("still.py:Still", "car1", 3.0)
    assert "k1" not in agent
    assert (stage.out / "still.py").read_text() == STILL  # the resolved scenario runs from its own folder
    moved = vcmvsp.run(str(stage.out / "scenario.toml")).states.to_pandas().query("vehicle == 'car2'")
    assert set(moved.x) == {-1.0}


def test_unknown_hosts_are_refused(stage: ByHand) -> None:
    run = stage.run()
    output = output_at_exit(2, stage.host(vehicle="car3"))
    assert "unknown vehicle 'car3'" in output
    output = output_at_exit(2, stage.host("leader_folower"))
    assert "did you mean 'leader_follower'" in output
    assert (exit_of(stage.host())[0], exit_of(run)[0]) == (0, 0)  # the run waits on for a valid host


def test_a_host_that_leaves_before_the_run_begins_can_be_replaced(stage: ByHand) -> None:
    run = stage.start("run", str(stage.scenario()), "--agents", "zenoh", "--out", str(stage.out), "--quiet")
    early = stage.host()
    read_until(early, "joined")
    early.kill()
    leader = stage.host(vehicle="car1")
    read_until(leader, "joined")  # complete but for the host that has left, which the run may not have detected yet
    later = stage.host()
    ends = [exit_of(each) for each in (run, later, leader)]
    assert [code for code, _ in ends] == [0, 0, 0], ends


def test_a_run_without_hosts_ends(stage: ByHand) -> None:
    output = output_at_exit(3, stage.run(patience=0.5))
    assert f"vcmvsp agent leader_follower --vehicle car2 --connect {stage.endpoint}" in output
    assert "agent host of vehicle car2: did not join within 0.5 s (agents.join_timeout_s)" in output
    assert not stage.out.exists()


def test_a_host_that_is_killed_ends_the_run(stage: ByHand) -> None:
    run, host = stage.run("--realtime", duration=3600.0, deadline=1.0), stage.host()
    wait_for(stage.out / "run.mcap")
    host.kill()
    code, output = exit_of(run)  # long before the end of the run, one hour
    assert code == 3
    assert "agent leader_follower of vehicle car2: did not answer within the deadline of 1 s: it left the run" in output
    assert (stage.out / "states.parquet").exists()


def test_a_run_that_is_killed_ends_the_host(stage: ByHand) -> None:
    run, host = stage.run("--realtime", duration=3600.0, deadline=1.0), stage.host()
    wait_for(stage.out / "run.mcap")
    run.kill()
    output = output_at_exit(3, host)
    assert "the run: is gone" in output


@pytest.mark.parametrize("users", [None, "(tx: (worker_threads: 2))"])
def test_thread_settings_are_temporary_and_the_users_win(users: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ZENOH_RUNTIME", raising=False)
    if users:
        monkeypatch.setenv("ZENOH_RUNTIME", users)
    with contextlib.suppress(UsageError), threads("(rx: (handover: acc))"):
        assert os.environ["ZENOH_RUNTIME"] == (users or "(rx: (handover: acc))")
        raise UsageError("cannot listen")
    assert os.environ.get("ZENOH_RUNTIME") == users


def test_endpoints_that_cannot_be_used_are_bad_input(stage: ByHand) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        code, _, err = vcmvsp_command("run", str(stage.scenario()), "--out", str(stage.out), "--listen", endpoint)
        assert code == 2
        assert "cannot listen on 'tcp/127.0.0.1:" in err
        assert "--listen" in err
    assert vcmvsp_command("agent", "--vehicle", "car2", "--connect", "nonsense").code == 2
