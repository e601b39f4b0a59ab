"""Scripts and notebooks in ``examples/`` run unchanged, and each makes its picture."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

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
RUNS = {"loss_and_delay.py": ["1"], "study_bands.py": ["2"], PAPER: ["2"]}  # seeds, instead of more
SCRIPTS, NOTEBOOKS = (sorted(path.name for path in FOLDER.glob(pattern)) for pattern in ("*.py", "*.ipynb"))


def test_every_example_is_in_the_index() -> None:
    shown = re.findall(r"^\| \[(\S+)\]\(\1\) \|", PAGES["examples/README.md"], re.MULTILINE)
    assert sorted(shown) == sorted([*SCRIPTS, *NOTEBOOKS, PAPER, LEARNING])


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_makes_its_picture(name: str, tmp_path: Path) -> None:
    command = [sys.executable, str(FOLDER / name), str(tmp_path), *RUNS.get(name, [])]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert [path.name for path in tmp_path.iterdir()] == [f"{name.removesuffix('.py')}.png"]
    assert (tmp_path / f"{name.removesuffix('.py')}.png").stat().st_size > 10_000


def test_the_figure_of_the_paper_has_bands_that_widen_with_loss(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, FOLDER / PAPER, tmp_path, *RUNS[PAPER]], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert {"figure.pdf", "figure.png"} <= {path.name for path in tmp_path.iterdir()}
    rows = read_csv(tmp_path / "agreement" / "summary.csv").set_index("radio.loss.probability")
    name = "own.agreed_s"
    assert rows[f"{name}.mean"][0.95] > rows[f"{name}.mean"][0.0]
    widths = rows[f"{name}.high"] - rows[f"{name}.low"]
    assert widths[0.95] > widths[0.0]


def test_learning_writes_policies_that_fly_and_the_figure(tmp_path: Path) -> None:
    command = [sys.executable, str(FOLDER / LEARNING), str(tmp_path), "--generations", "3", "--trainings", "2"]
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


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_runs_and_makes_its_picture(name: str, tmp_path: Path) -> None:
    shutil.copy(FOLDER / name, tmp_path)
    notebook = nbformat.read(tmp_path / name, as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells)
    nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": tmp_path}}).execute()
    assert (tmp_path / f"{name.removesuffix('.ipynb')}.png").stat().st_size > 10_000
