"""Reproduced figures: the framework, the closed forms behind the rows, and the quick figures through the command line."""

import csv
import json
import math
import signal
import sys
import types
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from tests.support.cosim.command_line import vcmvsp_command
from vcmvsp.cosim.analysis import closed_forms
from vcmvsp.cosim.errors import ScenarioError, UsageError, VcmvspError
from vcmvsp.cosim.plots.style import save
from vcmvsp.cosim.reproduction import figures
from vcmvsp.cosim.reproduction.figures import drawing
from vcmvsp.cosim.reproduction.figures.drawing import write
from vcmvsp.cosim.reproduction.figures.figure import Curve, Figure, Heat, Panel, as_json, table
from vcmvsp.cosim.reproduction.figures.formation import circle, loss_integration, steps
from vcmvsp.cosim.reproduction.figures.scenarios import (
    ASIDE,
    K1,
    R,
    T,
    V,
    fleet,
    overshoot,
    rms,
    settling_s,
    step_follower,
    track,
)
from vcmvsp.cosim.reproduction.row import Row, at_least, at_most, relative
from vcmvsp.cosim.reproduction.runner import Runner

pytestmark = pytest.mark.processes

AHEAD = math.sqrt(3.0) / 2.0


def synthetic(measured: float = 1.0) -> Figure:
    x = np.array([0.1, 1.0, 2.0])
    curves = [Curve(x, x**2, "square", 1, "both"), Curve(x, x, "", 2, "pose"), Curve(x, x, "thin", 3, "thin")]
    heat = Heat(x, x[:2], np.array([[0.5, 1.0, 2.0], [1.0, 1.0, 4.0]]), "ratio", "about one")
    panels = [
        Panel("curves, logarithmic", "x [m]", "y [m]", curves, levels={"band": (0.5, 0.6)}, log_x=True, log_y=True),
        Panel("map", "p", "d [s]", heat=heat),
    ]
    return Figure("A figure", panels, [Row("one", 1.0, measured, 0.1)])


@pytest.fixture
def made_up(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """Registers a figure ``made-up``."""
    module = types.ModuleType("made_up_figure")
    monkeypatch.setitem(sys.modules, f"{figures.__name__}.made_up_figure", module)
    names = {**figures.NAMES, "made-up": ("made_up_figure:make", "A figure.")}
    monkeypatch.setattr(figures, "NAMES", names)
    module.make = lambda runner: synthetic()  # type: ignore[attr-defined]
    return module


# --- rows ---


def test_a_row_is_ok_up_to_its_tolerance_and_a_limit_counts_the_excess() -> None:
    assert Row("", 1.0, 1.1, 0.1000001).ok
    assert not Row("", 1.0, 1.2, 0.1).ok
    assert not Row("", 1.0, math.nan, 1e9).ok
    assert relative("", -2.0, -2.1, 0.1).tolerance == pytest.approx(0.2)
    assert at_most("", 1.0, 0.5).ok
    assert not at_most("", 1.0, 1.5).ok
    assert at_most("", 1.0, 1.5).measured == 0.5
    assert not at_most("", 1.0, math.nan).ok
    assert at_least("", 1.0, 1.5).ok
    assert at_least("", 1.0, 0.75).measured == 0.25


# --- what a figure leaves ---


def test_files_contain_curves_and_rows(tmp_path: Path) -> None:
    figure = synthetic()
    written = write("made-up", figure, tmp_path / "new" / "folder")
    assert {path.name.removeprefix("made-up") for path in written} == {".csv", "-expected.csv", ".json", ".png", ".svg", ".pdf"}
    with written[0].open() as file:
        points = list(csv.DictReader(file))
    assert [float(each["y"]) for each in points if each["curve"] == "square"] == pytest.approx([0.01, 1.0, 4.0])
    assert [float(each["value"]) for each in points if each["panel"] == "map"] == [0.5, 1.0, 2.0, 1.0, 1.0, 4.0]
    with written[1].open() as file:
        assert list(csv.DictReader(file)) == [
            {"case": "one", "expected": "1.0", "measured": "1.0", "tolerance": "0.1", "ok": "true"}
        ]
    assert written[2].read_text() == as_json("made-up", figure)
    assert written[3].read_bytes()[:4] == b"\x89PNG"
    assert ">square<" in written[4].read_text()  # text stays text


def test_the_same_figure_gives_the_same_bytes(tmp_path: Path) -> None:
    files = [{path.name: path.read_bytes() for path in write("it", synthetic(), tmp_path / name)} for name in ("a", "b")]
    assert files[0] == files[1]


def test_the_table_marks_missed_rows() -> None:
    assert table(synthetic()).splitlines()[1].endswith("ok")
    assert table(synthetic(2.0)).splitlines()[1].endswith("MISSED")


def test_json_has_no_nan() -> None:
    row = json.loads(as_json("x", synthetic(math.nan)), parse_constant=pytest.fail)["rows"][0]
    assert row == {"case": "one", "expected": 1.0, "measured": None, "tolerance": 0.1, "ok": False}


# --- the command ---


def test_every_name_has_a_function() -> None:
    for name in figures.NAMES:
        assert callable(figures.find(name))


def test_an_unknown_name_suggests_the_nearest() -> None:
    with pytest.raises(UsageError, match="did you mean 'loss-delay'"):
        figures.find("los-delay")
    outcome = vcmvsp_command("figure", "estimator")
    assert outcome.code == 2
    assert "did you mean 'estimators'" in outcome.err


def test_without_a_name_all_are_listed() -> None:
    outcome = vcmvsp_command("figure")
    assert outcome.code == 0
    assert [line.split()[0] for line in outcome.out.splitlines()] == list(figures.NAMES)
    assert list(json.loads(vcmvsp_command("figure", "--json").out)) == list(figures.NAMES)


def test_the_exit_code_reports_missed_rows(made_up: types.ModuleType, tmp_path: Path) -> None:
    outcome = vcmvsp_command("figure", "made-up", "--out", str(tmp_path))
    assert outcome.code == 0
    assert str(tmp_path / "made-up.png") in outcome.out
    made_up.make = lambda runner: synthetic(2.0)  # type: ignore[attr-defined]
    missed = vcmvsp_command("figure", "made-up", "--out", str(tmp_path), "--json")
    assert missed.code == 1
    assert json.loads(missed.out)["rows"][0]["ok"] is False
    assert "1 of 1 numbers" in missed.err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(("--jobs", "0"), "--jobs 0: must be 1 or more"), (("--out", __file__), "is a file; name a folder")],
)
def test_bad_arguments_end_before_the_first_run(made_up: types.ModuleType, arguments: tuple[str, ...], words: str) -> None:
    made_up.make = pytest.fail  # type: ignore[attr-defined]
    outcome = vcmvsp_command("figure", "made-up", *arguments)
    assert outcome.code == 2
    assert words in outcome.err


# --- runs ---


def test_runs_in_processes_give_equal_results_in_order() -> None:
    jobs = [rms(fleet(3.0, leader={"yaw_rate": rate}), from_s=0.0) for rate in (0.1, 0.2, 0.3)]
    reports: list[tuple[int, int]] = []
    here = Runner(1)(jobs)
    there = Runner(2, lambda done, of: reports.append((done, of)))(jobs)
    assert [each.tolist() for each in there] == [each.tolist() for each in here]
    assert len({each.tobytes() for each in here}) == 3
    assert reports == [(1, 3), (2, 3), (3, 3)]


def test_a_run_that_fails_in_a_process_is_raised_here() -> None:
    good, bad = fleet(1.0), fleet(1.0, [{"distanec": 1.0}])
    with pytest.raises(ScenarioError, match="did you mean 'distance'"):
        Runner(2)([track(good), track(bad)])


def test_a_part_whose_worker_dies_twice_is_an_error() -> None:
    with pytest.raises(VcmvspError, match="died twice; --jobs 1"):
        Runner(2)([partial(signal.raise_signal, signal.SIGKILL)] * 2)


def test_an_unsendable_error_keeps_its_message() -> None:
    refusal = "from vcmvsp.cosim.errors import AgentError\nraise AgentError(('car1',), 'mine', 'no')"
    with pytest.raises(VcmvspError, match=r"^agent mine of vehicle car1: no$"):
        Runner(2)([partial(exec, refusal, {})] * 2)  # no function of this file, whose imports take longer


def test_a_step_begins_in_steady_state() -> None:
    """All vehicles have one speed until the step; the error at the step is the requested one."""
    (result,) = Runner(1)([track(fleet(31.0, [step_follower(30.0, behind=0.5, left=0.2)], path="straight", kind="lag"))])
    at = int(np.flatnonzero(result.time_s >= 30.0)[0])
    assert result.z[at, 0] == pytest.approx([0.5, -0.2], abs=1e-9)
    assert result.z[: at + 1, 0] == pytest.approx(np.tile([0.5, -0.2], (at + 1, 1)), abs=0.05)


def test_overshoot_and_settling() -> None:
    z = np.array([-0.5, -0.2, 0.1, -0.02, 0.0])
    assert overshoot(z) == pytest.approx(0.2)
    assert settling_s(np.arange(5.0), z, 0.05) == 3.0
    assert math.isnan(settling_s(np.arange(2.0), z[:2], 0.05))


# --- closed forms and integrations, against published numbers ---


def test_circle() -> None:
    assert closed_forms.circle(R, V, ASIDE, AHEAD) == pytest.approx((2.34521, 0.83666, 0.35178), abs=1e-5)
    assert closed_forms.circle(R, V, -ASIDE, AHEAD) == pytest.approx((1.22474, 1.22474, 0.18371), abs=1e-5)
    assert closed_forms.circle_distance(R, V, ASIDE, AHEAD, 0.3) == pytest.approx(0.9384, abs=5e-5)
    assert closed_forms.circle_distance(R, V, -ASIDE, AHEAD, 0.3) == pytest.approx(1.0520, abs=5e-5)
    assert closed_forms.circle_distance(R, V, ASIDE, AHEAD, AHEAD) == pytest.approx(0.83666, abs=1e-5)


def test_servo() -> None:
    z = [closed_forms.servo_step(k1, T, 0.5, 200) for k1 in (0.4, 0.8, 2.0, 4.0, 8.0)]
    assert [100 * overshoot(each) for each in z] == pytest.approx([0.0, 2.6, 20.6, 39.6, 62.2], abs=0.05)
    assert [settling_s(T * np.arange(200), each, 0.05) for each in z] == pytest.approx([6.2, 2.6, 2.7, 3.8, 5.0])
    assert [100 * closed_forms.servo_overshoot(k1, 0.5) for k1 in (1.0, 2.0, 4.0)] == pytest.approx([4.3, 16.3, 30.5], abs=0.05)
    assert overshoot(closed_forms.servo_step(16.0, T, 0.0, 50)) == pytest.approx(0.6)


def test_gain_across_the_heading_is_bounded() -> None:
    for period, bound in zip((0.1, 0.5, 1.0, 2.0), (19.654, 3.6536, 1.6536, 0.6536), strict=True):
        assert abs(closed_forms.side_steps(0.999 * bound, period, AHEAD, V, 2000)[-1]) < 0.9
        assert abs(closed_forms.side_steps(1.001 * bound, period, AHEAD, V, 2000)[-1]) > 1.1


def test_lag_under_loss() -> None:
    squares = [closed_forms.lag_behind(V, K1, T, 0.0, p)[1] for p in (0.1, 0.3, 0.5, 0.7, 0.8, 0.9)]
    assert squares == pytest.approx([0.0041, 0.0143, 0.0332, 0.0790, 0.1390, 0.3298], abs=5.1e-5)


def test_hop_gain() -> None:
    at = np.array([0.8])
    ways = [closed_forms.hop_gain(at, K1, 0.5, 0.3, way)[0] for way in ("hold", "dr", "none", "acceleration")]
    assert ways == pytest.approx([1.213, 1.366, 0.857, 1.0], abs=5e-4)
    omega = np.linspace(0.01, 5.0, 5000)
    assert closed_forms.hop_gain(omega, K1, 0.5, 0.0, "hold").max() == pytest.approx(1.2274, abs=5e-5)
    most = [closed_forms.hop_gain(omega, K1, 0.5, d, "dr").max() for d in (0.1, 0.3, 1.0)]
    assert most == pytest.approx([1.287, 1.416, 1.916], abs=5e-4)


@pytest.mark.parametrize(
    ("path", "estimator", "reference"),
    [
        ("slalom", "hold", (0.0061, 0.0185, 0.089)),
        ("slalom", "dr", (0.0061, 0.0066, 0.024)),
        ("slalom", "acc", (0.0061, 0.0060, 0.0095)),
        ("random", "dr", (0.0033, 0.0072, 0.039)),
        ("random", "plan", (0.0033, 0.0033, 0.0033)),
    ],
)
def test_the_integration_gives_the_published_errors(path: str, estimator: str, reference: tuple[float, ...]) -> None:
    """Losses of 0, 0.3, 0.7, reports used in the tick of their sending: RMS, m, of an independent simulation."""
    p = np.array([0.0, 0.3, 0.7])
    assert loss_integration.rms(path, estimator, p, np.zeros(3, int)) == pytest.approx(reference, rel=0.1)


# --- the quick figures, nearly whole; of the slow ones a part ---


@pytest.fixture
def fewer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer starts in figure 24's proof and followers in 26, one fine gain in 30, earlier steps in 33; SVG only."""
    monkeypatch.setattr(circle, "PARTS", 1)
    monkeypatch.setattr(circle, "STARTS", 25)
    monkeypatch.setattr(circle, "PAIRS", 3)
    monkeypatch.setattr(steps, "FINE_GAINS", (2.0,))
    monkeypatch.setattr(steps, "BEFORE_S", 40.0)
    monkeypatch.setattr(drawing, "save", partial(save, kinds=("svg",)))


@pytest.mark.usefixtures("fewer")
@pytest.mark.parametrize("name", ["24", "25", "26", "28", "30", "31", "32", "33", "stall", "levels"])
def test_figure(name: str, tmp_path: Path) -> None:
    outcome = vcmvsp_command("figure", name, "--jobs", "1", "--json", "--out", str(tmp_path))
    answer = json.loads(outcome.out)
    assert [row for row in answer["rows"] if not row["ok"]] == []
    assert outcome.code == 0
    assert answer["name"] == name
    assert (tmp_path / f"{name}.json").read_text() == outcome.out
