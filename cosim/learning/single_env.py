"""One vehicle of a task as a Gymnasium environment; the others follow the task's simple rule (`Task.baseline`)."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.config.binding import unknown
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.learning.parallel_env import MODES, VehiclesEnv, task_of
from vcmvsp.cosim.learning.task import Task

Vector = NDArray[np.float32]


class VehicleEnv(gymnasium.Env[Vector, Vector]):
    """One vehicle among scripted ones.

    Args:
        task: as of `vcmvsp.env.parallel_env`.
        agent: name of the vehicle; None: the last one.
        options: further arguments of `vcmvsp.env.parallel_env`.
    """

    metadata = {"render_modes": list(MODES), "render_fps": 10}  # noqa: RUF012  Gymnasium's attribute

    def __init__(self, task: str | Path | Task = "formation", *, agent: str | None = None, **options: Any) -> None:
        self.vehicles = VehiclesEnv(task_of(task), **options)
        names = self.vehicles.possible_agents
        self.agent, self.render_mode = names[-1] if agent is None else agent, self.vehicles.render_mode
        if self.agent not in names:
            raise UsageError(f"agent: {unknown('vehicle', self.agent, names)}")
        self.observation_space: gymnasium.Space[Any] = self.vehicles.observation_space(self.agent)
        self.action_space: gymnasium.Space[Any] = self.vehicles.action_space(self.agent)
        self._last: dict[str, Vector] = {}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Vector, dict[str, Any]]:
        """Start an episode."""
        super().reset(seed=seed)
        self._last, infos = self.vehicles.reset(seed, options)
        return self._last[self.agent], infos[self.agent]

    def step(self, action: Vector) -> tuple[Vector, float, bool, bool, dict[str, Any]]:
        """Act as the one vehicle, and let the others follow their rule."""
        names = self.vehicles.possible_agents
        observed = self.vehicles.views(np.stack([self._last[name] for name in names]))
        scripted = self.vehicles.task.baseline(observed).astype(np.float32)
        actions = {**dict(zip(names, scripted, strict=True)), self.agent: action}
        self._last, rewards, ended, cut, infos = self.vehicles.step(actions)
        return self._last[self.agent], rewards[self.agent], ended[self.agent], cut[self.agent], infos[self.agent]

    def render(self) -> Any:
        """A picture from above, or None."""
        return self.vehicles.render()

    def close(self) -> None:
        """Release the run."""
        self.vehicles.close()
