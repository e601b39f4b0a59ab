"""Replay of a run with a real vehicle (a robot in software, on the wall clock, in its own process), without the vehicle."""

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

import vcmvsp
from tests.support.cosim.run_processes import VCMVSP
from tests.support.paths import ROOT
from vcmvsp.cosim.recording.external_inputs import read_inputs
from vcmvsp.cosim.runs.replay import replay

pytestmark = pytest.mark.processes

SCENARIO = """
name = "hybrid"
duration_s = {duration}
seed = 4
[physics]
kind = "kinematic"
[radio]
preset = "wifi-b-1"
loss = {{ kind = "bernoulli", probability = 0.3 }}
[[vehicle]]
name = "car1"
kind = "amigobot"
driver = {{ kind = "bench", jitter_s = 0.02, slip = 0.1 }}
agent = {{ kind = "trajectory", path = "circle", speed = 0.3 }}
[[vehicle]]
name = "car2"
kind = "p2dx"
pose = [-1.0, -0.5, 0.0]
agent = {{ kind = "leader_follower", leader = "car1" }}
"""
SAME = ("run.mcap", "metrics.json", "states.parquet", "radio.parquet", "scenario.toml", "hardware.mcap")


def scenario(folder: Path, duration: float) -> Path:
    path = folder / "hybrid.toml"
    path.write_text(SCENARIO.format(duration=duration))
    return path


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of 1.5 s."""
    folder = tmp_path_factory.mktemp("robot")
    vcmvsp.run(scenario(folder, 1.5), out=folder / "run")
    return folder / "run"


def files(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in SAME}


def test_an_unchanged_replay_is_equal_to_the_byte(recorded: Path, tmp_path: Path) -> None:
    """Also a replay of the replay."""
    first = replay(recorded, out=tmp_path / "again")
    assert first.about["lateness"] is None  # not paced by the wall clock
    assert files(tmp_path / "again") == files(recorded)
    assert replay(tmp_path / "again", agents="process", set={"agents.deadline_s": 20.0}).metrics == first.metrics
    assert first.metrics["hardware"]["car1"]["age_s"]["p50"] > 0.0


def test_its_twin_can_take_its_place(recorded: Path) -> None:
    twin = replay(recorded, twin=True, radio="recorded")
    assert "hardware" not in twin.metrics
    assert twin.metrics["radio"]["losses"] == replay(recorded).metrics["radio"]["losses"]


def test_a_killed_run_is_replayed_as_far_as_written(tmp_path: Path) -> None:
    command = [*VCMVSP, "run", str(scenario(tmp_path, 60.0)), "--out", str(tmp_path / "run"), "-q"]
    path, lines = tmp_path / "run" / "hardware.mcap", list[str]()
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, env=environment, cwd=tmp_path) as process:
        try:
            deadline = time.monotonic() + 60.0
            while not (path.is_file() and path.stat().st_size > 4000):
                assert process.poll() is None
                assert time.monotonic() < deadline
                time.sleep(0.05)
        finally:
            process.send_signal(signal.SIGKILL)
    end_ns = read_inputs(path)[-1][1]
    assert end_ns > 0
    again = replay(tmp_path / "run", set={"duration_s": 20.0}, tell=lines.append)
    assert lines[0].startswith(f"{path} is damaged (it is truncated)")
    assert lines[-1] == f"the recording ends at {end_ns / 1e9:.3f} s: car1 stands still from then on"
    assert again.metrics["duration_s"] == 20.0
