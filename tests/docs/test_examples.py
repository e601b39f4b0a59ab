"""Scripts and notebooks in ``examples/`` run unchanged, and each makes its picture."""

import re
import runpy
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import matplotlib.pyplot as plt
import nbclient
import nbformat
import pytest
from pandas import read_csv

import vcmvsp
from tests.support.docs.readme_pages import PAGES
from tests.support.paths import ROOT

pytestmark = [pytest.mark.slow, pytest.mark.processes, pytest.mark.sockets]

FOLDER = ROOT / "examples"
PAPER, LEARNING = "paper/figure.py", "learning/train.py"
SECONDS = {"clocks.py": "20", "real_robot.py": "3", "udp_programs.py": "1"}
RUNS = {"loss_and_delay.py": "1", "study_bands.py": "1", PAPER: "2"}  # seeds
SHORTER = {**SECONDS, **RUNS}  # than without an argument
SCRIPTS, NOTEBOOKS = (sorted(path.name for path in FOLDER.glob(pattern)) for pattern in ("*.py", "*.ipynb"))


@pytest.fixture(autouse=True)
def _as_by_a_reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """An own folder, compiled code, and no windows."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("VCMVSP_COMPILED", "1")  # rays take a quarter of the time, with the compilation
    plt.switch_backend("agg")
    yield
    plt.close("all")


def run_script(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run an example as by ``python``, without the second in which a new process imports libraries."""
    more = [SHORTER[name]] if name in SHORTER else []
    monkeypatch.setattr(sys, "argv", [str(FOLDER / name), str(folder), *more])
    runpy.run_path(str(FOLDER / name), run_name="__main__")


def test_every_example_is_in_the_index() -> None:
    shown = re.findall(r"^\| \[(\S+)\]\(\1\) \|", PAGES["examples/README.md"], re.MULTILINE)
    assert sorted(shown) == sorted([*SCRIPTS, *NOTEBOOKS, PAPER, LEARNING])


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_makes_its_picture(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_script(name, tmp_path, monkeypatch)
    assert [path.name for path in tmp_path.iterdir()] == [f"{name.removesuffix('.py')}.png"]
    assert (tmp_path / f"{name.removesuffix('.py')}.png").stat().st_size > 10_000


def test_the_figure_of_the_paper_has_bands_that_widen_with_loss(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_script(PAPER, tmp_path, monkeypatch)
    assert {"figure.pdf", "figure.png"} <= {path.name for path in tmp_path.iterdir()}
    rows = read_csv(tmp_path / "agreement" / "summary.csv").set_index("radio.loss.probability")
    name = "own.agreed_s"
    assert rows[f"{name}.mean"][0.95] > rows[f"{name}.mean"][0.0]
    widths = rows[f"{name}.high"] - rows[f"{name}.low"]
    assert widths[0.95] > widths[0.0]


def test_learning_writes_policies_that_fly_and_the_figure(tmp_path: Path) -> None:
    command = [sys.executable, str(FOLDER / LEARNING), str(tmp_path), "--generations", "1", "--trainings", "2"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "training with it saves" in done.stdout
    assert (tmp_path / "train.png").stat().st_size > 10_000
    content = """
        name = "learned"
        duration_s = 3.0
        physics.kind = "kinematic"
        agents = { kind = "policy", file = "lossy-1.npz", period_s = 0.1 }
        vehicle = [{ name = "v", kind = "point", count = 3, spacing = [0.0, 1.5], columns = 1, agent = {} }]
    """
    (tmp_path / "learned.toml").write_text(content)
    assert vcmvsp.run(tmp_path / "learned.toml").states.num_rows == 31 * 3


def test_notebooks_run_and_make_their_pictures(tmp_path: Path) -> None:
    """In one kernel, which forgets all names after each."""
    cells = []
    for name in NOTEBOOKS:
        code = [cell for cell in nbformat.read(FOLDER / name, as_version=4).cells if cell.cell_type == "code"]
        assert not any(cell.outputs for cell in code)
        cells += [nbformat.v4.new_code_cell(text) for text in (*(cell.source for cell in code), "%reset -f")]
    book = nbformat.v4.new_notebook(cells=cells)
    nbclient.NotebookClient(book, timeout=300, kernel_name="python3", resources={"metadata": {"path": tmp_path}}).execute()
    pictures = {path.name for path in tmp_path.iterdir() if path.stat().st_size > 10_000}
    assert pictures == {name.replace(".ipynb", ".png") for name in NOTEBOOKS}
