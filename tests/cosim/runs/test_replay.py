"""Replay: unchanged, the run is equal to the byte; with one change, the rest stays as recorded."""

import json
import tomllib
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import vcmvsp
from tests.support.cosim.command_line import vcmvsp_command
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.runs.replay import beside, replay

pytestmark = pytest.mark.processes

SAME = ("metrics.json", "states.parquet", "radio.parquet", "scenario.toml")
SETTINGS: dict[str, Any] = {
    "duration_s": 3.0,
    "metrics.from_s": 1.0,
    "seed": 5,
    "physics.kind": "kinematic",
    "radio": {"preset": "wifi-b-1", "loss": {"kind": "bernoulli", "probability": 0.3}},
}
OWN = """from vcmvsp import Agent, Velocity

class Turn(Agent):
    period = 0.1

    def __init__(self, rate: float = 0.2) -> None:
        self.rate = rate

    def act(self, obs, radio):
        radio.send(x=obs.state.position[0])
        return Velocity(linear=(0.3, 0.0, 0.0), yaw_rate=self.rate)
"""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a simulated run, with losses and contention on the channel."""
    folder = tmp_path_factory.mktemp("runs") / "first"
    vcmvsp.run("formation-circle", set=SETTINGS, out=folder)
    return folder


def files(folder: Path, names: tuple[str, ...] = SAME) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in names}


def outcomes(radio: pa.Table) -> dict[tuple[str, int, str], str]:
    """Outcome of the n-th frame of each sender at each receiver."""
    numbers, found = dict[str, list[int]](), {}
    for row in radio.to_pylist():
        known = numbers.setdefault(row["sender"], [])
        if row["frame"] not in known:
            known.append(row["frame"])
        found[row["sender"], known.index(row["frame"]), row["receiver"]] = row["outcome"]
    return found


def recorded_outcomes(recorded: Path) -> dict[tuple[str, int, str], str]:
    return outcomes(pq.read_table(recorded / "radio.parquet"))


def digest(folder: Path) -> str:
    """Digest of a run."""
    return json.loads((folder / "metrics.json").read_text())["digest"]


def test_an_unchanged_replay_is_equal(recorded: Path, tmp_path: Path) -> None:
    replay(recorded, out=tmp_path / "again")
    assert files(tmp_path / "again", (*SAME, "run.mcap")) == files(recorded, (*SAME, "run.mcap"))


def test_recorded_frames_keep_their_outcomes(recorded: Path) -> None:
    """With another seed, another gain and a place farther away; newly drawn frames have other outcomes."""
    changed = {"vehicle.car2.agent.k1": 0.3, "vehicle.car3.pose": [-30.0, 0.0, 0.0]}
    frozen = replay(recorded, radio="recorded", seed=99, set=changed, mcap=False)
    drawn = replay(recorded, seed=99, set=changed, mcap=False)
    assert outcomes(frozen.radio) == recorded_outcomes(recorded)
    assert outcomes(drawn.radio) != recorded_outcomes(recorded)
    assert frozen.metrics["digest"] != digest(recorded)


def test_frames_beyond_the_recording_are_drawn_and_reported(recorded: Path) -> None:
    lines: list[str] = []
    again = replay(recorded, radio="recorded", set={"agents.period_s": 0.05}, tell=lines.append, mcap=False)
    before, now = recorded_outcomes(recorded), outcomes(again.radio)
    assert {key: now[key] for key in before} == before
    assert len(now) == 2 * len(before)
    (line,) = lines
    frames = len({key[:2] for key in before})
    assert line.startswith(f"{frames} of {2 * frames} frames are not in the recording")


def test_an_equal_seed_draws_equal_outcomes(recorded: Path) -> None:
    """Another gain moves a follower by centimetres only: it changes no outcome."""
    again = replay(recorded, set={"vehicle.car2.agent.k1": 0.3}, mcap=False)
    assert outcomes(again.radio) == recorded_outcomes(recorded)
    assert again.metrics["digest"] != digest(recorded)


def test_classes_are_read_from_the_files_of_the_run(tmp_path: Path) -> None:
    (tmp_path / "turn.py").write_text(OWN)
    (tmp_path / "own.toml").write_text(
        'name = "own"\nduration_s = 1.0\n[physics]\nkind = "kinematic"\n[[vehicle]]\nname = "car1"\nkind = "p2dx"\n'
        'agent = { kind = "turn.py:Turn" }\n'
    )
    vcmvsp.run(tmp_path / "own.toml", out=tmp_path / "run")
    (tmp_path / "turn.py").write_text(OWN.replace("0.2", "0.9"))
    assert replay(tmp_path / "run", mcap=False).metrics["digest"] == digest(tmp_path / "run")
    changed = replay(tmp_path / "run", set={"vehicle.car1.agent.rate": 0.9}, mcap=False)
    assert changed.metrics["digest"] != digest(tmp_path / "run")


def test_folders_that_are_no_run_are_refused(recorded: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="there is no such folder; name the folder of a run"):
        replay(tmp_path / "nowhere")
    with pytest.raises(UsageError, match=r"has no scenario\.toml"):
        replay(tmp_path)
    (tmp_path / "scenario.toml").write_bytes((recorded / "scenario.toml").read_bytes())
    with pytest.raises(UsageError, match=r"has no radio\.parquet.*--radio drawn"):
        replay(tmp_path, radio="recorded")
    with pytest.raises(UsageError, match="--radio guessed: must be drawn or recorded"):
        replay(tmp_path, radio="guessed")
    with pytest.raises(UsageError, match=r"--twin: no vehicle of .* was real"):
        replay(tmp_path, twin=True)
    with pytest.raises(UsageError, match="is the replayed run itself"):
        replay(recorded, out=recorded, force=True)


def test_a_damaged_table_of_frames_is_refused(recorded: Path, tmp_path: Path) -> None:
    (tmp_path / "scenario.toml").write_bytes((recorded / "scenario.toml").read_bytes())
    (tmp_path / "radio.parquet").write_bytes((recorded / "radio.parquet").read_bytes()[:-100])
    with pytest.raises(UsageError, match=r"radio\.parquet cannot be read"):
        replay(tmp_path, radio="recorded")


REAL = """
name = "hybrid"
duration_s = 1.0
[physics]
kind = "kinematic"
[[vehicle]]
name = "car1"
kind = "amigobot"
{real}
agent = {{ kind = "trajectory", path = "circle" }}
[[vehicle]]
name = "car2"
kind = "p2dx"
pose = [-1.0, -0.5, 0.0]
agent = {{ kind = "leader_follower", leader = "car1" }}
"""
DRIVEN = """driver = { kind = "bench" }
safety = { max_speed = 0.3 }
fusion = { start_sigma_m = 0.1 }
"""


@pytest.fixture
def real(tmp_path: Path) -> Path:
    """The folder of a run with a real vehicle, without its inputs."""
    (tmp_path / "scenario.toml").write_text(REAL.format(real=DRIVEN))
    return tmp_path


def test_a_twin_takes_the_place_of_a_real_vehicle(real: Path) -> None:
    simulated = tomllib.loads(REAL.format(real=""))
    assert replay(real, twin=True).metrics["digest"] == vcmvsp.run(simulated).metrics["digest"]


def test_a_twin_may_be_changed(real: Path) -> None:
    changed = {"vehicle.car1.kind": "p2dx"}
    simulated = tomllib.loads(REAL.format(real=""))
    assert replay(real, twin=True, set=changed).metrics["digest"] == vcmvsp.run(simulated, set=changed).metrics["digest"]


def test_a_twin_keeps_its_fusion(real: Path) -> None:
    """A real vehicle with fused pose: its twin fuses with equal parameters."""
    same = 'pose_source = "fusion"\nfusion = { start_sigma_m = 0.1 }\npositioning = { rate_hz = 10.0, sigma_m = 0.1 }\n'
    driven = same + 'driver = { kind = "bench" }\n'
    (real / "scenario.toml").write_text(REAL.format(real=driven))
    simulated = tomllib.loads(REAL.format(real=same))
    assert replay(real, twin=True).metrics["digest"] == vcmvsp.run(simulated).metrics["digest"]


def test_without_its_recording_a_real_vehicle_cannot_be_replayed(real: Path) -> None:
    with pytest.raises(UsageError, match=r"has no hardware\.mcap with the inputs of car1.*--twin"):
        replay(real)


def test_the_folder_is_beside_the_run() -> None:
    assert beside(Path("runs/one-1")) == Path("runs/one-1-replay")
    assert beside(Path("one/")) == Path("one-replay")


def test_the_command(recorded: Path) -> None:
    recorded.with_name("first-replay").mkdir()
    again = vcmvsp_command("replay", str(recorded), "--radio", "recorded", "--agents", "inprocess", "--json")
    assert again == (0, (recorded / "metrics.json").read_text(), f"same digest as {recorded}\n")
    assert files(recorded.with_name("first-replay-2")) == files(recorded)
    nothing = vcmvsp_command("replay", str(recorded.parent))
    assert nothing.code == 2
    assert nothing.err.strip().count("\n") == 0
    assert "has no scenario.toml" in nothing.err
