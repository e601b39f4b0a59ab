"""The examples of the pages of ``docs/`` work as shown."""

import re
from pathlib import Path

import pytest

import vcmvsp
from tests.support.docs import reference_pages
from tests.support.docs.gallery import section
from tests.support.docs.readme_pages import PAGES, block
from tests.support.docs.readme_sessions import MINE
from tests.support.paths import ROOT
from vcmvsp.cosim.testing import check_agent

TUTORIAL, METRIC = "docs/tutorial.md", "docs/howto/own-metric.md"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of a reader of the tutorial, with its files."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    for name, text in MINE.items():
        (tmp_path / name).write_text(text)
    return tmp_path


def run_block(page: str, words: str) -> dict[str, object]:
    """Run a block of Python; returns its names."""
    names: dict[str, object] = {}
    exec(compile(block(page, words), page, "exec", dont_inherit=True), names)
    return names


def test_the_tutorial_shows_the_output_of_its_first_run() -> None:
    shown = block(TUTORIAL, "formation-circle: 3 agents").splitlines()
    assert "\n".join(shown[1:3]) in PAGES["scenarios/README.md"]


ROWS = re.findall(r"^\| `(\w+)` \| (\d+) % \| (\d+) ms \| (\d\.\d{4}) m \|$", PAGES[TUTORIAL], re.MULTILINE)
SHOWN = " ".join(section("formation-circle").split())
"""Gallery text of the scenario of the tutorial; `tests/docs/test_gallery.py` runs it."""


@pytest.mark.parametrize("row", [row for row in ROWS if row[1] == "20"])  # as in the scenario
def test_the_errors_of_the_tutorial_without_more_loss_are_those_of_the_gallery(row: tuple[str, str, str, str]) -> None:
    *_, age_ms, error_m = row
    assert f"age {age_ms} ms" in SHOWN
    assert f" {error_m} m RMS" in SHOWN


@pytest.mark.parametrize("row", [row for row in ROWS if row[1] != "20"])
def test_the_errors_of_the_tutorial(row: tuple[str, str, str, str]) -> None:
    estimator, loss, age_ms, error_m = row
    changed = {"agents.estimator": estimator, "radio.loss.probability": int(loss) / 100}
    metrics = vcmvsp.run("formation-circle", set=changed, agents="inprocess", mcap=False).metrics
    assert f"{metrics['formation']['rms_m']:.4f}" == error_m
    assert round(1e3 * metrics["radio"]["age_s"]["mean"]) == pytest.approx(int(age_ms), abs=1)


@pytest.mark.usefixtures("folder")
def test_the_agent_of_the_tutorial_has_the_errors_on_the_page() -> None:
    match = re.search(r"The error is (\S+) m with the gain of 1, and (\S+) m with 3", PAGES[TUTORIAL])
    assert match
    errors = [
        vcmvsp.run("mine.toml", set={"agents.gain": gain}, mcap=False).metrics["formation"]["rms_m"] for gain in (1.0, 3.0)
    ]
    assert [f"{each:.3f}" for each in errors] == [*match.groups()]


@pytest.mark.usefixtures("folder")
def test_the_agent_of_the_tutorial_passes_its_check() -> None:
    run_block(TUTORIAL, "check_agent(lambda")


def test_the_shape_error_of_the_demo_is_that_of_the_tutorial() -> None:
    (said,) = re.findall(r"rigid triangle instead: (\S+) m", " ".join(PAGES[TUTORIAL].split()))
    (shown,) = re.findall(r"shape (\S+) m off", SHOWN)
    assert said == f"{float(shown):.3f}"


def test_own_metrics_agree_with_the_page(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    short = {"duration_s = 60.0": "duration_s = 3.0", "from_s = 20.0": "from_s = 0.0"}
    text = MINE["mine.toml"]
    for long, brief in short.items():
        text = text.replace(long, brief)
    notes, function = (block(METRIC, words).replace("[metrics.own]\n", "") for words in ("worst_m =", "late_share ="))
    notes = notes.replace('"disagreement_m"', '"age_s"')  # noted by the agent of the tutorial
    (folder / "mine.toml").write_text(f"{text}\n[metrics.own]\n{notes}\n{function}")
    (folder / "shares.py").write_text(block(METRIC, "def above("))
    own = vcmvsp.run("mine.toml", seed=1, agents="inprocess").metrics["own"]
    assert list(own) == ["disagreement_m", "worst_m", "of_car2_m", "late_share"]
    assert own["disagreement_m"] == own["of_car2_m"] == pytest.approx(0.1, abs=0.05)  # a message arrives at the next tick
    assert own["disagreement_m"] < own["worst_m"]
    assert 0.0 < own["late_share"] < 1.0
    run_block(METRIC, "result.notes.to_pandas()")
    mean_s, largest_m = map(float, capsys.readouterr().out.split())
    assert mean_s == pytest.approx(own["disagreement_m"])
    assert largest_m > 0.2
    agent = vcmvsp.Agent()
    exec(block(METRIC, "self.note(disagreement_m"), {"self": agent, "spread": 0.5})
    assert agent.drain_notes() == {"disagreement_m": 0.5, "status": "waiting"}


@pytest.mark.usefixtures("folder")
def test_tables_are_read_as_on_the_page(capsys: pytest.CaptureFixture[str]) -> None:
    result = vcmvsp.run("formation-circle", set={"duration_s": 2.0}, agents="inprocess", out="runs/formation-circle-1")
    run_block("docs/howto/export.md", "parquet.read_table")
    states, lost = map(int, capsys.readouterr().out.split())
    assert states == len(result.states)
    assert 0 < lost < len(result.radio)


def test_the_agent_of_the_authors_page_works() -> None:
    column = run_block("docs/reference/author-api.md", "class Column")["Column"]
    assert isinstance(column, type)
    check_agent(lambda: column("car1"))
    cars = [
        {"name": "car1", "agent": {"kind": "trajectory", "path": "straight"}},
        {"name": "car2", "position": [-3.0, 0.0, 0.0]},
    ]
    scenario = {
        "name": "column",
        "duration_s": 20.0,
        "metrics": {"from_s": 15.0},
        "vehicles": {"kind": "p2dx"},
        "vehicle": cars,
    }
    made = vcmvsp.run(scenario, agents={"car2": column("car1")}, mcap=False)
    assert made.metrics["formation"]["rms_m"] < 0.5


def test_the_paper_agrees_with_validation_and_bibliography() -> None:
    paper, bibliography = ((ROOT / "paper" / name).read_text("utf-8") for name in ("paper.md", "paper.bib"))
    (found,) = re.findall(r"\*\*(\d+ of \d+ checks, \d+ rows), all hold", (ROOT / "VALIDATION.md").read_text("utf-8"))
    assert f"{found}, all" in " ".join(paper.split())
    assert set(re.findall(r"@(\w+)[\];]", paper)) == set(re.findall(r"^@\w+\{(\w+),", bibliography, re.MULTILINE))


def test_missing_values_of_tables_are_described_as_null() -> None:
    """``radio/frame`` in the recording has -1 there, and shares its descriptions with the table."""
    assert "-1:" not in reference_pages.columns()


@pytest.mark.parametrize("name", reference_pages.BLOCKS)
def test_generated_pages_are_up_to_date(name: str) -> None:
    page = (reference_pages.FOLDER / name).read_text("utf-8")
    assert reference_pages.page_with_blocks(name, page) == page, f"write it anew: {reference_pages.COMMAND}, or make docs"


def test_every_public_name_is_on_the_page() -> None:
    shown = [name for names in reference_pages.API.values() for name in names if not name.startswith("check_")]
    assert sorted(shown) == sorted(vcmvsp.__all__)


@pytest.mark.parametrize("page", [page for page in PAGES if page.startswith("docs/howto/")])
def test_a_howto_page_is_short(page: str) -> None:
    prose = re.sub(r"^```.*?^```$|^ {4}.*$|^\|.*$", "", PAGES[page], flags=re.DOTALL | re.MULTILINE)
    assert len(prose.split()) < 600
