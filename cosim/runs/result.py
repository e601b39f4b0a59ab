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
from vcmvsp.cosim.metrics.motion import Window, motion
from vcmvsp.cosim.recording.external_inputs import FILE
from vcmvsp.cosim.recording.mission_log import MissionLog, read_mission
from vcmvsp.cosim.recording.recorded_run import tables_of
from vcmvsp.cosim.recording.recorder import Recorder
from vcmvsp.cosim.runs.figures import Content, Draws, are_enabled, draw
from vcmvsp.cosim.scenario import loader
from vcmvsp.cosim.tables.schema import Placement, RunFacts
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.util.documents import read_toml
from vcmvsp.cosim.util.files import Folder, replacing, to_json, write_whole, writing
from vcmvsp.cosim.util.text import Tell

if TYPE_CHECKING:
    import pyarrow as pa
    from matplotlib.figure import Figure


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
        numbers = [(name, f"{value:.4g} {unit}".strip()) for name, (value, unit) in names.items() if value is not None]
        run = f"{metrics['scenario']}, seed {metrics['seed']}, {metrics['duration_s']:g} s"
        return [("run", run), *numbers, *([("folder", str(self.folder))] if self.folder else [])]

    def plot(self) -> "dict[str, Figure]":
        """Figures by name; Jupyter shows them.

        ``trajectory``; ``formation_error`` if a vehicle follows another; ``mission``, ``mosaic`` and ``detections`` if agents
        published them and the run has a recording.
        """
        from vcmvsp.cosim.runs.notebook import Figures

        return Figures(self._content().figures())

    def _content(self) -> Content:
        """What the figures show."""
        recorder, world = self._recorder, self._world
        return Content(
            *recorder.tables, recorder.facts, self.window_s, worlds.outlines(world), world.targets, self._mission_log()
        )

    def _mission_log(self) -> MissionLog | None:
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

    def write(self, folder: Path, draw: Draws = draw) -> None:
        """Write all files except the MCAP file, which is written during the run."""
        from vcmvsp.cosim.report import run_page as report

        self.folder = folder
        write_whole(folder / "scenario.toml", self.scenario)
        for name, content in self._files.items():
            write_whole(folder / name, content)
        self._recorder.write_tables(folder)
        write_whole(folder / "metrics.json", to_json(self.metrics))
        write_whole(folder / "about.json", to_json(self.about))
        inputs = self._content()
        pictures = draw(inputs) if are_enabled() else {}
        for name, picture in pictures.items():
            write_whole(folder / f"{name}.png", picture.png)
        if self._video and inputs.mission:
            from vcmvsp.cosim.plots.mission_video import write_video

            write_video(folder / "mission.mp4", inputs.mission, motion(inputs.states), inputs.targets, inputs.outlines)
        report.write(folder, {name: picture.svg for name, picture in pictures.items()})


def figures_again(run_dir: Path, tell: Tell = lambda _: None, *, trust: bool = False) -> "dict[str, Figure]":
    """The figures of a saved or interrupted run, by name, from its tables (`tables_of`) and recording.

    Args:
        tell: receives a line about an incomplete recording.
        trust: import the class of its world even if it is not built in.

    Raises:
        UsageError: tables or recording are missing or unreadable.
    """
    from vcmvsp.cosim.plots.run_plots import OF_RADIO

    scenario = run_dir / "scenario.toml"
    try:
        recording = tables_of(run_dir, tell, numbers=True, radio=OF_RADIO)
        window = read_toml(limits.read_text(scenario)).get("metrics", {}) if scenario.is_file() else {}
    except (OSError, ValueError) as error:  # a damaged table or scenario
        raise UsageError(f"{run_dir} cannot be read: {error}") from error
    from vcmvsp.cosim.assembly.recorded_world import world_in

    world: Any = None
    with contextlib.suppress(VcmvspError), only(None if trust else NO_CODE):  # a world that cannot be built is not drawn
        world = world_in(run_dir, *loader.load(scenario))
    outlines, targets = ((), ()) if world is None else (worlds.outlines(world), world.targets)
    mission = mission_log(run_dir, recording.facts) if "mission" in recording.metrics else None
    within = window.get("from_s", 0.0), window.get("to_s")
    return Content(recording.states, recording.radio, recording.facts, within, outlines, targets, mission).figures()


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


def mission_log(folder: Path, facts: RunFacts) -> MissionLog | None:
    """Mission data that agents published in a saved run, or None without its recording."""
    with contextlib.suppress(OSError), (folder / "run.mcap").open("rb") as stream:
        return read_mission(stream, facts.vehicles, facts.end_ns)
    return None
