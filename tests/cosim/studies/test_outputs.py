"""Outputs of a study: figures of the summary's numbers, equal bytes every time, and a page with the command that repeats it."""

import csv
import html
import itertools
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure

import vcmvsp
from tests.support.cosim.studies import two
from vcmvsp.cosim.plots import study_plot
from vcmvsp.cosim.scenario.loader import settings_of
from vcmvsp.cosim.studies.outputs import command_of, toml_of, write
from vcmvsp.cosim.studies.plan import Plan, vary_of
from vcmvsp.cosim.studies.summary import summarise

pytestmark = [pytest.mark.processes, pytest.mark.usefixtures("figures")]

LOSS, DELAY, WHO, METRIC = "radio.loss.probability", "radio.delay.seconds", "agents.estimator", "formation.rms_m"


def study(vary: Mapping[str, Any], seeds: int = 3, fails: bool = False, **changed: Any) -> tuple[pa.Table, Plan]:
    """A study whose metric is the sum of all varied numbers and a hundredth of the seed."""
    points = [dict(zip(vary, values, strict=True)) for values in itertools.product(*vary.values())]
    rows = []
    for point in points:
        for seed in range(1, seeds + 1):
            value = 0.01 * seed + sum(each for each in point.values() if isinstance(each, int | float))
            failed = fails and seed == 2
            values = {METRIC: None if failed else value, "radio.delivery_ratio": None if failed else 1.0 / seed}
            rows.append({**point, "seed": seed, **values, "error": "car2: <it> raised" if failed else None, "digest": "00"})
    spec = Plan(
        scenario="study-loss",
        vary={key: list(values) for key, values in vary.items()},
        seeds=list(range(1, seeds + 1)),
        metrics=[METRIC, "radio.delivery_ratio"],
        set={"duration_s": 30.0},
        scenario_toml='name = "study-loss"  # <comment>\n',
        versions={"vcmvsp": "0.1.0"},
    )
    return pa.table({name: [row[name] for row in rows] for name in rows[0]}), msgspec.structs.replace(spec, **changed)


def figure_of(vary: Mapping[str, Any], metrics: tuple[str, ...] = (METRIC,)) -> Figure:
    table, _ = study(vary)
    return study_plot.lines(summarise(table, list(vary), metrics), list(vary), metrics)


def map_of(vary: Mapping[str, Any], seeds: int = 3) -> Figure:
    figure = study_plot.heat_map(summarise(study(vary, seeds)[0], list(vary), [METRIC]), list(vary), METRIC)
    assert figure is not None
    return figure


# --- figures -----------------------------------------------------------------------------------------------------------------


def test_lines_go_through_the_means_and_bands_through_their_ends() -> None:
    vary = {WHO: ["hold", "dr"], LOSS: [0.9, 0.1, 0.5]}  # unsorted
    table, _ = study(vary)
    summary = summarise(table, list(vary), [METRIC])
    (axes,) = study_plot.lines(summary, list(vary), [METRIC]).axes
    assert [line.get_label() for line in axes.lines] == ["hold", "dr"]
    for line, name in zip(axes.lines, ("hold", "dr"), strict=True):
        means = {row[LOSS]: row[f"{METRIC}.mean"] for row in summary.to_pylist() if row[WHO] == name}
        assert line.get_xydata().tolist() == [[x, means[x]] for x in (0.1, 0.5, 0.9)]  # type: ignore[union-attr]
    ends = {row[f"{METRIC}.{end}"] for row in summary.to_pylist() for end in ("low", "high")}
    corners = {float(y) for band in axes.collections for path in band.get_paths() for _, y in np.asarray(path.vertices)}
    assert ends == corners


def test_the_first_key_with_numbers_is_the_axis_and_a_key_with_one_value_is_none() -> None:
    (axes,) = figure_of({WHO: ["hold", "dr"], "seed_of_world": [3], DELAY: [0.0, 1.0], LOSS: [0.1, 0.5]}).axes
    assert axes.get_xlabel() == "delay before the wait for the next tick [s]"
    assert [line.get_label() for line in axes.lines] == ["hold, 0.1", "hold, 0.5", "dr, 0.1", "dr, 0.5"]


def test_names_alone_are_points_with_error_bars() -> None:
    (axes,) = figure_of({WHO: ["hold", "dr", "acc"], "radio.mac.kind": ["dcf", "ideal"]}).axes
    assert [text.get_text() for text in axes.get_xticklabels()] == ["hold", "dr", "acc"]
    assert len(axes.containers) == 2
    places = [float(x) for bars in axes.containers for x in np.asarray(bars.lines[0].get_xdata())]  # type: ignore[attr-defined]
    assert [round(x) for x in places] == [0, 1, 2, 0, 1, 2]
    assert len(set(places)) == 6  # beside each other


def test_booleans_count_as_names_and_tables_are_named_by_their_kinds_where_these_differ() -> None:
    (axes,) = figure_of({"record.sensors": [True, False]}).axes
    assert [text.get_text() for text in axes.get_xticklabels()] == ["true", "false"]
    gap, field, wide = '{"kind": "gap"}', '{"kind": "potential_field", "reach": 0.6}', '{"kind": "gap", "top": 5}'
    (axes,) = figure_of({"agents.avoidance": [gap, field], "world": ['{"kind": "gates"}', '{"kind": "pillar"}']}).axes
    assert [text.get_text() for text in axes.get_xticklabels()] == ["gap", "potential_field"]
    assert [bars.get_label() for bars in axes.containers] == ["gates", "pillar"]
    (axes,) = figure_of({"agents.avoidance": [gap, wide]}).axes
    assert [text.get_text() for text in axes.get_xticklabels()] == [gap, wide]


def test_a_metric_that_spans_decades_has_a_logarithmic_axis() -> None:
    assert figure_of({LOSS: [0.0, 9.0]}).axes[0].get_yscale() == "log"
    assert figure_of({LOSS: [0.5, 0.9]}).axes[0].get_yscale() == "linear"


def test_there_is_a_panel_for_each_metric() -> None:
    shown = figure_of({LOSS: [0.0, 0.5]}, (METRIC, "radio.delivery_ratio", "radio.age_s.mean")).axes
    assert [axes.get_ylabel() for axes in shown if axes.get_visible()] == [
        "formation error, RMS [m]",
        "share of frames delivered",
        "age of information, mean [s]",
    ]
    assert any("no run has a value" in text.get_text() for text in shown[2].texts)  # the third is in no row


def test_the_map_has_the_mean_of_each_point_in_its_cell() -> None:
    vary = {DELAY: [2.0, 0.5], LOSS: [0.1, 0.9, 0.5]}
    axes = map_of(vary).axes[0]
    summary = summarise(study(vary)[0], list(vary), [METRIC])
    assert [text.get_text() for text in axes.get_xticklabels()] == ["0.5", "2"]
    assert [text.get_text() for text in axes.get_yticklabels()] == ["0.1", "0.5", "0.9"]
    means = {(row[DELAY], row[LOSS]): row[f"{METRIC}.mean"] for row in summary.to_pylist()}
    shown = np.asarray(axes.collections[0].get_array())
    assert shown.tolist() == [[means[x, y] for x in (0.5, 2.0)] for y in (0.1, 0.5, 0.9)]
    numbers = {tuple(map(int, text.xy)): float(text.get_text()) for text in axes.texts}  # type: ignore[attr-defined]
    assert numbers[1, 2] == pytest.approx(means[2.0, 0.9], rel=0.05)


def test_a_large_map_has_no_numbers_and_a_map_needs_two_numeric_keys() -> None:
    eight = [0.1 * i for i in range(8)]
    assert not map_of({DELAY: eight, LOSS: eight}, seeds=1).axes[0].texts
    names = {WHO: ["hold", "dr"], LOSS: [0.1, 0.5]}
    table, _ = study(names)
    assert study_plot.heat_map(summarise(table, list(names), [METRIC]), list(names), METRIC) is None


def test_a_third_key_gives_a_map_for_each_of_its_values() -> None:
    figure = map_of({WHO: ["hold", "dr", "acc"], DELAY: [0.0, 1.0], LOSS: [0.1, 0.5]})
    assert [axes.get_title() for axes in figure.axes if axes.get_title()] == ["hold", "dr", "acc"]


# --- files -------------------------------------------------------------------------------------------------------------------


def test_the_page_contains_points_failures_and_command(tmp_path: Path) -> None:
    table, spec = study({WHO: ["hold", "dr"], LOSS: [0.1, 0.5]}, fails=True)
    write(tmp_path, table, spec)
    text = html.unescape((tmp_path / "report.html").read_text("utf-8"))
    assert "12 runs: 4 points with 3 seeds each; 4 failed" in text
    assert text.count("car2: <it> raised") == 4
    assert "formation error, RMS [m]</text>" in text
    assert command_of(spec) in text
    assert spec.scenario_toml in text
    assert "<dt>vcmvsp</dt><dd>0.1.0</dd>" in text
    with (tmp_path / "summary.csv").open(encoding="utf-8") as file:
        assert [row["failed"] for row in csv.DictReader(file)] == ["1"] * 4


def test_a_study_without_successful_runs_has_a_page(tmp_path: Path) -> None:
    table, spec = study({LOSS: [0.1]}, seeds=1)
    failed = table.drop_columns([METRIC, "radio.delivery_ratio", "error"]).append_column("error", pa.array(["no"]))
    write(tmp_path, failed, spec)
    assert "1 run: 1 point with 1 seed each; 1 failed" in (tmp_path / "report.html").read_text("utf-8")


def test_without_metrics_there_are_no_figures(tmp_path: Path) -> None:
    table, spec = study({LOSS: [0.1, 0.5]}, metrics=[])
    assert [path.name for path in write(tmp_path, table, spec)] == ["summary.csv", "report.html"]


# --- the command -------------------------------------------------------------------------------------------------------------

scalars = st.integers(-(2**62), 2**62) | st.floats(allow_nan=False, allow_infinity=False) | st.booleans()
words = st.text(st.characters(codec="utf-8", exclude_categories=("Cs", "Cc")), max_size=8)
values = st.recursive(
    scalars | words, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(words, inner, max_size=2), max_leaves=4
)


@settings(max_examples=150, deadline=None)
@given(values)
def test_a_value_is_read_back_unchanged(value: Any) -> None:
    assert vary_of([f"a.b={toml_of(value)}"]) == {"a.b": [value]}
    assert settings_of([f"a.b={toml_of(value)}"]) == {"a.b": value}


@pytest.mark.parametrize("text", ["-5", "-inf", "5", "1e5", "nan", "true", "1979-05-27", "2nd", "-", "_1", "0x1F", "a-b", "٣"])
def test_a_text_stays_a_text(text: str) -> None:
    assert vary_of([f"a.b={toml_of(text)}"]) == {"a.b": [text]}
    assert settings_of([f"a.b={toml_of(text)}"]) == {"a.b": text}


def test_a_scenario_that_has_no_name_has_no_command(tmp_path: Path) -> None:
    table, spec = study({LOSS: [0.1, 0.5]})
    write(tmp_path, table, spec, repeatable=False)
    text = html.unescape((tmp_path / "report.html").read_text("utf-8"))
    assert "vcmvsp study" not in text
    assert "Again" not in text
    vcmvsp.study(two(), vary={LOSS: [0.0]}, seeds=1, jobs=1, out=tmp_path / "whole")
    assert "vcmvsp study" not in (tmp_path / "whole" / "report.html").read_text("utf-8")


def test_the_command_describes_the_whole_study() -> None:
    vary = {
        WHO: ["hold", "true", "a, b", "0:1"],
        "radio.mac": [{"kind": "dcf", "cw_min": 7}, {"kind": "ideal"}],
        LOSS: [0.0, 0.3],
    }
    _, spec = study(vary, set={"agents.k1": 2, "name": "it's"})
    program, command, scenario, *rest = shlex.split(command_of(spec))
    assert (program, command, scenario) == ("vcmvsp", "study", "study-loss")
    options = [(rest[i], rest[i + 1]) for i in range(0, len(rest), 2)]
    assert vary_of([value for option, value in options if option == "--vary"]) == vary
    assert settings_of([value for option, value in options if option == "--set"]) == spec.set
    assert [value for option, value in options if option == "--metric"] == spec.metrics
    assert dict(options)["--seeds"] == "3"
    assert dict(options)["--seed"] == "1"
