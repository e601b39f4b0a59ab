"""Figure 51: its rows from made-up runs, and the whole figure with runs of seconds."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.support.cosim.figures import draw_figure
from vcmvsp.cosim.reproduction.figures.search import reconnaissance
from vcmvsp.cosim.reproduction.figures.search.reconnaissance import MissionRun, rows_of

pytestmark = pytest.mark.slow

TIME_S = np.arange(0.0, 100.0, 0.5)
ALPHA, BRAVO = np.array([10.0, 20.0]), np.array([-30.0, 5.0])
GOOD = MissionRun(
    TIME_S,
    np.stack([np.tile(ALPHA + 0.2, (200, 1)), np.tile(BRAVO, (200, 1))], axis=1),
    {"found_s": {"alpha": 40.0, "bravo": 60.0}, "targets_tracked": 2, "false_finds": 0},
    {"collisions": 0, "min_clearance_m": 1.5, "min_separation_m": 20.0},
)


def missed(run: MissionRun) -> list[str]:
    away = {name: np.hypot(*np.moveaxis(run.place - at, -1, 0)) for name, at in (("alpha", ALPHA), ("bravo", BRAVO))}
    return [row.case for row in rows_of("town", run, 50.0, away) if not row.ok]


def test_a_good_run() -> None:
    assert missed(GOOD) == []


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"mission": {**GOOD.mission, "found_s": {"alpha": 40.0, "bravo": None}}}, ["found", "last found"]),
        ({"mission": {**GOOD.mission, "found_s": {"alpha": 40.0, "bravo": 190.0}}}, ["last found"]),
        ({"mission": {**GOOD.mission, "targets_tracked": 1}}, ["tracked"]),
        ({"mission": {**GOOD.mission, "false_finds": 1}}, ["no target"]),
        ({"safety": {**GOOD.safety, "collisions": 1}}, ["contacts"]),
        ({"safety": {**GOOD.safety, "min_clearance_m": 0.4}}, ["clearance"]),
        ({"safety": {**GOOD.safety, "min_separation_m": 0.9}}, ["apart"]),
        ({"place": GOOD.place + 2.0}, ["alpha", "bravo"]),
    ],
)
def test_failures_are_missed_rows(changes: dict[str, object], words: list[str]) -> None:
    cases = missed(replace(GOOD, **changes))  # type: ignore[arg-type]
    assert len(cases) == len(words)
    assert all(word in case for word, case in zip(words, cases, strict=True))


def test_51(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs of 2 s, without any find."""
    monkeypatch.setattr(reconnaissance, "DURATION_S", 2.0)
    figure = draw_figure("51", tmp_path, 2, seeds=(1,))
    failed = {row.case for row in figure.rows if not row.ok}
    assert failed >= {"town 1: targets found", "town 1: targets tracked"}
    assert not any("contacts" in case or "clearance" in case for case in failed)
