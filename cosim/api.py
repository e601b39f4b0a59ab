"""``cosim.run``: a scenario in, a `Result` out. What the command line does, notebooks and studies do through here."""

import contextlib
import functools
import io
import itertools
import json
import math
import os
import platform
import shutil
import signal
import threading
import time
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
import tomli_w

from cosim import scenario as scenarios
from cosim import worlds
from cosim.agent import Agent
from cosim.assemble import Assembly
from cosim.clock import Clock, SimClock, WallClock
from cosim.errors import AgentError, FederateError, Interrupted, UsageError, VcmvspError
from cosim.federate import Event
from cosim.hosts import Tell
from cosim.kernel import Kernel, Observer
from cosim.record.metrics import Window
from cosim.record.recorder import Recorder
from cosim.record.tables import Placement, load
from cosim.text import plain
from cosim.types import Array, Presence

if TYPE_CHECKING:
    import pyarrow as pa
    from matplotlib.figure import Figure

Runs = scenarios.Runs
Progress = Callable[[int, int], None]
ABOUT_SCHEMA = "vcmvsp.about/1"


class Result:
    """What a run gave.

    Attributes:
        metrics: the numbers, as in ``metrics.json`` (schema ``vcmvsp.metrics/1``).
        about: host, versions and wall times; the only part that differs between two equal runs.
        scenario: the resolved scenario as TOML; running it gives the same result again.
        folder: where it was written, if it was.
    """

    folder: Path | None = None

    def __init__(
        self,
        recorder: Recorder,
        metrics: dict[str, Any],
        about: dict[str, Any],
        resolved: dict[str, Any],
        files: Mapping[str, bytes],
        mcap: io.BytesIO | None,
        world: Any,
    ) -> None:
        self.metrics, self.about = metrics, about
        self.scenario = tomli_w.dumps(resolved)
        self._recorder, self._files = recorder, dict(files)
        self._window = (resolved["metrics"]["from_s"], resolved["metrics"].get("to_s"))
        self._mcap, self._world = mcap, world

    @property
    def states(self) -> "pa.Table":
        """True states, a row per vehicle and recorded instant."""
        return self._recorder.states

    @property
    def radio(self) -> "pa.Table":
        """Frames, a row per frame and receiver."""
        return self._recorder.radio

    @property
    def files(self) -> Mapping[str, bytes]:
        """Files that the scenario names, as they were used, by the name under which they are kept beside it."""
        return self._files

    @property
    def follows(self) -> Sequence[Placement]:
        """Who meant to keep which place, and from when on."""
        return self._recorder.follows

    def plot(self) -> "dict[str, Figure]":
        """The run's figures, by name: ``trajectory`` and ``formation_error``."""
        recorder = self._recorder
        return _figures(recorder.states, recorder.radio, recorder.follows, self._window, worlds.outlines(self._world))

    def save(self, folder: str | Path, *, force: bool = False) -> Path:
        """Write everything that a run leaves into a folder."""
        if self._mcap is None and self.folder is None:
            raise UsageError("a run with mcap = False cannot be saved: it has no recording")
        with writing(Path(folder)):
            path = Folder(Path(folder), force=force).claim()
            if self._mcap is not None:
                (path / "run.mcap").write_bytes(self._mcap.getvalue())
            elif self.folder is not None and not path.samefile(self.folder):
                if to_json(self.about) != (self.folder / "about.json").read_text("utf-8"):
                    raise UsageError(f"{self.folder} holds another run by now, and the recording of this one was there")
                shutil.copyfile(self.folder / "run.mcap", path / "run.mcap")
            self.write(path)
        return path

    def write(self, folder: Path) -> None:
        """Everything but the MCAP file, which is written as the run goes on."""
        from cosim.record import plots

        self.folder = folder
        (folder / "scenario.toml").write_text(self.scenario, "utf-8")
        for name, content in self._files.items():
            (folder / name).write_bytes(content)
        self._recorder.write_tables(folder)
        (folder / "metrics.json").write_text(to_json(self.metrics), "utf-8")
        (folder / "about.json").write_text(to_json(self.about), "utf-8")
        for name, figure in self.plot().items():
            plots.save_png(figure, folder / f"{name}.png")


def _figures(
    states: "pa.Table", radio: "pa.Table", follows: Sequence[Placement], window: Window, outlines: Sequence[Array]
) -> "dict[str, Figure]":
    from cosim.record import plots

    return {
        "trajectory": plots.trajectory(states, follows, outlines),
        "formation_error": plots.formation_error(states, radio, follows, window),
    }


def run(
    scenario: str | Path | Mapping[str, Any],
    *,
    seed: int | None = None,
    set: Mapping[str, Any] | None = None,  # noqa: A002  the word of the command line
    agents: Mapping[str, Agent] | Runs | None = None,
    listen: str | None = None,
    keys: str | Path | None = None,
    insecure: bool = False,
    realtime: float | None = None,
    out: str | Path | None = None,
    numbered: bool = False,
    force: bool = False,
    mcap: bool = True,
    progress: Progress | None = None,
    tell: Tell = lambda _: None,
    watch: Callable[[], str | None] | None = None,
) -> Result:
    """Run a scenario to its end.

    Args:
        scenario: a built-in name, the path of a TOML file, or its content as a mapping.
        seed: instead of the scenario's.
        set: key path -> value, e.g. ``{"radio.loss.probability": 0.3}``.
        agents: agents as objects, by vehicle; or where all agents run: ``"inprocess"``, ``"process"`` or ``"zenoh"``.
        listen: endpoint for hosts that are started by hand, instead of ``agents.listen``.
        keys: folder of certificates (``vcmvsp keys init``), for hosts on other machines.
        insecure: let hosts on other machines come without certificates.
        realtime: simulated seconds per wall-clock second; None: as fast as possible.
        out: folder to write into; the recording then grows on disk while the run goes on.
        numbered: where ``out`` exists already, take ``out-2``, ``out-3``, ...: ``result.folder`` says which it was.
        force: write into a folder that is not empty.
        mcap: without it, nothing but tables and metrics is kept, in memory, which takes two thirds of the time.
        progress: called with (now, end) in ns before every instant.
        tell: takes lines for the user.
        watch: asked while hosts are waited for; an answer is why there is no use in it. None: the user starts them, told how.

    Raises:
        ScenarioError: the scenario cannot be run as it is.
        FederateError: a part or an agent failed; ``error.result`` is the `Result` up to then.
        Interrupted: Ctrl-C; ``error.result`` likewise.
    """
    objects, runs = (None, agents) if agents is None or isinstance(agents, str) else (agents, None)
    folder = None if out is None else Folder(Path(out), force=force, numbered=numbered)
    if folder and not mcap:
        raise UsageError("mcap = False: what is written into a folder includes the MCAP file")
    parsed, source = scenarios.load(scenario, settings=set, seed=seed)
    started, cpu = datetime.now(UTC), time.process_time()
    try:
        folder_of_keys = None if keys is None else Path(keys)
        with Assembly(
            parsed,
            source,
            objects=objects,
            runs=runs,
            listen=listen,
            keys=folder_of_keys,
            insecure=insecure,
            tell=tell,
            watch=watch,
        ) as assembly:
            clock = SimClock() if realtime is None else WallClock(realtime)
            simulation = _Simulation(assembly, clock, folder, progress, tell, mcap=mcap)
            with writing(folder.path if folder else None), simulation.calm():
                failure = simulation.run()
                result = simulation.result(failure, started, time.process_time() - cpu)
    except KeyboardInterrupt:
        raise Interrupted("interrupted") from None
    if failure is not None:
        failure.result = result
        raise failure
    return result


def check(scenario: str | Path | Mapping[str, Any], *, set: Mapping[str, Any] | None = None) -> dict[str, Any]:  # noqa: A002
    """Build and start everything, run nothing, and give the resolved scenario.

    Agents are built in this process, wherever the scenario runs them.

    Raises:
        ScenarioError: the scenario cannot be run as it is.
    """
    parsed, source = scenarios.load(scenario, settings=set)
    with Assembly(parsed, source, runs="here") as assembly:
        kernel = Kernel(assembly.run_info, assembly.federates)
        assembly.start(kernel)
        kernel.close()
        return assembly.resolved()


def plot(run_dir: Path, out: Path) -> list[Path]:
    """Draw the figures of a run that was saved, into the folder ``out``; the answer is what was written."""
    from cosim.record import plots

    scenario = run_dir / "scenario.toml"
    try:
        recording = load(run_dir)
        window = tomllib.loads(scenario.read_text("utf-8")).get("metrics", {}) if scenario.is_file() else {}
    except ValueError as error:  # a damaged table or scenario
        raise UsageError(f"{run_dir} cannot be read: {error}") from error
    seen: Sequence[Array] = ()
    with contextlib.suppress(VcmvspError):  # a world that is not to be had any more is not drawn
        seen = worlds.outlines(worlds.world_of(str(scenario), {})[0])
    within = window.get("from_s", 0.0), window.get("to_s")
    figures = _figures(recording.states, recording.radio, recording.follows, within, seen)
    paths = {out / f"{name}.png": figure for name, figure in figures.items()}
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        for path, figure in paths.items():
            plots.save_png(figure, path)
    return list(paths)


class _Simulation:
    """One run: kernel and recording, from the first event to the files."""

    def __init__(
        self,
        assembly: Assembly,
        clock: Clock,
        folder: "Folder | None",
        progress: Progress | None,
        tell: Tell,
        *,
        mcap: bool,
    ) -> None:
        self._assembly, self._clock, self._folder = assembly, clock, folder
        self._progress, self._tell, self._over = progress, tell, False
        self._resolved = assembly.resolved()  # before the run: what is wrong with it must not cost the run
        self._kernel = Kernel(assembly.run_info, assembly.federates, clock=clock)
        self._mcap = io.BytesIO() if mcap and folder is None else None
        self._recorder: Recorder | None = None

    def run(self) -> VcmvspError | None:
        """Run to the end; what goes wrong once the run has begun is returned, so that the recording can be kept."""
        kernel = self._kernel
        self._assembly.start(kernel)
        try:
            with self._recording() as recorder:
                failure = self._go(recorder)
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
        """Let Ctrl-C strike only where it breaks nothing: while waiting, or between two slots. A second one strikes at once."""
        kernel, saved = self._kernel, {}

        def on_signal(number: int, frame: Any) -> None:
            if kernel.waiting or kernel.stop:
                signal.default_int_handler(number, frame)
            kernel.stop = True

        if threading.current_thread() is threading.main_thread():  # elsewhere signals do not arrive
            for number in (signal.SIGINT, signal.SIGTERM):
                if signal.getsignal(number) is signal.default_int_handler:  # else somebody has plans of their own
                    saved[number] = signal.signal(number, on_signal)
        try:
            yield
        finally:
            for number, handler in saved.items():
                signal.signal(number, handler)

    def _go(self, recorder: Recorder) -> VcmvspError | None:
        kernel, progress, end_ns = self._kernel, self._progress, self._assembly.run_info.duration_ns
        failure: VcmvspError | None = None
        begin = time.monotonic()
        try:
            kernel.run(self._observer(recorder), on_instant=None if progress is None else lambda now: progress(now, end_ns))
        except KeyboardInterrupt:
            failure = Interrupted(f"interrupted at {kernel.now_ns / 1e9:.3f} s")
        except VcmvspError as error:
            failure = error
        self._simulating_s, self._over = time.monotonic() - begin, True
        if isinstance(failure, AgentError):
            gone = Presence(state="lost", since_ns=kernel.now_ns, why=plain(failure.cause))
            for vehicle in failure.vehicles:
                recorder.on(Event(f"{vehicle}/host", kernel.now_ns, gone))
        recorder.log("error" if failure else "info", str(failure or "the run is complete"), kernel.now_ns)
        recorder.close(kernel.now_ns)
        return failure

    def _observer(self, recorder: Recorder) -> Observer:
        topics = self._assembly.topics
        if topics is None:
            return recorder.on

        def on(event: Event) -> None:
            recorder.on(event)
            topics.on(event)

        return on

    @contextlib.contextmanager
    def _recording(self) -> Iterator[Recorder]:
        with contextlib.ExitStack() as stack:
            stream: BinaryIO | None = self._mcap
            if self._folder is not None:
                stream = stack.enter_context((self._folder.claim() / "run.mcap").open("wb" if self._folder.force else "xb"))
            assembly = self._assembly
            self._recorder = Recorder(
                assembly.run_info,
                record_ticks=assembly.record_ticks,
                mcap=stream,
                agents=assembly.infos,
                radius_m=assembly.radius_m,
                sensors=assembly.recorded_sensors,
                tell=lambda text: None if self._over else self._tell(text),
            )
            yield self._recorder

    def result(self, failure: VcmvspError | None, started: datetime, cpu_s: float) -> Result:
        """The result, written to the folder if there is one."""
        assembly, recorder = self._assembly, self._recorder
        if recorder is None:
            raise failure or VcmvspError("the run did not begin")
        resolved = self._resolved
        metrics = _finite(recorder.metrics(window=(resolved["metrics"]["from_s"], resolved["metrics"].get("to_s"))))
        wall_s = (datetime.now(UTC) - started).total_seconds()
        about = {
            "schema": ABOUT_SCHEMA,
            "started": started.isoformat(),
            "wall_s": wall_s,
            "simulating_s": self._simulating_s,
            "cpu_s": cpu_s,
            "simulated_s": self._kernel.now_ns / 1e9,
            "agents": assembly.where,
            "lateness": self._lateness(),
            "cuts_s": assembly.cuts_s,
            "error": failure and {"message": str(failure), "details": getattr(failure, "details", "")},
            "host": {"name": platform.node(), "system": platform.platform(), "python": platform.python_version()},
            "versions": _versions(),
        }
        result = Result(recorder, metrics, about, resolved, assembly.files, self._mcap, assembly.world)
        if self._folder is not None:
            result.write(self._folder.path)
        return result

    def _lateness(self) -> dict[str, Any] | None:
        """How late instants began, at wall pace."""
        if not isinstance(self._clock, WallClock) or not self._kernel.late_ns:
            return None
        late_s = np.maximum(self._kernel.late_ns, 0) / 1e9
        period_s = min([float(info.ticks.period) / 1e9 for info in self._assembly.infos], default=0.1) / self._clock.speed
        p50, p99 = np.percentile(late_s, [50, 99])
        return {
            "speed": self._clock.speed,
            "instants": len(late_s),
            "p50_s": float(p50),
            "p99_s": float(p99),
            "max_s": float(late_s.max()),
            "over_one_period": int((late_s > period_s).sum()),
        }


_PACKAGES = ("vcmvsp", "numpy", "simpy", "msgspec", "pyarrow", "mcap", "pybullet", "eclipse-zenoh", "matplotlib")


@functools.cache
def _versions() -> dict[str, str]:
    return {name: metadata.version(name) for name in _PACKAGES}


class Folder:
    """Where a run is to be written. It is looked at when it is named, and taken, by one run alone, when it is needed.

    Args:
        path: the folder; it must be new or empty, unless ``force`` or ``numbered``.
        force: write into it whatever it holds.
        numbered: if it exists, take the first of ``path-2``, ``path-3``, ... that does not.
    """

    def __init__(self, path: Path, *, force: bool = False, numbered: bool = False) -> None:
        self.path, self.force, self._numbered = path, force, numbered
        if not numbered:
            self._check()

    def claim(self) -> Path:
        """Make it, and say where it is."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self._numbered:
            numbers = (self.path.with_name(f"{self.path.name}-{number}") for number in itertools.count(2))
            self.path = next(path for path in itertools.chain([self.path], numbers) if _make(path))
        else:
            self._check()
            _make(self.path)
        return self.path

    def _check(self) -> None:
        try:
            if self.path.exists() and not self.path.is_dir():
                raise UsageError(f"--out {self.path}: is a file, not a folder")
            if self.path.is_dir() and any(self.path.iterdir()) and not self.force:
                raise UsageError(f"--out {self.path}: is not empty; give another folder, or --force to overwrite")
            parent = next(each for each in (self.path, *self.path.absolute().parents) if each.exists())
        except OSError as error:
            raise UsageError(f"--out {self.path}: {error.strerror}") from error
        if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
            raise UsageError(f"--out {self.path}: {parent} cannot be written to")


def _make(path: Path) -> bool:
    """Make a folder; whether it is new. Of several processes that try, one succeeds."""
    try:
        path.mkdir()
    except FileExistsError:
        return False
    return True


@contextlib.contextmanager
def writing(folder: Path | None) -> Iterator[None]:
    """A full disk and the like is said in one line."""
    try:
        yield
    except OSError as error:
        raise UsageError(f"cannot write into {folder}: {error.strerror or error}") from error


def _finite(value: Any) -> Any:
    """The value with None for numbers that JSON cannot say: a vehicle that was sent to infinity is infinitely far away."""
    if isinstance(value, dict):
        return {name: _finite(each) for name, each in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def to_json(value: Any) -> str:
    """JSON as it stands in the files: indented, keys in order, no NaN."""
    return json.dumps(value, indent=2, allow_nan=False) + "\n"
