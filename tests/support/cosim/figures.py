"""A figure by its name, and the laws of every figure.

Pictures are written as SVG only: ``test_figures`` writes a figure as PNG and PDF, too, and drawing takes as long as short runs.
"""

import csv
import json
import pickle
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from vcmvsp.cosim.plots.style import save
from vcmvsp.cosim.reproduction import figures
from vcmvsp.cosim.reproduction.figures import drawing
from vcmvsp.cosim.reproduction.figures.figure import Figure
from vcmvsp.cosim.reproduction.runner import Runner

ENDS = ".csv", "-expected.csv", ".json", ".svg"


def write(name: str, figure: Figure, folder: Path) -> list[Path]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drawing, "save", partial(save, kinds=("svg",)))
        return drawing.write(name, figure, folder)


def draw_figure(name: str, folder: Path, panels: int, **settings: Any) -> Figure:
    figure = figures.find(name)(Runner(1), **settings)
    cases = [row.case for row in figure.rows]
    assert len(set(cases)) == len(cases) > 0
    titles = [panel.title for panel in figure.panels]
    assert len(set(titles)) == len(titles) == panels
    written = write(name, figure, folder)
    assert all(path.stat().st_size > 100 for path in written)
    with written[0].open() as file:
        assert {point["panel"] for point in csv.DictReader(file)} <= {*titles}
    assert [row["case"] for row in json.loads(written[2].read_text())["rows"]] == cases
    return figure


def missed(figure: Figure) -> list[str]:
    return [f"{row.case}: {row.measured}" for row in figure.rows if not row.ok]


class CachedRun(Runner):
    """Makes a run once for all figures."""

    def __init__(self) -> None:
        super().__init__(1)
        self._made: dict[bytes, Any] = {}

    def __call__(self, jobs: Sequence[Callable[[], Any]]) -> list[Any]:
        keys = [pickle.dumps(job) for job in jobs]
        for key, job in zip(keys, jobs, strict=True):
            if key not in self._made:
                self._made[key] = job()
        return [self._made[key] for key in keys]


RUNNER = CachedRun()


def checked_figure(name: str, folder: Path, panels: int, words: Sequence[str], **settings: Any) -> Figure:
    """A figure by its name, after the checks of the laws of every figure."""
    figure = figures.find(name)(RUNNER, **settings)
    assert [row for row in figure.rows if not row.ok] == []
    cases = [row.case for row in figure.rows]
    assert len(set(cases)) == len(cases)
    assert [word for word in words if not any(word in case for case in cases)] == []
    titles = [panel.title for panel in figure.panels]
    assert len(set(titles)) == len(titles) == panels
    assert all(panel.heat is not None or panel.curves for panel in figure.panels)
    written = write(name, figure, folder)
    assert [path.name for path in written] == [f"{name}{end}" for end in ENDS]
    assert all(path.stat().st_size > 100 for path in written)
    with written[0].open() as file:
        assert {point["panel"] for point in csv.DictReader(file)} == {*titles}
    assert [row["case"] for row in json.loads(written[2].read_text())["rows"]] == cases
    return figure
