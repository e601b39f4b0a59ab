"""Mean and band of each point: exact where possible, with the right coverage, independent of the order of runs."""

import csv
import io
import math
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from vcmvsp.cosim.studies.summary import band, rows, summarise, to_csv

pytestmark = pytest.mark.slow

METRIC = "formation.rms_m"
numbers = st.floats(-1e6, 1e6, allow_nan=False)


def table(runs: list[dict[str, Any]]) -> pa.Table:
    names = dict.fromkeys(name for run in runs for name in run)
    return pa.table({name: [run.get(name) for run in runs] for name in ("error", *(n for n in names if n != "error"))})


def runs(values: dict[float, list[float | None]]) -> list[dict[str, Any]]:
    return [
        {"radio.loss.probability": key, "seed": seed, METRIC: value, "error": None}
        for key, listed in values.items()
        for seed, value in enumerate(listed)
    ]


@settings(max_examples=40, deadline=None)  # the first example imports SciPy
@given(st.lists(numbers, min_size=1, max_size=12))
def test_the_mean_is_exact_to_the_last_bit(values: list[float]) -> None:
    mean, low, high = band(values)
    assert mean == (values[0] if min(values) == max(values) else math.fsum(values) / len(values))
    if len(values) == 1:
        assert low is high is None
    else:
        assert low is not None
        assert high is not None
        slack = 1e-12 * max(map(abs, values))  # numpy's mean of equal values may be off by a bit
        assert min(values) - slack <= low <= high <= max(values) + slack


@pytest.mark.parametrize("n", [5, 10, 30])
def test_the_coverage_of_the_band_is_that_of_a_bootstrap(n: int) -> None:
    # Resampled means have the variance (n - 1)/n s^2 / n, so the band is mean +- 1.96 sqrt((n - 1)/n) s/sqrt(n). Student's t
    # with n - 1 degrees of freedom gives its coverage of the true mean.
    expected = 2.0 * stats.t.cdf(1.95996 * math.sqrt((n - 1) / n), n - 1) - 1.0
    draws, trials = np.random.default_rng(3), 500
    bands = [band(draws.normal(7.0, 2.0, n)) for _ in range(trials)]
    held = sum(each.low <= 7.0 <= each.high for each in bands if each.low is not None and each.high is not None) / trials
    assert held == pytest.approx(expected, abs=4.0 * math.sqrt(expected * (1.0 - expected) / trials))


def test_equal_values_have_a_band_without_width_and_one_value_has_none() -> None:
    assert band([0.3, 0.3, 0.3]) == (0.3, 0.3, 0.3)
    assert band([0.3]) == (0.3, None, None)
    assert band([]) == (None, None, None)


@settings(max_examples=15, deadline=None)
@given(st.randoms(use_true_random=False))
def test_the_order_of_the_runs_changes_no_bit(random: Any) -> None:
    listed = runs({0.5: [0.1, 0.4, 0.2, None], 0.1: [1.0, 2.0, 4.0, 3.0], 0.9: [5.0, 5.0, 5.0, 5.0]})
    sorted_rows = summarise(table(listed), ["radio.loss.probability"], [METRIC]).to_pylist()
    random.shuffle(listed)
    shuffled = summarise(table(listed), ["radio.loss.probability"], [METRIC]).to_pylist()
    assert sorted(shuffled, key=str) == sorted(sorted_rows, key=str)


@pytest.mark.parametrize(
    ("values", "expected"),
    [([1.0, None, 3.0], (3, 1, 2, 2.0)), ([], (0, 1, 0, None))],
    ids=["nulls and a failure", "failures alone"],
)
def test_nulls_and_failures_are_left_out_and_counted(values: list[float | None], expected: tuple[object, ...]) -> None:
    listed = [*runs({0.1: values}), {"radio.loss.probability": 0.1, "seed": 3, "error": "car2: it raised"}]
    (point,) = summarise(table(listed), ["radio.loss.probability"], [METRIC]).to_pylist()
    assert (point["n"], point["failed"], point[f"{METRIC}.n"], point[f"{METRIC}.mean"]) == expected


@pytest.mark.parametrize(
    "values", [[0.9, 0.1, 0.5], ["b", "a"], [True, False], [[1, 2], [2, 1]], [{"kind": "a"}, {"kind": "b"}]]
)
def test_values_of_any_type_make_points_in_the_order_of_the_study(values: list[Any]) -> None:
    listed = [{"key": value, "seed": seed, METRIC: 1.0, "error": None} for value in values for seed in (1, 2)]
    found = summarise(table(listed), ["key"], [METRIC])
    assert found["key"].to_pylist() == values
    assert found["n"].to_pylist() == [2] * len(values)


def test_nothing_varied_is_one_point() -> None:
    (point,) = summarise(table(runs({0.1: [1.0, 2.0]})), [], [METRIC]).to_pylist()
    assert (point["n"], point[f"{METRIC}.mean"]) == (2, 1.5)


@given(st.lists(st.lists(numbers, min_size=2, max_size=3), min_size=1, max_size=3))
@settings(max_examples=15, deadline=None)
def test_the_file_holds_every_digit(values: list[list[float]]) -> None:
    summary = summarise(table(runs(dict(enumerate(map(list, values), 1)))), ["radio.loss.probability"], [METRIC])
    read = list(csv.DictReader(io.StringIO(to_csv(summary))))
    for row, point in zip(read, summary.to_pylist(), strict=True):
        assert {name: float(text) for name, text in row.items()} == point


def test_missing_values_are_empty_in_the_file() -> None:
    summary = summarise(table(runs({0.1: [1.0]})), ["radio.loss.probability"], [METRIC])
    (row,) = csv.DictReader(io.StringIO(to_csv(summary)))
    assert row == {
        "radio.loss.probability": "0.1",
        "n": "1",
        "failed": "0",
        f"{METRIC}.n": "1",
        f"{METRIC}.mean": "1.0",
        f"{METRIC}.low": "",
        f"{METRIC}.high": "",
    }


def test_json_has_a_mapping_for_each_metric() -> None:
    summary = summarise(table(runs({0.1: [1.0, 1.0]})), ["radio.loss.probability"], [METRIC])
    assert rows(summary, ["radio.loss.probability"], [METRIC]) == [
        {"radio.loss.probability": 0.1, "n": 2, "failed": 0, METRIC: {"n": 2, "mean": 1.0, "low": 1.0, "high": 1.0}}
    ]
