"""A study's folder: readable at any moment, with equal bytes after any interruption."""

import errno
import json
import os
import shutil
import signal
import subprocess
from pathlib import Path
from typing import Any

import psutil
import pyarrow.parquet as pq
import pytest

from tests.support.cosim.command_line import vcmvsp_command
from tests.support.cosim.studies import ESTIMATOR, LOSS, columns, mine, start, two
from tests.support.waiting import wait_for
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.studies import plan as plans
from vcmvsp.cosim.studies import rows
from vcmvsp.cosim.studies import store as stores
from vcmvsp.cosim.studies.engine import examined, study
from vcmvsp.cosim.studies.plan import Plan
from vcmvsp.cosim.studies.store import Store, so_far
from vcmvsp.cosim.studies.worker import failed
from vcmvsp.cosim.tables.schema import read_table

pytestmark = pytest.mark.processes

NAP = "agents.nap_s"


def plan_of(**more: Any) -> Plan:
    defaults = {"scenario_toml": 'name = "two"\n', "vary": {LOSS: [0.0, 0.5], "n": [1, 2]}, "seeds": [3, 4], "metrics": ["a"]}
    return Plan(scenario="two", **{**defaults, **more})


def fill(store: Store, skip: int = 0, stop: int | None = None) -> None:
    """Add rows of all odd kinds: a metric in few runs only, numbers without a value, failures."""
    for number, run in enumerate(store.plan.runs):
        if skip <= number < (stop or store.plan.size):
            values: dict[str, Any] = {"a": 0.1 * run.seed, "none": None, "whole": run.seed, "digest": run.key}
            values |= {f"per.car{number}.x": 1.0 / 3.0} if number % 3 == 0 else {f"radio.losses.l{number % 4}": 7}
            row = rows.encode(rows.Row(values))
            store.add(run.key, failed("no") if number == 5 else row)


def whole(folder: Path, plan: Plan) -> bytes:
    with Store(folder, plan, resume=False, force=False) as store:
        fill(store)
        store.finish()
    return (folder / "study.parquet").read_bytes()


def test_the_table_is_there_from_the_start_and_grows(tmp_path: Path) -> None:
    with Store(tmp_path / "s", plan_of(), resume=False, force=False) as store:
        assert pq.read_table(tmp_path / "s" / "study.parquet").num_rows == 0
        fill(store, stop=3)
        store.write()
        found = pq.read_table(tmp_path / "s" / "study.parquet")
        assert columns(found, LOSS, "n", "seed") == [(0.0, 1, 3), (0.0, 1, 4), (0.0, 2, 3)]
    assert not (tmp_path / "s" / "study.lock").exists()


@pytest.mark.parametrize("written", [0, 1, 4, 8])
@pytest.mark.parametrize("torn", [b"", b'{"run":"0\\n1\\n3","row":{"val', bytes(60) + b"\n", bytes(60), b"\xff\n[1]\n"])
def test_resuming_any_table_and_journal_gives_equal_bytes(tmp_path: Path, written: int, torn: bytes) -> None:
    expected = whole(tmp_path / "whole", plan_of())
    store = Store(tmp_path / "s", plan_of(), resume=False, force=False)
    with store:
        fill(store, stop=written or None)
        if written:
            store.write()
        fill(store, skip=2, stop=6)  # some twice, and not in the plan's order
        saved = tmp_path / "as killed"
        shutil.copytree(tmp_path / "s", saved)
    with (saved / "study.journal").open("ab") as journal:
        journal.write(torn)
    with Store(saved, plan_of(), resume=True, force=False) as again:
        assert "0.5\n1\n4" not in again.rows  # the failed one
        fill(again)
        again.finish()
    assert (saved / "study.parquet").read_bytes() == expected
    assert not (saved / "study.journal").exists()


def test_lines_after_a_damaged_one_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vcmvsp.cosim.studies.store.SHARE", 1e-9)  # no other table is due, however long this takes
    with Store(tmp_path / "s", plan_of(), resume=False, force=False) as store:
        store.write()
        fill(store)
        shutil.copytree(tmp_path / "s", tmp_path / "cut")
    journal = tmp_path / "cut" / "study.journal"
    lines = journal.read_bytes().split(b"\n")
    lines[2] = bytes(len(lines[2]))
    journal.write_bytes(b"\n".join(lines))
    with Store(tmp_path / "cut", plan_of(), resume=True, force=False) as again:
        missing = [number for number, run in enumerate(plan_of().runs) if run.key not in again.rows]
    assert missing == [2, 5]  # and the failed one


def test_plan_and_table_are_on_the_disk_before_they_replace_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    steps: list[str] = []
    sync, replace, folder = os.fsync, Path.replace, tmp_path.stat().st_ino

    def synced(file: int) -> None:
        status = os.fstat(file)
        steps.append("the folder" if status.st_ino == folder else f"{status.st_size} bytes")
        sync(file)

    def replaced(path: Path, target: Path) -> Path:
        steps.append(f"{path.stat().st_size} bytes are {target.name}")
        return replace(path, target)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(Path, "replace", replaced)
    with Store(tmp_path, plan_of(), resume=False, force=False):
        pass
    expected = []
    for name in ("study.toml", "study.parquet"):
        size = (tmp_path / name).stat().st_size
        expected += [f"{size} bytes", f"{size} bytes are {name}", "the folder"]
    assert steps == expected


def test_values_and_seeds_may_be_added_later(tmp_path: Path) -> None:
    more = plan_of(vary={LOSS: [0.25, 0.0, 0.5], "n": [2, 1, 3.5]}, seeds=[2, 3, 4, 5])
    expected = whole(tmp_path / "whole", more)
    whole(tmp_path / "s", plan_of())
    with Store(tmp_path / "s", more, resume=True, force=False) as store:
        assert len(store.rows) == 7
        fill(store)
        store.finish()
    assert (tmp_path / "s" / "study.parquet").read_bytes() == expected


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"scenario_toml": 'name = "three"\n'}, r"the scenario differs \(name: 'three' now, 'two' then\)"),
        ({"set": {"duration_s": 3}}, r"--set differs \(duration_s: 3 now, nothing then\)"),
        ({"files": {"mine.py": "abc"}}, "its file differs .mine.py"),
        ({"files": {"mine.py": "0", "two.py": "1 3"}}, "its file differs .two.py"),
        ({"versions": {"vcmvsp": "99"}}, "the version of differs .vcmvsp: '99' now"),
        ({"vary": {LOSS: [0.0, 0.5]}}, "it varies radio.loss.probability, n"),
        ({"vary": {LOSS: [0.0], "n": [1, 2]}}, "not left out: radio.loss.probability was varied over 0.5"),
        ({"seeds": [3]}, "seeds may be added, not left out: they were 3 to 4"),
    ],
)
def test_another_study_is_not_continued(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    before = whole(tmp_path, plan_of(files={"mine.py": "0", "two.py": "1 2"}))
    with pytest.raises(UsageError, match=words), Store(tmp_path, plan_of(**change), resume=True, force=False):
        pass
    assert (tmp_path / "study.parquet").read_bytes() == before


@pytest.mark.parametrize(
    "change",
    [{"files": {"mine.py": "0 1", "new.py": "2"}}, {"scenario_toml": 'name = "two" # 2\n[study]\nseeds = 3\n'}],
    ids=["a file of a new value", "comments and the study table"],
)
def test_a_change_without_effect_on_the_rows_keeps_the_study(tmp_path: Path, change: dict[str, Any]) -> None:
    files = {"mine.py": "0"}
    whole(tmp_path, plan_of(files=files))
    with Store(tmp_path, plan_of(**{"files": files, **change}), resume=True, force=False) as store:
        assert len(store.rows) == 7


PREDICTOR = "from vcmvsp.agents.formation.reports.prediction import DeadReckoning\n\n\nclass Own(DeadReckoning):\n    pass\n"


def scenario_with_own_files(folder: Path, part: str) -> tuple[dict[str, Any], str]:
    """A scenario, and a key for two files of one basename with an agent or an estimator."""
    for name in ("one", "other"):
        (folder / name).mkdir()
        text = PREDICTOR if part == "estimator" else (mine(folder).parent / "mine.py").read_text()
        (folder / name / "own.py").write_text(f"{text}# {name}\n")
    if part == "estimator":
        return two(), ESTIMATOR
    return two(vehicle=[{"name": "car1", "agent": {"kind": "mine.py:Mine"}}], agents={}), "vehicle.car1.agent.kind"


@pytest.mark.parametrize("part", ["agent", "estimator"])
def test_rows_of_changed_code_are_not_mixed_with_new_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: str) -> None:
    monkeypatch.chdir(tmp_path)
    scenario, key = scenario_with_own_files(tmp_path, part)
    name = "Own" if part == "estimator" else "Mine"
    values = [f"one/own.py:{name}", f"other/own.py:{name}"]
    arguments: dict[str, Any] = {"seeds": 1, "jobs": 1, "out": tmp_path / "s"}
    study(scenario, vary={key: values[:1]}, **arguments)
    assert study(scenario, vary={key: values}, resume=True, **arguments).num_rows == 2
    for changed in ("one", "other"):
        path = tmp_path / changed / "own.py"
        before = path.read_text()
        path.write_text(f"{before}# changed\n")
        with pytest.raises(UsageError, match=r"holds another study: its file differs \(own\.py: "):
            study(scenario, vary={key: values}, seeds=2, out=tmp_path / "s", resume=True)
        path.write_text(before)


def test_a_folder_with_contents_needs_an_option(tmp_path: Path) -> None:
    whole(tmp_path / "s", plan_of())
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").touch()
    for folder, resume, words in (
        ("s", False, "already contains a study of two"),
        ("other", False, "not empty"),
        ("other", True, "no study"),
    ):
        with pytest.raises(UsageError, match=words), Store(tmp_path / folder, plan_of(), resume=resume, force=False):
            pass
    (tmp_path / "s" / "report.html").touch()
    with Store(tmp_path / "s", plan_of(), resume=False, force=True) as store:
        assert not store.rows
        assert not (tmp_path / "s" / "report.html").exists()


def test_a_folder_that_cannot_be_read_is_named_in_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def iterdir(path: Path) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "iterdir", iterdir)
    with pytest.raises(UsageError, match=f"^cannot write into {tmp_path}: Permission denied$"):
        study(two(), vary={LOSS: [0.0]}, seeds=1, out=tmp_path)


def test_only_write_errors_are_reported_as_such(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(*counts: int) -> None:
        raise BrokenPipeError(32, "Broken pipe")

    with pytest.raises(BrokenPipeError):
        study(two(), vary={LOSS: [0.0]}, seeds=1, jobs=1, out=tmp_path / "a", progress=gone)
    for name in ("vcmvsp.cosim.studies.store.write_table", "vcmvsp.cosim.studies.outputs.write"):

        def full(*arguments: Any, **more: Any) -> None:
            raise OSError(28, "No space left on device")

        with monkeypatch.context() as patch:
            patch.setattr(name, full)
            with pytest.raises(UsageError, match=r"cannot write into .*: No space left on device"):
                study(two(), vary={LOSS: [0.0]}, seeds=1, jobs=1, out=tmp_path / name)


def test_a_folder_that_becomes_unwritable_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also for root: nothing in the folder can be made, renamed or removed."""
    folder = tmp_path / "study"
    refused = PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    def lose(done: int, failed: int, total: int) -> None:
        if done == 1:
            for name in ("mkdir", "unlink", "replace"):
                monkeypatch.setattr(Path, name, refuse)

    def refuse(path: Path, *_: Any, **__: Any) -> None:
        raise refused

    with pytest.raises(UsageError) as error:
        study(two(), vary={LOSS: [0.0]}, seeds=2, jobs=1, out=folder, progress=lose)
    assert str(error.value) == f"cannot write into {folder}: Permission denied"
    monkeypatch.undo()
    assert study(two(), seeds=2, jobs=1, out=folder, resume=True)["seed"].to_pylist() == [0, 1]


def test_two_studies_never_share_a_folder(tmp_path: Path) -> None:
    with Store(tmp_path, plan_of(), resume=False, force=False):
        for resume, force in ((True, False), (False, True)):
            words = f"another study is writing there .process {os.getpid()} on"
            with pytest.raises(UsageError, match=words), Store(tmp_path, plan_of(), resume=resume, force=force):
                pass
    (tmp_path / "study.lock").write_text("process 1 on this machine")  # its process is dead
    with Store(tmp_path, plan_of(), resume=True, force=False):
        pass
    assert not (tmp_path / "study.lock").exists()


@pytest.mark.parametrize("name", [stores.LOCK, stores.JOURNAL])
def test_a_link_in_the_place_of_a_file_is_not_written_through(tmp_path: Path, name: str) -> None:
    whole(tmp_path / "s", plan_of())
    victim = tmp_path / "victim"
    victim.write_bytes(b"mine")
    (tmp_path / "s" / name).symlink_to(victim)
    with pytest.raises(UsageError, match=f"{name}: is a symb"), Store(tmp_path / "s", plan_of(), resume=True, force=False):
        pass
    assert victim.read_bytes() == b"mine"


def test_a_plan_is_read_back_unchanged(tmp_path: Path) -> None:
    for text in ('name = "two"\n', "a = '''x'''\n", 'b = "\\\\ \\u0001"', "\n\nname = 1"):
        plan = plan_of(scenario_toml=text, set={"a.b": [1, {"c": "d"}]}, files={"f": "0"}, versions={"vcmvsp": "1"})
        (tmp_path / "study.toml").write_text(plan.to_toml(), "utf-8")
        assert Plan.read(tmp_path / "study.toml") == plan
        assert text in plan.to_toml() or "'''" in text


def test_a_started_study_is_resumed_with_its_own_settings(tmp_path: Path) -> None:
    settings: dict[str, Any] = {"vary": {LOSS: [0.5]}, "seed": 7, "metrics": ["radio.frames"], "jobs": 1}
    with Store(tmp_path / "s", started_plan(settings), resume=False, force=False):
        pass
    again = study(two(), out=tmp_path / "s", resume=True, seeds=2, jobs=1)
    assert again["seed"].to_pylist() == [7, 8]
    assert again.equals(study(two(), seeds=2, **settings))
    assert (tmp_path / "s" / "report.html").exists()
    about = json.loads((tmp_path / "s" / "about.json").read_text())
    assert (about["runs"], about["runs_made"]) == (2, 2)


def started_plan(settings: dict[str, Any]) -> Plan:
    """The plan of a study of one run that was started and got no further."""
    base = plans.base_of(two())
    arguments = {"vary": settings["vary"], "seed": settings["seed"], "metrics": settings["metrics"]}
    return examined(plans.make(base, seeds=1, settings={}, stored=None, **arguments), base)


def held_study(folder: Path, out: str) -> tuple["subprocess.Popen[str]", list[psutil.Process]]:
    """A study that has finished a run and is held before its end, and the processes that it has started."""
    mine(folder)
    (folder / "held").touch()
    run = start(folder, *ARGUMENTS, "--out", out)

    table, journal = folder / out / "study.parquet", folder / out / "study.journal"

    def begun() -> bool:
        assert run.poll() is None, run.communicate()
        noted = journal.exists() and b"\n" in journal.read_bytes()
        return noted or (table.exists() and pq.read_table(table).num_rows > 0)

    wait_for(begun)
    return run, psutil.Process(run.pid).children(recursive=True)


HOLD = ("--set", "agents.held_by=held", "--set", "agents.held_from=2")  # no run of the last seed continues while it exists
ARGUMENTS = ("mine.toml", "--vary", f"{NAP}=0.01,0.011,0.012", "--seeds", "3", "--jobs", "2", "--json", "--quiet", *HOLD)


def test_a_killed_study_resumes_to_equal_bytes_and_leaves_no_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    killed, workers = held_study(tmp_path, "killed")
    assert sum(not each.children() for each in workers) == 2
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    assert psutil.wait_procs(workers, timeout=500)[1] == []
    (tmp_path / "held").unlink()
    assert pq.read_table(tmp_path / "killed" / "study.parquet").num_rows < 9
    assert (tmp_path / "killed" / "study.lock").exists()

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("VCMVSP_FIGURES", "1")
    code, out, err = vcmvsp_command("study", *ARGUMENTS, "--out", "killed", "--resume")
    assert code == 0, err
    about = json.loads((tmp_path / "killed" / "about.json").read_text())
    assert 0 < about["runs_made"] < 9
    whole_out = vcmvsp_command("study", *ARGUMENTS, "--jobs", "1", "--out", "whole").out
    names = {path.name for path in (tmp_path / "whole").iterdir()}
    assert {path.name for path in (tmp_path / "killed").iterdir()} == names
    for name in names - {"about.json"}:
        assert (tmp_path / "killed" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    assert out.replace('"killed"', '"whole"') == whole_out
    found = json.loads(out)
    assert (found["runs"], found["failed"], len(found["rows"])) == (9, 0, 3)


def test_ctrl_c_reports_progress_and_resuming(tmp_path: Path) -> None:
    run, workers = held_study(tmp_path, "s")
    run.send_signal(signal.SIGINT)
    out, err = run.communicate(timeout=500)
    assert (run.returncode, out) == (130, "")
    rows_there = pq.read_table(tmp_path / "s" / "study.parquet").num_rows
    assert err == f"vcmvsp: interrupted: {rows_there} of 9 runs are done; the same command with --resume goes on\n"
    assert rows_there > 0
    assert psutil.wait_procs(workers, timeout=500)[1] == []


def test_a_page_made_during_writing_lacks_no_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Store(tmp_path / "s", plan_of(), resume=False, force=False) as store:
        fill(store, stop=3)  # only in the journal

        def read(path: Path) -> Any:
            found = read_table(path)
            store.write()
            return found

        monkeypatch.setattr(stores, "read_table", read)
        assert so_far(tmp_path / "s", store.plan).num_rows == 3
        assert so_far(tmp_path / "s", store.plan).num_rows == 3
