"""``vcmvsp radio --coverage``: maps agree with recorded runs."""

import json
import math
import shutil
from pathlib import Path

import msgspec
import numpy as np
import pytest

from tests.support.cosim.command_line import vcmvsp_command
from tests.support.cosim.walled_run import rows, run_rooms
from vcmvsp.cosim.analysis import coverage
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.plots import radio_plots, style

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run shared by all tests, unchanged."""
    return run_rooms(tmp_path_factory.mktemp("coverage"))


@pytest.mark.parametrize("at_s", [None, 2.0])
def test_levels_at_vehicles_agree_with_the_run(folder: Path, at_s: float | None) -> None:
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
    assert np.unravel_index(np.argmax(found.level_dbm), found.level_dbm.shape) == (row, column)  # the vehicle's position
    assert np.array_equal(found.level_dbm >= -82.0, found.success > 0.5)


def test_in_an_empty_world_the_map_reaches_as_far_as_the_radio(folder: Path) -> None:
    found = coverage.coverage("formation-circle", "car1", resolution_m=10.0)
    for axis in (found.x, found.y):
        assert -110.0 <= axis[0] <= -85.0  # range 85.6 m
        assert 85.0 <= axis[-1] <= 110.0


@pytest.mark.parametrize("height_m", [40.0, 200.0])
def test_the_title_of_a_map_fits_its_width(folder: Path, height_m: float) -> None:
    found = coverage.coverage(folder, "car1", resolution_m=8.0)
    figure = radio_plots.coverage(msgspec.structs.replace(found, y=np.linspace(0.0, height_m, len(found.y))))
    figure.draw_without_rendering()
    (title,) = [text for text in figure.texts if "coverage of car1" in text.get_text()]
    assert figure.bbox.x0 <= title.get_window_extent().x0 < title.get_window_extent().x1 <= figure.bbox.x1


@pytest.mark.parametrize("resolution_m", [100.0, 125.0, 250.0])
def test_a_coarse_map_has_all_vehicles_on_it_too(folder: Path, resolution_m: float) -> None:
    found = coverage.coverage(folder, "car1", resolution_m=resolution_m)
    for axis, values in ((0, found.x), (1, found.y)):
        assert values[0] <= min(place[axis] for place in found.places.values())
        assert max(place[axis] for place in found.places.values()) <= values[-1]


@pytest.mark.parametrize("resolution_m", [0.0, -1.0, math.inf, math.nan])
def test_a_resolution_is_a_positive_number(folder: Path, resolution_m: float) -> None:
    with pytest.raises(UsageError, match="must be a positive number"):
        coverage.coverage(folder, "car1", resolution_m=resolution_m)


@pytest.mark.parametrize("at_s", [-1.0, 1e9, math.nan])
def test_a_time_outside_the_run_is_refused(folder: Path, at_s: float) -> None:
    with pytest.raises(UsageError, match="lasted from 0 to"):
        coverage.coverage(folder, "car1", at_s=at_s, resolution_m=20.0)


def test_a_damaged_run_needs_only_its_states(folder: Path, tmp_path: Path) -> None:
    run = shutil.copytree(folder, tmp_path / "run")
    (run / "metrics.json").write_text("{")
    assert coverage.coverage(run, "car1", at_s=1.0, resolution_m=50.0).places.keys() >= {"car1", "car2"}
    whole = (folder / "states.parquet").read_bytes()
    for left in (whole[:-20], whole[:1000] + bytes(2000) + whole[3000:]):
        (run / "states.parquet").write_bytes(left)
        with pytest.raises(UsageError, match="cannot be read"):
            coverage.coverage(run, "car1", at_s=1.0, resolution_m=50.0)


def test_the_picture_has_units_equal_scales_and_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    found = coverage.coverage(folder, "car1", resolution_m=8.0)
    figure = radio_plots.coverage(found)
    labels = [axes.get_ylabel() + axes.get_xlabel() for axes in figure.axes]
    assert any("[dBm]" in label for label in labels)
    assert any("[%]" in label for label in labels)
    maps = figure.axes[:2]
    assert all(axes.get_aspect() == 1.0 for axes in maps)
    assert any("[m]" in axes.get_ylabel() for axes in maps)
    for name in ("a.png", "b.png"):
        style.save_png(radio_plots.coverage(found), tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_a_map_from_the_command_line(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = vcmvsp_command("radio", str(folder), "--coverage", "car1", "--resolution", "5")
    assert (code, err) == (0, "")
    assert "coverage-car1.png" in out
    assert (tmp_path / "coverage-car1.png").read_bytes().startswith(b"\x89PNG")
    code, out, _ = vcmvsp_command("radio", str(folder), "--coverage", "car1", "--resolution", "5", "--size", "200", "--json")
    answer = json.loads(out)
    assert (code, answer["size_bytes"]) == (0, 200)
    assert len(answer["level_dbm"]) == len(answer["y_m"])
    assert len(answer["level_dbm"][0]) == len(answer["x_m"])
