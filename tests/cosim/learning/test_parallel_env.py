"""Environment of all vehicles: PettingZoo's contract; an episode equals a run."""

import math
import pickle
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import max_cycles_test, parallel_api_test, parallel_seed_test, render_test
from pettingzoo.utils.conversions import parallel_to_aec

import vcmvsp
from tests.support.requirements import installed_apart
from vcmvsp import Agent, Observation, Radio, ScenarioError, UsageError, Velocity
from vcmvsp.env import Formation, Gates, Search, Task, VehiclesEnv, Worlds, env, parallel_env

TASKS = ("formation", "search", "gates")


def _random(env: VehiclesEnv, steps: int) -> list[dict[str, Any]]:
    rng = np.random.default_rng(3)
    sizes = {name: env.action_space(name).shape for name in env.possible_agents}
    return [{name: rng.uniform(-1.0, 1.0, size).astype(np.float32) for name, size in sizes.items()} for _ in range(steps)]


@pytest.mark.parametrize("task", TASKS)
def test_it_keeps_the_contract_of_pettingzoo(task: str) -> None:
    parallel_api_test(parallel_env(task), num_cycles=60)
    parallel_seed_test(lambda: parallel_env(task), num_cycles=40)

    class Module:
        parallel_env = staticmethod(lambda **options: parallel_env(task, **options))
        env = staticmethod(lambda **options: env(task, **options))

    max_cycles_test(Module)


def test_pictures_are_drawn_from_above() -> None:
    drawn = parallel_env("formation", render_mode="rgb_array")
    drawn.metadata["render_modes"] = ["rgb_array"]  # the control station is tested elsewhere
    render_test(lambda **_: parallel_to_aec(drawn))
    drawn.reset()
    picture: Any = drawn.render()
    assert picture.shape == (480, 480, 3)
    vehicles = (np.abs(picture.astype(int) - (40, 70, 160)) < 8).all(axis=-1)
    assert vehicles.sum() > 3 * 150  # three discs of 16 pixels diameter


@pytest.mark.processes
@pytest.mark.parametrize("task", TASKS)
def test_one_vehicle_keeps_the_contract_of_gymnasium(task: str) -> None:
    check_env(gymnasium.make(f"vcmvsp/{task}-v0", max_cycles=30).unwrapped)


def test_wrappers_of_supersuit_put_copies_side_by_side() -> None:
    supersuit = installed_apart("supersuit")  # its dependencies have no wheels for Python 3.14
    many = supersuit.pettingzoo_env_to_vec_env_v1(parallel_env("gates", max_cycles=20))
    many = supersuit.concat_vec_envs_v1(many, 2, num_cpus=1, base_class="gymnasium")
    observations, _ = many.reset(seed=3)
    assert observations.shape == (6, *many.observation_space.shape)
    assert np.array_equal(observations[3:], np.stack(list(parallel_env("gates").reset(seed=4)[0].values())))
    for _ in range(25):  # beyond the end of an episode
        many.step(np.zeros((6, *many.action_space.shape), np.float32))
    many.close()


class Scripted(Agent):
    """Executes given actions, one per tick."""

    def __init__(self, task: Task, actions: list[np.ndarray]) -> None:
        self.task, self.actions, self.tick = task, actions, 0

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        action = self.actions[self.tick]
        self.tick += 1
        if action[self.task.motions] > 0.0:
            radio.send(action[self.task.motions + 1 :].astype("<f4").tobytes())
        x, y, z, turn = self.task.motion(action[: self.task.motions].astype(float)).tolist()
        return Velocity(linear=(x, y, z) if self.task.flies else (x, 0.0, 0.0), yaw_rate=turn)


@pytest.mark.parametrize("seed", range(1, 6))
@pytest.mark.parametrize(
    ("task", "settings"),
    [
        (Formation(kind="p2dx"), {"physics.kind": "bullet"}),
        (Search(kind="quadrotor"), {"physics.kind": "bullet", "radio": {"preset": "wifi-g-6"}}),
        (Gates(), {}),
    ],
)
def test_an_episode_equals_a_run_with_its_actions(task: Task, settings: dict[str, Any], seed: int) -> None:
    episode = parallel_env(task, set=settings, max_cycles=30, record=True)
    episode.reset(seed=seed)
    actions = _random(episode, 30)
    taken: list[dict[str, Any]] = []
    while episode.agents:
        taken.append(actions[len(taken)])
        episode.step(taken[-1])
    result = episode.result()
    scenario, _ = episode.scenario.load(seed)
    agents = {name: Scripted(task, [each[name] for each in taken]) for name in episode.possible_agents}
    if len(taken) == 30:
        run = vcmvsp.run(scenario, agents=agents)
        assert run.radio.equals(result.radio)
        assert run.states.equals(result.states)


@pytest.mark.parametrize("radio", ["ideal", "wifi-g-6"])
def test_observations_do_not_depend_on_recording(radio: str) -> None:
    both = [parallel_env("gates", set={"radio": {"preset": radio}}, max_cycles=20, record=record) for record in (False, True)]
    actions = _random(both[0], 20)
    for each in both:
        each.reset(seed=2)
    for action in actions:
        one, other = (each.step(action) for each in both)
        assert all(np.array_equal(one[0][name], other[0][name]) for name in both[0].possible_agents)
        assert one[1:4] == other[1:4]


def test_frames_are_counted_with_their_losses() -> None:
    """In a channel with 100 % loss, each vehicle sends one frame a tick, and each of the two others loses it."""
    lossy = parallel_env("search", set={"radio.loss.probability": 1.0}, max_cycles=5)
    lossy.reset()
    send = lossy.task.motions
    for _ in range(5):
        actions = {name: np.eye(1, 9, send, dtype=np.float32)[0] for name in lossy.agents}
        *_, infos = lossy.step(actions)
        expected = {"frames_sent": 1, "received": 0, "lost": {"random loss": 2}}
        assert all(info == expected for info in infos.values())
    silent = parallel_env("search", max_cycles=5)
    silent.reset()
    *_, infos = silent.step({name: np.zeros(9) for name in silent.agents})
    assert all(info == {"frames_sent": 0, "received": 0, "lost": {}} for info in infos.values())


def test_a_message_is_observed_with_its_age_and_level_when_it_has_arrived() -> None:
    """Sent at 0, delayed by 0.25 s: unknown until 0.2 s, observed at 0.3 s with an age of 0.3 s, older at each tick."""
    radio = {"delay": {"kind": "fixed", "seconds": 0.25}, "path_loss": {"kind": "log_distance"}}
    task = Formation()
    env = parallel_env(task, set={"radio": radio}, max_cycles=6)
    observations, _ = env.reset(seed=1)
    send = np.zeros(7, np.float32)
    send[2:] = 1.0, 0.25, -0.5, 1.0, 0.0
    ages = []
    for tick in range(5):
        actions = {name: np.zeros(7, np.float32) for name in env.agents}
        if tick == 0:
            actions["v0"] = send
        observations, *_ = env.step(actions)
        parts = env.views(observations["v1"][None])  # other vehicles in order: row 0 is v0
        ages.append(float(parts.age_s[0, 0]) if parts.heard[0, 0] else None)
        if parts.heard[0, 0]:
            assert parts.message[0, 0].tolist() == [0.25, -0.5, 1.0, 0.0]
            assert -60.0 < parts.rssi_dbm[0, 0] < -20.0
    assert ages[:2] == [None, None]
    assert ages[2:] == pytest.approx([0.3, 0.4, 0.5])


def test_observations_are_within_their_spaces_and_have_the_state() -> None:
    env = parallel_env("search", max_cycles=10)
    observations, _ = env.reset(seed=5)
    for action in _random(env, 10):
        observations, *_ = env.step(action)
        for row, name in enumerate(env.possible_agents):
            assert env.observation_space(name).contains(observations[name])
            assert observations[name][:3] == pytest.approx(env.worlds.position[0, row])
            assert math.atan2(observations[name][4], observations[name][3]) == pytest.approx(env.worlds.yaw[0, row], abs=1e-6)
        assert env.state_space.contains(env.state())


def test_sensors_are_observed_as_numbers() -> None:
    class Seeing(Formation):
        sensors = ("scan", "odometry")

        def scenario(self) -> dict[str, Any]:
            scanner = {"scan": {"kind": "range_scanner", "beams": 7, "field_of_view": 3.0, "range_max": 6.0}}
            return {**super().scenario(), "vehicles": {"sensors": scanner}, "world": {"kind": "laboratory"}}

    env = parallel_env(Seeing(), max_cycles=3)
    observations, _ = env.reset()
    scan = env.views(observations["v0"]).sensors[:7]
    assert scan.shape == (7,)
    assert ((scan >= 0.0) & (scan <= 6.0)).all()
    assert env.views(observations["v0"]).sensors[7:9] == pytest.approx(observations["v0"][:2], abs=1e-5)


def test_a_copy_begins_with_the_next_seed() -> None:
    first = parallel_env("gates", seed=6)
    copy = pickle.loads(pickle.dumps(first))
    one, other = first.reset()[0], copy.reset()[0]
    assert all(np.array_equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda actions: {name: value for name, value in actions.items() if name != "v1"}, "no action for v1"),
        (lambda actions: {**actions, "v7": actions["v0"]}, "unknown vehicle 'v7'"),
        (lambda actions: {**actions, "v1": np.zeros(3)}, r"shape \(3,\)"),
        (lambda actions: {**actions, "v1": np.full(7, np.nan)}, "the action of v1 is not finite"),
        (lambda actions: {**actions, "v1": "left"}, "must be 7 numbers"),
    ],
)
def test_a_wrong_action_is_one_error(change: Any, problem: str) -> None:
    env = parallel_env("formation")
    env.reset()
    with pytest.raises(UsageError, match=problem):
        env.step(change({name: np.zeros(7) for name in env.agents}))


def test_other_wrong_use_is_one_error() -> None:
    class Nowhere(Task):
        def step(self, worlds: Worlds) -> Any:
            return worlds

    for wrong, problem in (
        (lambda: parallel_env("formatoin"), "did you mean 'formation'"),
        (lambda: parallel_env(Nowhere()), "names no scenario"),
        (lambda: parallel_env("gates", render_mode="ansi"), "unknown mode 'ansi'"),
        (lambda: parallel_env("gates").step({}), "call reset"),
        (lambda: parallel_env("gates", set={"radio.los.probability": 1}), "did you mean 'loss'"),
    ):
        with pytest.raises((UsageError, ScenarioError), match=problem):
            wrong()


def test_a_scenario_has_no_reward_and_scripted_vehicles_are_driven() -> None:
    env = parallel_env("formation-circle", max_cycles=3)
    env.reset()
    _, rewards, *_ = env.step({name: np.zeros(7, np.float32) for name in env.agents})
    assert rewards == {"car1": 0.0, "car2": 0.0, "car3": 0.0}


@pytest.mark.parametrize("task", TASKS)
def test_the_baseline_does_the_task_better_than_standing_still(task: str) -> None:
    total = {}
    for rule in ("baseline", "still"):
        env = parallel_env(task)
        observations, _ = env.reset(seed=1)
        total[rule] = 0.0
        while env.agents:
            values = np.stack([observations[name] for name in env.agents])
            actions = env.task.baseline(env.views(values)).astype(np.float32) * (rule == "baseline")
            observations, rewards, *_ = env.step(dict(zip(env.agents, actions, strict=True)))
            total[rule] += sum(rewards.values())
    assert total["baseline"] > total["still"]
