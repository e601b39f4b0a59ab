"""``vcmvsp radio --coverage``: maps agree with what runs recorded."""

import json
from pathlib import Path

import numpy as np
import pytest

from cosim import coverage
from cosim.record import coverage_plot, plots
from tests.cosim.command import vcmvsp
from tests.cosim.rooms import rows, run_rooms


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that nobody changes."""
    return run_rooms(tmp_path_factory.mktemp("coverage"))


@pytest.mark.parametrize("at_s", [None, 2.0])
def test_levels_at_vehicles_are_those_of_the_run(folder: Path, at_s: float | None) -> None:
    found = coverage.coverage(folder, "car3", at_s=at_s, resolution_m=20.0)
    for name, (level, _) in found.others.items():
        sent_ns = round((at_s or 0.0) * 1e9)
        (row,) = [row for row in rows(folder, "car3", name) if row["sent_ns"] == sent_ns]
        assert level == pytest.approx(row["rssi_dbm"] - row["fading_db"], abs=1e-9)


def test_a_map_has_a_value_for_each_place(folder: Path) -> None:
    found = coverage.coverage(folder.parent / "rooms.toml", "car1", resolution_m=5.0, set={"radio.fading.kind": "none"})
    assert found.level_dbm.shape == found.success.shape == (len(found.y), len(found.x))
    assert np.allclose(np.diff(found.x), 5.0)
    assert found.x[0] < 0.0 < 200.0 < found.x[-1]
    column, row = np.searchsorted(found.x, 0.0), np.searchsorted(found.y, 0.0)
    assert (found.x[column], found.y[row]) == (0.0, 0.0)
    assert np.unravel_index(np.argmax(found.level_dbm), found.level_dbm.shape) == (row, column)  # where it stands
    assert np.array_equal(found.level_dbm >= -82.0, found.success > 0.5)


def test_in_an_empty_world_the_map_reaches_as_far_as_the_radio(folder: Path) -> None:
    found = coverage.coverage("formation-circle", "car1", resolution_m=10.0)
    for axis in (found.x, found.y):
        assert -110.0 <= axis[0] <= -85.0  # range 85.6 m
        assert 85.0 <= axis[-1] <= 110.0


def test_the_picture_has_units_equal_scales_and_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    found = coverage.coverage(folder, "car1", resolution_m=8.0)
    figure = coverage_plot.coverage(found)
    labels = [axes.get_ylabel() + axes.get_xlabel() for axes in figure.axes]
    assert any("[dBm]" in label for label in labels)
    assert any("[%]" in label for label in labels)
    maps = figure.axes[:2]
    assert all(axes.get_aspect() == 1.0 for axes in maps)
    assert any("[m]" in axes.get_ylabel() for axes in maps)
    for name in ("a.png", "b.png"):
        plots.save_png(coverage_plot.coverage(found), tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_a_map_from_the_command_line(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = vcmvsp("radio", str(folder), "--coverage", "car1", "--resolution", "5")
    assert (code, err) == (0, "")
    assert "coverage-car1.png" in out
    assert (tmp_path / "coverage-car1.png").read_bytes().startswith(b"\x89PNG")
    code, out, _ = vcmvsp("radio", str(folder), "--coverage", "car1", "--resolution", "5", "--size", "200", "--json")
    answer = json.loads(out)
    assert (code, answer["size_bytes"]) == (0, 200)
    assert len(answer["level_dbm"]) == len(answer["y_m"])
    assert len(answer["level_dbm"][0]) == len(answer["x_m"])
