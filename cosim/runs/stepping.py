"""``vcmvsp.start``: a run that its caller steps, in the same process: for notebooks, learning and other simulators."""

import time
from collections.abc import Collection, Generator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, Self, cast

from vcmvsp.cosim.agent import DrivenVehicle, Observation
from vcmvsp.cosim.assembly.run import AssembledRun, assemble, clock_of
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.config.binding import unknown
from vcmvsp.cosim.errors import UsageError, VcmvspError
from vcmvsp.cosim.kernel.kernel import Kernel, Observer
from vcmvsp.cosim.runs.api import Result, Simulation
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.types import Receptions, Velocity, Waypoint
from vcmvsp.cosim.util.files import Folder, writing
from vcmvsp.cosim.util.text import Tell

if TYPE_CHECKING:
    from vcmvsp.cosim.view.live.session import Viewing

Command = Velocity | Waypoint | None
Steps = Generator[None, bool | None, VcmvspError | None]


class Observes(Protocol):
    """The host of the driven vehicles (`agents.driven_host.DrivenHost`)."""

    observations: dict[str, Observation]
    received: Receptions | None
    from_ns: int

    def act(self, commands: Mapping[str, Command]) -> None:
        """Set the commands of the present tick."""


class SteppedRun:
    """A run that goes on when its caller asks for the next observations; made by `start`.

    Use it as a context manager: leaving it releases what the run holds; a result has to be taken before.

    Attributes:
        vehicles: the driven vehicles, by name: send with ``run.vehicles["car1"].radio.send(...)``, record with ``note(...)``,
            set ``follows`` to measure a formation error.
        observations: of the present step, by vehicle; empty at the end of the run.
        last: of the end of the run, where no vehicle acts; empty before.
    """

    def __init__(
        self,
        run: AssembledRun,
        vehicles: Mapping[str, DrivenVehicle],
        steps: Steps,
        simulation: Simulation | None,
        folder: Path | None = None,
    ) -> None:
        self._run, self.vehicles, self._simulation, self._folder = run, vehicles, simulation, folder
        self._host = cast("Observes", next(each for each in run.federates if each.name == DRIVEN))
        self._steps: Steps | None = steps
        self._started, self._cpu_s = datetime.now(UTC), time.process_time()
        self._result: Result | None = None
        self.observations: dict[str, Observation] = {}
        self.last: dict[str, Observation] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def step(self, until_s: float | None = None) -> dict[str, Observation]:
        """Run to the first tick of a driven vehicle at or after a time, and at least one tick further.

        Ticks in between keep the last command; the messages that arrive at them are in the next observation.

        Args:
            until_s: simulated time, s; None: the next tick.

        Returns:
            The observations of the vehicles that have a tick then, by vehicle; empty: the run has ended.

        Raises:
            FederateError: a part or an agent failed; ``error.result`` is the `Result` so far.
        """
        self._host.from_ns = 0 if until_s is None else seconds_to_ns(until_s)
        self.observations = {}
        while self._steps is not None and not self.observations:
            self._go_on(self._steps)
        return self.observations

    @property
    def received(self) -> Receptions | None:
        """The messages in ``heard`` of all present observations, as columns by receiver and arrival; None: there are none."""
        return self._host.received

    def act(self, commands: Mapping[str, Command]) -> None:
        """Set the commands of the present step, by vehicle; without one a vehicle keeps its last command.

        Raises:
            UsageError: a vehicle has no tick now.
            AgentError: a command is no `Velocity` or `Waypoint`, or not finite. The run can go on.
        """
        for vehicle in commands:
            if vehicle not in self.observations:
                tick = unknown("vehicle", vehicle, self.observations) if self.observations else "no vehicle has a tick now"
                raise UsageError(f"act(): {tick}")
        self._host.act(commands)

    def result(self) -> Result:
        """End the run here, if it has not ended, and return its result.

        Raises:
            FederateError: a part failed at its end; ``error.result`` is the `Result` so far.
            UsageError: the run is not recorded, or has been closed.
        """
        if self._simulation is None:
            raise UsageError("result(): the run is not recorded: leave out record=False")
        if self._steps is not None:
            if not self.observations:  # it has not begun
                self.step()
            if self._steps is not None:
                self._go_on(self._steps, is_end=True)
        if self._result is None:
            raise UsageError("result(): the run has been closed: ask for the result before")
        return self._result

    def close(self) -> None:
        """Release what the run holds. Repeated calls are allowed."""
        if self._steps is not None:
            self._steps.close()
            self._steps = None
        self._run.hosts.close()

    def _go_on(self, steps: Steps, *, is_end: bool = False) -> None:
        try:
            if is_end:
                steps.send(True)
            else:
                next(steps)
        except StopIteration as stop:
            self._steps = None
            self.observations, self.last = {}, {} if is_end else self._host.observations
            self._finish(stop.value)
        else:
            self.observations = self._host.observations

    def _finish(self, failure: VcmvspError | None) -> None:
        if self._simulation is not None:
            cpu_s = time.process_time() - self._cpu_s
            with writing(self._folder):
                self._result, failure = self._simulation.result(failure, self._started, cpu_s)
            if failure is not None:
                failure.result = self._result
        if failure is not None:
            raise failure


DRIVEN = "caller"
"""Name of the federate of driven vehicles."""


def start(
    scenario: str | Path | Mapping[str, Any] | scenarios.Loaded,
    *,
    seed: int | None = None,
    set: Mapping[str, Any] | None = None,  # noqa: A002  the word of the command line
    drives: Collection[str] | None = None,
    out: str | Path | None = None,
    force: bool = False,
    mcap: bool = True,
    record: bool = True,
    observe: Observer | None = None,
    view: "Viewing | None" = None,
    tell: Tell = lambda _: None,
) -> SteppedRun:
    """Start a run that its caller steps: ``with vcmvsp.start("formation-circle") as run: observations = run.step()``.

    It gives the same bytes as `vcmvsp.run` with agents that give the same commands and messages.

    Args:
        scenario, seed, set, out, force, mcap, view, tell: as of `vcmvsp.run`.
        drives: names of the vehicles that the caller drives; the others keep their agents. None: all vehicles.
        record: keep tables and metrics; without it there is no `SteppedRun.result`.
        observe: called with every event at its own time, after the recording.

    Raises:
        ScenarioError: the scenario cannot be run as it is.
        UsageError: ``drives`` names no vehicle, or ``out`` already holds a run.
    """
    loaded = scenario if isinstance(scenario, scenarios.Loaded) else scenarios.load(scenario, settings=set, seed=seed)
    parsed, source = loaded
    names = [each.name for each in parsed.vehicle]
    chosen = names if drives is None else list(drives)
    for name in chosen:
        if name not in names:
            raise UsageError(f"drives: {unknown('vehicle', name, names)}")
    if not chosen:
        raise UsageError("drives: names no vehicle; vcmvsp.run() runs a scenario with agents only")
    vehicles = {name: DrivenVehicle() for name in chosen}
    folder = None if out is None else Folder(Path(out), force=force)
    built = (lambda _: None) if view is None else view.prepare
    clock = clock_of(parsed, None, replayed=False)
    run = assemble(parsed, source, clock=clock, objects=vehicles, connect=True, built=built, tell=tell)
    if not record:
        return SteppedRun(run, vehicles, _unrecorded(run, observe or (lambda _: None)), None)
    simulation = Simulation(run, folder, mcap=mcap or folder is not None, progress=None, tell=tell, observe=observe, view=view)
    return SteppedRun(run, vehicles, simulation.steps(), simulation, None if folder is None else folder.path)


def _unrecorded(run: AssembledRun, observe: Observer) -> Steps:
    """Steps of a run without a recording."""
    kernel = Kernel(run.info, run.federates, clock=run.clock)
    run.start(kernel)
    try:
        kernel.begin(observe)
        while kernel.advance():
            yield
    finally:
        kernel.close()
    return None
