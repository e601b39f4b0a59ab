"""``vcmvsp.env.parallel_env``: a task as a PettingZoo environment."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from vcmvsp.cosim.config.binding import unknown
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.learning.episode import Episode, TaskScenario
from vcmvsp.cosim.learning.sensors import SensorVector
from vcmvsp.cosim.learning.task import SPEED_BOUND, YAW_RATE_BOUND, Layout, Observed, Task, Worlds
from vcmvsp.cosim.learning.tasks import TASKS
from vcmvsp.cosim.runs.api import Result
from vcmvsp.cosim.scenario import loader as scenarios

if TYPE_CHECKING:
    from vcmvsp.cosim.view.live.session import Viewing

Vector = NDArray[np.float32]
Actions = Mapping[str, Any]
MODES = ("human", "rgb_array")
_STATE_BOUNDS = (1.0, 1.0) + (SPEED_BOUND,) * 3 + (YAW_RATE_BOUND,)


class _OfScenario(Task):
    """All vehicles of a scenario, without a reward of its own."""

    def __init__(self, scenario: str | Path | Mapping[str, Any]) -> None:
        self._scenario = scenario

    def scenario(self) -> Mapping[str, Any] | str | Path:
        """The scenario."""
        return self._scenario


def task_of(task: str | Path | Mapping[str, Any] | Task | type[Task]) -> Task:
    """The task of a name, a class, or a scenario.

    Raises:
        UsageError: there is no such task or scenario, or a custom task has no scenario.
    """
    if isinstance(task, type) and issubclass(task, Task):
        task = task()
    if isinstance(task, Task):
        if type(task).scenario is Task.scenario:
            raise UsageError(
                f"task {type(task).__name__}: names no scenario: define scenario(), which returns a name or a table"
            )
        return task
    if isinstance(task, str) and task.removeprefix("vcmvsp/").removesuffix("-v0") in TASKS:
        return TASKS[task.removeprefix("vcmvsp/").removesuffix("-v0")]()
    if isinstance(task, Mapping | Path) or (isinstance(task, str) and (task.endswith(".toml") or "/" in task)):
        return _OfScenario(task)
    if isinstance(task, str) and task in scenarios.names():
        return _OfScenario(task)
    raise UsageError(
        f"task: {unknown('task', str(task), TASKS)}, a scenario, or an object of a class derived from vcmvsp.env.Task"
    )


class VehiclesEnv(ParallelEnv[str, Vector, Vector]):  # type: ignore[misc]  # PettingZoo has no types
    """All vehicles of a task as agents of a PettingZoo environment; arguments as of `parallel_env`.

    An observation is a vector (`layout` names its parts). An action is a vector in [-1, 1]: motion (forward speed and yaw rate,
    or the velocity in x, y, z and the yaw rate, as shares of the task's greatest), then a number above 0 to send a message,
    then the message. ``infos`` count the frames that were decided since the last step: ``frames_sent``, ``received`` (at all
    receivers), and ``lost`` by cause.

    Attributes:
        task: the task.
        layout: places of the parts of an observation; `views` gives them by name.
    """

    def __init__(
        self,
        task: Task,
        *,
        seed: int | None = None,
        set: Mapping[str, Any] | None = None,  # noqa: A002  the word of the command line
        render_mode: str | None = None,
        max_cycles: int | None = None,
        record: bool = False,
    ) -> None:
        if render_mode not in (None, *MODES):
            raise UsageError(f"render_mode: {unknown('mode', str(render_mode), MODES)}")
        self.task, self.render_mode = task, render_mode
        self.metadata = {
            "name": f"vcmvsp/{task.name}-v0",
            "render_modes": list(MODES),
            "is_parallelizable": True,
        }
        self.scenario = TaskScenario(task, set, max_cycles)
        self.metadata["render_fps"] = round(1.0 / self.scenario.period_s)
        self.possible_agents = list(self.scenario.names)
        self.agents: list[str] = []
        self._next_seed = self.scenario.seed if seed is None else seed
        self._record = record or render_mode == "human"
        self._episode: Episode | None = None
        self._view: Viewing | None = None
        self._ticks = 0
        self._begin(self._next_seed, shows=False)  # the first episode tells the sizes
        first = self._now.observed
        self._sensors, feature_count = SensorVector(task.sensors, self._now.readings()), task.features(first).shape[-1]
        self.layout = Layout(len(self.possible_agents), task.message_floats, feature_count, self._sensors.size)
        self._bounds = self.layout.bounds(task, self._sensors.bounds)
        actions = task.action_size
        self._observation_spaces = {each: Box(*self._bounds, dtype=np.float32) for each in self.possible_agents}
        self._action_spaces = {each: Box(-1.0, 1.0, (actions,), np.float32) for each in self.possible_agents}
        bounds = np.tile([*(task.reach_m,) * 3, *_STATE_BOUNDS], len(self.possible_agents))
        bounds = np.append(bounds, np.full(task.shared(first).shape[-1], max(task.reach_m, task.features_bound())))
        self.state_space = Box(-bounds.astype(np.float32), bounds.astype(np.float32), dtype=np.float32)
        self.close()
        self._next_seed -= 1

    def __getstate__(self) -> dict[str, Any]:
        """A copy in another process has no episode until it is reset, with the seed that would come next here."""
        return {**self.__dict__, "_episode": None, "_view": None, "agents": []}

    def observation_space(self, agent: str) -> Box:
        """The space of a vehicle's observations."""
        return self._observation_spaces[agent]

    def action_space(self, agent: str) -> Box:
        """The space of a vehicle's actions."""
        return self._action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, Vector], dict[str, dict[str, Any]]]:
        """Start an episode; without a seed, that of the episode before plus one."""
        self._begin(self._next_seed if seed is None else seed)
        self.agents = self.possible_agents[:]
        return self._observations(), self._infos()

    def step(
        self, actions: Actions
    ) -> tuple[dict[str, Vector], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Act, and go on to the next tick; every vehicle needs an action, or all have None at the end of an episode.

        Raises:
            UsageError: an action is missing, has another shape or is not finite, or no episode is under way.
        """
        if not self.agents:
            raise UsageError("step(): no episode is under way; call reset()")
        values = self._checked(actions)
        motions = self.task.motions
        goes_on = self._now.step(
            self.task.motion(values[:, :motions].astype(float)), values[:, motions] > 0.0, values[:, motions + 1 :]
        )
        rewards, done = self.task.step(self._now.true)
        self._ticks += 1
        ended, cut = bool(done[0]), not goes_on or self._ticks >= self.scenario.steps
        observations, infos, alive = self._observations(), self._infos(), self.agents
        if ended or cut:
            self.agents = []
        return (
            observations,
            dict(zip(alive, rewards[0].tolist(), strict=True)),
            dict.fromkeys(alive, ended),
            dict.fromkeys(alive, cut and not ended),
            infos,
        )

    def state(self) -> Vector:
        """For a critic: the true states of all vehicles, 9 numbers each (`task.OWN`), then what the task shares."""
        true = self._now.true
        own = [true.position, np.cos(true.yaw)[..., None], np.sin(true.yaw)[..., None], true.velocity, true.yaw_rate[..., None]]
        values = np.append(np.concatenate(own, axis=-1).ravel(), self.task.shared(true).ravel())
        return np.clip(values, self.state_space.low, self.state_space.high).astype(np.float32)

    def views(self, observations: NDArray[Any]) -> Observed:
        """The parts of observations (..., n, size) by name."""
        return Observed(observations, self.layout)

    @property
    def worlds(self) -> Worlds:
        """The true state of the one world."""
        return self._now.true

    def render(self) -> NDArray[np.uint8] | None:
        """A picture from above, (height, width, 3) RGB; None in mode ``human``, where the control station shows the run."""
        if self.render_mode != "rgb_array":
            return None
        from vcmvsp.cosim.learning.drawing import picture

        return picture(self.task, self._now.true, self._now.reports, self.possible_agents)

    def result(self) -> Result:
        """The result of the present episode's run, which ends with this; an environment with ``record=True`` only."""
        self.agents = []
        return self._now.run.result()

    def close(self) -> None:
        """Release the run."""
        if self._episode is not None:
            self._episode.run.close()
        if self._view is not None:
            self._view.close()

    @property
    def _now(self) -> Episode:
        assert self._episode is not None  # noqa: S101  made by the constructor
        return self._episode

    def _begin(self, seed: int, *, shows: bool = True) -> None:
        self.close()
        self._next_seed, self._ticks = seed + 1, 0
        if shows and self.render_mode == "human":
            from vcmvsp.cosim.view.live.session import Viewing

            self._view = Viewing(opened=lambda url: print(f"control station: {url}"))  # noqa: T201  for the person at the terminal
        self._episode = Episode(self.scenario, seed, record=self._record, view=self._view)

    def _observations(self) -> dict[str, Vector]:
        observed = self._now.observed
        values = self.layout.observations(observed, self.task.features(observed), self._bounds)[0]
        if self._sensors.size:
            readings = self._now.readings()
            for row, name in enumerate(self.possible_agents):
                values[row, self.layout.sensors] = self._sensors.values(readings[name].readings)
        return dict(zip(self.possible_agents, values, strict=True))

    def _infos(self) -> dict[str, dict[str, Any]]:
        return {name: count.info() for name, count in zip(self.possible_agents, self._now.frames, strict=True)}

    def _checked(self, actions: Actions) -> Vector:
        """Actions of all vehicles within their bounds, (n, a)."""
        size = self.task.action_size
        for name in self.agents:
            if name not in actions:
                raise UsageError(f"step(): no action for {name}")
        if wrong := [name for name in actions if name not in self.agents]:
            raise UsageError(f"step(): {unknown('vehicle', wrong[0], self.agents)}")
        rows = np.empty((len(self.agents), size), np.float32)
        for row, name in enumerate(self.agents):
            action = actions[name]
            try:
                action = np.asarray(action, np.float32)
            except (TypeError, ValueError):
                raise UsageError(f"step(): the action of {name} must be {size} numbers, not {action!r}") from None
            if action.shape != (size,):
                raise UsageError(f"step(): the action of {name} has the shape {action.shape}; it must be ({size},)")
            rows[row] = action
        if not np.isfinite(rows).all():
            name = self.agents[int(np.argmin(np.isfinite(rows).all(axis=1)))]
            raise UsageError(f"step(): the action of {name} is not finite: {rows[self.agents.index(name)].tolist()}")
        return np.minimum(np.maximum(rows, -1.0), 1.0)
