"""``cosim.run``: a scenario in, a `Result` out. What the command line does, notebooks and studies do through here."""

import contextlib
import io
import json
import math
import os
import platform
import shutil
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
from cosim.agent import Agent
from cosim.assemble import Assembly
from cosim.clock import Clock, SimClock, WallClock
from cosim.errors import FederateError, Interrupted, UsageError, VcmvspError
from cosim.hosts import Tell
from cosim.kernel import Kernel
from cosim.record.metrics import Window
from cosim.record.recorder import Recorder
from cosim.record.tables import Placement, load

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
        files: Mapping[str, Path],
    ) -> None:
        self.metrics, self.about = metrics, about
        self.scenario = tomli_w.dumps(resolved)
        self._recorder, self._files = recorder, dict(files)
        self._window = (resolved["metrics"]["from_s"], resolved["metrics"].get("to_s"))
        self._mcap: io.BytesIO | None = None

    @property
    def states(self) -> "pa.Table":
        """True states, a row per vehicle and recorded instant."""
        return self._recorder.states

    @property
    def radio(self) -> "pa.Table":
        """Frames, a row per frame and receiver."""
        return self._recorder.radio

    def plot(self) -> "dict[str, Figure]":
        """The run's figures, by name: ``trajectory`` and ``formation_error``."""
        recorder = self._recorder
        return _figures(recorder.states, recorder.radio, recorder.follows, self._window)

    def save(self, folder: str | Path, *, force: bool = False) -> Path:
        """Write everything that a run leaves into a folder."""
        path = check_folder(Path(folder), force=force)
        with _writing(path):
            path.mkdir(parents=True, exist_ok=True)
            if self._mcap is not None:
                (path / "run.mcap").write_bytes(self._mcap.getvalue())
            elif self.folder is not None:
                shutil.copyfile(self.folder / "run.mcap", path / "run.mcap")
            self._write(path)
        return path

    def _write(self, folder: Path) -> None:
        """Everything but the MCAP file, which is written as the run goes on."""
        from cosim.record import plots

        self.folder = folder
        (folder / "scenario.toml").write_text(self.scenario, "utf-8")
        for name, path in self._files.items():
            if path != (folder / name).resolve():
                shutil.copyfile(path, folder / name)
        self._recorder.write_tables(folder)
        (folder / "metrics.json").write_text(to_json(self.metrics), "utf-8")
        (folder / "about.json").write_text(to_json(self.about), "utf-8")
        for name, figure in self.plot().items():
            plots.save_png(figure, folder / f"{name}.png")


def _figures(states: "pa.Table", radio: "pa.Table", follows: Sequence[Placement], window: Window) -> "dict[str, Figure]":
    from cosim.record import plots

    return {
        "trajectory": plots.trajectory(states, follows),
        "formation_error": plots.formation_error(states, radio, follows, window),
    }


def run(
    scenario: str | Path | Mapping[str, Any],
    *,
    seed: int | None = None,
    set: Mapping[str, Any] | None = None,  # noqa: A002  the word of the command line
    agents: Mapping[str, Agent] | Runs | None = None,
    listen: str | None = None,
    realtime: float | None = None,
    out: str | Path | None = None,
    force: bool = False,
    progress: Progress | None = None,
    tell: Tell = lambda _: None,
) -> Result:
    """Run a scenario to its end.

    Args:
        scenario: a built-in name, the path of a TOML file, or its content as a mapping.
        seed: instead of the scenario's.
        set: key path -> value, e.g. ``{"radio.loss.probability": 0.3}``.
        agents: agents as objects, by vehicle; or where all agents run: ``"inprocess"``, ``"process"`` or ``"zenoh"``.
        listen: endpoint for hosts that are started by hand, instead of ``agents.listen``.
        realtime: simulated seconds per wall-clock second; None: as fast as possible.
        out: folder to write into; the recording then grows on disk while the run goes on.
        force: write into a folder that is not empty.
        progress: called with (now, end) in ns before every instant.
        tell: takes lines for the user.

    Raises:
        ScenarioError: the scenario cannot be run as it is.
        FederateError: a part or an agent failed; ``error.result`` is the `Result` up to then.
        Interrupted: Ctrl-C; ``error.result`` likewise.
    """
    objects, runs = (None, agents) if agents is None or isinstance(agents, str) else (agents, None)
    folder = None if out is None else check_folder(Path(out), force=force)
    parsed, source = scenarios.load(scenario, settings=set, seed=seed)
    started, cpu = datetime.now(UTC), time.process_time()
    try:
        with Assembly(parsed, source, objects=objects, runs=runs, listen=listen, tell=tell) as assembly:
            clock = SimClock() if realtime is None else WallClock(realtime)
            simulation = _Simulation(assembly, clock, folder, progress)
            with _writing(folder):
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
        try:
            assembly.start(kernel)
        finally:
            kernel.close()
        return assembly.resolved()


def plot(run_dir: Path, out: Path) -> list[Path]:
    """Draw the figures of a run that was saved, into the folder ``out``; the answer is what was written."""
    from cosim.record import plots

    recording = load(run_dir)
    scenario = run_dir / "scenario.toml"
    window = tomllib.loads(scenario.read_text("utf-8")).get("metrics", {}) if scenario.is_file() else {}
    figures = _figures(recording.states, recording.radio, recording.follows, (window.get("from_s", 0.0), window.get("to_s")))
    paths = {out / f"{name}.png": figure for name, figure in figures.items()}
    with _writing(out):
        out.mkdir(parents=True, exist_ok=True)
        for path, figure in paths.items():
            plots.save_png(figure, path)
    return list(paths)


class _Simulation:
    """One run: kernel and recording, from the first event to the files."""

    def __init__(self, assembly: Assembly, clock: Clock, folder: Path | None, progress: Progress | None) -> None:
        self._assembly, self._clock, self._folder = assembly, clock, folder
        self._progress = progress
        self._mcap: io.BytesIO | None = None
        self._recorder: Recorder | None = None

    def run(self) -> VcmvspError | None:
        """Run to the end; what goes wrong once the run has begun is returned, so that the recording can be kept."""
        self._kernel = kernel = Kernel(self._assembly.run_info, self._assembly.federates, clock=self._clock)
        try:
            self._assembly.start(kernel)
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

    def _go(self, recorder: Recorder) -> VcmvspError | None:
        kernel, progress, end_ns = self._kernel, self._progress, self._assembly.run_info.duration_ns
        failure: VcmvspError | None = None
        begin = time.monotonic()
        try:
            kernel.run(recorder.on, on_instant=None if progress is None else lambda now: progress(now, end_ns))
        except KeyboardInterrupt:
            failure = Interrupted(f"interrupted at {kernel.now_ns / 1e9:.3f} s")
        except FederateError as error:
            failure = error
        self._simulating_s = time.monotonic() - begin
        recorder.log("error" if failure else "info", str(failure or "the run is complete"), kernel.now_ns)
        recorder.close(kernel.now_ns)
        return failure

    @contextlib.contextmanager
    def _recording(self) -> Iterator[Recorder]:
        with contextlib.ExitStack() as stack:
            stream: BinaryIO
            if self._folder is None:
                stream = self._mcap = io.BytesIO()
            else:
                self._folder.mkdir(parents=True, exist_ok=True)
                stream = stack.enter_context((self._folder / "run.mcap").open("wb"))
            assembly = self._assembly
            self._recorder = Recorder(
                assembly.run_info,
                record_ticks=assembly.record_ticks,
                mcap=stream,
                agents=assembly.infos,
                radius_m=assembly.radius_m,
            )
            yield self._recorder

    def result(self, failure: VcmvspError | None, started: datetime, cpu_s: float) -> Result:
        """The result, written to the folder if there is one."""
        assembly, recorder = self._assembly, self._recorder
        if recorder is None:
            raise failure or VcmvspError("the run did not begin")
        resolved = assembly.resolved()
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
            "error": failure and {"message": str(failure), "details": getattr(failure, "details", "")},
            "host": {"name": platform.node(), "system": platform.platform(), "python": platform.python_version()},
            "versions": {name: metadata.version(name) for name in _PACKAGES},
        }
        result = Result(recorder, metrics, about, resolved, assembly.files)
        result._mcap = self._mcap  # noqa: SLF001
        if self._folder is not None:
            result._write(self._folder)  # noqa: SLF001
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


def check_folder(folder: Path, *, force: bool) -> Path:
    """A folder that may be written into: new, empty, or ``force``."""
    try:
        if folder.exists() and not folder.is_dir():
            raise UsageError(f"--out {folder}: is a file, not a folder")
        if folder.is_dir() and any(folder.iterdir()) and not force:
            raise UsageError(f"--out {folder}: is not empty; give another folder, or --force to overwrite")
    except OSError as error:
        raise UsageError(f"--out {folder}: {error.strerror}") from error
    parent = next(each for each in (folder, *folder.absolute().parents) if each.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise UsageError(f"--out {folder}: {parent} cannot be written to")
    return folder


@contextlib.contextmanager
def _writing(folder: Path | None) -> Iterator[None]:
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
