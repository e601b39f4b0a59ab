"""Names of the varied values in the figures of a study."""

from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from matplotlib.figure import Figure

from vcmvsp.cosim.plots import study_plot

pytestmark = pytest.mark.slow


def summary(rows: list[dict[str, Any]]) -> pa.Table:
    shared = {"n": 1, "failed": 0, "m.n": 1, "m.low": None, "m.high": None}
    return pa.Table.from_pylist([{**row, **shared} for row in rows])


@pytest.mark.parametrize("values", [(1e6, 1e6 + 1.0), (0.12345671, 0.12345672), (0.5, 1.0)])
def test_close_values_have_separate_lines(values: tuple[float, float]) -> None:
    points = [{"x": x, "f": f, "m.mean": x + number} for number, f in enumerate(values) for x in (0.0, 1.0, 2.0)]
    (axes,) = study_plot.lines(summary(points), ["x", "f"], ["m"]).axes
    assert [np.asarray(line.get_ydata()).tolist() for line in axes.lines] == [[0.0, 1.0, 2.0], [1.0, 2.0, 3.0]]
    assert [float(str(line.get_label())) for line in axes.lines] == list(values)


def test_a_text_that_begins_like_a_table_is_a_text() -> None:
    points = [{"k": name, "m.mean": 1.0} for name in ("{a", '{"kind": "b"}', '{"b": 1}')]
    (axes,) = study_plot.lines(summary(points), ["k"], ["m"]).axes
    assert [label.get_text() for label in axes.get_xticklabels()] == [point["k"] for point in points]


@pytest.mark.parametrize(("count", "named"), [(7, 7), (100, 19)])
def test_a_legend_has_as_many_names_as_there_is_room_for(count: int, named: int) -> None:
    points = [{"x": x, "k": f"e{k}", "m.mean": 1.0} for k in range(count) for x in (0.0, 1.0)]
    figure = study_plot.lines(summary(points), ["x", "k"], ["m"])
    figure.draw_without_rendering()
    (legend,) = figure.legends
    texts = [text.get_text() for text in legend.get_texts()]
    assert texts[:5] == ["e0", "e1", "e2", "e3", "e4"]
    assert len(texts) == named
    assert texts[-1] == (f"and {count - named + 1} more" if count > named else f"e{count - 1}")
    assert legend.get_window_extent().y0 >= 0.0  # within the figure


def test_a_map_of_many_values_is_no_larger_and_names_some_of_them() -> None:
    def of(count: int) -> Figure:
        points = [{"x": float(x), "y": float(y), "m.mean": 1.0} for x in range(count) for y in (0, 1)]
        figure = study_plot.heat_map(summary(points), ["x", "y"], "m")
        assert figure is not None
        return figure

    large = of(300)
    assert large.get_figwidth() == of(48).get_figwidth() < 20.0
    named = [float(label.get_text()) for label in large.axes[0].get_xticklabels()]
    assert named == list(large.axes[0].get_xticks())
    assert len(named) <= 48
