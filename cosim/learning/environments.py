"""Constructors of the environments, with built-in tasks by name."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pettingzoo import AECEnv
from pettingzoo.utils.conversions import parallel_to_aec

from vcmvsp.cosim.learning.parallel_env import VehiclesEnv, task_of
from vcmvsp.cosim.learning.task import Task
from vcmvsp.cosim.learning.vector_env import WorldsEnv


def parallel_env(
    task: str | Path | Mapping[str, Any] | Task | type[Task] = "formation",
    *,
    seed: int | None = None,
    set: Mapping[str, Any] | None = None,  # noqa: A002  the word of the command line
    render_mode: str | None = None,
    max_cycles: int | None = None,
    record: bool = False,
) -> VehiclesEnv:
    """All vehicles of a task as agents of a PettingZoo ``ParallelEnv``.

    Args:
        task: ``formation``, ``search`` or ``gates``; a custom task; or a scenario, whose rewards are 0.
        seed: of the first episode; each one after it has the seed of the one before plus one. None: the scenario's.
        set: key path -> value, as of `vcmvsp.run`.
        render_mode: ``rgb_array``: pictures from above; ``human``: a control station for each episode.
        max_cycles: ticks of an episode, in place of the scenario's ``duration_s``.
        record: keep tables and metrics of an episode, for ``env.result()``.

    Raises:
        UsageError: there is no such task or mode.
        ScenarioError: the task's scenario cannot be run as it is.
    """
    return VehiclesEnv(task_of(task), seed=seed, set=set, render_mode=render_mode, max_cycles=max_cycles, record=record)


def env(task: str | Path | Mapping[str, Any] | Task | type[Task] = "formation", **options: Any) -> "AECEnv[str, Any, Any]":
    """All vehicles of a task as agents of an ``AECEnv``, which act one after the other; arguments as of `parallel_env`."""
    return parallel_to_aec(parallel_env(task, **options))


def vector_env(
    task: str | Path | Mapping[str, Any] | Task | type[Task] = "formation",
    *,
    num_envs: int = 256,
    seed: int | None = None,
    set: Mapping[str, Any] | None = None,  # noqa: A002  the word of the command line
    max_cycles: int | None = None,
) -> WorldsEnv:
    """Many worlds of a task side by side, as arrays: for vehicles without bodies and radios without contention.

    Args:
        task, set, max_cycles: as of `parallel_env`.
        num_envs: number of worlds.
        seed: of the first world; the others have the seeds after it. None: the scenario's.

    Raises:
        UsageError: there is no such task.
        ScenarioError: the scenario has something that only one world at a time can have: the error names the key.
    """
    return WorldsEnv(task_of(task), num_envs, seed=seed, set=set, max_cycles=max_cycles)
