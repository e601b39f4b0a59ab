"""The slow figures whole, with fewer points and fewer followers: all rows, drawings and files.

``tests/validation`` covers the expected values of their rows, the runs behind them and the figure of chains.
"""

from collections.abc import Mapping
from pathlib import Path

import pytest

from tests.support.cosim.figures import checked_figure
from vcmvsp.cosim.reproduction.figures.avoidance import gaps, passages, potential_fields
from vcmvsp.cosim.reproduction.figures.formation import consensus, loss_integration, messages

pytestmark = pytest.mark.slow

DELAYS_S = (0.5,)


@pytest.fixture
def one_delay(monkeypatch: pytest.MonkeyPatch) -> None:
    at = [messages.DELAYS_S.index(each) for each in DELAYS_S]
    few = {
        path: {estimator: tuple(of[i] for i in at) for estimator, of in table.items()}
        for path, table in messages.REFERENCE.items()
    }
    monkeypatch.setattr(messages, "DELAYS_S", DELAYS_S)
    monkeypatch.setattr(messages, "REFERENCE", few)


def test_loss(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loss_integration, "PATHS", ("random",))
    monkeypatch.setattr(messages, "MANY", 20)
    monkeypatch.setattr(messages, "TEAM_S", 50.0)  # expected values use the losses of the run
    figure = checked_figure(
        "loss", tmp_path, 2, [*loss_integration.ESTIMATORS, "straight"], followers=2, probabilities=(0.3,), straight=4
    )
    assert len(figure.rows) == 4 + 1 + 1  # each estimator, dr over hold, the closed form


@pytest.mark.usefixtures("one_delay")
def test_delay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loss_integration, "PATHS", ("slalom",))
    figure = checked_figure("delay", tmp_path, 3, ["straight", "circle", "slalom"])
    assert len(figure.rows) == (1 + 1) + (2 + 1) + (2 + 1)  # a line, a circle of either follower, a path


@pytest.mark.usefixtures("one_delay")
def test_estimators(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loss_integration, "PATHS", ("random",))  # the slalom is in `test_delay`
    figure = checked_figure("estimators", tmp_path, 1, loss_integration.ESTIMATORS)
    assert len(figure.rows) == 4 + 1


def test_loss_and_delay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(messages, "MAP_P", (0.0, 0.6))
    monkeypatch.setattr(messages, "MAP_S", DELAYS_S)
    monkeypatch.setattr(messages, "NAMED", {(0.6, 0.5): messages.NAMED[0.6, 0.5]})
    figure = checked_figure("loss-delay", tmp_path, 3, ["p = 0.6, delay 0.5 s", "map of hold", "map of dr"], followers=2)
    assert len(figure.rows) == 2 + 2 + 1
    assert all(panel.heat is not None and panel.heat.values.shape == (1, 2) for panel in figure.panels)


def test_consensus_delay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few: Mapping[str, int] = {"path": 5}
    monkeypatch.setattr(consensus, "GRAPHS", few)
    monkeypatch.setattr(consensus, "AGES", range(2, 5))
    words = ["last stable", "first unstable", "1 kHz", "no delay", "own point fresh"]
    figure = checked_figure("consensus-delay", tmp_path, 4, words, shares=(0.98,))
    assert len(figure.rows) == 4 + 1 + 1 + 1


def test_29(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(potential_fields, "SPACINGS", {spacing: potential_fields.SPACINGS[spacing] for spacing in (1.2, 1.5)})
    figure = checked_figure("29", tmp_path, 4, ["tang 0", "tang 1", "spacing 1.2 m"])
    assert len(figure.rows) == 2 * 5 + 1 + 1


def test_41(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gaps, "DOORS", 80)
    monkeypatch.setattr(gaps, "PARTS", 1)
    monkeypatch.setattr(gaps, "DISTANCES", 10)
    monkeypatch.setattr(gaps, "RUN_S", 16.0)  # through the door, 2.5 m away, at 0.3 m/s
    figure = checked_figure("41", tmp_path, 5, ["left door", "narrow door", "behind the robot", "40 doors", "80 random doors"])
    assert len(figure.rows) == 2 * (3 + 2 + 2) + 4


@pytest.mark.parametrize("name", ["42", "43"])
def test_corridor(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(passages, "SEEDS", (1,))
    assert len(checked_figure(name, tmp_path, 3, ["changes of shape", "changes of mode", "clearance"]).rows) == 6


def test_passage_policies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(passages, "SEEDS", (1,))
    monkeypatch.setattr(passages, "EXPECTED", {"corridor": passages.EXPECTED["corridor"]})
    figure = checked_figure("passage-policies", tmp_path, 2, ["corridor, A2", "gates, B, p = 0.9", "low scanners", "at most 5"])
    assert len(figure.rows) == 3 * 6 + 1 + 2 * 2 * 3
