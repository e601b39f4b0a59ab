"""Figures of a run, from its tables and recording.

`Drawer` draws the figures of a short run in a second process, which imports Matplotlib during the run: the import takes as long
as the run itself. With ``VCMVSP_FIGURES=0`` in the environment a run leaves no figures; ``vcmvsp plot`` draws them later.
"""

import contextlib
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

from vcmvsp.cosim.errors import VcmvspError
from vcmvsp.cosim.processes.worker_pool import Worker, WorkerDiedError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from vcmvsp.cosim.metrics.mission import Target
    from vcmvsp.cosim.metrics.motion import Window
    from vcmvsp.cosim.recording.mission_log import MissionLog
    from vcmvsp.cosim.tables.schema import RunFacts, Table
    from vcmvsp.cosim.types import Array

IMPORTS = ("vcmvsp.cosim.plots.run_plots",)


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

    def figures(self) -> "dict[str, Figure]":
        """The figures by name.

        ``trajectory``; ``formation_error`` if a vehicle follows another; ``mission``, ``mosaic`` and ``detections`` if agents
        published them.
        """
        from vcmvsp.cosim.plots import run_plots

        follows, mission = self.facts.follows, self.mission
        figures = {"trajectory": run_plots.trajectory(self.states, follows, self.outlines, self.facts.stations or ())}
        if follows:
            figures["formation_error"] = run_plots.formation_error(self.states, self.radio, follows, self.window_s)
        if not mission:
            return figures
        from vcmvsp.cosim.metrics.motion import motion
        from vcmvsp.cosim.plots import mission_plot

        moved = motion(self.states)
        figures["mission"] = mission_plot.mission(mission, moved, self.targets, self.outlines)
        if mission.mosaics:
            figures["mosaic"] = mission_plot.mosaic(mission, moved, self.targets)
        if mission_plot.chosen_pictures(mission):
            figures["detections"] = mission_plot.detections(mission)
        return figures


def draw(content: Content) -> dict[str, Picture]:
    """The figures of a run by name, drawn in this process."""
    from vcmvsp.cosim.plots import style

    return {name: Picture(style.png(figure), style.svg(figure)) for name, figure in content.figures().items()}


def wanted() -> bool:
    """Whether runs leave figures."""
    return os.environ.get("VCMVSP_FIGURES", "1") != "0"


Draws = Callable[[Content], Mapping[str, Picture]]


class Drawer:
    """Draws the figures of one run; a context manager around the run, which may be entered again within.

    Args:
        apart: draw the figures of a short run in a second process, unless this process has imported Matplotlib already.
    """

    def __init__(self, *, apart: bool = True) -> None:
        self._apart = apart and "matplotlib.figure" not in sys.modules
        self._worker: Worker | None = None

    def __enter__(self) -> "Drawer":
        if self._apart and wanted() and self._worker is None:
            with contextlib.suppress(VcmvspError):  # a process that cannot be started: drawn here
                self._worker = Worker(draw, IMPORTS)
        return self

    def __exit__(self, *error: object) -> None:
        if self._worker is not None:
            self._worker.close()

    def draw(self, content: Content) -> Mapping[str, Picture]:
        """The figures by name."""
        from vcmvsp.cosim.tables.schema import PART_ROWS, selected

        states, radio = content.states, content.radio
        if self._worker is None or content.mission or max(states.num_rows, radio.num_rows) > PART_ROWS:
            return draw(content)
        states, radio = (selected(table, table.schema.names) for table in (states, radio))
        try:
            drawn: dict[str, Picture] = self._worker.run(replace(content, states=states, radio=radio))
        except (WorkerDiedError, VcmvspError):
            return draw(content)
        return drawn
