"""Result of a run, in memory and as files."""

import contextlib
import io
import shutil
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tomli_w

from vcmvsp.cosim.assembly import worlds
from vcmvsp.cosim.config.registry import NO_CODE, only
from vcmvsp.cosim.errors import UsageError, VcmvspError
from vcmvsp.cosim.metrics import routing
from vcmvsp.cosim.metrics.motion import Window, motion
from vcmvsp.cosim.recording.external_inputs import FILE
from vcmvsp.cosim.recording.mission_log import MissionLog, read_mission
from vcmvsp.cosim.recording.recorded_run import tables_of
from vcmvsp.cosim.recording.recorder import Recorder
from vcmvsp.cosim.scenario import loader
from vcmvsp.cosim.tables.schema import Placement, RunFacts, Table
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.util.documents import read_toml
from vcmvsp.cosim.util.files import Folder, replacing, to_json, write_whole, writing
from vcmvsp.cosim.util.text import Tell

if TYPE_CHECKING:
    import pyarrow as pa
    from matplotlib.figure import Figure


DRAWN = ("sender", "receiver", "outcome", "sent_ns", "received_ns", *routing.COLUMNS)
"""Columns of the radio's table that figures need."""


class Result:
    """The result of a run.

    Attributes:
        metrics: content of ``metrics.json`` (schema ``vcmvsp.metrics/1``).
        about: host, versions and wall times: the only part that differs between two equal runs. Empty while own metrics are
            computed.
        window_s: begin and end of the window of ``[metrics]``, s; None: the end of the run.
        folder: of its files; None: not written.
    """

    folder: Path | None = None

    def __init__(
        self,
        recorder: Recorder,
        metrics: dict[str, Any],
        resolved: dict[str, Any],
        files: Mapping[str, bytes],
        mcap: io.BytesIO | None,
        world: Any,
    ) -> None:
        self.metrics, self.about = metrics, dict[str, Any]()
        self._resolved, self._recorder, self._files = resolved, recorder, dict(files)
        self.window_s: Window = (resolved["metrics"]["from_s"], resolved["metrics"].get("to_s"))
        self._mcap, self._world = mcap, world
        self._video = resolved["record"].get("video", False)

    def __getstate__(self) -> object:
        raise UsageError("a Result cannot be pickled: save(folder) writes it, metrics, about and scenario are plain values")

    @cached_property
    def scenario(self) -> str:
        """The resolved scenario as TOML; running it gives the same result again."""
        return tomli_w.dumps(self._resolved)  # not for each of a study's runs: a tenth of the time of a short one

    @property
    def states(self) -> "pa.Table":
        """True states: a row per vehicle and recorded instant."""
        return self._recorder.states

    @property
    def radio(self) -> "pa.Table":
        """Radio frames: a row per frame and receiver."""
        return self._recorder.radio

    @property
    def errors(self) -> "pa.Table":
        """Formation errors: a row per recorded instant and follower."""
        return self._recorder.errors

    @property
    def notes(self) -> "pa.Table":
        """Values that agents noted (`Agent.note`): a row per time, vehicle and name."""
        return self._recorder.notes

    @property
    def files(self) -> Mapping[str, bytes]:
        """Content of the files that the run used, by their name beside the scenario."""
        return self._files

    @property
    def follows(self) -> Sequence[Placement]:
        """Formation slots announced by vehicles, with start times."""
        return self._recorder.follows

    def __repr__(self) -> str:
        return f"<Result of {', '.join(f'{name} {value}' for name, value in self._head())}>"

    def _repr_html_(self) -> str:
        """Main numbers and figures, for Jupyter."""
        from vcmvsp.cosim.runs import notebook

        return notebook.table(self._head()) + notebook.pictures(self.plot())

    def _head(self) -> list[tuple[str, str]]:
        """The main numbers, as words."""
        metrics = self.metrics
        names = {
            "formation error, RMS": (metrics["formation"]["rms_m"], "m"),
            "frames delivered": (metrics["radio"]["delivery_ratio"], ""),
            "age of information": (metrics["radio"]["age_s"]["mean"], "s"),
            **{f"own.{name}": (value, "") for name, value in metrics.get("own", {}).items()},
        }
        known = [(name, f"{value:.4g} {unit}".strip()) for name, (value, unit) in names.items() if value is not None]
        run = f"{metrics['scenario']}, seed {metrics['seed']}, {metrics['duration_s']:g} s"
        return [("run", run), *known, *([("folder", str(self.folder))] if self.folder else [])]

    def plot(self) -> "dict[str, Figure]":
        """The run's figures, by name: ``trajectory``, ``formation_error`` and `mission_figures`.

        The second only where a vehicle follows another, the last only with a recording of a mission. Jupyter shows them.
        """
        from vcmvsp.cosim.runs.notebook import Figures

        return Figures(self._figures(self._shown()))

    def _figures(self, shown: MissionLog | None) -> "dict[str, Figure]":
        recorder, outlines = self._recorder, worlds.outlines(self._world)
        figures = figures_of(*recorder.tables, recorder.facts, self.window_s, outlines)
        return figures | mission_figures(shown, recorder.tables[0], self._world)

    def _shown(self) -> MissionLog | None:
        """Mission data that agents published, or None if there is none or no recording."""
        facts = self._recorder.facts
        if "mission" not in self.metrics or (self._mcap is None and self.folder is None):
            return None
        if self._mcap is not None:
            return read_mission(io.BytesIO(self._mcap.getvalue()), facts.vehicles, facts.end_ns)
        assert self.folder is not None  # noqa: S101
        return mission_log(self.folder, facts)

    def save(self, folder: str | Path, *, force: bool = False) -> Path:
        """Write all files of the run into a folder."""
        if self._mcap is None and self.folder is None:
            raise UsageError("a run with mcap = False has no recording and cannot be saved")
        with writing(Path(folder)):
            path = Folder(Path(folder), force=force).claim()
            if self._mcap is not None:
                write_whole(path / "run.mcap", self._mcap.getvalue())
            elif self.folder is not None and not path.samefile(self.folder):
                if to_json(self.about) != (self.folder / "about.json").read_text("utf-8"):
                    raise UsageError(f"{self.folder} now contains another run; the recording of this one is gone")
                for name in ("run.mcap", FILE):
                    if (self.folder / name).is_file():
                        with replacing(path / name) as place:
                            shutil.copyfile(self.folder / name, place)
            self.write(path)
        return path

    def write(self, folder: Path) -> None:
        """Write all files except the MCAP file, which is written during the run."""
        from vcmvsp.cosim.plots import style
        from vcmvsp.cosim.report import run_page as report

        self.folder = folder
        write_whole(folder / "scenario.toml", self.scenario)
        for name, content in self._files.items():
            write_whole(folder / name, content)
        self._recorder.write_tables(folder)
        write_whole(folder / "metrics.json", to_json(self.metrics))
        write_whole(folder / "about.json", to_json(self.about))
        shown = self._shown()
        figures = self._figures(shown)
        for name, figure in figures.items():
            style.save_png(figure, folder / f"{name}.png")
        if self._video:
            mission_video(folder / "mission.mp4", shown, self._recorder.tables[0], self._world)
        report.write(folder, {name: style.svg(figure) for name, figure in figures.items()})


def figures_again(run_dir: Path, tell: Tell = lambda _: None, *, trust: bool = False) -> "dict[str, Figure]":
    """The figures of a saved or interrupted run, by name, from its tables (`tables_of`) and recording.

    Args:
        tell: receives a line about an incomplete recording.
        trust: import the class of its world even if it is not built in.

    Raises:
        UsageError: tables or recording are missing or unreadable.
    """
    scenario = run_dir / "scenario.toml"
    try:
        recording = tables_of(run_dir, tell, numbers=True, radio=DRAWN)
        window = read_toml(limits.read_text(scenario)).get("metrics", {}) if scenario.is_file() else {}
    except (OSError, ValueError) as error:  # a damaged table or scenario
        raise UsageError(f"{run_dir} cannot be read: {error}") from error
    from vcmvsp.cosim.assembly.recorded_world import world_in

    world: Any = None
    with contextlib.suppress(VcmvspError), only(None if trust else NO_CODE):  # a world that cannot be built is not drawn
        world = world_in(run_dir, *loader.load(scenario))
    seen: Sequence[Array] = () if world is None else worlds.outlines(world)
    within = window.get("from_s", 0.0), window.get("to_s")
    figures = figures_of(recording.states, recording.radio, recording.facts, within, seen)
    if "mission" in recording.metrics:
        figures |= mission_figures(mission_log(run_dir, recording.facts), recording.states, world)
    return figures


def compared(run_dirs: Sequence[Path], tell: Tell = lambda _: None) -> "Figure":
    """A figure that shows several runs side by side, each with the name of its folder.

    Raises:
        UsageError: a folder has no readable tables or recording, or two have the same name.
    """
    from vcmvsp.cosim.plots import run_plots

    runs = {}
    for run_dir in run_dirs:
        try:
            recording = tables_of(run_dir, tell, radio=())
        except (OSError, ValueError) as error:
            raise UsageError(f"{run_dir} cannot be read: {error}") from error
        title = run_dir.resolve().name
        if title in runs:
            raise UsageError(f"{run_dir}: two of these folders are called {title}")
        runs[title] = recording.states, recording.follows
    return run_plots.comparison(runs)


def figures_of(states: Table, radio: Table, facts: RunFacts, window: Window, outlines: Sequence[Array]) -> "dict[str, Figure]":
    """The figures of a run, by name: ``trajectory`` and, if a vehicle follows another, ``formation_error``."""
    from vcmvsp.cosim.plots import run_plots

    follows = facts.follows
    figures = {"trajectory": run_plots.trajectory(states, follows, outlines, facts.stations or ())}
    if follows:
        figures["formation_error"] = run_plots.formation_error(states, radio, follows, window)
    return figures


def load_figures() -> None:
    """Import what draws figures, which takes a third of a second."""
    from vcmvsp.cosim.plots import run_plots  # noqa: F401


def mission_log(folder: Path, facts: RunFacts) -> MissionLog | None:
    """Mission data that agents published in a saved run, or None without its recording."""
    with contextlib.suppress(OSError), (folder / "run.mcap").open("rb") as stream:
        return read_mission(stream, facts.vehicles, facts.end_ns)
    return None


def mission_figures(shown: MissionLog | None, states: Table, world: Any) -> "dict[str, Figure]":
    """Figures of a reconnaissance mission, by name: ``mission``, and ``mosaic`` and ``detections`` if agents published them."""
    if not shown:
        return {}
    from vcmvsp.cosim.plots import mission_plot

    moved, targets = motion(states), () if world is None else world.targets
    figures = {"mission": mission_plot.mission(shown, moved, targets, () if world is None else worlds.outlines(world))}
    if shown.mosaics:
        figures["mosaic"] = mission_plot.mosaic(shown, moved, targets)
    if mission_plot.chosen_pictures(shown):
        figures["detections"] = mission_plot.detections(shown)
    return figures


def mission_video(path: Path, shown: MissionLog | None, states: Table, world: Any) -> None:
    """Write the video of a reconnaissance mission, if there was one."""
    if shown:
        from vcmvsp.cosim.plots.mission_video import write_video

        targets, outlines = ((), ()) if world is None else (world.targets, worlds.outlines(world))
        write_video(path, shown, motion(states), targets, outlines)
