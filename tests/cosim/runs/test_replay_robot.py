"""Replay of a run with a real vehicle (a robot in software, on the wall clock, in its own process), without the vehicle."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vcmvsp
from tests.support.cosim.run_processes import Stage, wait_for
from tests.support.cosim.secure_hub import until
from vcmvsp.cosim.federate import Event
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
def events() -> list[Event]:
    """Of the recorded run."""
    return []


@pytest.fixture(scope="module")
def recorded(events: list[Event], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of 1.5 s."""
    folder = tmp_path_factory.mktemp("robot")
    vcmvsp.run(scenario(folder, 1.5), out=folder / "run", observe=events.append)
    return folder / "run"


def files(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in SAME}


def replayed(folder: Path, **changed: Any) -> list[Event]:
    """Events of a replay with changed keys."""
    events: list[Event] = []
    replay(folder, set=changed, observe=events.append, mcap=False)
    return events


def of(events: list[Event], prefix: str) -> list[Event]:
    return [each for each in events if each.key.startswith(prefix)]


def motion(events: list[Event]) -> dict[int, np.ndarray]:
    """Position and velocity of the robot by time, ns."""
    return {each.time_ns: np.array([each.value.position[0], each.value.velocity[0]]) for each in of(events, "world/states")}  # type: ignore[union-attr]


def test_an_unchanged_replay_is_equal_to_the_byte(recorded: Path, tmp_path: Path) -> None:
    """Also a replay of the replay."""
    first = replay(recorded, out=tmp_path / "again")
    assert first.about["lateness"] is None  # not paced by the wall clock
    assert files(tmp_path / "again") == files(recorded)
    assert replay(tmp_path / "again", agents="process", set={"agents.deadline_s": 20.0}).metrics == first.metrics
    assert first.metrics["hardware"]["car1"]["age_s"]["p50"] > 0.0


def test_a_replay_with_bodies_is_equal(tmp_path: Path) -> None:
    run = vcmvsp.run(scenario(tmp_path, 0.5), set={"physics.kind": "bullet"}, out=tmp_path / "run")
    assert replay(tmp_path / "run", mcap=False).metrics["digest"] == run.metrics["digest"]


def test_a_changed_algorithm_meets_the_recorded_robot(recorded: Path, events: list[Event]) -> None:
    now = replayed(recorded, **{"vehicle.car2.agent.k1": 0.2})
    assert of(now, "car1/") == of(events, "car1/")
    assert of(now, "car2/command") != of(events, "car2/command")
    np.testing.assert_equal(motion(now), motion(events))


def test_the_robot_does_not_obey_in_a_replay(recorded: Path, events: list[Event]) -> None:
    now = replayed(recorded, **{"vehicle.car1.agent.speed": 0.05})
    assert of(now, "car1/command") != of(events, "car1/command")
    assert of(now, "car1/estimate") == of(events, "car1/estimate")


def test_agents_may_have_shorter_periods(recorded: Path, events: list[Event]) -> None:
    """Physics requests instants between the recorded ones: positions are interpolated."""
    before, now = sorted(motion(events)), motion(replayed(recorded, **{"vehicle.car2.agent.period_s": 0.05}))
    for begin, end in pairwise(before):
        np.testing.assert_allclose(now[(begin + end) // 2][0], 0.5 * (now[begin][0] + now[end][0]), atol=1e-12)


def test_after_the_recording_the_robot_stands(recorded: Path) -> None:
    """The other vehicles and the agent of the robot continue."""
    now = replayed(recorded, duration_s=3.0)
    states = motion(now)
    for time_ns in range(1_600_000_000, 3_000_000_001, 100_000_000):
        np.testing.assert_array_equal(states[time_ns], [states[1_500_000_000][0], np.zeros(3)])
    assert of(now, "car1/estimate")[-1].time_ns <= 1_500_000_001
    assert of(now, "car1/command")[-1].time_ns == of(now, "car2/command")[-1].time_ns == 2_900_000_000


def test_its_twin_can_take_its_place(recorded: Path) -> None:
    twin = replay(recorded, twin=True, radio="recorded")
    assert "hardware" not in twin.metrics
    assert twin.metrics["radio"]["losses"] == replay(recorded).metrics["radio"]["losses"]


def test_a_killed_run_is_replayed_as_far_as_written(tmp_path: Path) -> None:
    path, lines = tmp_path / "run" / "hardware.mcap", list[str]()
    with Stage(tmp_path) as stage:
        stage.start("run", str(scenario(tmp_path, 60.0)), "--out", "run", "-q")
        wait_for(path)
        until(lambda: path.stat().st_size > 4000)
    end_ns = read_inputs(path)[-1][1]
    assert end_ns > 0
    again = replay(tmp_path / "run", set={"duration_s": 20.0}, tell=lines.append)
    assert lines[0].startswith(f"{path} is damaged (it is truncated)")
    assert lines[-1] == f"the recording ends at {end_ns / 1e9:.3f} s: car1 stands still from then on"
    assert again.metrics["duration_s"] == 20.0
