"""Fits to logs of a known radio, their files, and rejected input."""

import math
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.netsim.channels import Line, even_uniforms, linked_frame
from tests.support.netsim.measured_links import BOXES, links, mean_of, normal_score, points, shadows, tour
from tests.support.netsim.ray_worlds import rays_among
from vcmvsp.cosim.cli.radio import write_calibration
from vcmvsp.cosim.config.binding import call
from vcmvsp.cosim.errors import UsageError
from vcmvsp.netsim.calibration.fit import calibrate_file, figure_data, fit, fit_rays
from vcmvsp.netsim.calibration.likelihood import Survey, below, covariance, log_likelihood, restricted
from vcmvsp.netsim.calibration.measurements import MeasuredLinks, read_links, sample
from vcmvsp.netsim.calibration.result import Calibration, ParameterEstimate
from vcmvsp.netsim.propagation.fading import Nakagami
from vcmvsp.netsim.propagation.path_loss import LogDistance
from vcmvsp.netsim.propagation.shadowing import Shadowing
from vcmvsp.netsim.propagation.walls import FixedWalls
from vcmvsp.physics.raycast.line_of_sight import Sightline
from vcmvsp.physics.world.solids import Box

pytestmark = pytest.mark.slow

SEEDS = range(3)


@pytest.mark.parametrize("lost", [0.0, 0.3])
def test_known_truth_comes_back_within_its_standard_errors(lost: float) -> None:
    """Shadowing from the channel's own layer, fading, links all over a place: every estimate, over several worlds.

    Each score is nearly standard normal: none is beyond 4, and the means of 3 stay within 4 / sqrt(3).
    """
    scores = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        a, b = points(rng, 50), points(rng, 50)
        a, b = np.repeat(a, 4, axis=0), np.repeat(b, 4, axis=0) + rng.exponential((1.0, 1.0, 0.0), (200, 3))
        mean = mean_of(a, b)
        level = mean - shadows(a, b, seed, Shadowing(6.0, 10.0)) + rng.normal(0.0, 2.0, 200)
        found = fit(links(a, b, level, float(np.quantile(mean, lost)) if lost else -math.inf))
        assert (found.lost > 0) == (lost > 0.0)
        estimates = found.level_dbm, found.exponent, found.shadowing_db, found.correlation_distance_m, found.fading_db
        scores.append([normal_score(*each) for each in zip(estimates, (-40.0, 3.0, 6.0, 10.0, 2.0), strict=True)])
    assert np.abs(scores).max() < 4.0
    assert np.abs(np.mean(scores, axis=0)).max() < 4.0 / math.sqrt(len(SEEDS))


def test_the_offset_of_rays_comes_back_and_less_is_left_than_of_log_distance() -> None:
    """Levels by rays round a building, 4 dB lower, with 2 dB of scatter, cut off at a sensitivity."""
    rays = rays_among(Box(center=(0.0, 0.0, 5.0), size=(30.0, 30.0, 10.0), material="concrete"), ground="concrete")
    rng = np.random.default_rng(3)
    a, b = (30.0 * np.exp(1j * rng.uniform(0.0, 2.0 * math.pi, 60)) for _ in range(2))
    a, b = (np.column_stack([each.real, each.imag, np.ones(60)]) for each in (a, b))
    level = 16.0 - rays.pair_loss_db(a, b) - 4.0 + rng.normal(0.0, 2.0, 60)
    measured = links(a, b, level, float(np.quantile(level, 0.1)))
    found = fit_rays(measured, rays.pair_loss_db, {"kind": "rays"}, tx_power_dbm=16.0)
    assert abs(found.offset_db.value + 4.0) < 3.0 * found.offset_db.standard_error < 1.5
    assert found.deviation_db == pytest.approx(2.0, abs=0.6)
    assert found.deviation_db < 0.5 * found.log_distance.deviation_db
    assert found.aic < min(found.log_distance.aic.values())
    assert "log-distance" in found.summary()
    table = tomllib.loads(found.toml())["radio"]
    assert table["path_loss"]["offset_db"] == pytest.approx(-found.offset_db.value, abs=1.0)  # fading lowers the mean in dB


def test_without_losses_and_correlation_it_is_ordinary_least_squares() -> None:
    rng = np.random.default_rng(1)
    a, b = points(rng, 200), points(rng, 200)
    level = mean_of(a, b) + rng.normal(0.0, 4.0, 200)
    found = fit(links(a, b, level), reference_distance_m=2.0)
    assert found.model == "independent"

    X = np.column_stack([np.ones(200), -10.0 * np.log10(np.maximum(Line.between(a, b).distance_m, 2.0) / 2.0)])
    beta, (squares,), *_ = np.linalg.lstsq(X, level, rcond=None)
    errors = np.sqrt(np.diagonal(np.linalg.inv(X.T @ X)) * squares / 198)
    assert (found.level_dbm.value, found.exponent.value) == pytest.approx(beta.tolist(), rel=1e-9)
    assert (found.level_dbm.standard_error, found.exponent.standard_error) == pytest.approx(errors.tolist(), rel=1e-4)
    student = 1.972017  # 97.5 % of Student's t with 198 degrees of freedom
    assert found.exponent.high == pytest.approx(beta[1] + student * errors[1], rel=1e-5)
    assert found.shadowing_db is not None
    assert found.shadowing_db.value == pytest.approx(math.sqrt(squares / 198), rel=1e-4)
    assert found.shadowing_db.standard_error == pytest.approx(math.sqrt(squares / 198) / math.sqrt(2 * 198), rel=1e-3)
    likelihood = -0.5 * (200 * math.log(2.0 * math.pi * squares / 198) + 198)
    assert found.log_likelihood == pytest.approx(likelihood, abs=1e-4)
    assert found.aic["independent"] == pytest.approx(2 * 3 - 2 * likelihood, abs=1e-3)


def test_standard_errors_know_that_neighbours_are_alike() -> None:
    """A robot on a tour round its base: ten times the rows on the same way add hardly any information, and standard errors say
    so.
    """
    base = np.tile((-5.0, -5.0, 1.0), (400, 1))
    way = tour(400)
    level = mean_of(base, way) - shadows(base, way, 3, Shadowing(4.0, 10.0))
    level += np.random.default_rng(1).normal(0.0, 1.0, 400)
    every, few = fit(links(base, way, level)), fit(links(base[::10], way[::10], level[::10]))
    assert every.exponent.standard_error > 0.6 * few.exponent.standard_error
    assert every.exponent.naive_error is not None
    assert every.exponent.naive_error < 0.5 * every.exponent.standard_error
    assert abs(normal_score(every.exponent, 3.0)) < 4.0


def test_repeated_measurements_tell_fading_from_shadowing() -> None:
    rng = np.random.default_rng(2)
    a, b = np.repeat(points(rng, 40, 400.0), 8, axis=0), np.repeat(points(rng, 40, 400.0), 8, axis=0)
    place = np.repeat(rng.normal(0.0, 5.0, 40), 8)
    found = fit(links(a, b, mean_of(a, b) + place + rng.normal(0.0, 2.0, 320)))
    assert found.model.endswith("fading")
    assert abs(normal_score(found.fading_db, 2.0)) < 4.0
    assert abs(normal_score(found.shadowing_db, 5.0)) < 4.0
    assert found.fading_db is not None
    assert found.fading_db.standard_error == pytest.approx(2.0 / math.sqrt(2.0 * 280), rel=0.3)  # 280 = 40 places x (8 - 1)


@pytest.mark.parametrize("seed", [1, 2])
def test_losses_of_walls_come_back(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = points(rng, 250), points(rng, 250)
    sightline = Sightline(BOXES)
    walls = FixedWalls(sightline, materials_db={"concrete": 12.0, "plasterboard": 4.0})
    loss = np.concatenate([walls.loss_db(Line.between(a[i], b[i : i + 1])) for i in range(250)])
    log = links(a, b, mean_of(a, b) - loss + rng.normal(0.0, 3.0, 250), -98.0)
    found = fit(log, sightline=sightline)
    assert list(found.walls_db) == ["concrete", "plasterboard"]  # no estimate for wood: no row crosses it
    assert abs(normal_score(found.walls_db["concrete"], 12.0)) < 4.0
    assert abs(normal_score(found.walls_db["plasterboard"], 4.0)) < 4.0
    assert abs(normal_score(found.exponent, 3.0)) < 4.0
    assert found.walls_db["concrete"].standard_error < 1.5
    assert found.aic["without walls"] > found.aic[found.model] + 10.0


def test_losses_that_level_does_not_explain_are_counted() -> None:
    rng = np.random.default_rng(1)
    a, b = points(rng, 150), points(rng, 150)
    level = mean_of(a, b) + rng.normal(0.0, 3.0, 150)
    honest = fit(links(a, b, level, -100.0))
    assert honest.unexplained == 0
    near = np.argsort(Line.between(a, b).distance_m)[:3]
    level[near] = -math.inf
    jammed = fit(links(a, b, level, -100.0), sensitivity_dbm=-100.0)
    assert jammed.unexplained == 3
    assert "3 lost rows have an expected level far above the sensitivity" in jammed.summary()


def test_a_sensitivity_that_received_rows_contradict_is_refused() -> None:
    rng = np.random.default_rng(1)
    a, b = points(rng, 100), points(rng, 100)
    with pytest.raises(UsageError, match=r"sensitivity -60 dBm: 9.% of the received rows are weaker, down to "):
        fit(links(a, b, mean_of(a, b)), sensitivity_dbm=-60.0)


def test_walls_without_receptions_are_named() -> None:
    rng = np.random.default_rng(1)
    a, b = points(rng, 60), points(rng, 60)
    sightline = Sightline(BOXES[:1])
    behind = np.array([sightline.crossings(a[i], b[i : i + 1])[0][0, 0] for i in range(60)])
    level = np.where(behind, np.nan, mean_of(a, b) + rng.normal(0.0, 3.0, 60))
    with pytest.raises(UsageError, match="the loss of walls of concrete is not identifiable"):
        fit(MeasuredLinks(np.arange(60.0), a, b, level), sightline=sightline)
    through = np.flatnonzero(behind)
    with pytest.raises(UsageError, match="cannot be separated"):
        fit(MeasuredLinks(np.arange(60.0), a, b, mean_of(a, b)).only(through), sightline=sightline)


@pytest.mark.parametrize(("correlation", "error"), [(0.0, 1e-12), (0.5, 0.002), (0.9, 0.031), (0.99, 0.085), (-0.4, 0.0005)])
def test_the_probability_of_two_values_below_their_mean_is_the_closed_form(correlation: float, error: float) -> None:
    """``1/4 + asin(rho) / (2 pi)`` (W. Sheppard, 1899)."""
    matrix = 9.0 * np.array([[1.0, correlation], [correlation, 1.0]])
    exact = math.log(0.25 + math.asin(correlation) / (2.0 * math.pi))
    assert below(np.full(2, -90.0), matrix, -90.0).log_probability == pytest.approx(exact, abs=error)


def test_independent_values_below_a_bound_are_exact() -> None:
    mean, sigma = np.array([-200.0, -95.0, -90.0, -85.0, 60.0]), np.array([1.0, 3.0, 4.0, 2.0, 1.0])
    z = [(-90.0 - m) / s for m, s in zip(mean, sigma, strict=True)]
    exact = sum(math.log(0.5 * math.erfc(-each / math.sqrt(2.0))) for each in z[:4])
    exact += -0.5 * 150.0**2 - math.log(150.0 * math.sqrt(2.0 * math.pi)) - 1.0 / 150.0**2  # asymptotic, 150 sigma away
    assert below(mean, np.diag(sigma**2), -90.0).log_probability == pytest.approx(exact, rel=1e-8)


@pytest.mark.parametrize("parameters", [(3.0,), (3.0, 2.0), (3.0, 2.5, -1.0)])
def test_gradient_is_that_of_the_likelihood(parameters: Sequence[float]) -> None:
    rng = np.random.default_rng(6)
    a, b = points(rng, 60, 30.0), points(rng, 60, 30.0)
    level = mean_of(a, b) + rng.normal(0.0, 4.0, 60)
    at = np.array(parameters)
    X = np.column_stack([np.ones(60), mean_of(a, b, 0.0, 1.0)])
    survey = Survey.between(a, b, level_dbm=level, lost=level < -78.0, sensitivity_dbm=-78.0, design=X)
    for k, slope in enumerate(restricted(survey, at).gradient.tolist()):
        step = 1e-4 * np.eye(len(at))[k]
        difference = restricted(survey, at + step).log_likelihood - restricted(survey, at - step).log_likelihood
        assert slope == pytest.approx(difference / 2e-4, rel=1e-3, abs=1e-3)


def test_without_losses_the_likelihood_is_the_normal_density() -> None:
    rng = np.random.default_rng(8)
    a, b = points(rng, 30, 30.0), points(rng, 30, 30.0)
    at, X = np.array([3.0, 2.0, -1.0]), np.ones((30, 1))
    survey = Survey.between(a, b, level_dbm=mean_of(a, b), lost=np.zeros(30, bool), sensitivity_dbm=0.0, design=X)
    matrix, deviation = covariance(survey, at)[0], mean_of(a, b) + 80.0
    squares = deviation @ np.linalg.inv(matrix) @ deviation
    exact = -0.5 * (np.linalg.slogdet(matrix)[1] + squares + 30 * math.log(2.0 * math.pi))
    assert log_likelihood(survey, at, np.array([-80.0])) == pytest.approx(exact, rel=1e-9)


def test_covariance_is_that_of_the_shadowing_layer() -> None:
    """Over 800 worlds, 4 links that share ends or are one link both ways."""
    a = np.array([(0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (8.0, 1.0, 0.0), (40.0, 0.0, 0.0)]) + 1000.0
    b = np.array([(8.0, 0.0, 0.0), (8.0, 0.0, 2.0), (0.0, 0.0, 0.0), (45.0, 0.0, 0.0)]) + 1000.0
    layer = Shadowing(1.0, 10.0, 32)
    worlds = np.array([shadows(a, b, seed, layer) for seed in range(800)])
    survey = Survey.between(a, b, level_dbm=np.zeros(4), lost=np.zeros(4, bool), sensitivity_dbm=0.0, design=np.ones((4, 1)))
    expected, _ = covariance(survey, np.array([0.0, math.log(10.0)]))
    np.testing.assert_allclose(np.cov(worlds.T), expected, atol=4.0 * math.sqrt(2.0 / 800))


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
    call(FixedWalls, table["walls"], arguments={"sightline": Sightline(BOXES)})
    assert table["walls"]["materials_db"] == {"brick": 5.0, "glass": 0.0}
    assert fading.m == pytest.approx(1.0, abs=0.002)

    uniforms = even_uniforms(20_000)
    gain = fading.gain_db(linked_frame("a", *["b"] * 20_000), lambda: uniforms)
    assert gain.std() == pytest.approx(5.57, rel=0.01)
    for distance, level in ((2.0, -42.0), (20.0, -69.0)):
        loss = path_loss.loss_db(Line.between(np.zeros(3), np.array([(distance, 0.0, 0.0)])))
        assert 16.0 - loss[0] + gain.mean() == pytest.approx(level, abs=0.05)


def test_parameters_without_an_estimate_are_not_in_the_table() -> None:
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
        (["0,0,0,0,1,0,0,-50"], "time,ax,ay,bx,by,bz,rssi_dbm", "no column az; required: time, ax, .*; found: time, ax, ay"),
        (["0,0,0,0,1,0,0,-50,1"], HEADER + ",ax", "column ax appears twice"),
        ([], HEADER, "no rows below the header"),
        (["0,0,0,0,1,0,0,-50", "0,0,nan,0,1,0,0,-50"], HEADER, "line 3: ay is 'nan'; it must be a finite number"),
        (["0,0,0,0,1,0,inf,-50"], HEADER, "line 2: bz is 'inf'; it must be a finite number"),
        (["0,0,0,0,1,0,0,-50", "", "0,0,0,0,1,0,0,weak"], HEADER, "line 4: rssi_dbm is 'weak'; it must be a finite number"),
        (["0,0,0,0,1,0,0"], HEADER, "line 2: has 7 fields; the header has 8"),
        (["0,0,0,0,1,0,0,-50,maybe"], HEADER + ",received", "line 2: received is 'maybe'; it must be 0, 1, true or false"),
        (["0,0,0,0,1,0,0,,1"], HEADER + ",received", "line 2: received = 1, but rssi_dbm is missing"),
        (["0,0,0,0,1,0,0,"], HEADER, "no row has a received level"),
        (["0,0,0,0,1,0,0,-50", "1,0,0,0,2,0,0,-59"], HEADER, "2 received rows; 2 parameters need at least 4"),
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
