"""Positions from a file, packet errors by SNR, levels by distance: what is right, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vcmvsp.cosim.errors import UsageError
from vcmvsp.netsim.evaluation.files import read_positions
from vcmvsp.netsim.evaluation.model_curves import error_rate, grid, mean_levels, packet_errors
from vcmvsp.netsim.phy.constant_rate import ConstantRate
from vcmvsp.netsim.phy.dsss import Dsss, DsssErrors
from vcmvsp.netsim.phy.ieee802154 import Ieee802154, OqpskErrors
from vcmvsp.netsim.phy.ofdm import Ofdm, OfdmErrors
from vcmvsp.netsim.propagation.path_loss import LogDistance

# --- positions --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("head", ["", "x,y,z\n", "X_m, y_m ,z_m\r\n", "\ufeff", "\n\nx,y,z\n"])
def test_positions_come_with_or_without_a_header(head: str, tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text(head + "1,2,3\n\n -4.5 ,1e3,0\n", "utf-8", newline="")
    assert read_positions(tmp_path / "p.csv").tolist() == [[1.0, 2.0, 3.0], [-4.5, 1000.0, 0.0]]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "has no positions"),
        ("x,y,z\n", "has no positions"),
        ("1,2,3\n4,5\n", "line 2: must have 3 columns, x,y,z, not 2: 4,5"),
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
    ],
)
def test_what_is_no_position_is_named(text: str, problem: str, tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(UsageError) as error:
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
    ("text", "wanted"),
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
def test_a_range_holds_its_end_where_that_is_a_step(text: str, wanted: list[float]) -> None:
    assert grid(text, "--snr").tolist() == wanted


def test_a_range_has_a_million_points_at_most() -> None:
    assert len(grid("1:1000000:1", "--snr")) == 1_000_000
    with pytest.raises(UsageError, match=r"1e\+06 points; at most 1000000"):
        grid("0:1000000:1", "--snr")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("1:2", "write START:STOP:STEP"),
        ("1:2:3:4", "write START:STOP:STEP"),
        ("a:2:1", "write START:STOP:STEP"),
        ("", "write START:STOP:STEP"),
        ("0:1:0", "STEP must not be 0"),
        ("0:1:-1", "nothing gets from 0 to 1"),
        ("1:0:0.5", "nothing gets from 1 to 0"),
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
    ("phy", "model", "name", "wanted"),
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
def test_packet_errors_are_those_of_the_model(phy: Any, model: str, name: str, wanted: Any) -> None:
    errors, called = error_rate(phy, model)
    assert (errors, called) == (wanted, name)
    snr_db = np.arange(-12.0, 25.0, 0.37)
    curves = packet_errors(errors, snr_db, 200)
    assert curves["snr_db"] == snr_db.tolist()
    assert curves["success"] == pytest.approx(wanted.frame_success(snr_db, 200), rel=1e-12)
    assert np.array(curves["per"]) + curves["success"] == pytest.approx(np.ones(len(snr_db)), abs=1e-15)
    header, bits = wanted.header
    assert np.array(curves["payload_success"]) * header.success(snr_db, bits) == pytest.approx(
        np.array(curves["success"]), rel=1e-9
    )
    assert np.all(np.diff(curves["success"]) >= 0.0)


def test_packet_errors_keep_their_digits_where_hardly_any_is_lost() -> None:
    """1 - success would be 0 or 1.1e-16 here."""
    per = packet_errors(DsssErrors(1e6), np.array([3.0]), 100)["per"][0]
    assert 0.0 < per < 1e-15


def test_a_model_that_a_phy_does_not_have_is_refused() -> None:
    with pytest.raises(UsageError, match=r"--model nist: .* one of default, oqpsk"):
        error_rate(Ieee802154(), "nist")
    with pytest.raises(UsageError, match=r"--model oqpsk: .* one of default, table, yans, nist"):
        error_rate(Ofdm(), "oqpsk")
    with pytest.raises(UsageError, match="ConstantRate has no packet errors"):
        error_rate(ConstantRate(), "default")


def test_levels_by_distance_follow_the_law() -> None:
    """Log-distance by its closed form; thermal noise in 20 MHz with 7 dB is -93.965 dBm."""
    distance_m = np.array([0.5, 1.0, 10.0, 85.6])
    levels = mean_levels(LogDistance(exponent=2.5, reference_loss_db=40.0), Dsss(tx_power_dbm=20.0), distance_m)
    wanted = 40.0 + 25.0 * np.log10([1.0, 1.0, 10.0, 85.6])
    assert levels["distance_m"] == distance_m.tolist()
    assert levels["path_loss_db"] == pytest.approx(wanted)
    assert levels["rssi_dbm"] == pytest.approx(20.0 - wanted)
    assert levels["snr_db"] == pytest.approx(20.0 - wanted + 93.965, abs=1e-3)
