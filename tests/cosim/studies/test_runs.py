"""Studies through ``vcmvsp.study``: rows do not depend on the way of making them."""

import errno
import functools
import hashlib
import itertools
import os
import signal
import subprocess
import threading
import time
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pytest

import vcmvsp
from tests.support.cosim.studies import ESTIMATOR, LOSS, columns, mine, two
from tests.support.waiting import wait_for
from vcmvsp.cosim.assembly.run import AssembledRun
from vcmvsp.cosim.errors import AgentError, FederateError, UsageError, VcmvspError
from vcmvsp.cosim.processes import child_process, worker_pool
from vcmvsp.cosim.processes.worker_pool import Pool
from vcmvsp.cosim.studies import engine, rows
from vcmvsp.cosim.studies import plan as plans
from vcmvsp.cosim.studies.engine import study
from vcmvsp.cosim.studies.plan import Plan
from vcmvsp.cosim.studies.rows import Row, encode, flat, packed, table_of
from vcmvsp.cosim.studies.worker import DIED, Job, Work, failed, run_one, version
from vcmvsp.cosim.terminal.progress import StudyProgress

pytestmark = pytest.mark.processes

VARY: dict[str, list[Any]] = {LOSS: [0.0, 0.4], ESTIMATOR: ["hold", "dr"]}


@pytest.fixture(scope="module")
def table() -> pa.Table:
    return study(two(), vary=VARY, seeds=3, seed=5, jobs=2)


def test_there_is_a_row_per_run_in_the_order_of_the_grid(table: pa.Table) -> None:
    assert columns(table, LOSS, ESTIMATOR, "seed") == list(itertools.product([0.0, 0.4], ["hold", "dr"], [5, 6, 7]))
    assert table["error"].null_count == table.num_rows
    assert table.column_names[:3] == [LOSS, ESTIMATOR, "seed"]
    assert table.column_names[-2:] == ["error", "digest"]


def test_each_row_equals_a_single_run(table: pa.Table) -> None:
    for row in table.to_pylist()[::4]:
        alone = flat(vcmvsp.run(two(), seed=row["seed"], set={LOSS: row[LOSS], ESTIMATOR: row[ESTIMATOR]}).metrics)
        absent = {name for name in row if name not in alone} - {LOSS, ESTIMATOR, "error"}
        assert all(name.startswith("radio.losses.") and row[name] == 0 for name in absent)
        assert {name: row[name] for name in alone} == alone


def test_the_order_of_values_changes_the_order_of_rows_alone(table: pa.Table) -> None:
    turned = study(two(), vary={ESTIMATOR: ["dr", "hold"], LOSS: [0.4, 0.0]}, seeds=3, seed=5)
    order: Any = [(name, "ascending") for name in (LOSS, ESTIMATOR, "seed")]
    assert turned.select(table.column_names).sort_by(order).equals(table.sort_by(order))


def test_points_share_their_draws() -> None:
    """Common random numbers: frames lost at a probability of 0.1 are lost at 0.3 too, and at 0.3 with either estimator."""
    delivered = []
    for probability, estimator in ((0.1, "hold"), (0.3, "hold"), (0.3, "dr")):
        settings = {"duration_s": 20.0, LOSS: probability, ESTIMATOR: estimator}
        radio = vcmvsp.run(two(), seed=3, set=settings, mcap=False).radio
        delivered.append({row[0] for row in columns(radio, "frame", "outcome") if row[1] == "received"})
    assert delivered[1] == delivered[2]
    assert delivered[1] < delivered[0]
    losses = study(two(duration_s=20.0), vary={LOSS: [0.1, 0.3], ESTIMATOR: ["hold", "dr"]}, seeds=1, seed=3)
    assert [row[0] for row in columns(losses, "radio.receptions")] == [len(delivered[i]) for i in (0, 0, 1, 1)]


def test_a_run_that_fails_is_a_row(tmp_path: Path) -> None:
    found = study(mine(tmp_path), vary={"agents.nap_s": [0.0, 0.001]}, seeds=3, set={"vehicle.car1.agent.bad_seed": 1})
    errors = [row[0] for row in columns(found, "error")]
    assert [error is None for error in errors] == [True, False, True] * 2
    assert "RuntimeError: not with this seed" in errors[1]
    failed = found.filter(pc.is_valid(found["error"])).drop_columns(["agents.nap_s", "seed", "error"])
    assert failed.num_columns > 20
    assert all(column.null_count == 2 for column in failed.columns)
    with pytest.raises(AgentError, match="not with"):
        vcmvsp.run(mine(tmp_path), seed=1, set={"vehicle.car1.agent.bad_seed": 1})


def test_causes_without_losses_are_zero() -> None:
    found = study(two(), vary={LOSS: [0.0, 1.0]}, seeds=1, metrics=["radio.losses.walls"])
    assert columns(found, "radio.losses.random loss", "radio.losses.walls") == [(0, 0), (10, 0)]


def test_values_of_all_kinds_make_columns_of_their_types() -> None:
    def column(values: list[Any]) -> Any:
        plan = Plan(scenario="", scenario_toml="", vary={"key": values}, seeds=[0])
        return table_of(plan, {run.key: packed(failed("no")) for run in plan.runs})["key"]

    for values, kind in (([0, 1], pa.int64()), ([0, 0.5], pa.float64()), ([True, False], pa.bool_()), (["a", ""], pa.string())):
        assert column(values).type == kind
        assert column(values).to_pylist() == values
    assert column(["a", 1, [1.0, "x"], {"b": True}]).to_pylist() == ["a", "1", '[1.0, "x"]', '{"b": true}']


def test_a_metric_that_is_varied_has_one_column() -> None:
    plan = Plan(scenario="", scenario_toml="", vary={"duration_s": [0.5, 1.0]}, seeds=[0])
    found = table_of(plan, {run.key: packed(encode(Row({"duration_s": 9.0, "digest": "d"}))) for run in plan.runs})
    assert found.column_names == ["duration_s", "seed", "error", "digest"]
    assert found["duration_s"].to_pylist() == [0.5, 1.0]


def test_progress_counts_up(tmp_path: Path) -> None:
    reports: list[tuple[int, int, int]] = []
    settings = {"vehicle.car1.agent.bad_seed": 0}
    study(
        mine(tmp_path), vary={"agents.nap_s": [0.0]}, seeds=3, set=settings, jobs=1, progress=lambda *each: reports.append(each)
    )
    assert reports == [(0, 0, 3), (1, 1, 3), (2, 1, 3), (3, 1, 3)]


def pool_and_job(folder: Path) -> tuple[Pool, Job]:
    """A pool of one worker, and a run that leaves a mark and then waits while the file ``held`` exists."""
    work = Work(mine(folder).read_text(), str(folder), version())
    (folder / "held").touch()
    held = {"vehicle.car1.agent.mark": str(folder / "mark"), "vehicle.car1.agent.held_by": str(folder / "held")}
    return Pool(functools.partial(run_one, work), 1, died=DIED), Job(0, held)


@pytest.mark.parametrize("deaths", [1, 2])
def test_a_worker_that_is_killed_costs_its_run_only_if_it_dies_twice(tmp_path: Path, deaths: int) -> None:
    pool, slow = pool_and_job(tmp_path)
    quick = Job(0, {})
    mark = tmp_path / "mark"

    def marked(number: int) -> bool:
        return mark.exists() and len(mark.read_text()) > number

    def kill() -> None:
        for number in range(deaths):
            wait_for(functools.partial(marked, number))
            (worker,) = pool._workers
            os.kill(worker._process.pid, signal.SIGKILL)
        (tmp_path / "held").unlink()

    killer = threading.Thread(target=kill)
    killer.start()
    with pool:
        rows = [row for _, row in pool.answers([(None, job) for job in (quick, slow, quick)], 3)]
    killer.join()
    assert rows[0] == rows[2]
    assert b'"error":null' in rows[0]
    assert (b'"error":"its worker died"' in rows[1]) == (deaths == 2)


@pytest.mark.parametrize("deaths", [3, worker_pool.STARTS])
def test_a_worker_that_is_killed_while_it_starts_costs_no_run(
    deaths: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    boots = iter(["import os; os.kill(os.getpid(), 9)  # {module} {paths}"] * deaths + [child_process.BOOT] * 2)

    class Boot:
        def format(self, **named: str) -> str:
            return next(boots).format(**named)

    monkeypatch.setattr(child_process, "BOOT", Boot())
    with Pool(abs, 1, died="died") as pool:
        if deaths < worker_pool.STARTS:
            assert list(pool.answers([(0, -7)], 1)) == [(0, 7)]
        else:
            with pytest.raises(VcmvspError, match="were killed during their start"):
                list(pool.answers([(0, -7)], 1))


def test_leaving_a_pool_ends_its_workers_in_the_middle_of_a_run(tmp_path: Path) -> None:
    pool, slow = pool_and_job(tmp_path)
    with pool:
        answers = pool.answers([(None, slow)], 1)
        threading.Thread(target=lambda: next(answers, None), daemon=True).start()
        wait_for((tmp_path / "mark").exists)
        (worker,) = pool._workers
    assert worker._process.returncode == -signal.SIGKILL


def test_an_error_of_a_worker_is_raised_here() -> None:
    with Pool(int, 2, died=None) as pool:
        assert sorted(pool.answers(enumerate(["1", "2"]), 2)) == [(0, 1), (1, 2)]
        with pytest.raises(ValueError, match="invalid literal") as error:
            list(pool.answers([(0, "x")], 1))
    assert "Traceback" in error.value.__notes__[0]  # traceback of the worker


def test_a_worker_that_cannot_be_started_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def popen(*arguments: Any, **more: Any) -> None:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr(subprocess, "Popen", popen)
    with pytest.raises(VcmvspError, match=r"^cannot start a worker: Too many open files$"):
        study(two(), vary={LOSS: [0.0]}, seeds=1, out=tmp_path / "s")


def test_a_workers_exit_code_at_start_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vcmvsp.cosim.processes.child_process.BOOT", "raise SystemExit(7)  # {module}")
    with pytest.raises(VcmvspError, match=r"ended while it started \(exit code 7\)"):
        study(two(), vary={LOSS: [0.0]}, seeds=1)


def test_output_of_agents_is_no_answer(tmp_path: Path) -> None:
    (tmp_path / "loud.py").write_text(
        "import os\nprint('module')\nos.write(1, b'raw')\n" + (mine(tmp_path).parent / "mine.py").read_text()
    )
    work = Work(mine(tmp_path).read_text().replace("mine.py", "loud.py"), str(tmp_path), version())
    with Pool(functools.partial(run_one, work), 1, died=DIED) as pool:
        ((_, row),) = pool.answers([(0, Job(0, {}))], 1)
    assert row.startswith(b'{"values":{')


def test_another_version_makes_no_rows(tmp_path: Path) -> None:
    row = run_one(Work(mine(tmp_path).read_text(), str(tmp_path), "0.0.0"), Job(0, {}))
    assert b"this worker has vcmvsp" in row


def test_progress_in_a_log_has_the_time_left(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    for quiet in (False, True):
        with StudyProgress(quiet=quiet) as progress:
            progress.on_run(10, 0, 50)  # done before: not timed
            for done in (11, 12, 13, 14):
                now[0] += 2.0
                progress.on_run(done, done - 11, 50)
        assert capsys.readouterr().err == ("" if quiet else "13 of 50 runs done, 2 failed, 1 min 14 s left\n")


# --- what is checked before the first run ------------------------------------------------------------------------------------


def test_of_many_points_each_value_is_checked_once(monkeypatch: pytest.MonkeyPatch) -> None:
    base = plans.base_of(two())
    points: list[tuple[Any, ...]] = []
    reports: list[tuple[int, int]] = []
    check = engine._check

    def noted(plan: Plan, base: plans.Base, point: tuple[Any, ...], *more: Any) -> Any:
        points.append(point)
        return check(plan, base, point, *more)

    monkeypatch.setattr(engine, "_check", noted)
    for losses, count in ((25, 50), (26, 27)):
        points.clear()
        reports.clear()
        vary: dict[str, list[Any]] = {LOSS: [i / 100 for i in range(losses)], ESTIMATOR: ["hold", "dr"]}
        plan = plans.make(base, vary=vary, seeds=3, seed=None, settings={}, metrics=None, stored=None)
        engine.examined(plan, base, lambda done, of: reports.append((done, of)))
        assert reports == [(number, count) for number in range(count)]
        assert len(set(points)) == count
        assert [{point[key] for point in points} for key in (0, 1)] == [{*values} for values in vary.values()]


def test_each_remark_on_a_point_is_told_once() -> None:
    base = plans.base_of("formation-circle")
    vary = {LOSS: [0.0, 0.1], "radio.delay.seconds": [0.0, 100.0]}
    settings = {"duration_s": 5.0}
    plan = plans.make(base, vary=vary, seeds=1, seed=None, settings=settings, metrics=None, stored=None)
    lines: list[str] = []
    engine.examined(plan, base, tell=lines.append)
    assert [line.partition(":")[0] for line in lines] == ["metrics.from_s = 20", "radio.delay.seconds = 100"]


def test_checking_shows_its_progress(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    with StudyProgress(quiet=False) as progress:
        for done in range(4):
            progress.on_check(done, 120)
            now[0] += 2.0
    assert capsys.readouterr().err == "checking: 3 of 120 points\n"


@pytest.mark.parametrize(("error", "shown"), [(AgentError(("car1",), "a", "no"), True), (FederateError("air", "no"), False)])
def test_an_error_of_the_start_is_raised_unless_it_is_an_agents(
    monkeypatch: pytest.MonkeyPatch, error: FederateError, shown: bool
) -> None:
    def start(run: AssembledRun, kernel: Any) -> None:
        raise error

    monkeypatch.setattr(AssembledRun, "start", start)
    if shown:
        assert study(two(), vary={LOSS: [0.0]}, seeds=1)["error"].to_pylist() == [None]  # workers start normally
    else:
        with pytest.raises(FederateError, match="air: no"):
            study(two(), vary={LOSS: [0.0]}, seeds=1)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), [1.0, float("-inf")], {"a": float("nan")}])
def test_only_finite_values_are_varied_over(value: Any) -> None:
    with pytest.raises(UsageError, match=f"--vary {LOSS}=.*: must be finite, not -?(nan|inf)"):
        study(two(), vary={LOSS: [0.0, value]}, seeds=1)


@pytest.mark.parametrize("seeds", [float("nan"), float("inf"), 2.5])
def test_seeds_are_a_whole_number(seeds: float) -> None:
    with pytest.raises(VcmvspError, match="--seeds"):
        study(two(), vary={LOSS: [0.0]}, seeds=seeds)  # type: ignore[arg-type]


def test_a_file_that_changes_while_the_study_runs_makes_no_rows(tmp_path: Path) -> None:
    scenario = mine(tmp_path).read_text()
    now = hashlib.sha256((tmp_path / "mine.py").read_bytes()).hexdigest()
    for known, problem in ((now, None), ("0" * 64, "mine.py changed during the study")):
        work = Work(scenario, str(tmp_path), version(), files={"mine.py": known})
        assert rows.decode(run_one(work, Job(0, {}))).error == problem


@pytest.mark.parametrize(
    ("arguments", "says"), [({"vary": "a=0,1"}, "vary: must be a mapping"), ({"metrics": "age"}, "--metric age:")]
)
def test_strings_in_place_of_lists_are_refused(arguments: dict[str, Any], says: str) -> None:
    with pytest.raises(UsageError, match=says):
        vcmvsp.study("study-delay", seeds=1, **arguments)
