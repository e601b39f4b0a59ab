"""``vcmvsp.run``: runs a scenario and returns a `Result`, for the command line, notebooks and studies.

Covers a run from its first event to its files: kernel, recording, interruption, and facts about the machine.
"""

import contextlib
import functools
import io
import platform
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, BinaryIO, get_args

import msgspec
import numpy as np
import tomli_w

from vcmvsp.cosim.agent import Agent
from vcmvsp.cosim.assembly import real_vehicles
from vcmvsp.cosim.assembly.run import AssembledRun, assemble, clock_of
from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import AgentError, FederateError, Interrupted, UsageError, VcmvspError
from vcmvsp.cosim.federate import ControllingStack, Event
from vcmvsp.cosim.kernel.kernel import Kernel, Observer
from vcmvsp.cosim.metrics.own import own_values
from vcmvsp.cosim.recording import external_inputs
from vcmvsp.cosim.recording.external_inputs import FILE
from vcmvsp.cosim.recording.mcap_writer import MessageSink
from vcmvsp.cosim.recording.recorder import Recorder
from vcmvsp.cosim.runs import notebook
from vcmvsp.cosim.runs.control import StackControl
from vcmvsp.cosim.runs.figures import Drawer, Draws, draw
from vcmvsp.cosim.runs.result import Result, compared, figures_again
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.scenario import schema
from vcmvsp.cosim.tables.schema import write_table
from vcmvsp.cosim.types import Presence
from vcmvsp.cosim.util.files import Folder, finite, write_whole, writing
from vcmvsp.cosim.util.text import Tell, plain
from vcmvsp.cosim.util.versions import versions_of

if TYPE_CHECKING:
    from vcmvsp.cosim.view.live.session import Viewing


class SlowAgents:
    """A thread that watches the run's thread and reports agents that compute for too long.

    Args:
        deadline_s: wall time after which a computing agent is reported.
    """

    def __init__(self, now_ns: Callable[[], int], deadline_s: float, tell: Tell) -> None:
        self._now_ns, self._deadline_s, self._tell = now_ns, deadline_s, tell
        self._run, self._over = threading.get_ident(), threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def _watch(self) -> None:
        tick, since, is_reported = ("", -1), time.monotonic(), False
        while not self._over.wait(min(self._deadline_s / 4, 1.0)):
            label, location = computing(sys._current_frames().get(self._run))  # noqa: SLF001  the only access to another thread's frame
            if (label, self._now_ns()) != tick:
                tick, since, is_reported = (label, self._now_ns()), time.monotonic(), False
            elif label and not is_reported and (for_s := time.monotonic() - since) > self._deadline_s:
                is_reported = True
                self._tell(f"{label} has been computing for {for_s:.0f} s ({location}); Ctrl-C twice ends the run at once")


def computing(frame: FrameType | None) -> tuple[str, str]:
    """The agent that computes in a thread and its code location, in words; empty if none does."""
    location = (
        "" if frame is None else f"{Path(frame.f_code.co_filename).name} line {frame.f_lineno}, in {frame.f_code.co_name}"
    )
    label = ""
    while frame is not None:
        agent, runner = frame.f_locals.get("self"), frame.f_back and frame.f_back.f_locals.get("self")
        if isinstance(agent, Agent) and (vehicle := getattr(runner, "vehicle", "")):
            label = f"agent {type(agent).__name__} of vehicle {vehicle}"
        frame = frame.f_back
    return label, location


def host_facts() -> dict[str, str]:
    """Name and system of the machine, for ``about.json``; `platform.platform` would start a program."""
    system = f"{platform.system()}-{platform.release()}-{platform.machine()}"
    return {"name": platform.node(), "system": system, "python": platform.python_version()}


Progress = Callable[[int, int], None]
ABOUT_SCHEMA = "vcmvsp.about/1"
DELIVERIES = "bridge.parquet"
"""Table of deliveries to external programs and their wall-clock lateness, which a repetition does not reproduce."""


class Simulation:
    """One run: kernel and recording, from the first event to the files.

    Args:
        folder: receives the files; None: they stay in memory.
        progress: called with (now, end) in ns before every instant; default: in Jupyter, a bar.
        observe: called with every event, after the recording.
        view: shows the run and accepts interventions.
        speed: initial speed of the view, simulated seconds per wall second.
        sink: also receives the messages of the recording.
    """

    def __init__(
        self,
        run: AssembledRun,
        folder: Folder | None,
        *,
        mcap: bool,
        progress: Progress | None,
        tell: Tell,
        observe: Observer | None = None,
        view: "Viewing | None" = None,
        speed: float | None = None,
        sink: MessageSink | None = None,
    ) -> None:
        self._run, self._folder, self._progress, self._tell, self._over = run, folder, progress, tell, False
        callers = [each for each in run.stacks.values() if isinstance(each, ControllingStack)]
        self._control = StackControl(run, callers, stop=self._stop, clock=run.clock) if callers else None
        self._clock = run.clock if self._control is None else self._control.clock
        self._live = None if view is None else view.live(run, speed or 1.0, stop=self._stop, tell=tell, clock=self._clock)
        if self._live is not None:
            self._clock = self._live.clock
            if self._control is not None:
                self._control.also = self._live.listen
        if self._live is not None or self._control is not None:  # orders may come at any time
            for radio in run.radios:
                radio.looks_ahead = False
        topics, live = run.hosts.topics, self._live
        self._broadcast = None
        if topics is not None:
            from vcmvsp.cosim.view.live.broadcast import Broadcast

            self._broadcast = Broadcast(run, topics)
        self._observers: list[Observer] = [] if topics is None else [topics.on]
        self._observers += [] if observe is None else [observe]
        self._observers += [each.on for each in (self._control, live, self._broadcast) if each is not None]
        self._resolved = run.resolved()  # before the run: an error here must not discard a finished run
        info = msgspec.structs.replace(run.info, paced=self._clock.speed is not None)
        strict = run.scenario.clock.late == "stop"
        self._kernel = Kernel(info, run.federates, clock=self._clock, tolerance_ns=self._tolerance_ns(), strict=strict)
        self._mcap = io.BytesIO() if mcap and folder is None else None
        self._recorder: Recorder | None = None
        self._sink = sink

    def run(self) -> VcmvspError | None:
        """Run to the end; returns an error after the start, so that the recording can be kept."""
        steps = self.steps()
        try:
            while True:
                next(steps)
        except StopIteration as end:
            failure: VcmvspError | None = end.value
            return failure

    def steps(self) -> Generator[None, bool | None, VcmvspError | None]:
        """Run to the end, with a stop wherever a driven vehicle waits for its command; returns what `run` returns.

        True sent at a stop ends the run there.
        """
        kernel = self._kernel
        self._run.start(kernel)
        try:
            with self._recording() as recorder:
                failure = yield from self._go(recorder)
        except BaseException:
            with contextlib.suppress(VcmvspError):
                kernel.close()
            raise
        try:
            kernel.close()
        except FederateError as error:
            failure = failure or error
        return failure

    @contextlib.contextmanager
    def calm(self) -> Iterator[None]:
        """Delay Ctrl-C to a safe point: a wait, or the end of a slot. A second Ctrl-C acts at once.

        After the run, the first Ctrl-C only reports that files are written, and what a second one would leave.
        """
        kernel, saved = self._kernel, {}

        def on_signal(number: int, frame: Any) -> None:
            if kernel.waiting or kernel.stop:
                signal.default_int_handler(number, frame)
            kernel.stop = True
            if self._over:
                self._tell(
                    f"the run has ended and its files are being written; another Ctrl-C stops that: {self._remaining_work()}"
                )

        if threading.current_thread() is threading.main_thread():  # other threads receive no signals
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                if signal.getsignal(number) is signal.default_int_handler:  # else the caller has its own handler
                    saved[number] = signal.signal(number, on_signal)
        try:
            yield
        except KeyboardInterrupt:
            if not self._over:
                raise
            raise Interrupted(f"interrupted while the files of the run were written: {self._remaining_work()}") from None
        finally:
            for number, handler in saved.items():
                signal.signal(number, handler)

    def _remaining_work(self) -> str:
        """What remains of a run whose files are not all written, in words."""
        return "nothing is kept" if self._folder is None else f"run.mcap in {self._folder.path} is whole"

    def _go(self, recorder: Recorder) -> Generator[None, bool | None, VcmvspError | None]:
        kernel = self._kernel
        failure: VcmvspError | None = None
        begin, on_instant, is_cut = time.monotonic(), self._on_instant(), False
        try:
            with SlowAgents(lambda: kernel.now_ns, self._run.scenario.agents.deadline_s, self._tell):
                kernel.begin(self._observer(recorder))
                while not is_cut and kernel.advance(on_instant):
                    is_cut = bool((yield))
        except KeyboardInterrupt as error:
            failure = Interrupted(f"interrupted at {kernel.now_ns / 1e9:.3f} s{error}")
        except VcmvspError as error:
            failure = error
        kernel.release()
        self._simulating_s, self._over = time.monotonic() - begin, True
        if isinstance(failure, AgentError):
            presence = Presence(state="lost", since_ns=kernel.now_ns, why=plain(failure.cause))
            for vehicle in failure.vehicles:
                recorder.on(Event(f"{vehicle}/host", kernel.now_ns, presence))
        last = str(
            failure or (f"ended by its caller at {kernel.now_ns / SECOND_NS:.3f} s" if is_cut else "the run is complete")
        )
        recorder.log("error" if failure else "info", last, kernel.now_ns)
        recorder.close(kernel.now_ns, is_cut=is_cut or failure is not None)
        if self._broadcast is not None:
            self._broadcast.close(last)
        if self._live is not None:
            where = "it is not recorded" if self._folder is None else f"`vcmvsp view {self._folder.path}` opens the recording"
            self._live.close(f"{last}; {where}")
        return failure

    def _stop(self) -> None:
        """End the run like Ctrl-C; at once while it waits, since a paused run would never reach the next slot."""
        if self._kernel.waiting:
            raise KeyboardInterrupt
        self._kernel.stop = True

    def _on_instant(self) -> Callable[[int], None] | None:
        """Callback before each instant: progress display and live view."""
        progress, live, broadcast, control = self._progress, self._live, self._broadcast, self._control
        clock, end_ns = self._clock, self._run.info.duration_ns
        if live is None and broadcast is None and control is None:
            return None if progress is None else lambda now: progress(now, end_ns)

        def all_of_them(now_ns: int) -> None:
            if live is not None:
                live.on_instant(now_ns)
            if broadcast is not None:
                broadcast.pace(clock.speed)
            if control is not None:
                control.on_instant(now_ns)
            if progress is not None:
                progress(now_ns, end_ns)

        return all_of_them

    def _observer(self, recorder: Recorder) -> Observer:
        """Passes each event to the recording, then to the other observers."""
        observers = self._observers
        if not observers:
            return recorder.on

        def on(event: Event) -> None:
            recorder.on(event)
            for observer in observers:
                observer(event)

        return on

    @contextlib.contextmanager
    def _recording(self) -> Iterator[Recorder]:
        with contextlib.ExitStack() as stack:
            stream: BinaryIO | None = self._mcap
            if self._folder is not None:
                stream = self._new_file(stack, self._folder.claim() / "run.mcap")
                self._write_scenario(self._folder.path)
            folder = None if self._folder is None else self._folder.path
            self._recorder = self._run.recorder(
                stream, lambda text: None if self._over else self._tell(text), folder, self._sink
            )
            if self._run.has_outside and stream is not None:
                inputs = None if self._folder is None else self._new_file(stack, self._folder.path / FILE)
                self._run.inputs.open(inputs)
                stack.callback(self._run.inputs.close)
            yield self._recorder

    def _new_file(self, stack: contextlib.ExitStack, path: Path) -> BinaryIO:
        """A new file, closed by the stack; an existing one is replaced only with ``force``."""
        if self._folder and self._folder.force:
            path.unlink(missing_ok=True)  # a link is not followed
        return stack.enter_context(path.open("xb"))

    def _write_scenario(self, folder: Path) -> None:
        """Write the scenario and its files, for readers of an unfinished or killed run's recording."""
        write_whole(folder / "scenario.toml", tomli_w.dumps(self._resolved))
        for name, content in self._run.resolution.files.items():
            write_whole(folder / name, content)

    def result(
        self, failure: VcmvspError | None, started: datetime, cpu_s: float, draw: Draws = draw
    ) -> tuple[Result, VcmvspError | None]:
        """The result, written to the folder if there is one, and what failed: the run, else a metric of its own."""
        run, recorder = self._run, self._recorder
        if recorder is None:
            raise failure or VcmvspError("the run did not begin")
        resolved = run.resolved() if run.operator.done else self._resolved  # with live interventions
        metrics = finite(recorder.metrics(window=(resolved["metrics"]["from_s"], resolved["metrics"].get("to_s"))))
        files = dict(run.resolution.files)
        if content := run.inputs.content:  # kept in memory
            files[FILE] = content
        if run.bridge is not None:
            table = io.BytesIO()
            write_table(run.bridge.table(), table)
            files[DELIVERIES] = table.getvalue()
        result = Result(recorder, metrics, resolved, files, self._mcap, run.world)
        if run.metrics:
            result.metrics["own"], failed = own_values(run.metrics, result)
            failure = failure or failed
        result.about = self._about(failure, started, cpu_s)
        if self._folder is not None:
            result.write(self._folder.path, draw)
        return result, failure

    def _about(self, failure: VcmvspError | None, started: datetime, cpu_s: float) -> dict[str, Any]:
        """Content of ``about.json``: facts that differ between two equal runs."""
        run = self._run
        return {
            "schema": ABOUT_SCHEMA,
            "started": started.isoformat(),
            "wall_s": (datetime.now(UTC) - started).total_seconds(),
            "simulating_s": self._simulating_s,
            "cpu_s": cpu_s,
            "simulated_s": self._kernel.now_ns / 1e9,
            "agents": run.where,
            "lateness": self._lateness(),
            "cuts_s": run.hosts.cuts_s,
            "forged_answers": run.hosts.forged,
            "unrepeatable": run.hosts.unrepeatable,
            **({} if run.bridge is None else {"bridge": run.bridge.lateness}),
            "error": failure and {"message": str(failure), "details": getattr(failure, "details", "")},
            "host": host_facts(),
            "versions": _versions(),
        }

    def _tolerance_ns(self) -> int | None:
        """Tolerated lateness of an instant on the wall clock, or None without a wall clock."""
        if self._clock.speed is None:
            return None
        tolerance_s = self._run.scenario.clock.tolerance_s
        return seconds_to_ns(self._period_s() if tolerance_s is None else tolerance_s)

    def _period_s(self) -> float:
        """Wall-clock period of the fastest agent."""
        periods = [float(info.ticks.period) / SECOND_NS for info in self._run.agents]
        return min(periods, default=0.1) / (self._clock.speed or 1.0)

    def _lateness(self) -> dict[str, Any] | None:
        """Statistics of the lateness of agents' instants on the wall clock."""
        if self._clock.speed is None or not self._kernel.late_ns:
            return None
        late_s = np.maximum(self._kernel.late_ns, 0) / 1e9
        p50, p99 = np.percentile(late_s, [50, 99])
        return {
            "speed": self._clock.speed,
            "instants": len(late_s),
            "p50_s": float(p50),
            "p99_s": float(p99),
            "max_s": float(late_s.max()),
            "over_one_period": int((late_s > self._period_s()).sum()),
            "slipped_s": self._clock.slipped_ns / SECOND_NS,
        }


_PACKAGES = ("vcmvsp", "numpy", "simpy", "msgspec", "pyarrow", "mcap", "pybullet", "mujoco-core", "eclipse-zenoh", "matplotlib")


@functools.cache
def _versions() -> dict[str, str]:
    return versions_of(_PACKAGES)


Runs = schema.Runs

__all__ = ["Result", "Runs", "check", "plot", "run"]


def run(
    scenario: str | Path | Mapping[str, Any] | scenarios.Loaded,
    *,
    seed: int | None = None,
    set: Mapping[str, Any] | None = None,  # noqa: A002  the word of the command line
    agents: Mapping[str, Agent] | Runs | None = None,
    listen: str | None = None,
    keys: str | Path | None = None,
    insecure: bool = False,
    realtime: float | None = None,
    playback: str | Path | None = None,
    recorded_radio: str | Path | None = None,
    out: str | Path | None = None,
    numbered: bool = False,
    force: bool = False,
    mcap: bool = True,
    progress: Progress | None = None,
    tell: Tell = lambda _: None,
    observe: Observer | None = None,
    view: "Viewing | None" = None,
    sink: MessageSink | None = None,
    watch: Callable[[], str | None] | None = None,
    drawer: Drawer | None = None,
) -> Result:
    """Run a scenario to its end.

    Args:
        scenario: a built-in name, the path of a TOML file, its content as a mapping, or a loaded scenario.
        seed: replaces the scenario's.
        set: key path -> value, e.g. ``{"radio.loss.probability": 0.3}``.
        agents: agents as objects, by vehicle; or where all agents run: ``"inprocess"``, ``"process"`` or ``"zenoh"``.
        listen: endpoint for manually started hosts, overriding ``agents.listen``.
        keys: folder of certificates (``vcmvsp keys init``), for hosts on other machines.
        insecure: admit hosts on other machines without certificates.
        realtime: simulated seconds per wall-clock second, above 0; None: as fast as possible, or 1 with real vehicles.
        playback: folder of a run whose recorded real vehicles replace the robots, which are not driven.
        recorded_radio: ``radio.parquet`` of a run whose frame outcomes are repeated, see `netsim.channel.replayed`.
        out: folder to write into; the recording is then written during the run.
        numbered: if ``out`` exists, use ``out-2``, ``out-3``, ...; ``result.folder`` is the one used.
        force: write into a folder that is not empty.
        mcap: make a recording; without it only tables and metrics are kept, in memory, which takes two thirds of the time.
        progress: called with (now, end) in ns before every instant.
        tell: receives lines for the user.
        observe: called with every event at its own time, after the recording; it cannot change the run.
        view: shows the run live and accepts interventions (`cosim.view.live.session.Viewing`). The run then keeps to the wall
            clock, at speed ``realtime`` or 1 until the user changes it.
        sink: receives each message of the recording, encoded, when it is written (`cosim.view.live.foxglove_server`).
        watch: called while waiting for hosts; returns a reason to give up, or None. Default: the user is told how to start
            the hosts.
        drawer: draws the figures of a run with ``out``; it may have been started before. Default: one of this run.

    Raises:
        ScenarioError: the scenario cannot be run as it is.
        FederateError: a part or an agent failed; ``error.result`` is the `Result` so far.
        Interrupted: Ctrl-C; ``error.result`` is the `Result` so far.
        UsageError: an argument is invalid, or ``out`` already holds a run.
    """
    objects, runs = (None, agents) if agents is None or isinstance(agents, str) else (agents, None)
    if runs is not None and runs not in get_args(Runs):
        raise UsageError(f"agents: must be {binding.describe(Runs)}, not {runs!r}")
    folder = None if out is None else Folder(Path(out), force=force, numbered=numbered)
    if folder and not mcap:
        raise UsageError("mcap = False: a run with a folder always writes run.mcap; leave out one of the two")
    if sink is not None and not mcap:
        raise UsageError("mcap = False: a sink receives the messages of the recording; leave out one of the two")
    loaded = scenario if isinstance(scenario, scenarios.Loaded) else scenarios.load(scenario, settings=set, seed=seed)
    parsed, source = loaded
    progress = progress or notebook.bar(parsed.name)
    started, cpu = datetime.now(UTC), time.process_time()
    recorded, replayed, vehicles = None, None, None
    if playback is not None:
        recorded = Path(playback) / FILE
        replayed = external_inputs.read_inputs(recorded, tell=tell)
        vehicles = real_vehicles.playback(parsed, replayed, tell)
    paced = clock_of(parsed, realtime, replayed=replayed is not None)
    built = (lambda _: None) if view is None else view.prepare
    try:
        with (
            drawer or Drawer(apart=folder is not None and view is None and paced.speed is None) as drawing,
            assemble(
                parsed,
                source,
                clock=paced,
                objects=objects,
                runs=runs,
                listen=listen,
                keys=_path(keys),
                insecure=insecure,
                connect=replayed is None,
                playback=vehicles,
                bridged=replayed,
                recorded_radio=_path(recorded_radio),
                tell=tell,
                watch=watch,
                built=built,
            ) as assembled,
        ):
            if recorded is not None:
                assembled.resolution.keep(recorded)  # so that a replay can be replayed
            simulation = Simulation(
                assembled,
                folder,
                mcap=mcap,
                progress=progress,
                tell=tell,
                observe=observe,
                view=view,
                speed=realtime,
                sink=sink,
            )
            with writing(folder.path if folder else None), simulation.calm():
                failure = simulation.run()
                result, failure = simulation.result(failure, started, time.process_time() - cpu, drawing.draw)
    except KeyboardInterrupt:
        raise Interrupted("interrupted") from None
    if failure is not None:
        failure.result = result
        raise failure
    return result


def _path(path: str | Path | None) -> Path | None:
    return None if path is None else Path(path)


def check(
    scenario: str | Path | Mapping[str, Any],
    *,
    set: Mapping[str, Any] | None = None,  # noqa: A002
    tell: Tell = lambda _: None,
) -> dict[str, Any]:
    """Check a scenario: builds and starts all parts, runs nothing, returns the resolved scenario.

    All agents are built in this process. ``tell`` receives remarks on what is valid but hardly meant so.

    Raises:
        ScenarioError: the scenario cannot be run as it is.
    """
    parsed, source = scenarios.load(scenario, settings=set)
    with assemble(parsed, source, runs="here", tell=tell) as assembled:
        kernel = Kernel(assembled.info, assembled.federates)
        assembled.start(kernel)
        kernel.close()
        return assembled.resolved()


def plot(
    run_dirs: Sequence[Path], out: Path, *, kinds: Sequence[str] = ("png",), tell: Tell = lambda _: None, trust: bool = False
) -> list[Path]:
    """Draw the figures of a saved or interrupted run into the folder ``out``, or one that compares several; returns the files.

    Args:
        kinds: of the files: png, svg, pdf.
        trust: import the class of a run's world even if it is not built in.
    """
    from vcmvsp.cosim.plots import style

    figures = figures_again(run_dirs[0], tell, trust=trust) if len(run_dirs) == 1 else {"comparison": compared(run_dirs, tell)}
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        return [path for name, figure in figures.items() for path in style.save(figure, out / name, kinds)]
