"""Parallel worlds give the results of each world alone."""

from typing import Any

import numpy as np
import pytest

from vcmvsp import ScenarioError, UsageError
from vcmvsp.env import Formation, Gates, Search, Task, parallel_env, vector_env

LOG = {"radio.path_loss": {"kind": "log_distance"}, "radio.phy.sensitivity_dbm": -60.0}
RADIOS: dict[str, dict[str, Any]] = {
    "losses and delays": {},
    "bursts": {"radio.loss": {"kind": "bursts", "probability": 0.3, "mean_burst_s": 0.5}},
    "Rician fading": {**LOG, "radio.fading": {"kind": "rician"}},
    "fading in time": {**LOG, "radio.fading": {"kind": "rayleigh", "doppler_hz": 8.0}},
    "packet errors": {
        "radio": {
            "preset": "wifi-b-11",
            "mac": {"kind": "ideal"},
            "walls": {"kind": "none"},
            "fading": {"kind": "nakagami"},
            "phy": {"tx_power_dbm": -25.0},
            "delay": {"kind": "gamma", "mean_s": 0.2, "sigma_s": 0.1},
        }
    },
    "a queue": {"radio": {"phy": {"rate_bps": 1000.0}}},  # 128 ms for a message of 16 bytes every 100 ms
}


def _check(task: Task, worlds: int, ticks: int, settings: dict[str, Any]) -> set[str]:
    """Compares parallel worlds with each world alone; returns the causes of losses."""
    together = vector_env(task, num_envs=worlds, seed=11, set=settings, max_cycles=ticks)
    alone = [parallel_env(task, seed=11 + world, set=settings, max_cycles=ticks) for world in range(worlds)]
    observations, _ = together.reset()
    for world, each in enumerate(alone):
        assert np.array_equal(np.stack(list(each.reset()[0].values())), observations[world])
    rng, causes = np.random.default_rng(5), set[str]()
    for _ in range(ticks):
        actions = rng.uniform(-1.0, 1.0, (worlds, len(together.names), *together.single_action_space.shape)).astype(np.float32)
        observations, rewards, ended, cut, infos = together.step(actions)
        causes |= infos["lost"].keys()
        for world, each in enumerate(alone):
            if each.agents:
                one = each.step(dict(zip(each.agents, actions[world], strict=True)))
                assert np.array_equal(np.stack(list(one[0].values())), observations[world])
                assert list(one[1].values()) == rewards[world].tolist()
                assert set(one[2].values()) == {bool(ended[world])}
                assert set(one[3].values()) == {bool(cut[world])}
                for row, info in enumerate(one[4].values()):
                    lost = {cause: int(count[world, row]) for cause, count in infos["lost"].items() if count[world, row]}
                    both = infos["frames_sent"][world, row], infos["received"][world, row]
                    assert info == {"frames_sent": both[0], "received": both[1], "lost": lost}
    return causes


@pytest.mark.slow
@pytest.mark.parametrize("task", [Formation(), Search(), Gates()], ids=lambda task: task.name)
def test_each_world_equals_that_of_its_seed(task: Task) -> None:
    assert _check(task, 8, 200, {}) == {"random loss"}


@pytest.mark.parametrize("radio", RADIOS)
def test_with_any_radio_without_contention(radio: str) -> None:
    causes = _check(Gates(), 3, 40, RADIOS[radio])
    assert causes or radio == "a queue"


@pytest.mark.parametrize("kind", ["kinematic", "lag", "p2dx"])
def test_with_vehicles_on_the_ground(kind: str) -> None:
    _check(Formation(kind=kind), 3, 20, {})


@pytest.mark.parametrize("physics", ["kinematic", "flight"])
def test_with_quadrotors(physics: str) -> None:
    _check(Search(kind="quadrotor"), 3, 20, {"physics.kind": physics})


def test_a_world_whose_task_is_done_gets_no_further_reward() -> None:
    class Short(Formation):
        def step(self, worlds: Any) -> Any:
            rewards, _ = super().step(worlds)
            return rewards, worlds.position[:, 0, 0] > np.median(worlds.position[:, 0, 0])

    env = vector_env(Short(), num_envs=4, max_cycles=5)
    env.reset()
    for _ in range(5):
        before = env._done.copy()
        _, rewards, ended, cut, _ = env.step(np.zeros((4, 3, 7)))
        assert not rewards[before].any()
        assert (ended >= before).all()
    assert np.array_equal(cut, ~ended)
    with pytest.raises(UsageError, match="reset"):
        env.step(np.zeros((4, 3, 7)))


def test_seeds_continue_after_the_last_episode() -> None:
    env = vector_env("gates", num_envs=3, seed=1)
    env.reset()
    second = env.reset()[0]
    assert np.array_equal(second, vector_env("gates", num_envs=3, seed=4).reset()[0])


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        ({"physics.kind": "bullet"}, "physics.kind"),
        ({"radio": {"preset": "wifi-g-6"}}, "radio"),
        ({"radio.shadowing.sigma_db": 4.0}, "radio"),
        ({"radio.jammer": {"kind": "jammer", "position": [0.0, 0.0, 0.0]}}, "radio"),
        ({"world.kind": "laboratory"}, "world"),
        ({"world.wind.velocity": [1.0, 0.0, 0.0]}, "world"),
        ({"agents.latency_s": 0.05}, "agents.latency_s"),
        ({"vehicle.v1.pose_source": "positioning", "vehicle.v1.positioning.rate_hz": 10.0}, "pose_source"),
        ({"vehicle.v1.sensors.imu.kind": "imu"}, "sensors"),
    ],
)
def test_settings_for_single_worlds_are_refused_by_key(settings: dict[str, Any], key: str) -> None:
    with pytest.raises(ScenarioError, match=key):
        vector_env("gates", num_envs=2, set=settings)


@pytest.mark.parametrize(
    ("actions", "problem"),
    [
        (np.zeros((2, 3, 8)), r"shape \(2, 3, 8\)"),
        (np.full((2, 3, 9), np.inf), "v0 in world 0 is not finite"),
        ("left", "must be numbers"),
    ],
)
def test_wrong_actions_are_one_error(actions: Any, problem: str) -> None:
    env = vector_env("gates", num_envs=2)
    env.reset()
    with pytest.raises(UsageError, match=problem):
        env.step(actions)
