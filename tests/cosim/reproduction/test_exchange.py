"""Figures of searches: the sequential test of a cell, the watcher of a run, and the figures with short runs."""

import math
from pathlib import Path

import numpy as np
import pytest

from tests.support.cosim.figures import draw_figure
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.reproduction.figures.search import map_exchange
from vcmvsp.cosim.reproduction.figures.search.map_exchange import (
    CELL_M,
    SURE,
    Watcher,
    places,
    search,
    searched,
    sequential,
)
from vcmvsp.cosim.types import Note, ProbabilityMap

pytestmark = pytest.mark.slow

QUICK = 15  # seed for which four vehicles find the targets within seconds


@pytest.mark.parametrize("p", [0.6, 0.7, 0.8, 0.9, 0.95])
def test_the_sequential_test_by_its_closed_forms(p: float) -> None:
    """m: least with (p/q)^m > 99; wrong 1 / (1 + (p/q)^m); looks by Wald's identity, m (1 - 2 wrong) / (p - q)."""
    net, wrong, looks = sequential(p)
    odds = p / (1.0 - p)
    assert net == math.floor(math.log(99.0) / math.log(odds)) + 1
    assert wrong == pytest.approx(1.0 / (1.0 + odds**net), rel=1e-9)
    assert looks == pytest.approx(net * (1.0 - 2.0 * wrong) / (2.0 * p - 1.0), rel=1e-9)


def shown(sure: list[tuple[int, int]]) -> ProbabilityMap:
    probability = np.full((50, 50), 128, np.uint8)
    for cell in sure:
        probability[cell] = 253
    return ProbabilityMap(left=0.0, bottom=0.0, cell_m=CELL_M, probability=probability, seen=np.zeros((50, 50), np.bool_))


def test_a_search_is_over_when_all_maps_are_sure_of_both() -> None:
    """Targets in column 5, row 20 and column 30, row 1; a third cell is false."""
    watcher = Watcher(2, [(11.0, 41.0), (61.0, 3.0)], ())
    both = [(20, 5), (1, 30)]
    for second, (vehicle, cells) in enumerate(
        [("uav1", both), ("uav2", both[:1]), ("uav1", [*both, (7, 7)]), ("uav2", both), ("uav2", both)]
    ):
        watcher.on(Event(f"{vehicle}/map", second * 10**9, shown(cells)))
    watcher.on(Event("uav1/note", 5 * 10**9, Note(values={"map_bytes": 100.0})))
    watcher.on(Event("uav1/note", 6 * 10**9, Note(values={"map_bytes": 150.0})))
    found = watcher.end(600.0)
    assert (found.done_s, found.seconds, found.bytes_sent) == (3.0, 3.0, 150.0)
    assert found.false_cells == 0.5


def test_an_unfinished_search_takes_the_whole_time() -> None:
    found = Watcher(2, [(11.0, 41.0)], ()).end(600.0)
    assert math.isinf(found.done_s)
    assert found.seconds == 600.0
    assert math.isnan(found.false_cells)


def test_sure_is_more_than_99_percent() -> None:
    assert round(255 * 0.9900) < SURE < round(255 * 0.9986)  # three net hits with p = 0.9


def test_targets_keep_off_the_border_and_vehicles_begin_on_their_lanes() -> None:
    assert all(10.0 <= value <= 90.0 for seed in range(20) for place in places(seed) for value in place)
    starts = [each["position"][:2] for each in search(2, "ledger", 0.0, 1, 10.0)["vehicle"]]
    assert starts == [(6.25, 4.0), (56.25, 4.0)]


def test_without_loss_a_ledger_and_increments_are_the_same_map() -> None:
    first = searched(4, "ledger", 0.0, QUICK, 60.0)
    assert first == searched(4, "ledger", 0.0, QUICK, 60.0)
    assert math.isfinite(first.done_s)
    assert searched(4, "delta", 0.0, QUICK, 60.0).done_s == first.done_s
    assert math.isinf(searched(4, "none", 0.0, QUICK, 2.0 * first.done_s).done_s)


def test_search_exchange(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The sequential test of a cell gives the published numbers."""
    monkeypatch.setattr(map_exchange, "LIMITS_S", {2: 5.0, 4: 5.0})
    figure = draw_figure("search-exchange", tmp_path, 4, seeds=1, losses=(0.0, 0.9))
    assert sum("one cell" in row.case and row.ok for row in figure.rows) == 6
    assert all(row.ok for row in figure.rows if "none" in row.case)


def test_45(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(map_exchange, "SHOWN_S", (2.0, 5.0))
    figure = draw_figure("45", tmp_path, 4)
    assert all(panel.heat is not None and panel.heat.values.max() <= 1.0 for panel in figure.panels)
    (apart,) = [row for row in figure.rows if "differ" in row.case]
    assert apart.ok
