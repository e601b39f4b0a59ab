"""Curves of radio models: positions from a file, packet errors by SNR, levels by distance, coverage; rejected input."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vcmvsp.cosim.assembly import radio
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError, UsageError
from vcmvsp.cosim.types import Message, Vec3
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.evaluation.coverage import among, coverage, floor_dbm, range_m
from vcmvsp.netsim.evaluation.files import read_positions
from vcmvsp.netsim.evaluation.model_curves import error_rate, grid, mean_levels, packet_errors
from vcmvsp.netsim.interfaces.layers import Floats, Radio
from vcmvsp.netsim.phy.constant_rate import ConstantRate
from vcmvsp.netsim.phy.dsss import Dsss, DsssErrors
from vcmvsp.netsim.phy.ieee802154 import Ieee802154, OqpskErrors
from vcmvsp.netsim.phy.ofdm import Ofdm, OfdmErrors
from vcmvsp.netsim.propagation.path_loss import LogDistance
from vcmvsp.physics.world.solids import Box

pytestmark = pytest.mark.slow

# --- positions --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("head", ["", "x,y,z\n", "X_m, y_m ,z_m\r\n", "\ufeff", "\n\nx,y,z\n"])
def test_positions_come_with_or_without_a_header(head: str, tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text(head + "1,2,3\n\n -4.5 ,1e3,0\n", "utf-8", newline="")
    assert read_positions(tmp_path / "p.csv").at(0).tolist() == [[1.0, 2.0, 3.0], [-4.5, 1000.0, 0.0]]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "has no positions"),
        ("x,y,z\n", "has no positions"),
        ("1,2,3\n4,5\n", "line 2: must have 3 columns (x,y,z), not 2: 4,5"),
        ("1,2\n", "line 1: must have 3 columns"),
        ("1,2,3,4\n", "line 1: must have 3 columns"),
        ("x,y\n1,2\n", "line 1: the columns must be x,y,z, not x,y"),
        ("y,x,z\n1,2,3\n", "line 1: the columns must be x,y,z, not y,x,z"),
        ("x,y,z\n1,2,3\n1,two,3\n", "line 3, column y: must be a number, not 'two'"),
        ("1,2,\n", "line 1, column z: must be a number, not ''"),
        ("1,2,3\nx,y,z\n", "line 2, column x: must be a number, not 'x'"),
        ("1,2,nan\n", "line 1, column z: must be finite, not nan"),
        ("-inf,2,3\n", "line 1, column x: must be finite, not -inf"),
        ("nan,nan,nan\n", "line 1, column x: must be finite"),
        ("1,2e9,3\n", "line 1, column y: must be from -1e"),
        ("t,name,x,y,z\n", "has no positions"),
        ("t,who,x,y,z\n0,a,1,2,3\n", "line 1: the columns must be t,name,x,y,z, not t,who,x,y,z"),
        ("0,a,1,2,3\n0.5,a,1,2\n", "line 2: must have 5 columns (t,name,x,y,z), not 4: 0.5,a,1,2"),
        ("0,a,1,2,3\nsoon,a,1,2,3\n", "line 2, column t: must be a number, not 'soon'"),
        ("0,a,1,2,inf\n", "line 1, column z: must be finite"),
        ("0,a,1,2,3\n1e10,a,1,2,3\n", "line 2, column t: must be from -1e+09 to 1e+09 s"),
        ("0,a b,1,2,3\n", "line 1, column name"),
        ("1,a,1,2,3\n0,b,1,2,3\n1,a,4,5,6\n", "line 3: the times of a must increase, and 1 s is not after the one before"),
    ],
)
def test_an_invalid_position_is_named(text: str, problem: str, tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises((UsageError, ScenarioError)) as error:
        read_positions(tmp_path / "p.csv")
    assert str(error.value).startswith(str(tmp_path / "p.csv"))
    assert problem in str(error.value)


def test_a_file_of_positions_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    for name, problem in (("none.csv", "there is no such file"), (".", "cannot be read"), ("binary", "is not a CSV file")):
        with pytest.raises(UsageError, match=problem):
            read_positions(tmp_path / name)


# --- curves -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0:1:0.25", [0.0, 0.25, 0.5, 0.75, 1.0]),
        ("0:0.3:0.1", [0.0, 0.1, 0.2, 0.3]),
        ("-1:0.9:0.5", [-1.0, -0.5, 0.0, 0.5]),
        ("3:1:-1", [3.0, 2.0, 1.0]),
        ("5:5:1", [5.0]),
        ("0:0.9999999999:0.5", [0.0, 0.5, 1.0]),  # within 1e-9 steps
        ("0:0.999999:0.5", [0.0, 0.5]),
        (" 1e1 : 2e1 : 5 ", [10.0, 15.0, 20.0]),
    ],
)
def test_a_range_holds_its_end_where_that_is_a_step(text: str, expected: list[float]) -> None:
    assert grid(text, "--snr").tolist() == expected


def test_a_range_has_a_million_points_at_most() -> None:
    assert len(grid("1:1000000:1", "--snr")) == 1_000_000
    with pytest.raises(UsageError, match=r"1e\+06 points are too many \(at most 1000000\)"):
        grid("0:1000000:1", "--snr")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("1:2", "write START:STOP:STEP"),
        ("1:2:3:4", "write START:STOP:STEP"),
        ("a:2:1", "write START:STOP:STEP"),
        ("", "write START:STOP:STEP"),
        ("0:1:0", "STEP must not be 0"),
        ("0:1:-1", "do not lead from 0 to 1"),
        ("1:0:0.5", "do not lead from 1 to 0"),
        ("0:nan:1", "must be finite"),
        ("0:inf:1", "must be finite"),
        ("0:1e999:1", "must be finite"),
        ("0:1:1e-9", "at most 1000000"),
        ("0:1e300:1e-300", "at most 1000000"),
    ],
)
def test_a_range_that_is_none_is_refused(text: str, problem: str) -> None:
    with pytest.raises(UsageError, match=f"^--snr {text}: .*{problem}"):
        grid(text, "--snr")


@pytest.mark.parametrize(
    ("phy", "model", "name", "expected"),
    [
        (Ofdm(rate_bps=6e6), "default", "table", OfdmErrors(6e6, "2.4GHz", "table")),
        (Ofdm(rate_bps=54e6, band="5GHz", error_model="yans"), "default", "yans", OfdmErrors(54e6, "5GHz", "yans")),
        (Ofdm(rate_bps=54e6), "nist", "nist", OfdmErrors(54e6, "2.4GHz", "nist")),
        *((Dsss(rate_bps=11e6), model, model, DsssErrors(11e6)) for model in ("dsss", "table", "yans", "nist")),
        (Dsss(), "default", "dsss", DsssErrors(1e6)),
        (Ieee802154(), "default", "oqpsk", OqpskErrors()),
        (Ieee802154(), "oqpsk", "oqpsk", OqpskErrors()),
    ],
)
def test_packet_errors_equal_the_model(phy: Any, model: str, name: str, expected: Any) -> None:
    errors, called = error_rate(phy, model)
    assert (errors, called) == (expected, name)
    snr_db = np.arange(-12.0, 25.0, 0.37)
    curves = packet_errors(errors, snr_db, 200)
    assert curves["snr_db"] == snr_db.tolist()
    assert curves["success"] == pytest.approx(expected.frame_success(snr_db, 200), rel=1e-12)
    assert np.array(curves["per"]) + curves["success"] == pytest.approx(np.ones(len(snr_db)), abs=1e-15)
    header, bits = expected.header
    assert np.array(curves["payload_success"]) * header.success(snr_db, bits) == pytest.approx(
        np.array(curves["success"]), rel=1e-9
    )
    assert np.all(np.diff(curves["success"]) >= 0.0)


def test_packet_errors_keep_their_digits_where_hardly_any_is_lost() -> None:
    """1 - success would be 0 or 1.1e-16 here."""
    per = packet_errors(DsssErrors(1e6), np.array([3.0]), 100)["per"][0]
    assert 0.0 < per < 1e-15


def test_a_model_that_a_phy_does_not_have_is_refused() -> None:
    with pytest.raises(UsageError, match=r"--model nist: .* allows default, oqpsk"):
        error_rate(Ieee802154(), "nist")
    with pytest.raises(UsageError, match=r"--model oqpsk: .* allows default, table, yans, nist"):
        error_rate(Ofdm(), "oqpsk")
    with pytest.raises(UsageError, match="ConstantRate has no packet-error model"):
        error_rate(ConstantRate(), "default")


def test_levels_by_distance_follow_the_law() -> None:
    """Log-distance by its closed form; thermal noise in 20 MHz with 7 dB is -93.965 dBm."""
    distance_m = np.array([0.5, 1.0, 10.0, 85.6])
    levels = mean_levels(LogDistance(exponent=2.5, reference_loss_db=40.0), Dsss(tx_power_dbm=20.0), distance_m)
    loss_db = 40.0 + 25.0 * np.log10([1.0, 1.0, 10.0, 85.6])
    assert levels["distance_m"] == distance_m.tolist()
    assert levels["path_loss_db"] == pytest.approx(loss_db)
    assert levels["rssi_dbm"] == pytest.approx(20.0 - loss_db)
    assert levels["snr_db"] == pytest.approx(20.0 - loss_db + 93.965, abs=1e-3)


BOXES = (
    Box(center=(10.0, 0.0, 1.25), size=(0.11, 16.0, 2.5), material="brick"),
    Box(center=(20.0, 2.0, 1.25), size=(0.2, 20.0, 2.5), yaw_rad=0.4, material="concrete"),
    Box(center=(30.0, 8.0, 0.2), size=(2.0, 2.0, 0.4), material="wood"),
)
SHADOWED: dict[str, Any] = {"shadowing": {"sigma_db": 4.0}}
SEED = 5


def make(preset: str = "wifi-b-1", radios: Mapping[str, Radio] | None = None, **layers: dict[str, Any]) -> Channel:
    """A channel among the boxes, without contention."""
    tables = {"preset": preset, "mac": {"kind": "ideal"}, **layers}
    channel: Channel = radio.build(tables, Source("test", Path()), solids=BOXES, radios=radios)[0]
    channel.start(SEED)
    return channel


def with_receivers(car: Vec3, antennas: Floats) -> dict[str, Vec3]:
    """A car, and vehicles at these antennas, without radios of their own."""
    return {"car": car, **{f"r{k}": tuple(place) for k, place in enumerate(antennas.tolist())}}


def reported(channel: Channel, sender: str, places: Mapping[str, Vec3], frames: int = 1) -> tuple[Floats, Floats]:
    """Mean level and share of receptions of each transmission, (n,) each."""
    names, position = tuple(places), np.array(list(places.values()))
    levels, received = [], []
    for k in range(frames):
        (report,) = channel.send(k * 10_000_000, Message(sender=sender, body={}, size_bytes=100), names, position)
        levels.append(report.rssi_dbm - (0.0 if report.fading_db is None else report.fading_db))
        received.append(report.received_ns >= 0)
    return np.mean(levels, axis=0), np.mean(received, axis=0)


def test_the_level_equals_the_channels_report_to_a_receiver_there() -> None:
    rng = np.random.default_rng(1)
    antennas = np.column_stack([rng.uniform(-40.0, 60.0, (40, 2)), np.full(40, 0.5)])
    car: Vec3 = (1.0, -2.0, 0.0)
    radios = {"car": Radio(tx_power_dbm=20.0, antenna_gain_dbi=3.0, antenna_height_m=0.8)}
    found = coverage(make(radios=radios, **SHADOWED), "car", np.array(car), antennas, seed=SEED)
    level, received = reported(make(radios=radios, **SHADOWED), "car", with_receivers(car, antennas))
    np.testing.assert_allclose(found.level_dbm, level, atol=1e-9)
    sure = (found.success < 1e-12) | (found.success > 1.0 - 1e-12)
    assert sure.sum() > 30
    assert np.array_equal(found.success[sure] > 0.5, received[sure] > 0.5)


def test_vehicles_count_with_their_own_radios() -> None:
    places = {"a": (0.0, 0.0, 0.0), "b": (40.0, 1.0, 0.0), "c": (90.0, 0.0, 0.0)}
    radios = {"a": Radio(), "b": Radio(antenna_gain_dbi=2.0), "c": Radio(sensitivity_dbm=-89.0, antenna_height_m=2.0)}
    found = among(make(radios=radios), "a", places, seed=SEED)
    level, received = reported(make(radios=radios), "a", places)
    np.testing.assert_allclose(found.level_dbm, level, atol=1e-9)
    assert np.array_equal(found.success > 0.5, received > 0.5)


@pytest.mark.parametrize(
    "fading",
    [
        {"kind": "rayleigh"},
        {"kind": "nakagami", "m": 1.5},
        {"kind": "rician", "k_factor": 4.0},
        {"kind": "rayleigh", "doppler_hz": 40.0},
    ],
    ids=["rayleigh", "nakagami", "rician", "doppler"],
)
def test_the_chance_of_success_is_the_share_of_many_frames(fading: dict[str, Any]) -> None:
    layers = {"fading": fading, "walls": {"kind": "none"}, "phy": {"rate_bps": 54e6, "preamble_snr_db": 0.0}}
    antennas = np.array([(d, 0.0, 0.0) for d in (10.0, 30.0, 45.0, 60.0, 80.0, 100.0)])
    found = coverage(make("wifi-g-54", **layers), "car", np.zeros(3), antennas, seed=SEED)
    frames = 1500
    _, received = reported(make("wifi-g-54", **layers), "car", with_receivers((0.0, 0.0, 0.0), antennas), frames)
    noise = 4.5 * np.sqrt(0.25 / frames) * (3.0 if "doppler_hz" in fading else 1.0)  # equal in the same process
    assert np.ptp(found.success) > 0.5
    np.testing.assert_allclose(found.success, received, atol=noise + 2.0 / 233)


def test_rayleigh_fading_over_a_threshold_in_closed_form() -> None:
    # P(level + g >= sensitivity) = exp(-10^((sensitivity - level) / 10)), g exponential with mean 1.
    phy = {"kind": "constant_rate", "tx_power_dbm": 16.0206, "sensitivity_dbm": -82.0}
    antennas = np.array([(d, 0.0, 0.0) for d in np.geomspace(1.0, 500.0, 200)])
    found = coverage(make(phy=phy, fading={"kind": "rayleigh"}), "car", np.zeros(3), antennas)
    np.testing.assert_allclose(found.success, np.exp(-(10.0 ** ((-82.0 - found.level_dbm) / 10.0))), atol=1.0 / 233)


def test_a_place_is_independent_of_other_places() -> None:
    channel = make(**SHADOWED, fading={"kind": "rayleigh"})
    antennas = np.random.default_rng(3).uniform(-50.0, 50.0, (5000, 3))
    everywhere = coverage(channel, "car", np.zeros(3), antennas, seed=SEED)
    alone = coverage(channel, "car", np.zeros(3), antennas[4999:], seed=SEED)
    assert (everywhere.level_dbm[-1], everywhere.success[-1]) == (alone.level_dbm[0], alone.success[0])
    assert coverage(channel, "car", np.zeros(3), np.empty((0, 3))).level_dbm.shape == (0,)


def test_asking_changes_nothing_for_a_channel_that_is_in_use() -> None:
    layers: dict[str, Any] = {**SHADOWED, "fading": {"kind": "rayleigh"}}
    places = {"a": (0.0, 0.0, 0.0), "b": (40.0, 1.0, 0.0)}
    channel, other = make(**layers), make(**layers)
    for _ in range(3):
        coverage(channel, "a", np.ones(3), np.ones((4, 3)), seed=77)
        assert reported(channel, "a", places)[0] == reported(other, "a", places)[0]


def test_range_of_the_log_distance_law() -> None:
    # d0 10^((P - L0 - sensitivity) / (10 N)), 85.6 m for the preset.
    assert range_m(make(), "car", 0.0) == pytest.approx(10.0 ** ((16.0206 - 40.052 + 82.0) / 30.0), rel=0.012)
    assert range_m(make("wss"), "car", 0.0) is None  # 43 km
    assert range_m(make("ideal"), "car", 0.0) is None
    assert range_m(make(phy={"tx_power_dbm": -90.0}), "car", 0.0) == 0.0


def test_the_weakest_level_is_the_sensitivity_or_the_preambles_need() -> None:
    noise_dbm = 10.0 * math.log10(1.380649e-23 * 290.0 * 20e6) + 30.0 + 7.0
    assert floor_dbm(make()) == -82.0
    assert floor_dbm(make(phy={"sensitivity_dbm": -100.0})) == pytest.approx(noise_dbm + 4.0, abs=1e-9)
