"""Scenario and seed determine every byte of a run, for any place of the agents and any load of the machine."""

import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vcmvsp
from tests.support.cosim.command_line import contents
from tests.support.cosim.memory_links import behind_the_wire
from tests.support.cosim.run_processes import VCMVSP
from tests.support.netsim.gateway_context import free_ports
from tests.support.waiting import wait_for
from vcmvsp.agents.formation.followers.leader_follower import LeaderFollower
from vcmvsp.agents.formation.leaders.trajectory import Trajectory

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

TABLES = frozenset(  # of which pictures and reports are made
    ("scenario.toml", "run.mcap", "radio.parquet", "states.parquet", "errors.parquet", "metrics.json")
)
NAMES = TABLES | {"trajectory.png", "formation_error.png", "report.html"}
SHORT = {"duration_s": 4.0, "metrics.from_s": 2.0}  # three p2dx in Bullet; with loss and jitter


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Files of the run with all agents in this process, by name."""
    folder = tmp_path_factory.mktemp("reference")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VCMVSP_FIGURES", "1")
        vcmvsp.run("formation-circle", set=SHORT, out=folder)
    left = contents(folder)
    assert set(left) == NAMES
    return left


def assert_same(folder: Path, reference: dict[str, bytes], names: frozenset[str] = TABLES) -> None:
    left = contents(folder)
    assert names <= set(left) <= NAMES
    assert [name for name in names if left[name] != reference[name]] == []


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VCMVSP_FIGURES", "1")


@pytest.mark.usefixtures("drawn")
def test_twice_in_one_process_and_saved_later(reference: dict[str, bytes], tmp_path: Path) -> None:
    np.random.seed(5)  # noqa: NPY002  what others do to the global generator must not matter
    first = vcmvsp.run("formation-circle", set=SHORT)
    np.random.random(7)  # noqa: NPY002
    vcmvsp.run("formation-circle", set={**SHORT, "physics.kind": "kinematic"}, seed=3)
    assert_same(first.save(tmp_path / "first"), reference, NAMES)


def test_another_seed_is_another_run(reference: dict[str, bytes], tmp_path: Path) -> None:
    left = contents(vcmvsp.run("formation-circle", set=SHORT, seed=2).save(tmp_path / "seed2"))
    assert {name for name in TABLES if left[name] != reference[name]} == TABLES


def test_the_resolved_scenario_gives_the_run_again(reference: dict[str, bytes], tmp_path: Path) -> None:
    resolved = tmp_path / "scenario.toml"
    resolved.write_bytes(reference["scenario.toml"])
    vcmvsp.run(resolved, out=tmp_path / "again")
    assert_same(tmp_path / "again", reference)


def test_behind_the_bytes_of_the_wire(reference: dict[str, bytes], tmp_path: Path) -> None:
    with behind_the_wire():
        vcmvsp.run("formation-circle", set=SHORT, agents="inprocess", out=tmp_path / "out")
    assert_same(tmp_path / "out", reference)


@pytest.mark.parametrize("processes", [1, 3])
def test_in_processes(processes: int, reference: dict[str, bytes], tmp_path: Path) -> None:
    vcmvsp.run("formation-circle", set={**SHORT, "agents.processes": processes}, agents="process", out=tmp_path / "out")
    assert_same(tmp_path / "out", reference)


@pytest.fixture
def busy() -> Iterator[None]:
    """A busy loop on every core."""
    spinning = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(os.cpu_count() or 1)]
    yield
    for process in spinning:
        process.kill()
        process.wait()


@pytest.mark.usefixtures("busy")
def test_on_a_busy_machine(reference: dict[str, bytes], tmp_path: Path) -> None:
    vcmvsp.run("formation-circle", set={**SHORT, "agents.processes": 2}, agents="process", out=tmp_path / "out")
    assert_same(tmp_path / "out", reference)


@pytest.mark.usefixtures("drawn")
def test_with_another_hash_seed(reference: dict[str, bytes], tmp_path: Path) -> None:
    out = tmp_path / "out"
    settings = [f"--set={key}={value}" for key, value in SHORT.items()]
    command = [*VCMVSP, "run", "formation-circle", *settings, "--out", str(out), "--quiet"]
    subprocess.run(command, check=True, timeout=500, env={**os.environ, "PYTHONHASHSEED": "12345"})
    assert_same(out, reference, NAMES)


@pytest.mark.parametrize("latency_s", [0.05, 0.25])
def test_with_latency_below_and_above_the_period(latency_s: float, reference: dict[str, bytes], tmp_path: Path) -> None:
    """At t the kernel does not wait for commands due at t + latency; the results are equal."""
    settings = {**SHORT, "physics.kind": "kinematic", "agents.latency_s": latency_s, "agents.processes": 2}
    vcmvsp.run("formation-circle", set=settings, agents="inprocess", out=tmp_path / "inprocess")
    vcmvsp.run("formation-circle", set=settings, agents="process", out=tmp_path / "process")
    with behind_the_wire():
        vcmvsp.run("formation-circle", set=settings, agents="inprocess", out=tmp_path / "encoded")
    here = contents(tmp_path / "inprocess")
    assert here["states.parquet"] != reference["states.parquet"]
    assert_same(tmp_path / "encoded", here)
    assert_same(tmp_path / "process", here)


def test_agents_as_objects(reference: dict[str, bytes], tmp_path: Path) -> None:
    """Agents built here with equal parameters replace those of the scenario; both kinds may be mixed."""
    leader, follower = Trajectory("circle", 0.3, 0.15), LeaderFollower("car1", 1.0, 30.0)
    vcmvsp.run("formation-circle", set=SHORT, agents={"car1": leader, "car2": follower}, out=tmp_path / "out")
    left = contents(tmp_path / "out")
    assert {name for name in TABLES if left[name] != reference[name]} <= {"scenario.toml"}


def test_hosts_started_by_hand(reference: dict[str, bytes], tmp_path: Path) -> None:
    """Two hosts in other processes, one started before the run and one after it; the first serves two vehicles."""
    endpoint = f"tcp/127.0.0.1:{free_ports(1, socket.SOCK_STREAM)}"
    logs = [(tmp_path / name).open("w+") for name in ("early.txt", "late.txt")]

    def host(log: Any, *vehicles: str) -> subprocess.Popen[str]:
        names = [word for vehicle in vehicles for word in ("--vehicle", vehicle)]
        return subprocess.Popen([*VCMVSP, "agent", *names, "--connect", endpoint], stderr=log, text=True)

    started = [host(logs[0], "car1", "car3")]
    lines: list[str] = []

    def tell(text: str) -> None:
        lines.append(text)
        if len(lines) == 4:  # the address, and a line for each vehicle
            started.append(host(logs[1], "car2"))

    try:
        wait_for(lambda: (tmp_path / "early.txt").stat().st_size > 0, 500.0)
        vcmvsp.run("formation-circle", set=SHORT, agents="zenoh", listen=endpoint, tell=tell, out=tmp_path / "out")
        assert [process.wait(timeout=500) for process in started] == [0, 0]
    finally:
        for process in started:
            process.kill()
            process.wait()
        for log in logs:
            log.close()
    assert_same(tmp_path / "out", reference)
    assert set(json.loads((tmp_path / "out" / "about.json").read_text())["agents"].values()) == {"zenoh"}
