"""One episode of a task in a run that is stepped (`cosim.runs.stepping`): from actions to `Worlds`, with w = 1."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.agent import Agent, Observation
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.frames import yaws_of
from vcmvsp.cosim.learning.mail import Mail
from vcmvsp.cosim.learning.task import Floats, Task, Worlds
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.runs.stepping import SteppedRun, start
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.types import FrameReport, States, Velocity

if TYPE_CHECKING:
    from vcmvsp.cosim.view.live.session import Viewing

RECEIVED = "received"
MOTION = ("position", "velocity", "attitude", "angular_velocity")
"""Names of the motion of vehicles, in `States` and in `VehicleState`."""


class TaskScenario:
    """The scenario of a task, with its changes: what is the same in all episodes.

    Args:
        settings: key path -> value, as ``set`` of `vcmvsp.run`.

    Attributes:
        names: of all vehicles.
        poses_are_true: whether all vehicles observe their true poses.
        seed: of the scenario.
        period_s, period_ns: time between two ticks.
        steps: ticks of an episode.
    """

    def __init__(self, task: Task, settings: Mapping[str, Any] | None, max_cycles: int | None = None) -> None:
        self.task, self._settings = task, dict(settings or {})
        self._content = task.scenario()
        parsed = scenarios.load(self._content, settings=self._settings).scenario
        self.names = tuple(each.name for each in parsed.vehicle)
        self._is_posed = [each.pose is not None for each in parsed.vehicle]
        starts = [each.start for each in parsed.vehicle]
        self._poses = np.array([[*position, heading] for position, heading in starts])
        self.poses_are_true = all(each.pose_source == "truth" for each in parsed.vehicle)
        self.seed, self.period_s = parsed.seed, parsed.agents.period_s or Agent.period
        duration_s = parsed.duration_s if max_cycles is None else max_cycles * self.period_s
        self._settings |= {"duration_s": duration_s, "agents.period_s": self.period_s}
        self.period_ns = seconds_to_ns(self.period_s)
        self.steps = -(-seconds_to_ns(duration_s) // self.period_ns)

    def begin(self, seed: int) -> tuple[Floats, dict[str, Any]]:
        """Start poses (n, 4), x, y, z m and heading rad, and the task's memory of the world of a seed."""
        rng = stream(seed, f"task/{self.task.name}")
        starts = self.task.starts(rng)
        if starts is None:
            starts = self._poses
        return starts, self.task.begin(rng, starts)

    def load(self, seed: int) -> tuple[scenarios.Loaded, dict[str, Any]]:
        """The scenario and the task's memory of the world of a seed."""
        (starts, memory), settings = self.begin(seed), dict(self._settings)
        if starts is not self._poses:
            for name, is_posed, (x, y, z, heading) in zip(self.names, self._is_posed, starts.tolist(), strict=True):
                if is_posed:
                    settings[f"vehicle.{name}.pose"] = [x, y, heading]
                else:
                    settings |= {f"vehicle.{name}.position": [x, y, z], f"vehicle.{name}.heading": heading}
        return scenarios.load(self._content, settings=settings, seed=seed), memory


class Episode:
    """A run of one world of a task: the caller gives actions and gets `Worlds` of w = 1.

    Attributes:
        run: the run.
        memory: of the task, arrays (1, ...).
        reports: of the frames that were decided within the last tick.
        frames: their counts, by sender.
        true, observed: state of the vehicles, and as they observe it themselves.
    """

    def __init__(self, scenario: TaskScenario, seed: int, *, record: bool = False, view: "Viewing | None" = None) -> None:
        self._scenario, self._task, self.names = scenario, scenario.task, scenario.names
        loaded, memory = scenario.load(seed)
        self.memory = {name: np.asarray(value)[None] for name, value in memory.items()}
        self._row = {name: row for row, name in enumerate(self.names)}
        self._mail = Mail(1, len(self.names), self._task.message_floats)
        self._states: States | None = None
        self.reports: list[FrameReport] = []
        self.frames: list[FrameCount] = []
        self.run: SteppedRun = start(loaded, record=record, mcap=False, observe=self._observe, view=view)
        self._next()

    def step(self, commands: Floats, sends: NDArray[np.bool_], messages: NDArray[np.float32]) -> bool:
        """Give commands (n, 4), see `Task.motion`, and messages (n, m) of those that send, (n,); whether the run goes on."""
        flies, by_vehicle = self._task.flies, {}
        for name, (x, y, z, turn) in zip(self.names, commands.tolist(), strict=True):
            by_vehicle[name] = Velocity(linear=(x, y, z) if flies else (x, 0.0, 0.0), yaw_rate=turn)
        self.run.act(by_vehicle)
        for row in np.flatnonzero(sends).tolist():
            self.run.vehicles[self.names[row]].radio.send(messages[row].astype("<f4").tobytes())
        return self._next()

    def readings(self) -> Mapping[str, Observation]:
        """The observations of all vehicles."""
        return self.run.observations or self.run.last

    def _next(self) -> bool:
        self.reports.clear()
        goes_on = bool(self.run.step())
        observations = self.readings()
        if len(observations) < len(self.names):
            missing = next(name for name in self.names if name not in observations)
            raise UsageError(
                f"{missing} has no tick with the others: all vehicles of a task need one period, and none may fail"
            )
        states = self._states
        assert states is not None  # noqa: S101  published before any tick
        now_ns = next(iter(observations.values())).time_ns
        if self.run.received is not None:
            self._mail.put(self.run.received, self._row)
        self.frames = counted(self.reports, self._row)
        rest: dict[str, Any] = {**self._mail.ages(now_ns), "time_s": np.array([now_ns / 1e9]), "memory": self.memory}
        self.true = self.observed = _world({name: getattr(states, name)[None] for name in MOTION}, rest)
        if not self._scenario.poses_are_true:
            own, motion = [observations[name].state for name in self.names], {}
            for name in MOTION:
                motion[name] = np.array([[getattr(each, name) for each in own]])
            self.observed = _world(motion, rest)
        return goes_on

    def _observe(self, event: Event) -> None:
        if event.key == "world/states":
            self._states = event.value  # type: ignore[assignment]  # the value of this key
        elif event.key == "radio/frame":
            self.reports.append(event.value)  # type: ignore[arg-type]  # the value of this key


def _world(motion: Mapping[str, Floats], rest: Mapping[str, Any]) -> Worlds:
    """One world with this motion (1, n, ...) of its vehicles."""
    yaw, yaw_rate = yaws_of(motion["attitude"]), motion["angular_velocity"][..., 2]
    return Worlds(position=motion["position"], velocity=motion["velocity"], yaw=yaw, yaw_rate=yaw_rate, **rest)


@dataclass
class FrameCount:
    """Frames of one vehicle that were decided within a tick."""

    sent: int = 0  # frames
    received: int = 0  # receptions of them, at all receivers
    lost: Counter[str] = field(default_factory=Counter)  # receivers that did not get them, by cause

    def info(self) -> dict[str, Any]:
        """The counts as a dictionary."""
        return {"frames_sent": self.sent, "received": self.received, "lost": dict(self.lost)}


def counted(reports: list[FrameReport], row: Mapping[str, int]) -> list[FrameCount]:
    """Counts by sender, in the order of vehicles."""
    counts = [FrameCount() for _ in row]
    for report in reports:
        count = counts[row[report.sender]]
        count.sent += 1
        received = report.outcome.count(RECEIVED)
        count.received += received
        if received < len(report.outcome):
            count.lost.update(outcome for outcome in report.outcome if outcome != RECEIVED)
    return counts
