"""``vcmvsp.env.vector_env``: many worlds of a task side by side, as arrays."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from vcmvsp.cosim.assembly.world_batch import WorldBatch
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.frames import yaws_of
from vcmvsp.cosim.learning.episode import TaskScenario
from vcmvsp.cosim.learning.mail import Mail
from vcmvsp.cosim.learning.task import Bools, Floats, Layout, Observed, Task, Worlds

Vectors = NDArray[np.float32]
BYTES_PER_NUMBER = 4
_NO_FRAMES: tuple[tuple[str, ...], NDArray[np.int64]] = (), np.zeros((1, 1, 0), np.int64)  # words and codes


class WorldsEnv:
    """w worlds of a task with n vehicles each; arguments as of `vector_env`.

    World k of the first episode is the world of `parallel_env` with the seed ``seed + k``: observations, rewards and frames are
    equal. All worlds begin together; a world whose task is done goes on, with the reward 0, until ``reset``.

    Attributes:
        task: the task.
        names: of the vehicles of a world.
        layout: places of the parts of an observation.
        single_observation_space, single_action_space: of one vehicle.
        worlds: the state of all worlds.
    """

    def __init__(
        self,
        task: Task,
        num_envs: int,
        *,
        seed: int | None = None,
        set: Mapping[str, Any] | None = None,  # noqa: A002  the word of the command line
        max_cycles: int | None = None,
    ) -> None:
        if num_envs < 1:
            raise UsageError(f"num_envs: must be at least 1, not {num_envs}")
        if task.sensors:
            raise UsageError(f"task {task.name}: sensors are observed in parallel_env only, not {', '.join(task.sensors)}")
        self.task, self.num_envs = task, num_envs
        self.scenario = TaskScenario(task, set, max_cycles)
        self.names = self.scenario.names
        self._next_seed = self.scenario.seed if seed is None else seed
        loaded = self.scenario.load(self._next_seed)[0]
        self._batch = WorldBatch(loaded.scenario, loaded.source, self.scenario.period_s)
        self.worlds: Worlds
        self._done: Bools
        self._memory: dict[str, Any]
        self._frames: tuple[tuple[str, ...], NDArray[np.int64]]
        self._begin(self._next_seed)  # tells the sizes
        self._next_seed -= num_envs
        feature_count = task.features(self.worlds).shape[-1]
        self.layout = Layout(len(self.names), task.message_floats, feature_count)
        self._bounds = self.layout.bounds(task)
        self._actions = task.action_size
        self.single_observation_space = Box(*self._bounds, dtype=np.float32)
        self.single_action_space = Box(-1.0, 1.0, (self._actions,), np.float32)

    def reset(self, seed: int | None = None) -> tuple[Vectors, dict[str, Any]]:
        """Start an episode in all worlds, with the seeds ``seed``, ``seed + 1``, ...; None: those after the last ones.

        Returns:
            Observations (w, n, size), and infos as of `step`.
        """
        self._begin(self._next_seed if seed is None else seed)
        return self._observations(), self._infos(np.zeros((self.num_envs, len(self.names)), np.bool_))

    def step(self, actions: NDArray[Any]) -> tuple[Vectors, Floats, Bools, Bools, dict[str, Any]]:
        """Act in all worlds, (w, n, a), and go on to the next tick.

        Returns:
            Observations (w, n, size); rewards (w, n); whether the tasks are done (w,); whether the episodes are over by time
            (w,); and infos: ``frames_sent`` and ``received`` (w, n), and ``lost``: cause -> (w, n).
        """
        if self._ticks >= self.scenario.steps:
            raise UsageError("step(): the episodes are over; call reset()")
        values = self._checked(actions)
        motions, task = self.task.motions, self.task
        sends = values[..., motions] > 0.0
        frames = self._batch.send(sends, BYTES_PER_NUMBER * task.message_floats)
        arrival_ns = np.where(sends[..., None], frames.arrival_ns, -1)
        self._sent.append((self._batch.now_ns, values[..., motions + 1 :].astype(float), arrival_ns, frames.rssi_dbm))
        self._ticks += 1
        self._batch.advance(task.motion(values[..., :motions].astype(float)), self._ticks * self.scenario.period_ns)
        self._look()
        rewards, done = task.step(self.worlds)
        rewards = np.where(self._done[:, None], 0.0, rewards)
        self._done = self._done | done
        cut = np.full(self.num_envs, self._ticks >= self.scenario.steps) & ~self._done
        self._frames = frames.words, np.where(sends[..., None], frames.code, -1)
        return self._observations(), rewards, self._done.copy(), cut, self._infos(sends)

    def views(self, observations: NDArray[Any]) -> Observed:
        """The parts of observations (..., n, size) by name."""
        return Observed(observations, self.layout)

    def close(self) -> None:
        """Do nothing: no resource is open."""

    def _begin(self, seed: int) -> None:
        seeds = range(seed, seed + self.num_envs)
        self._next_seed, self._ticks = seed + self.num_envs, 0
        episodes = [self.scenario.begin(each) for each in seeds]
        poses = np.stack([starts for starts, _ in episodes])
        self._memory = {}
        for name in episodes[0][1]:
            self._memory[name] = np.stack([memory[name] for _, memory in episodes])
        self._done = np.zeros(self.num_envs, np.bool_)
        self._frames = _NO_FRAMES
        self._mail = Mail(self.num_envs, len(self.names), self.task.message_floats)
        self._sent: list[tuple[int, Floats, NDArray[np.int64], Floats]] = []  # messages that have not arrived everywhere
        self._batch.start(seeds, poses)
        self._look()

    def _look(self) -> None:
        now_ns = self._batch.now_ns
        for sent_ns, message, arrival_ns, rssi_dbm in self._sent:  # the oldest first
            self._mail.take(now_ns, sent_ns, message, arrival_ns, rssi_dbm)
        self._sent = [each for each in self._sent if (each[2] > now_ns).any()]
        position, velocity, attitude, yaw_rate = self._batch.motion()
        self.worlds = Worlds(
            time_s=np.full(self.num_envs, now_ns / 1e9),
            position=position,
            velocity=velocity,
            yaw=yaws_of(attitude),
            yaw_rate=yaw_rate,
            memory=self._memory,
            **self._mail.ages(now_ns),
        )

    def _observations(self) -> Vectors:
        return self.layout.observations(self.worlds, self.task.features(self.worlds), self._bounds)

    def _infos(self, sends: Bools) -> dict[str, Any]:
        words, code = self._frames
        code = np.broadcast_to(code, (*sends.shape, code.shape[-1]))
        causes = {number: words[number] for number in np.unique(code[code > 0]).tolist()}
        lost = {cause: (code == number).sum(axis=-1) for number, cause in causes.items()}
        return {"frames_sent": sends.astype(int), "received": (code == 0).sum(axis=-1), "lost": lost}

    def _checked(self, actions: NDArray[Any]) -> Vectors:
        shape = self.num_envs, len(self.names), self._actions
        try:
            values = np.asarray(actions, np.float32)
        except (TypeError, ValueError):
            raise UsageError(f"step(): actions must be numbers of the shape {shape}") from None
        if values.shape != shape:
            raise UsageError(f"step(): actions have the shape {values.shape}; it must be {shape}: worlds, vehicles, numbers")
        if not np.isfinite(values).all():
            world, vehicle, _ = np.argwhere(~np.isfinite(values))[0].tolist()
            raise UsageError(f"step(): the action of {self.names[vehicle]} in world {world} is not finite")
        return np.clip(values, -1.0, 1.0)
