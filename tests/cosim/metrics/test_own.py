"""Own metrics of a scenario: a number of metrics.json, a column of a study, a row of the report."""

import math
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

import vcmvsp
from tests.support.cosim.command_line import contents, vcmvsp_command
from tests.support.cosim.recordings import follows, note, recorder_after, states
from tests.support.validation.fleets import fleet
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.metrics.own import STATISTICS, NoteStatistic, own_values
from vcmvsp.cosim.tables.radio_frames import CHUNK_ROWS
from vcmvsp.cosim.types import VehicleState

FUNCTIONS = """
def rms_m(run):
    return (run.errors["error_m"].to_numpy() ** 2).mean() ** 0.5

def share(run, outcome="received"):
    return run.radio["outcome"].to_pylist().count(outcome) / run.radio.num_rows

def broken(run):
    return 1 / 0
"""
OWN = {
    "rms_m": {"kind": "own.py:rms_m"},
    "lost": {"kind": "own.py:share", "outcome": "random loss"},
    "age_s": {"note": "age_s", "value": "max", "vehicles": ["car2"]},
}
TEXTS = {"mode": "task", "status": ""}


def scenario(**more: Any) -> dict[str, Any]:
    """Three cars, with own metrics and loss."""
    radio = {"preset": "wifi-b-1", "loss": {"probability": 0.3}}
    return {**fleet(3.0, radio=radio), "metrics": {"own": {**OWN, **more}}}


@pytest.fixture
def functions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with ``own.py``."""
    (tmp_path / "own.py").write_text(FUNCTIONS)
    monkeypatch.chdir(tmp_path)
    return tmp_path


numbers = st.lists(st.tuples(st.sampled_from("ab"), st.integers(0, 9), st.floats(-1e6, 1e6)), min_size=1, max_size=20)


@given(numbers)
def test_statistics_of_notes_cover_the_numbers_in_the_window(notes: Sequence[tuple[str, int, float]]) -> None:
    notes = sorted(notes, key=lambda each: each[1])
    events = [note(vehicle, second * SECOND_NS, z=value, **TEXTS) for vehicle, second, value in notes]
    run = SimpleNamespace(
        notes=recorder_after("ab", [*events, note("a", 0, other=5.0)], 10 * SECOND_NS).notes, window_s=(2.0, 7.0)
    )
    inside = [(vehicle, value) for vehicle, second, value in notes if 2 <= second <= 7]
    values = [value for _, value in inside]
    expected: dict[str, Callable[[], float]] = {
        "mean": lambda: statistics.fmean(values),
        "rms": lambda: math.sqrt(statistics.fmean(value**2 for value in values)),
        "min": lambda: min(values),
        "max": lambda: max(values),
        "final": lambda: statistics.fmean(dict(inside).values()),
    }
    for name in STATISTICS:
        found = NoteStatistic("z", name)(run)  # type: ignore[arg-type]
        assert found == (pytest.approx(expected[name](), rel=1e-9, abs=1e-9) if inside else None)
    of_b = [value for vehicle, value in inside if vehicle == "b"]
    assert NoteStatistic("z", "max", ("b",))(run) == max(of_b, default=None)


def test_any_number_of_notes_is_a_table_in_order() -> None:
    count = CHUNK_ROWS + 7
    events = [note("a", k, z=float(k), flag=k % 2 == 0, word="x" if k % 3 else "") for k in range(count)]
    table = recorder_after("a", events, count).notes.to_pydict()
    assert table["time_ns"] == [k for k in range(count) for _ in range(3)]
    assert table["name"] == ["z", "flag", "word"] * count
    assert table["value"] == [each for k in range(count) for each in (float(k), float(k % 2 == 0), None)]
    assert table["text"] == [each for k in range(count) for each in ("", "", "x" if k % 3 else "")]


@pytest.mark.parametrize(
    ("returned", "value"),
    [(2, 2), (0.5, 0.5), (np.float32(0.5), 0.5), (pa.scalar(3), 3), (None, None), (math.nan, None), (np.inf, None)],
)
def test_a_number_of_any_library_or_none_is_a_value(returned: object, value: float | None) -> None:
    assert own_values({"x": lambda _: returned}, None) == ({"x": value}, None)


@pytest.mark.processes
def test_own_metrics_are_equal_inprocess_and_in_processes(functions: Path) -> None:
    result = vcmvsp.run(scenario(), out="one", agents="inprocess")
    own = result.metrics["own"]
    whole = vcmvsp.run({**scenario(), "metrics": {}}, agents="inprocess", mcap=False).metrics
    assert own["rms_m"] == pytest.approx(whole["formation"]["rms_m"])
    lost = whole["radio"]["losses"]["random loss"]
    assert own["lost"] == pytest.approx(lost / (lost + whole["radio"]["receptions"] + whole["radio"]["under_way"]))
    assert whole["digest"] == result.metrics["digest"]  # own metrics do not change the digest
    notes = result.notes.to_pandas().query("name == 'age_s' and vehicle == 'car2'")
    assert own["age_s"] == notes["value"].max()
    (functions / "own.py").unlink()  # the run folder contains a copy
    vcmvsp.run("one/scenario.toml", out="two", agents="process")
    assert contents(functions / "one") == contents(functions / "two")
    report = (functions / "one" / "report.html").read_text()
    assert "Own metrics" in report
    assert "rms_m" in report


@pytest.mark.processes
@pytest.mark.usefixtures("functions")
def test_own_metrics_are_columns_of_a_study() -> None:
    losses = [0.0, 0.6]
    table = vcmvsp.study(
        scenario(), vary={"radio.loss.probability": losses}, seeds=2, metrics=["own.lost", "own.rms_m"], jobs=1, out="study"
    ).to_pandas()
    assert (table["own.lost"] > 0).tolist() == [False, False, True, True]
    assert "own.lost.mean" in Path("study/summary.csv").read_text().partition("\n")[0]


@pytest.mark.processes
def test_a_metric_that_fails_costs_only_its_own_value(functions: Path) -> None:
    (functions / "bad.toml").write_text(
        'name = "bad"\nduration_s = 1.0\n[vehicles]\nkind = "p2dx"\n[[vehicle]]\nname = "a"\n'
        '[metrics.own]\nbroken = { kind = "own.py:broken" }\nframes = { kind = "own.py:rms_m" }\n'
    )
    outcome = vcmvsp_command("run", "bad.toml", "--out", "out", "-q")
    assert outcome.code == 3
    assert "metrics.own.broken: ZeroDivisionError: division by zero (own.py line 9, in broken)" in outcome.err
    assert {"metrics.json", "states.parquet", "report.html", "run.mcap"} <= {path.name for path in Path("out").iterdir()}
    failed = vcmvsp.study("bad.toml", vary={"duration_s": [1.0]}, seeds=1, jobs=1)
    assert "metrics.own.broken" in failed["error"][0].as_py()


@pytest.mark.usefixtures("functions")
@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"nte": "x"}, "metrics.own.x.nte: unknown key 'nte'; did you mean 'note'?"),
        ({}, "metrics.own.x.note: is missing"),
        ({"note": "z", "value": "median"}, "metrics.own.x.value: "),
        ({"note": "z", "vehicles": ["car9"]}, "metrics.own.x.vehicles: unknown vehicle 'car9'"),
        ({"kind": "own.py:share", "above": 1}, "metrics.own.x.above: unknown key 'above'"),
        ({"kind": "own.py:nothing"}, "metrics.own.x.kind: 'own.py' has no class 'nothing'"),
        ({"kind": "none.py:x"}, "metrics.own.x.kind: there is no file"),
    ],
)
def test_a_wrong_table_is_refused_before_the_run(table: dict[str, Any], words: str) -> None:
    with pytest.raises(vcmvsp.ScenarioError) as refused:
        vcmvsp.run(scenario(x=table))
    assert words in str(refused.value)


def test_errors_are_the_distance_to_the_place_in_the_followers_frame() -> None:
    """The follower heads north; its slot is 3 m ahead and 4 m to the left."""
    events: list[Event] = [follows("b", "a", (-1.0, 2.0), 0.0, time_ns=SECOND_NS)]
    events += [states(k * SECOND_NS, {"a": (5.0, 5.0, 0.0), "b": (8.0, 4.0, math.pi / 2)}) for k in range(3)]
    table = recorder_after("ab", events, 2 * SECOND_NS).errors.to_pylist()
    assert [row["time_ns"] for row in table] == [SECOND_NS, 2 * SECOND_NS]
    assert {(row["vehicle"], row["leader"]) for row in table} == {("b", "a")}
    assert [table[0][name] for name in ("ahead_m", "left_m", "error_m")] == pytest.approx([3.0, 4.0, 5.0])


@given(st.floats(-3.1, 3.1))
def test_yaw_column_equals_the_yaw_of_the_state(yaw: float) -> None:
    row = recorder_after("a", [states(0, {"a": (0.0, 0.0, yaw)})], 0).states.to_pylist()[0]
    attitude = tuple(row[name] for name in ("qw", "qx", "qy", "qz"))
    assert row["yaw"] == pytest.approx(VehicleState(position=(0.0, 0.0, 0.0), attitude=attitude).yaw, abs=1e-12)
    assert row["yaw"] == pytest.approx(yaw, abs=1e-9)
