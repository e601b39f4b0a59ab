"""Figures of a run are equal from this and from other processes, and are drawn even if the others die."""

import sys
from pathlib import Path

import pytest

from vcmvsp.cosim.processes import child_process
from vcmvsp.cosim.recording.recorded_run import tables_of
from vcmvsp.cosim.report import run_page
from vcmvsp.cosim.runs import api
from vcmvsp.cosim.runs.figures import Content, Drawer, draw

pytestmark = [pytest.mark.slow, pytest.mark.processes, pytest.mark.usefixtures("figures")]
SHORT = {"duration_s": 1.0, "agents.runs": "inprocess", "metrics.from_s": 0.0}


@pytest.fixture
def without_matplotlib(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without Matplotlib in ``sys.modules``, this process leaves drawing to another one."""
    monkeypatch.delitem(sys.modules, "matplotlib.figure", raising=False)


def content_of(folder: Path) -> Content:
    recording = tables_of(folder)
    return Content(recording.states, recording.radio, recording.facts, (0.0, None))


def test_figures_from_another_process_are_equal(tmp_path: Path, without_matplotlib: None) -> None:
    api.run("formation-circle", set=SHORT, out=tmp_path / "run")
    assert "matplotlib.figure" not in sys.modules
    here = draw(content_of(tmp_path / "run"))
    assert {name: (tmp_path / "run" / f"{name}.png").read_bytes() for name in here} == {
        name: picture.png for name, picture in here.items()
    }
    page = run_page.write(tmp_path / "run", {name: picture.svg for name, picture in here.items()}, tmp_path / "page.html")
    assert page.read_bytes() == (tmp_path / "run" / "report.html").read_bytes()


def test_figures_are_drawn_here_if_no_other_process_lives(
    tmp_path: Path, without_matplotlib: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    api.run("formation-circle", set=SHORT, out=tmp_path / "run")
    content = content_of(tmp_path / "run")
    monkeypatch.setattr(child_process, "BOOT", "import os; os.kill(os.getpid(), 9)  # {module} {paths}")
    with Drawer(apart=True) as drawer:
        assert drawer._pool is not None
        drawn = drawer.draw(content)
    assert drawn == draw(content)
