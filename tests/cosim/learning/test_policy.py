"""A trained policy as an agent."""

from pathlib import Path
from typing import Any, get_args

import msgspec
import numpy as np
import pytest

import vcmvsp
from vcmvsp import ScenarioError, UsageError
from vcmvsp.cosim.scenario.schema import Runs
from vcmvsp.env import Formation, Search, Task, VehiclesEnv, parallel_env
from vcmvsp.policy import META, Policy, load_network, meta_of, save_network


def _saved(path: Path, env: VehiclesEnv, **changes: Any) -> Path:
    """Saves a network with random weights; it sends a message at most ticks."""
    rng, size, actions = np.random.default_rng(2), env.layout.size, len(env.action_space(env.possible_agents[0]).low)
    layers = [(rng.normal(0.0, 0.3, (size, 16)), np.zeros(16)), (rng.normal(0.0, 0.5, (16, actions)), np.zeros(actions))]
    layers[-1][1][env.task.motions] = 3.0
    meta = msgspec.structs.replace(meta_of(env.task, env.layout), **changes)
    save_network(path, layers, meta, scale=np.full(size, 0.1))
    return path


def _episode(env: VehiclesEnv, file: Path, seed: int) -> vcmvsp.Result:
    """The result of an episode with a policy."""
    network = load_network(file)
    observations, _ = env.reset(seed=seed)
    while env.agents:
        observations, *_ = env.step({name: network(each) for name, each in observations.items()})
    return env.result()


@pytest.mark.processes
@pytest.mark.parametrize("runs", get_args(Runs)[:2])  # in this process, in other processes
@pytest.mark.parametrize("task", ["formation", "search", "gates"])
def test_it_acts_as_in_the_environment_also_in_other_processes(tmp_path: Path, task: str, runs: Runs) -> None:
    env = parallel_env(task, record=True, max_cycles=40)
    file = _saved(tmp_path / "policy.npz", env)
    episode = _episode(env, file, seed=4)
    assert 0 < episode.radio.num_rows <= 40 * 3 * 2
    run = vcmvsp.run(episode_scenario(env, 4, file), agents=runs)
    assert run.radio.equals(episode.radio)
    assert run.states.equals(episode.states)


def episode_scenario(env: VehiclesEnv, seed: int, file: Path) -> dict[str, Any]:
    """Scenario of an episode, with the policy as the agent of all vehicles."""
    content: Any = env.task.scenario()
    starts, _ = env.scenario.begin(seed)
    vehicles = [
        {**each, "position": pose[:3], "heading": pose[3], "agent": {}}
        for each, pose in zip(content["vehicle"], starts.tolist(), strict=True)
    ]
    agents = {"period_s": 0.1, "kind": "vcmvsp.policy:Policy", "file": str(file)}
    return {**content, "vehicle": vehicles, "agents": agents, "duration_s": 4.0, "seed": seed}


def _run(file: Path, task: Task, vehicles: int = 3) -> None:
    env = parallel_env(task)
    content = episode_scenario(env, 1, file)
    vcmvsp.run({**content, "vehicle": content["vehicle"][:vehicles], "duration_s": 0.5})


def test_a_file_of_another_task_or_team_is_one_error(tmp_path: Path) -> None:
    file = _saved(tmp_path / "policy.npz", parallel_env("formation"))
    with pytest.raises(UsageError, match="trained for the task formation with 3 vehicles, not for search"):
        load_network(file).check(Search(), 3, str(file))
    with pytest.raises(ScenarioError, match="formation with 3 vehicles, not for formation with 2"):
        _run(file, Formation(), vehicles=2)
    foreign = _saved(tmp_path / "own.npz", parallel_env("formation"), task="juggling")
    with pytest.raises(vcmvsp.VcmvspError, match="juggling"):
        _run(foreign, Formation())


def test_the_settings_of_the_training_hold(tmp_path: Path) -> None:
    """A policy that always drives ahead reaches the greatest speed of its own task."""
    env = parallel_env(Formation(kind="kinematic", max_speed=0.25))
    layers = [(np.zeros((env.layout.size, 7)), np.array([9.0, 0.0, -9.0, 0.0, 0.0, 0.0, 0.0]))]
    save_network(tmp_path / "on.npz", layers, meta_of(env.task, env.layout))
    content = episode_scenario(env, 1, tmp_path / "on.npz")
    states: Any = vcmvsp.run(content).states.to_pandas().groupby("vehicle")[["x", "y"]]
    way = states.last() - states.first()
    assert np.hypot(way["x"], way["y"]).to_numpy() == pytest.approx(0.25 * 4.0, abs=0.02)


def test_a_common_clock_offset_changes_nothing(tmp_path: Path) -> None:
    env = parallel_env("formation")
    content = episode_scenario(env, 1, _saved(tmp_path / "policy.npz", env))
    late = [{**each, "clock": {"offset_s": 5.0}} for each in content["vehicle"]]
    both = [vcmvsp.run({**content, "vehicle": vehicles}) for vehicles in (content["vehicle"], late)]
    assert both[0].states.equals(both[1].states)


class ScanTask(Formation):
    """A task with a range scanner."""

    sensors = ("scan",)

    def scenario(self) -> dict[str, Any]:
        scan = {"kind": "range_scanner", "beams": 5, "field_of_view": 3.0, "range_max": 6.0}
        return {**super().scenario(), "vehicles": {"sensors": {"scan": scan}}, "world": {"kind": "laboratory"}}


class ScanPolicy(Policy):
    """Policies of the task `ScanTask`."""

    task_class = ScanTask


def test_a_user_task_with_sensors(tmp_path: Path) -> None:
    env = parallel_env(ScanTask(), record=True, max_cycles=20)
    file = _saved(tmp_path / "policy.npz", env)
    episode = _episode(env, file, seed=2)
    run = vcmvsp.run(env.scenario.load(2)[0], agents={name: ScanPolicy(file) for name in env.possible_agents})
    assert run.radio.equals(episode.radio)
    assert run.states.equals(episode.states)


@pytest.mark.parametrize(
    ("arrays", "problem"),
    [
        ({"w0": np.zeros((3, 2))}, "matrices"),
        ({"w0": np.zeros((3, 2)), "b0": np.zeros(3)}, "matrices"),
        ({"w0": np.zeros((3, 2)), "b0": np.zeros(2), "w1": np.zeros((3, 2)), "b1": np.zeros(2)}, "inputs of the next"),
        ({"w0": np.full((3, 2), np.nan), "b0": np.zeros(2)}, "finite"),
        ({}, "no entry"),
    ],
)
def test_a_file_that_is_no_policy_is_one_error(tmp_path: Path, arrays: dict[str, Any], problem: str) -> None:
    meta = {META: np.frombuffer(b'{"task": "formation", "vehicles": 3}', np.uint8)} if arrays else {"other": np.zeros(1)}
    np.savez(tmp_path / "wrong.npz", **arrays, **meta)
    with pytest.raises(UsageError, match=problem):
        load_network(tmp_path / "wrong.npz")


def test_a_file_that_cannot_be_read_is_one_error(tmp_path: Path) -> None:
    (tmp_path / "text.npz").write_text("no archive")
    for name in ("text.npz", "missing.npz", "missing.onnx"):
        with pytest.raises(UsageError, match=name):
            load_network(tmp_path / name)


def test_onnx_equals_its_network(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    from onnx import TensorProto, helper, numpy_helper

    weights = np.random.default_rng(1).normal(0.0, 0.2, (29, 7)).astype(np.float32)
    nodes = [helper.make_node("MatMul", ["x", "w"], ["y"]), helper.make_node("Tanh", ["y"], ["z"])]
    ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, size]) for name, size in (("x", 29), ("z", 7))]
    graph = helper.make_graph(nodes, "policy", ends[:1], ends[1:], [numpy_helper.from_array(weights, "w")])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, {META: '{"task": "formation", "vehicles": 3}'})
    onnx.save(model, tmp_path / "policy.onnx")
    network = load_network(tmp_path / "policy.onnx")
    observation = np.linspace(-1.0, 1.0, 29, dtype=np.float32)
    assert network(observation) == pytest.approx(np.tanh(observation @ weights), abs=1e-6)
    _run(tmp_path / "policy.onnx", Formation())
