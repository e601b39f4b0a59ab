"""From a log to a table: reading, refusing, sampling, writing."""

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.netsim.links import Line, even_uniforms, linked_frame
from tests.support.netsim.measured_links import BOXES, mean_of, points, tour
from vcmvsp.cosim.cli.radio import write_calibration
from vcmvsp.cosim.config.binding import call
from vcmvsp.cosim.errors import UsageError
from vcmvsp.netsim.calibration.fit import calibrate_file, figure_data
from vcmvsp.netsim.calibration.measurements import MeasuredLinks, read_links, sample
from vcmvsp.netsim.calibration.result import Calibration, ParameterEstimate
from vcmvsp.netsim.propagation.fading import Nakagami
from vcmvsp.netsim.propagation.path_loss import LogDistance
from vcmvsp.netsim.propagation.shadowing import Shadowing
from vcmvsp.netsim.propagation.walls import FixedWalls
from vcmvsp.physics.line_of_sight import Sightline


def test_a_long_log_is_sampled_evenly_and_in_neighbours() -> None:
    way = tour(20_000)
    base = np.zeros_like(way)
    log = MeasuredLinks(np.zeros(20_000), base, way, np.zeros(20_000))
    rows = sample(log, 400)
    assert 300 < len(rows) <= 400
    assert np.diff(rows).max() <= 2 * 20_000 / 200
    assert np.median(np.diff(rows)[::2]) < 10
    assert sample(log, 400).tolist() == rows.tolist()


def calibrated(**changes: Any) -> Calibration:
    known: dict[str, Any] = {
        "level_dbm": ParameterEstimate.of_mean(-42.0, 1.0, 1.0),
        "exponent": ParameterEstimate.of_mean(2.7, 0.1, 0.1),
        "walls_db": {"brick": ParameterEstimate.of_mean(5.0, 1.0, 1.0), "glass": ParameterEstimate.of_mean(-0.5, 1.0, 1.0)},
        "shadowing_db": ParameterEstimate.positive(4.0, 0.1),
        "correlation_distance_m": ParameterEstimate.positive(8.0, 0.1),
        "fading_db": ParameterEstimate.positive(5.57, 0.1),
        "tx_power_dbm": 16.0,
        "reference_distance_m": 2.0,
        "sensitivity_dbm": -90.0,
        "rows": 10,
        "used": 10,
        "lost": 1,
        "spacing_m": 3.0,
        "log_likelihood": -1.0,
        "aic": {"independent": 1.0},
        "model": "independent",
        "unexplained": 0,
    }
    return Calibration(**{**known, **changes})


def test_the_table_builds_layers_with_the_mean_and_spread_that_were_found() -> None:
    """Fading of 5.57 dB is Rayleigh's, which is 2.51 dB below its mean power on average (Euler's constant x 10 / ln 10)."""
    found = calibrated()
    table = tomllib.loads(found.toml())["radio"]
    assert table == found.table()
    kinds = {name: each.pop("kind", None) for name, each in table.items()}
    assert kinds == {"path_loss": "log_distance", "shadowing": "gudmundson", "walls": "fixed", "fading": "nakagami"}
    path_loss, fading = call(LogDistance, table["path_loss"]), call(Nakagami, table["fading"])
    call(Shadowing, table["shadowing"])
    call(FixedWalls, table["walls"], given={"sightline": Sightline(BOXES)})
    assert table["walls"]["materials_db"] == {"brick": 5.0, "glass": 0.0}
    assert fading.m == pytest.approx(1.0, abs=0.002)

    uniforms = even_uniforms(20_000)
    gain = fading.gain_db(linked_frame("a", *["b"] * 20_000), lambda: uniforms)
    assert gain.std() == pytest.approx(5.57, rel=0.01)
    for distance, level in ((2.0, -42.0), (20.0, -69.0)):
        loss = path_loss.loss_db(Line.between(np.zeros(3), np.array([(distance, 0.0, 0.0)])))
        assert 16.0 - loss[0] + gain.mean() == pytest.approx(level, abs=0.05)


def test_what_was_not_found_is_not_in_the_table() -> None:
    bare = calibrated(walls_db={}, fading_db=None, shadowing_db=None, correlation_distance_m=None)
    assert list(bare.table()) == ["path_loss"]
    assert bare.table()["path_loss"]["reference_loss_db"] == pytest.approx(58.0)
    independent = calibrated(correlation_distance_m=None)
    assert independent.table()["shadowing"]["correlation_distance_m"] == pytest.approx(1.0)
    with pytest.raises(ValueError, match="levels rise with distance"):
        calibrated(exponent=ParameterEstimate.of_mean(-0.2, 0.1, 0.1)).table()


HEADER = "time,ax,ay,az,bx,by,bz,rssi_dbm"


def write(path: Path, *lines: str, header: str = HEADER) -> Path:
    path = path / "links.csv"
    path.write_text("\n".join([header, *lines]) + "\n", "utf-8")
    return path


def test_a_log_is_read_whatever_the_order_of_columns_and_times(tmp_path: Path) -> None:
    log = read_links(
        write(
            tmp_path,
            " -60.5, 2.0, 0,0,0, 3,0,4, true, car1",
            "",
            "-99, 1.0, 0,0,0, 3,0,0, 0, car1",
            ", 3.0, 0,0,0, 3,0,0, False, car2",
            header="\ufeffrssi_dbm,time,ax,ay,az,bx,by,bz,received,name",
        )
    )
    assert log.time_s.tolist() == [2.0, 1.0, 3.0]
    assert log.distance_m.tolist() == [5.0, 3.0, 3.0]
    assert log.lost.tolist() == [False, True, True]
    assert log.level_dbm[0] == -60.5


@pytest.mark.parametrize(
    ("lines", "header", "message"),
    [
        (["0,0,0,0,1,0,0,-50"], "time,ax,ay,bx,by,bz,rssi_dbm", "no column az; wanted: time, ax, .*; found: time, ax, ay, bx"),
        (["0,0,0,0,1,0,0,-50,1"], HEADER + ",ax", "column ax stands there twice"),
        ([], HEADER, "no rows under the header"),
        (["0,0,0,0,1,0,0,-50", "0,0,nan,0,1,0,0,-50"], HEADER, "line 3: ay is 'nan'; it must be a finite number"),
        (["0,0,0,0,1,0,inf,-50"], HEADER, "line 2: bz is 'inf'; it must be a finite number"),
        (["0,0,0,0,1,0,0,-50", "", "0,0,0,0,1,0,0,weak"], HEADER, "line 4: rssi_dbm is 'weak'; it must be a finite number"),
        (["0,0,0,0,1,0,0"], HEADER, "line 2: has 7 fields; the header has 8"),
        (["0,0,0,0,1,0,0,-50,maybe"], HEADER + ",received", "line 2: received is 'maybe'; it must be 0, 1, true or false"),
        (["0,0,0,0,1,0,0,,1"], HEADER + ",received", "line 2: was received, but has no rssi_dbm"),
        (["0,0,0,0,1,0,0,"], HEADER, "no row was received"),
        (["0,0,0,0,1,0,0,-50", "1,0,0,0,2,0,0,-59"], HEADER, "2 rows were received; 2 numbers need at least 4"),
        ([f"{i},0,0,0,0,{3 * (-1) ** i},0,-5{i}" for i in range(8)], HEADER, "all received rows are at one distance .3 m."),
        ([f"{i},0,0,0,0,0.{i},0,-5{i}" for i in range(8)], HEADER, "nearer than the reference distance: the exponent is not"),
    ],
)
def test_bad_logs_are_refused_by_file_and_line(lines: list[str], header: str, message: str, tmp_path: Path) -> None:
    path = write(tmp_path, *lines, header=header)
    with pytest.raises(UsageError, match=message) as raised:
        calibrate_file(path)
    assert str(raised.value).startswith(str(path))


def test_a_file_that_is_not_there_or_is_no_text(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"none\.csv: there is no such file"):
        read_links(tmp_path / "none.csv")
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00\x80")
    (tmp_path / "long.csv").write_text(f"{HEADER}\n{'1' * 200_000},0,0,0,1,0,0,-50\n")
    for name in ("binary.csv", "long.csv"):
        with pytest.raises(UsageError, match=f"{name}: is not a CSV file in UTF-8"):
            read_links(tmp_path / name)


def test_the_command_writes_a_table_and_a_picture_twice_the_same(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    b = points(rng, 120)
    level = mean_of(np.zeros((120, 3)), b) + rng.normal(0.0, 3.0, 120)
    rows = [f"0,0,0,0,{x},{y},{z},{'' if v < -95 else v}" for (x, y, z), v in zip(b.tolist(), level.tolist(), strict=True)]
    path = write(tmp_path, *rows)
    walls = Sightline(BOXES)
    links, first = calibrate_file(path, sightline=walls)
    again, second = calibrate_file(path, sightline=walls)
    assert second == first
    write_calibration(tmp_path / "one", first, figure_data(links, first, walls))
    write_calibration(tmp_path / "two", second, figure_data(again, second, walls))
    for name in ("radio.toml", "calibration.png"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()
    assert tomllib.loads((tmp_path / "one" / "radio.toml").read_text())["radio"] == first.table()
    text = first.summary()
    for word in ("120 of 120 rows", "path-loss exponent", "wall of concrete", "standard error", "AIC: "):
        assert word in text
