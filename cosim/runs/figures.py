"""Figures of a run, from its tables and recording.

`Drawer` draws the figures of a short run in other processes: the import of Matplotlib takes as long as the run itself, so one
process imports it meanwhile, and each figure is drawn by a fork of it. With ``VCMVSP_FIGURES=0`` in the environment a run
leaves no figures; ``vcmvsp plot`` draws them later.
"""

import contextlib
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

from vcmvsp.cosim.errors import VcmvspError
from vcmvsp.cosim.processes.fork_server import FORKS
from vcmvsp.cosim.processes.worker_pool import Pool, WorkerDiedError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from vcmvsp.cosim.metrics.mission import Target
    from vcmvsp.cosim.metrics.motion import Motion, Window
    from vcmvsp.cosim.recording.mission_log import MissionLog
    from vcmvsp.cosim.tables.schema import RunFacts, Table
    from vcmvsp.cosim.types import Array

IMPORTS = ("vcmvsp.cosim.plots.run_plots",)
JOBS = 2  # figures at the same time


class Picture(NamedTuple):
    """A drawn figure: the content of a PNG file, and SVG text."""

    png: bytes
    svg: str


@dataclass(frozen=True)
class Content:
    """What the figures of a run show.

    Attributes:
        radio: its table, with at least the columns `run_plots.OF_RADIO`.
        window_s: evaluation window, s.
        outlines: of the world's solids from above, (k, 2) m each.
        targets: of a mission.
        mission: what agents published about a mission; None: nothing.
    """

    states: "Table"
    radio: "Table"
    facts: "RunFacts"
    window_s: "Window"
    outlines: "Sequence[Array]" = ()
    targets: "Sequence[Target]" = ()
    mission: "MissionLog | None" = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the figures.

        ``trajectory``; ``formation_error`` if a vehicle follows another; ``mission``, ``mosaic`` and ``detections`` if agents
        published them.
        """
        names = ["trajectory"]
        if self.facts.follows:
            names.append("formation_error")
        if self.mission:
            from vcmvsp.cosim.plots import mission_plot

            names.append("mission")
            if self.mission.mosaics:
                names.append("mosaic")
            if mission_plot.chosen_pictures(self.mission):
                names.append("detections")
        return tuple(names)

    def figure(self, name: str) -> "Figure":
        """One of the figures. Raises `KeyError` (there is none of this name)."""
        from vcmvsp.cosim.plots import run_plots

        follows, mission = self.facts.follows, self.mission
        if name == "trajectory":
            return run_plots.trajectory(self.states, follows, self.outlines, self.facts.stations or ())
        if name == "formation_error":
            return run_plots.formation_error(self.states, self.radio, follows, self.window_s)
        from vcmvsp.cosim.plots import mission_plot

        if mission is None:
            raise KeyError(name)
        if name == "detections":
            return mission_plot.detections(mission)
        if name == "mosaic":
            return mission_plot.mosaic(mission, self._moved, self.targets)
        return mission_plot.mission(mission, self._moved, self.targets, self.outlines)

    @cached_property
    def _moved(self) -> "Motion":
        from vcmvsp.cosim.metrics.motion import motion

        return motion(self.states)

    def figures(self) -> "dict[str, Figure]":
        """The figures by name."""
        return {name: self.figure(name) for name in self.names}


def draw(content: Content) -> dict[str, Picture]:
    """The figures of a run by name, drawn in this process."""
    return {name: _picture((name, content)) for name in content.names}


def _picture(request: tuple[str, Content]) -> Picture:
    from vcmvsp.cosim.plots import style

    name, content = request
    figure = content.figure(name)
    return Picture(style.png(figure), style.svg(figure))


def are_enabled() -> bool:
    """Whether runs leave figures."""
    return os.environ.get("VCMVSP_FIGURES", "1") != "0"


Draws = Callable[[Content], Mapping[str, Picture]]


class Drawer:
    """Draws the figures of one run; a context manager around the run, which may be entered again within.

    Args:
        apart: draw the figures of a short run in other processes, unless this process has imported Matplotlib already.
    """

    def __init__(self, *, apart: bool = True) -> None:
        self._apart = apart and FORKS and "matplotlib.figure" not in sys.modules
        self._pool: Pool | None = None

    def __enter__(self) -> "Drawer":
        if self._apart and are_enabled() and self._pool is None:
            pool = Pool(_picture, JOBS, died=WorkerDiedError(), imports=IMPORTS)
            with contextlib.suppress(VcmvspError):  # no process can be started: drawn here
                self._pool = pool.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        if self._pool is not None:
            self._pool.__exit__(*error)

    def draw(self, content: Content) -> Mapping[str, Picture]:
        """The figures by name."""
        from vcmvsp.cosim.tables.schema import PART_ROWS, selected

        states, radio = content.states, content.radio
        if self._pool is None or content.mission or max(states.num_rows, radio.num_rows) > PART_ROWS:
            return draw(content)
        states, radio = (selected(table, table.schema.names) for table in (states, radio))
        names, sent = content.names, replace(content, states=states, radio=radio)
        try:
            pictures = dict(self._pool.answers([(name, (name, sent)) for name in names], len(names)))
        except (WorkerDiedError, VcmvspError):
            return draw(content)
        return {name: pictures[name] for name in names}
