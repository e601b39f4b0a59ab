"""The page of a run: its metrics, no external requests, a list of missing files."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

import vcmvsp
from tests.support.cosim.command_line import Outcome, two_cars, vcmvsp_command
from tests.support.cosim.html_pages import Reader
from tests.support.cosim.reconnaissance_recording import TARGETS
from tests.support.cosim.studies import two
from vcmvsp.cosim.analysis.links import Log, overview
from vcmvsp.cosim.errors import VcmvspError
from vcmvsp.cosim.metrics.catalogue import GROUPS, METRICS, metric_of
from vcmvsp.cosim.metrics.mission import Mission
from vcmvsp.cosim.metrics.motion import motion
from vcmvsp.cosim.report.page import cell
from vcmvsp.cosim.report.run_folder import FILES
from vcmvsp.cosim.report.tables import flat
from vcmvsp.cosim.tables.schema import load

pytestmark = pytest.mark.slow

HOSTILE = "<script>alert('x')</script> & \"quoted\" <b>"
AGENT = f"""
from vcmvsp import Agent, Velocity


class Mine(Agent):
    def act(self, obs, radio):
        self.note(task={HOSTILE!r})
        radio.send(x=1.0)
        if obs.vehicle == "car2" and obs.time_ns >= 200_000_000:
            raise RuntimeError({HOSTILE!r})
        return Velocity(linear=(0.1, 0.0, 0.0))
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run with followers and random losses."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    radio = {"preset": "wifi-b-1", "loss": {"kind": "bernoulli", "probability": 0.4}}
    vcmvsp.run(two(duration_s=3.0, radio=radio, seed=5), out=folder)
    return folder


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def read(folder: Path) -> Reader:
    return Reader((folder / "report.html").read_text("utf-8"))


def test_the_page_makes_no_requests(run: Path) -> None:
    text = (run / "report.html").read_text("utf-8")
    page = Reader(text)
    assert page.resources
    assert all(each.startswith(("#", "data:")) for each in page.resources)
    assert {each[1:] for each in page.resources if each.startswith("#")} <= set(page.ids)
    assert not page.tags & {"script", "link", "iframe", "object", "form", "img"}
    assert "@import" not in text


def test_its_numbers_equal_the_metrics(run: Path) -> None:
    metrics, page = json.loads((run / "metrics.json").read_text()), read(run)
    shown = {row[0]: row[1] for table in page.tables if table[0][:2] == ["number", "value"] for row in table[1:]}
    for group in GROUPS:
        for path, value in flat(metrics.get(group, {})):
            name = ".".join(path)
            assert (shown[name] == cell(value)) if value is not None else (name not in shown), name
    (car2,) = page.rows("vehicle", "rms_m [m]")
    assert car2[:2] == ["car2", cell(metrics["formation"]["per_follower"]["car2"]["rms_m"])]
    assert metrics["digest"] in page.words


def test_links_equal_those_of_the_radio_command(run: Path) -> None:
    rows = {(row[0], row[1]): row for row in read(run).rows("from", "to", "sent", "received")}
    for link in overview(Log(run)):
        if not link["frames"]:
            assert (link["sender"], link["receiver"]) not in rows
            continue
        row = rows.pop((link["sender"], link["receiver"]))
        assert row[2:4] == [str(link["frames"]), str(link["received"])]
        assert float(row[-3]) == pytest.approx(100.0 * link["delivery_ratio"], abs=0.05)
        assert row[-1] == ", ".join(f"{loss['frames']} {cause}" for cause, loss in link["losses"].items())
    assert not rows


def test_losses_have_their_cause_and_an_example(run: Path) -> None:
    losses = json.loads((run / "metrics.json").read_text())["radio"]["losses"]
    rows = read(run).rows("cause", "frames")
    assert {row[0]: int(row[1]) for row in rows} == losses
    assert all(row[-1].startswith("frame ") and " at " in row[-1] for row in rows)


@pytest.mark.usefixtures("figures")
def test_a_page_made_again_from_the_folder_is_equal(folder: Path) -> None:
    vcmvsp.run(two(duration_s=2.0), out=folder / "out")
    before = (folder / "out" / "report.html").read_bytes()
    assert before.count(b"<svg") == 2
    (folder / "out" / "report.html").unlink()
    assert vcmvsp_command("report", "out") == Outcome(0, "out/report.html\n", "")
    assert (folder / "out" / "report.html").read_bytes() == before
    assert vcmvsp_command("report", "out", "--out", "page.html") == Outcome(0, "page.html\n", "")
    assert (folder / "page.html").read_bytes() == before


def test_a_run_without_frames_and_followers_has_a_page(folder: Path) -> None:
    (folder / "mine.py").write_text(
        "from vcmvsp import Agent\nclass Mine(Agent):\n    def act(self, obs, radio):\n        pass\n"
    )
    agent = 'kind = "mine.py:Mine"'
    text = two_cars(agent=agent).replace('kind = "trajectory", path = "circle"', agent)
    vcmvsp.run(_written(folder, text), out=folder / "out")
    page = read(folder / "out")
    assert "Nobody sent anything." in page.words
    assert "Nothing was sent." in page.words


def test_runs_without_a_folder_leave_no_page(folder: Path) -> None:
    vcmvsp.run(two(), mcap=False)
    assert list(folder.iterdir()) == []
    saved = vcmvsp.run(two()).save("saved")
    assert (saved / "report.html").is_file()


@pytest.mark.parametrize("policy", ["stop", "hold"])
def test_texts_of_agents_are_never_markup(folder: Path, policy: str) -> None:
    (folder / "mine.py").write_text(AGENT)
    agent = 'kind = "mine.py:Mine"'
    text = two_cars(agents=f'on_lost = "{policy}"', agent=agent).replace('kind = "trajectory", path = "circle"', agent)
    if policy == "stop":
        with pytest.raises(VcmvspError):
            vcmvsp.run(_written(folder, text), out=folder / "out")
    else:
        vcmvsp.run(_written(folder, text), out=folder / "out")
    page = read(folder / "out")
    assert HOSTILE in page.words
    assert not page.tags & {"script", "b"}
    missed = json.loads((folder / "out" / "metrics.json").read_text())["agents"]["car2"]["missed"]
    assert [row[:3] for row in page.rows("vehicle", "late", "missed")] == [["car2", "0", str(missed)]]


def test_unicast_frames_count_as_sent_and_agents_may_be_missing(folder: Path) -> None:
    act = "for to in ('car2', 'car3')[: 2 * (obs.vehicle == 'car1')]:\n            radio.send(x=1.0, to=to)"
    (folder / "mine.py").write_text(
        f"from vcmvsp import Agent\nclass Mine(Agent):\n    def act(self, obs, radio):\n        {act}\n"
    )
    agents: list[dict[str, Any]] = [{"agent": {}}, {"agent": {}}, {}]
    vehicles = [{"name": f"car{k + 1}", "pose": [float(k), 0.0, 0.0], **agent} for k, agent in enumerate(agents)]
    scenario = two(agents={"kind": str(folder / "mine.py:Mine"), "period_s": 0.1}, vehicle=vehicles)
    result = vcmvsp.run(scenario, out=folder / "out")
    rows = {row[0]: row for row in read(folder / "out").rows("vehicle", "kind")}
    assert int(rows["car1"][7]) == result.metrics["radio"]["frames"] == 20
    assert [rows[name][2] for name in rows] == ["mine.py:Mine", "mine.py:Mine", ""]


def _written(folder: Path, text: str) -> Path:
    (folder / "s.toml").write_text(text)
    return folder / "s.toml"


def test_a_killed_run_lists_missing_files(run: Path, folder: Path) -> None:
    (folder / "cut").mkdir()
    whole = (run / "run.mcap").read_bytes()
    (folder / "cut" / "run.mcap").write_bytes(whole[: len(whole) * 3 // 4])
    assert vcmvsp_command("report", "cut").code == 0
    page = read(folder / "cut")
    missing = {row[0]: row[1] for row in page.rows("file")}
    assert missing == dict.fromkeys(FILES.keys() - {"run.mcap"}, "is not there")
    assert "two, seed 5" in page.words
    assert "run.mcap, goes to" in page.words


@pytest.mark.parametrize("name", ["states.parquet", "radio.parquet", "metrics.json", "about.json", "scenario.toml", "run.mcap"])
@pytest.mark.parametrize("content", [None, b"", b"PAR1\x00 not [ what { it was"])
def test_a_folder_without_one_of_its_files_has_a_page(run: Path, folder: Path, name: str, content: bytes | None) -> None:
    shutil.copytree(run, "out")
    if content is None:
        (folder / "out" / name).unlink()
    else:
        (folder / "out" / name).write_bytes(content)
    assert vcmvsp_command("report", "out").code == 0
    if (name, content) in (("scenario.toml", b""), ("run.mcap", b""), ("run.mcap", b"PAR1\x00 not [ what { it was")):
        return  # an empty scenario is valid; a damaged recording is read up to the damage
    assert {row[0] for row in read(folder / "out").rows("file")} == {name}  # all other files are shown


@pytest.mark.parametrize("target", ["nowhere", "s.toml", "empty"])
def test_a_path_without_a_run_is_refused(folder: Path, target: str) -> None:
    _written(folder, two_cars())
    (folder / "empty").mkdir()
    code, out, err = vcmvsp_command("report", target)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(f"vcmvsp: {target}: ")
    assert list((folder / "empty").iterdir()) == []


def test_a_page_that_cannot_be_written_is_one_error(run: Path, folder: Path) -> None:
    (folder / "here").mkdir()
    for out in ("here", "no/such/folder.html"):
        code, _, err = vcmvsp_command("report", str(run), "--out", out)
        assert (code, err.count("\n")) == (2, 1)


def test_every_number_is_explained(run: Path) -> None:
    """Metrics of this run, of a mission and of real vehicles."""
    metrics: dict[str, Any] = json.loads((run / "metrics.json").read_text())
    metrics["mission"] = Mission().metrics(motion(load(run).states), TARGETS)
    for group in ("formation", "radio", "control", "connectivity", "safety", "mission", "agents"):
        for path, _ in flat(metrics[group]):
            assert metric_of((group, *path)).meaning, path
    assert len({each.meaning for each in METRICS.values()}) == len(METRICS)  # no two explanations are equal
