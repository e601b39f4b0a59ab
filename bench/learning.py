"""Environments for learning beside PyFlyt's ``MAQuadXHoverEnv``, which has no radio, and worlds side by side.

``python -m bench.learning``. Ours: quadrotors with rotors and autopilots at 240 Hz, ten actions a second, a message each at
every step over 802.11g with contention. PyFlyt steps at 240 Hz with 40 actions a second.
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from bench import cores
from bench.asked import SilentError, installed, program
from bench.drones import OLD
from bench.measure import Row, cpu, in_turn, missing, table

ROUNDS = 5
STEPS = 100  # of a stretch
PEER_STEP_S, OUR_STEP_S = 1.0 / 40.0, 0.1
CONTENTION: dict[str, Any] = {"physics": {"kind": "flight", "rate_hz": 240.0}, "radio": {"preset": "wifi-g-6"}}


def rows() -> Iterator[Row]:
    """All rows; each is measured when it is requested."""
    for count in (4, 10):
        yield from _beside_pyflyt(count)
    yield _side_by_side("kinematic robots", "formation", {}, 10_000)
    yield _side_by_side("quadrotors with rotors", "search", {"physics": {"kind": "flight"}}, 3_000)
    yield _reset("kinematic robots", "formation", {}, 20.0)
    yield _reset("quadrotors in PyBullet", "search", {"physics": {"kind": "bullet"}}, 60.0)
    yield _two_processes()


def _task(name: str, vehicles: int) -> Any:
    from vcmvsp.env import Formation, Search

    return Formation(vehicles=vehicles) if name == "formation" else Search(vehicles=vehicles, kind="quadrotor")


def _stepping(count: int, settings: dict[str, Any]) -> Callable[[], None]:
    """A hundred steps of random actions; all vehicles send at each."""
    from vcmvsp.env import parallel_env

    env = parallel_env(_task("search", count), set=settings, max_cycles=100_000)
    env.reset()
    rng = np.random.default_rng(1)
    actions = rng.uniform(-1.0, 1.0, (STEPS, count, 9)).astype(np.float32)
    actions[..., 4] = 1.0

    def steps() -> None:
        for each in actions:
            env.step(dict(zip(env.agents, each, strict=True)))

    steps()
    return steps


def _beside_pyflyt(count: int) -> Iterator[Row]:
    steps = _stepping(count, CONTENTION)
    name = f"{count} quadrotors with contention, steps of an environment; beside PyFlyt's MAQuadXHoverEnv, without a radio"
    try:
        with program("pyflyt_env", installed(OLD), agents=count, span_s=STEPS) as peer_stretch:
            ours, other, ratio = in_turn(lambda: cpu(steps), peer_stretch, ROUNDS)
    except SilentError as error:
        yield missing(name, "<= 0.2", error)
        return
    yield Row(name, f"{STEPS / ours:.0f} steps / CPU s", f"{STEPS / other:.0f}", ratio, "<= 0.2", ratio <= 0.2)
    simulated = ratio * PEER_STEP_S / OUR_STEP_S
    figures = f"{STEPS * OUR_STEP_S / ours:.1f} sim s / CPU s", f"{STEPS * PEER_STEP_S / other:.2f}"
    yield Row(f"the same {count}, simulated time", *figures, simulated, "<= 0.05", simulated <= 0.05)


def _side_by_side(vehicles: str, task: str, settings: dict[str, Any], least: float) -> Row:
    """256 worlds of ten vehicles, loss and delay; beside one world of ten."""
    from vcmvsp.env import parallel_env, vector_env

    many = vector_env(_task(task, 10), num_envs=256, set=settings, max_cycles=100_000)
    one = parallel_env(_task(task, 10), set=settings, max_cycles=100_000)
    many.reset()
    one.reset()
    size = many.single_action_space.shape[0]
    actions = np.random.default_rng(1).uniform(-1.0, 1.0, (20, 256, 10, size)).astype(np.float32)

    def together() -> float:
        return cpu(lambda: [many.step(each) for each in actions]) / (20 * 256)

    def alone() -> float:
        return cpu(lambda: [one.step(dict(zip(one.agents, each[0], strict=True))) for each in actions]) / 20

    ours, other, ratio = in_turn(together, alone, ROUNDS)
    name = f"256 worlds of 10 {vehicles}, loss and delay, steps of an environment; beside one world"
    demand = f"goal: >= {least:g} steps / CPU s"
    return Row(name, f"{1.0 / ours:.0f} steps / CPU s", f"{1.0 / other:.0f}", ratio, demand, 1.0 / ours >= least)


def _reset(vehicles: str, task: str, settings: dict[str, Any], most_ms: float) -> Row:
    from vcmvsp.env import parallel_env

    env = parallel_env(_task(task, 10), set=settings)
    cost_s, steps_s, ratio = in_turn(lambda: cpu(env.reset), lambda: cpu(lambda: _ten_steps(env)), ROUNDS)
    name = f"reset of an environment of 10 {vehicles}; beside ten steps of it"
    demand = f"goal: <= {most_ms:g} ms"
    return Row(name, f"{1e3 * cost_s:.1f} ms", f"{1e3 * steps_s:.1f} ms", ratio, demand, 1e3 * cost_s <= most_ms)


def _ten_steps(env: Any) -> None:
    for _ in range(10):
        env.step({name: np.zeros(env.action_space(name).shape, np.float32) for name in env.agents})


def _environment() -> Callable[[], None]:
    return _stepping(4, CONTENTION)


def _two_processes() -> Row:
    """Gain by a second process, beside the gain of an integer loop: shared machines have less than two cores."""
    name = "steps of two processes with an environment each, beside one process; beside the same of a loop over integers"
    try:
        ours, other, ratio = in_turn(lambda: cores.gain(_environment), lambda: cores.gain(cores.integers), ROUNDS)
    except ValueError as error:
        return missing(name, ">= 0.9", error)
    return Row(name, f"{ours:.2f}x one process", f"{other:.2f}x", ratio, ">= 0.9", ratio >= 0.9)


if __name__ == "__main__":
    print(table(list(rows())))
