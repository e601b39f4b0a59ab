"""The page of a study, made again from its folder: equal, or, for a cut study, with the finished runs."""

import shutil
from pathlib import Path

import msgspec
import pytest

import vcmvsp
from tests.support.cosim.command_line import Outcome, vcmvsp_command
from tests.support.cosim.html_pages import Reader
from tests.support.cosim.studies import LOSS, two
from vcmvsp.cosim.studies.plan import Plan, Run
from vcmvsp.cosim.studies.rows import Row, encode
from vcmvsp.cosim.studies.store import JOURNAL, PLAN, JournalLine

pytestmark = [pytest.mark.processes, pytest.mark.usefixtures("figures")]

METRIC = "formation.rms_m"


@pytest.fixture(scope="module")
def finished_study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a study of two points with two seeds each."""
    folder = tmp_path_factory.mktemp("studies") / "out"
    vcmvsp.study(two(), vary={LOSS: [0.0, 0.5]}, seeds=2, metrics=[METRIC], jobs=1, out=folder)
    return folder


@pytest.fixture
def study(finished_study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the study in the current folder."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(finished_study, "out")
    return tmp_path / "out"


def read(folder: Path) -> Reader:
    return Reader((folder / "report.html").read_text("utf-8"))


def test_made_again_it_is_equal(study: Path) -> None:
    before = (study / "report.html").read_bytes()
    assert before.count(b"<svg") == 1
    (study / "report.html").unlink()
    assert vcmvsp_command("report", "out") == Outcome(0, "out/report.html\n", "")
    assert (study / "report.html").read_bytes() == before
    assert vcmvsp_command("report", "out", "--out", "page.html") == Outcome(0, "page.html\n", "")
    assert Path("page.html").read_bytes() == before


def test_a_cut_study_shows_finished_runs_of_table_and_journal(study: Path) -> None:
    plan = Plan.read(study / PLAN)
    longer = msgspec.structs.replace(plan, scenario="two.toml", seeds=[0, 1, 2])  # one more seed requested
    (study / PLAN).write_text(longer.to_toml())
    row = msgspec.Raw(encode(Row(error="car1: <script>alert(1)</script>")))
    (study / JOURNAL).write_bytes(msgspec.json.encode(JournalLine(Run((0.5,), 2).key, row)) + b'\n{"run": "0.0')
    assert vcmvsp_command("report", "out").code == 0
    page = read(study)
    assert "Of these only 5 are done yet" in page.words
    assert "1 failed" in page.words
    (failed,) = page.rows(LOSS, "seed", "error")
    assert failed == ["0.5", "2", "car1: <script>alert(1)</script>"]
    assert "script" not in page.tags
    rows = page.rows(LOSS, "n", "failed")
    assert [row[:3] for row in rows] == [["0", "2", "0"], ["0.5", "2", "1"]]
    assert "--seeds 3" in page.words
    assert "--resume" in page.words


def test_before_the_first_run_is_done_there_is_a_page(study: Path) -> None:
    for name in ("study.parquet", "report.html"):
        (study / name).unlink()
    assert vcmvsp_command("report", "out").code == 0
    assert "only 0 are done" in read(study).words


@pytest.mark.parametrize(("name", "content"), [("study.toml", "nonsense = ["), ("study.parquet", "PAR1 nonsense")])
def test_a_damaged_study_is_one_error(study: Path, name: str, content: str) -> None:
    (study / name).write_text(content)
    before = (study / "report.html").read_bytes()
    code, out, err = vcmvsp_command("report", "out")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "out" in err
    assert (study / "report.html").read_bytes() == before
