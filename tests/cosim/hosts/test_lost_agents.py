"""Failed agents and lost hosts in runs that continue without them: motion of their vehicles, and what is recorded."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

import vcmvsp
from tests.support.cosim.memory_links import behind_the_wire
from tests.support.cosim.run_processes import Stage, exit_of, output_at_exit, read_until, wait_for
from vcmvsp.cosim.clock import SECOND_NS, Ticks
from vcmvsp.cosim.hosts import protocol
from vcmvsp.cosim.metrics.agents import agent_metrics
from vcmvsp.cosim.types import Presence

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

AGENTS = '''
import os, signal, sys
from vcmvsp import Agent, Follows, Velocity

class Failing(Agent):
    """Drives on at 0.5 m/s, counts its ticks, and at ``at`` seconds does what ``how`` says."""
    def __init__(self, how: str = "fine", at: float = 1.0, once: str = "") -> None:
        self.how, self.at, self.once, self.acted = how, at, once, 0

    def act(self, obs, radio):
        self.acted += 1
        self.follows = Follows(leader="car1", slot=(-2.0, 0.0)) if obs.vehicle != "car1" else None
        if obs.time_s >= self.at and not (self.once and os.path.exists(self.once)):
            if self.once:
                open(self.once, "w").close()
            if self.how == "raise": raise RuntimeError("lost my way")
            if self.how == "kill": os.kill(os.getpid(), signal.SIGKILL)
            if self.how == "stop": os.kill(os.getpid(), signal.SIGSTOP)
            if self.how == "nan": return Velocity(linear=(float("nan"), 0.0, 0.0))
        if self.once and self.acted > 13:
            open(self.once + " and on", "w").close()
        radio.send(acted=self.acted)
        return Velocity(linear=(0.5, 0.0, 0.0))
'''
SCENARIO: dict[str, Any] = {
    "name": "losing",
    "duration_s": 5.0,
    "physics": {"kind": "kinematic"},
    "radio": {"preset": "ideal"},
    "agents": {"kind": "failing.py:Failing", "period_s": 0.1, "deadline_s": 30.0},
    "vehicles": {"kind": "kinematic"},
    "vehicle": [
        {"name": "car1", "agent": {}},
        {"name": "car2", "pose": [-2.0, 1.0, 0.0], "agent": {"how": "fine"}},
        {"name": "car3", "pose": [-2.0, -1.0, 0.0], "agent": {"how": "fine"}},
    ],
}
FINE = {"late": 0, "missed": 0, "reconnects": 0, "lost_s": 0.0}


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    import tomli_w

    (tmp_path / "failing.py").write_text(AGENTS)
    path = tmp_path / "losing.toml"
    path.write_text(tomli_w.dumps(SCENARIO))
    return path


def travelled(result: vcmvsp.Result, vehicle: str) -> float:
    """Distance along x, m."""
    x = result.states.filter(pc.field("vehicle") == vehicle)["x"].to_numpy()
    return float(x[-1] - x[0])


def presences(folder: Path) -> list[tuple[str, float, dict[str, Any]]]:
    """Records of lost and returned agents: topic, time in s, content."""
    with (folder / "run.mcap").open("rb") as stream:
        return [
            (channel.topic, message.log_time / SECOND_NS, json.loads(message.data))
            for _, channel, message in make_reader(stream).iter_messages()
            if channel.topic.endswith("/host")
        ]


@pytest.mark.parametrize("latency_s", [0.0, 0.25])
@pytest.mark.parametrize(
    ("how", "policy", "hold_s"), [("raise", "hold", 0.0), ("nan", "hold", 1.5), ("raise", "hold", 60.0), ("nan", "remove", 1.5)]
)
def test_an_agent_that_fails_leaves_the_same_bytes_wherever_it_runs(
    how: str, policy: str, hold_s: float, latency_s: float, scenario: Path, tmp_path: Path
) -> None:
    """Its last command holds for ``hold_s``, then its vehicle stands still; other vehicles continue."""
    settings = {"agents.on_lost": policy, "agents.hold_s": hold_s, "agents.latency_s": latency_s, "vehicle.car2.agent.how": how}
    here = vcmvsp.run(scenario, set=settings, out=tmp_path / "here")
    effective_hold_s = min(hold_s if policy == "hold" else 0.0, 4.0)
    # Commands of 0 to 0.9 s take effect a latency later; the one of 1 s failed; a hold ends at a tick.
    drives_s = min(1.0 + np.ceil(effective_hold_s / 0.1 - 1e-9) * 0.1, 5.0 - latency_s)
    assert travelled(here, "car2") == pytest.approx(0.5 * drives_s, abs=1e-9)
    assert travelled(here, "car3") == pytest.approx(0.5 * (5.0 - latency_s), abs=1e-9)
    assert here.metrics["agents"] == {
        "car1": FINE,
        "car2": {"late": 0, "missed": 40, "reconnects": 0, "lost_s": 4.0},
        "car3": FINE,
    }
    assert sum(1 for sender in here.radio["sender"].to_pylist() if sender == "car2") == 2 * 10  # ten frames, two receivers each
    follows = [each for each in here.follows if each.vehicle == "car2"]
    assert [each.follows.leader for each in follows] == (["car1"] if policy == "hold" else ["car1", None])
    (event,) = presences(tmp_path / "here")
    assert (event[0], event[1]) == ("car2/host", 1.0 + latency_s)
    assert event[2]["state"] == ("lost" if policy == "hold" else "removed")
    assert event[2]["since_ns"] == SECOND_NS
    places = [tmp_path / "encoded"]
    with behind_the_wire():
        vcmvsp.run(scenario, set=settings, out=places[0])
    if latency_s:
        places.append(tmp_path / "process")
        vcmvsp.run(scenario, set=settings, agents="process", out=places[1])
    for there in places:
        for name in ("run.mcap", "states.parquet", "radio.parquet", "metrics.json", "scenario.toml"):
            assert (there / name).read_bytes() == (tmp_path / "here" / name).read_bytes(), name
    again = vcmvsp.run(tmp_path / "here" / "scenario.toml")
    assert again.metrics == here.metrics


@pytest.mark.parametrize("policy", ["hold", "remove"])
def test_a_killed_host_costs_the_run_only_its_vehicles(policy: str, scenario: Path, tmp_path: Path) -> None:
    """Every bit of the result equals that of an agent that raises at the same tick, except for the reason."""
    settings = {"agents.on_lost": policy, "vehicle.car2.agent.how": "kill"}
    killed = vcmvsp.run(scenario, set=settings, agents="process", out=tmp_path / "killed")
    raised = vcmvsp.run(scenario, set={**settings, "vehicle.car2.agent.how": "raise"})
    assert killed.states.equals(raised.states)
    assert killed.radio.equals(raised.radio)
    assert killed.metrics["agents"] == raised.metrics["agents"]
    assert killed.metrics["agents"]["car2"]["missed"] == 40
    assert [each[2]["why"] for each in presences(tmp_path / "killed")] == ["was killed by SIGKILL"]


def test_a_killed_host_loses_its_pending_answers(scenario: Path, tmp_path: Path) -> None:
    """With a latency, answers may be on the way when it is killed; all from the first missing one are lost."""
    settings = {"agents.on_lost": "remove", "agents.latency_s": 0.25, "vehicle.car2.agent.how": "kill"}
    killed = vcmvsp.run(scenario, set=settings, agents="process", out=tmp_path / "killed")
    ((_, at_s, presence),) = presences(tmp_path / "killed")
    assert 0.7 <= presence["since_ns"] / SECOND_NS <= 1.0
    assert at_s == pytest.approx(presence["since_ns"] / SECOND_NS + 0.25)
    assert killed.metrics["agents"]["car2"]["missed"] == round(50 - presence["since_ns"] / 1e8)
    assert travelled(killed, "car2") == pytest.approx(0.5 * presence["since_ns"] / SECOND_NS)
    assert killed.metrics["agents"]["car1"] == killed.metrics["agents"]["car3"] == FINE


def test_one_vehicle_that_must_not_be_lost_ends_the_run(scenario: Path) -> None:
    settings = {"agents.on_lost": "hold", "vehicle.car3.agent.on_lost": "stop", "vehicle.car2.agent.how": "kill"}
    with pytest.raises(vcmvsp.AgentError, match="vehicles car1, car2, car3: was killed by SIGKILL") as caught:
        vcmvsp.run(scenario, set={**settings, "agents.processes": 1}, agents="process")
    assert caught.value.result.metrics["agents"]["car2"] == {**FINE, "missed": 1}


class ByHand(Stage):
    """The scenario with car2 on a manually started host."""

    def __init__(self, folder: Path, scenario: Path) -> None:
        super().__init__(folder)
        self._scenario = scenario
        self.open_to: list[str] = []  # --insecure: to all users

    def run(self, *settings: str) -> subprocess.Popen[str]:
        elsewhere = ["vehicle.car2.agent.runs=zenoh", "agents.on_lost=hold", "agents.deadline_s=2.0"]
        more = ["duration_s=3600", *elsewhere, *settings]
        sets = [word for setting in more for word in ("--set", setting)]
        return self.start(
            "run", str(self._scenario), "--out", "out", "--listen", self.endpoint, "--realtime", *sets, *self.open_to
        )

    def host(self, *more: str) -> subprocess.Popen[str]:
        folder = str(self._scenario.parent)
        return self.start("agent", "--vehicle", "car2", "--connect", self.endpoint, "--folder", folder, *more, *self.open_to)

    def finish(self, run: subprocess.Popen[str]) -> tuple[str, dict[str, Any], list[tuple[str, float, dict[str, Any]]]]:
        """End a run by Ctrl-C: its output, the metrics of car2, and the records of `presences`."""
        run.send_signal(signal.SIGINT)
        output = output_at_exit(130, run)
        return output, self.written()["agents"]["car2"], presences(self.out)


@pytest.fixture
def stage(scenario: Path, tmp_path: Path) -> Iterator[ByHand]:
    with ByHand(tmp_path, scenario) as made:
        yield made


def test_another_host_may_take_the_place_of_one_that_was_killed(stage: ByHand) -> None:
    run, first = stage.run(), stage.host()
    wait_for(stage.out / "run.mcap")
    first.kill()
    read_until(run, "car2 has lost its agent")
    second = stage.host()
    read_until(run, "car2 has its agent again")
    _, metrics, events = stage.finish(run)
    assert exit_of(second)[0] == 0
    assert metrics["reconnects"] == 1
    assert (metrics["late"], metrics["missed"] > 0) == (0, True)
    assert [each[2]["state"] for each in events] == ["lost", "back"]
    (unrepeatable,) = stage.written("about.json")["unrepeatable"]
    assert unrepeatable.startswith(f"the host of car2 was lost at {events[0][2]['since_ns'] / SECOND_NS:g} s: ")
    assert metrics["lost_s"] == pytest.approx((events[1][2]["since_ns"] - events[0][2]["since_ns"]) / SECOND_NS)
    assert metrics["missed"] == round(metrics["lost_s"] / 0.1)


def test_a_host_that_hangs_continues_with_its_state(stage: ByHand) -> None:
    """The agent keeps its state and continues to count. Its answer after the deadline does not count."""
    run = stage.run("vehicle.car2.agent.how=stop", f"vehicle.car2.agent.once={stage.folder / 'stopped'}")
    host = stage.host()
    read_until(run, "car2 has lost its agent: did not answer within the deadline of 2 s")
    host.send_signal(signal.SIGCONT)
    read_until(run, "car2 has its agent again")
    wait_for(stage.folder / "stopped and on")
    _, metrics, events = stage.finish(run)
    assert exit_of(host)[0] == 0
    assert (metrics["late"], metrics["reconnects"]) == (1, 1)
    assert metrics["missed"] == round(metrics["lost_s"] / 0.1) >= 1
    assert [each[2]["state"] for each in events] == ["lost", "back"]
    with (stage.out / "run.mcap").open("rb") as stream:
        counts = [
            json.loads(message.data)["body"]["acted"]
            for _, channel, message in make_reader(stream).iter_messages(topics=["car2/send"])
        ]
    # 10 ticks before; the answer to the eleventh came too late; the next is the twelfth.
    assert counts[9:11] == [10, 12]
    assert counts == sorted(set(counts))


def test_a_removed_agent_does_not_return(stage: ByHand) -> None:
    run = stage.run("agents.on_lost=remove")
    first = stage.host()
    wait_for(stage.out / "run.mcap")
    first.kill()
    read_until(run, "car2 is without an agent for good")
    output = output_at_exit(2, stage.host())
    assert "the run rejects this host: it has started, and no host is missing" in output
    _, metrics, events = stage.finish(run)
    assert metrics["reconnects"] == 0
    assert [each[2]["state"] for each in events] == ["removed"]


def test_a_run_refuses_unusable_hosts(stage: ByHand) -> None:
    """A second host for a vehicle, one of another version, and one whose run was replaced by another at the same address."""
    stage.open_to = ["--insecure"]
    run, first = stage.run(), stage.host()
    wait_for(stage.out / "run.mcap")
    code, output = exit_of(stage.host())
    assert (code, "it has started, and no host is missing" in output) == (2, True)
    run.kill()
    exit_of(run)
    other = stage.start(
        "run", "formation-circle", "--listen", stage.endpoint, "--agents", "zenoh", "--insecure", "--out", "other"
    )
    output = output_at_exit(3, first)
    assert "the run: is gone: another run listens there now; start this host again" in output
    older = "import vcmvsp.agents.host_process as serve; serve.PROTOCOL = 1\n"
    older += f"serve.host('{stage.endpoint}', ('car2',), insecure=True)"
    process = subprocess.run([sys.executable, "-c", older], check=False, capture_output=True, text=True, timeout=500)
    refusal = f"speaks protocol {protocol.PROTOCOL}, the host 1: use the same vcmvsp version"
    assert refusal in process.stderr
    other.send_signal(signal.SIGINT)
    assert refusal in exit_of(other)[1]


tick_times = st.integers(0, 30)


@given(st.lists(tick_times, unique=True, max_size=8).map(sorted), st.integers(1, 30), st.integers(1, 7))
def test_missed_ticks_are_counted_exactly(changes: list[int], end: int, per: int) -> None:
    """Compared with a loop over all ticks."""
    train, second = Ticks(SECOND_NS, per), SECOND_NS
    news, there = list[tuple[str, Presence]](), True
    for change in changes:
        news.append(("car1", Presence(state="lost" if there else "back", since_ns=change * second, late=0 if there else 1)))
        there = not there
    end = max([end, *changes])
    found = agent_metrics(news, {"car1": train}, end * second, end * second)["car1"]
    missed = 0
    for number in range(end * per):
        past = [change for change in changes if change * second <= train.at(number)]
        missed += len(past) % 2
    assert found["missed"] == missed
    assert found["late"] == found["reconnects"] == len(changes) // 2
    moments = [*changes, end] if len(changes) % 2 else changes
    assert found["lost_s"] == sum(back - lost for lost, back in zip(moments[::2], moments[1::2], strict=True))


def test_a_host_that_cannot_start_costs_the_run_only_its_vehicle(stage: ByHand) -> None:
    """Another host may come late, with the same class from its own folder, but without other parameters."""
    run, bad = stage.run("agents.join_timeout_s=2.0"), stage.host("nobody.py:Nobody")
    code, output = exit_of(bad)
    assert (code, "nobody.py" in output) == (2, True)
    read_until(run, "the host of car2 did not join within 2 s (agents.join_timeout_s); the run starts without")
    read_until(run, "car2 has lost its agent: it has no host yet")
    code, output = exit_of(stage.host("--set", "at=7.0"))
    assert (code, "accepts no other parameters: leave out --set" in output) == (2, True)
    elsewhere = stage.folder / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "failing.py").write_text(AGENTS)
    stage.folder = elsewhere
    late = stage.start("agent", "failing.py:Failing", "--vehicle", "car2", "--connect", stage.endpoint)
    read_until(run, "car2 has its agent again")
    _, metrics, _ = stage.finish(run)
    assert exit_of(late)[0] == 0
    assert metrics["reconnects"] == 1
    assert metrics["missed"] > 0


def test_a_host_that_was_stopped_while_its_run_ended_ends_too(stage: ByHand) -> None:
    run, host = stage.run("agents.join_timeout_s=1.0"), stage.host()
    wait_for(stage.out / "run.mcap")
    read_until(host, "joined")  # maybe after the start of the run
    host.send_signal(signal.SIGSTOP)
    stage.finish(run)
    host.send_signal(signal.SIGCONT)
    code, output = exit_of(host)
    # It may first read the farewell sent meanwhile, or first detect the closed link.
    assert (code, "is gone" in output) in {(0, False), (3, True)}


def test_a_failed_agent_does_not_return_with_its_host(stage: ByHand) -> None:
    """Later its host hangs and returns; the agent does not."""
    more = ("vehicle.car2.agent.how=raise", "vehicle.car2.agent.at=0.3", "agents.deadline_s=1.0")
    run, host = stage.run(*more), stage.host()
    read_until(run, "car2 has lost its agent: raised RuntimeError: lost my way")
    host.send_signal(signal.SIGSTOP)
    time.sleep(1.5)
    host.send_signal(signal.SIGCONT)
    time.sleep(0.5)  # it continues before the run ends
    _, metrics, events = stage.finish(run)
    assert exit_of(host)[0] == 0
    assert [each[2]["state"] for each in events] == ["lost"]
    assert metrics["reconnects"] == 0
    assert metrics["missed"] - round(metrics["lost_s"] / 0.1) in (0, 1)  # the run may end at a tick
    assert metrics["missed"] > 0
