"""The slow figures whole, at fewer points and with fewer followers: every row comes out, and everything is drawn and written.

What their rows are compared with, and the runs behind them, is the matter of ``tests/validation``.
"""

import csv
import json
import pickle
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from cosim import figures
from cosim.figures import chain, consensus, delay, fields, gauge, lossy, passages
from cosim.figures.files import write
from cosim.figures.kit import Figure, Runner

DELAYS_S = (0.5,)


@pytest.fixture
def one_delay(monkeypatch: pytest.MonkeyPatch) -> None:
    at = [delay.DELAYS_S.index(each) for each in DELAYS_S]
    few = {path: {who: tuple(of[i] for i in at) for who, of in table.items()} for path, table in delay.REFERENCE.items()}
    monkeypatch.setattr(delay, "DELAYS_S", DELAYS_S)
    monkeypatch.setattr(delay, "REFERENCE", few)


class Once(Runner):
    """Makes a run once, however many figures show it."""

    def __init__(self) -> None:
        super().__init__(1)
        self._made: dict[bytes, Any] = {}

    def __call__(self, jobs: Sequence[Callable[[], Any]]) -> list[Any]:
        keys = [pickle.dumps(job) for job in jobs]
        for key, job in zip(keys, jobs, strict=True):
            if key not in self._made:
                self._made[key] = job()
        return [self._made[key] for key in keys]


RUNNER = Once()


def made(name: str, folder: Path, panels: int, words: Sequence[str], **settings: Any) -> Figure:
    """A figure by its name, with all that holds for each of them."""
    figure = figures.find(name)(RUNNER, **settings)
    assert [row for row in figure.rows if not row.ok] == []
    cases = [row.case for row in figure.rows]
    assert len(set(cases)) == len(cases)
    assert [word for word in words if not any(word in case for case in cases)] == []
    titles = [panel.title for panel in figure.panels]
    assert len(set(titles)) == len(titles) == panels
    assert all(panel.heat is not None or panel.curves for panel in figure.panels)
    written = write(name, figure, folder)
    assert [path.name for path in written] == [f"{name}{end}" for end in (".csv", "-expected.csv", ".json", ".png", ".svg")]
    assert all(path.stat().st_size > 100 for path in written)
    with written[0].open() as file:
        assert {point["panel"] for point in csv.DictReader(file)} == {*titles}
    assert [row["case"] for row in json.loads(written[2].read_text())["rows"]] == cases
    return figure


def test_loss(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lossy, "PATHS", ("random",))
    figure = made("loss", tmp_path, 2, [*lossy.ESTIMATORS, "straight"], followers=4, probabilities=(0.3,), straight=4)
    assert len(figure.rows) == 4 + 1 + 1  # each estimator, dr over hold, the closed form


@pytest.mark.usefixtures("one_delay")
def test_delay(tmp_path: Path) -> None:
    figure = made("delay", tmp_path, 4, ["straight", "circle", "slalom", "random"])
    assert len(figure.rows) == (1 + 1) + (2 + 1) + 2 * (2 + 1)  # a line, a circle of either follower, two paths


@pytest.mark.usefixtures("one_delay")
def test_estimators(tmp_path: Path) -> None:
    figure = made("estimators", tmp_path, 2, lossy.ESTIMATORS)
    assert len(figure.rows) == 2 * (4 + 1)


def test_loss_and_delay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(delay, "MAP_P", (0.0, 0.6))
    monkeypatch.setattr(delay, "MAP_S", DELAYS_S)
    monkeypatch.setattr(delay, "NAMED", {(0.6, 0.5): delay.NAMED[0.6, 0.5]})
    figure = made("loss-delay", tmp_path, 3, ["p = 0.6, delay 0.5 s", "map of hold", "map of dr"], followers=4)
    assert len(figure.rows) == 2 + 2 + 1
    assert all(panel.heat is not None and panel.heat.values.shape == (1, 2) for panel in figure.panels)


def test_chain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chain, "OMEGAS", (0.8, 0.963))
    monkeypatch.setattr(chain, "DELAYS_S", ())
    monkeypatch.setattr(chain, "WARM_S", 8.0)
    figure = made("chain", tmp_path, 2, ["largest gain", "column"])
    assert len(figure.rows) == 4 + 1 + 4 + 4 + 2 + 3


def test_consensus_delay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few: Mapping[str, int] = {"path": 5}
    monkeypatch.setattr(consensus, "GRAPHS", few)
    monkeypatch.setattr(consensus, "AGES", range(2, 5))
    monkeypatch.setattr(consensus, "SHARES", (1.02,))
    monkeypatch.setattr(consensus, "GROWTH", {graph: consensus.GROWTH[graph][2:3] for graph in few})
    figure = made("consensus-delay", tmp_path, 4, ["last stable", "first unstable", "1 kHz", "no delay", "own point fresh"])
    assert len(figure.rows) == 4 + 1 + 1 + 1


def test_29(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fields, "SPACINGS", {spacing: fields.SPACINGS[spacing] for spacing in (1.2, 1.5)})
    figure = made("29", tmp_path, 4, ["tang 0", "tang 1", "spacing 1.2 m"])
    assert len(figure.rows) == 2 * 5 + 1 + 1


def test_41(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gauge, "DOORS", 80)
    monkeypatch.setattr(gauge, "PARTS", 1)
    monkeypatch.setattr(gauge, "DISTANCES", 10)
    figure = made("41", tmp_path, 5, ["left door", "narrow door", "behind the robot", "40 doors", "80 random doors"])
    assert len(figure.rows) == 2 * (3 + 2 + 2) + 4


@pytest.mark.parametrize("name", ["42", "43"])
def test_corridor(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(passages, "SEEDS", (1,))
    assert len(made(name, tmp_path, 3, ["changes of shape", "changes of mode", "clearance"]).rows) == 6


def test_passage_policies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(passages, "SEEDS", (1,))
    monkeypatch.setattr(passages, "EXPECTED", {"corridor": passages.EXPECTED["corridor"]})
    figure = made("passage-policies", tmp_path, 2, ["corridor, A2", "gates, B, p = 0.9", "low scanners", "at most 5"])
    assert len(figure.rows) == 3 * 6 + 1 + 2 * 2 * 3
