"""``vcmvsp radio``: reports of a run add up and agree with its recording."""

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.support.cosim.command_line import vcmvsp_command
from tests.support.cosim.walled_run import ROOMS, rows, run_rooms
from vcmvsp.cosim.analysis import link_budget, link_text
from vcmvsp.cosim.analysis import links as explain
from vcmvsp.cosim.analysis.link_budget import why
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.runs import api

pytestmark = pytest.mark.slow

LINKS = [(a, b) for a in ("car1", "car2", "car3", "car4") for b in ("car1", "car2", "car3", "car4") if a != b]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run shared by all tests, unchanged."""
    return run_rooms(tmp_path_factory.mktemp("explain"))


@pytest.fixture
def log(folder: Path) -> explain.Log:
    """The frames of the run."""
    return explain.Log(folder)


# --- links ------------------------------------------------------------------------------------------------------------------


def test_every_frame_is_received_lost_or_under_way(log: explain.Log, folder: Path) -> None:
    found = explain.overview(log)
    assert {(row["sender"], row["receiver"]) for row in found} == set(LINKS)
    for row in found:
        lost = sum(loss["frames"] for loss in row["losses"].values())
        assert row["received"] + lost + row["under_way"] == row["frames"] == len(rows(folder, row["sender"], row["receiver"]))
    ratios = [row["delivery_ratio"] for row in found]
    assert ratios == sorted(ratios)  # worst first
    assert sum(row["under_way"] for row in found) > 0  # delays are 0.15 s: some frames are under way at the end

    total = json.loads((folder / "metrics.json").read_text())["radio"]
    assert sum(row["received"] for row in found) == total["receptions"]
    counts: dict[str, int] = {}
    for row in found:
        for cause, loss in row["losses"].items():
            counts[cause] = counts.get(cause, 0) + loss["frames"]
    assert counts == total["losses"]
    assert {"walls", "fading", "random loss", "below sensitivity"} <= set(counts)


@pytest.mark.parametrize("pair", [("car1", "car2"), ("car2", "car3"), ("car4", "car1")])
def test_numbers_of_a_link_follow_from_its_rows(log: explain.Log, folder: Path, pair: tuple[str, str]) -> None:
    found, frames = explain.link_report(log, pair), rows(folder, *pair)
    end_ns = log.facts.end_ns
    arrived = [row["received_ns"] for row in frames if row["received_ns"] is not None and row["received_ns"] <= end_ns]
    assert found["rssi_dbm"]["median"] == pytest.approx(float(np.median([row["rssi_dbm"] for row in frames])))
    assert found["distance_m"]["min"] == min(row["distance_m"] for row in frames)
    assert found["shadowing_db"]["mean"] == pytest.approx(float(np.mean([row["shadowing_db"] for row in frames])))
    assert found["fading_db"]["sd"] == pytest.approx(float(np.std([row["fading_db"] for row in frames])))
    assert found["walls"]["loss_db"] == pytest.approx(float(np.mean([row["wall_loss_db"] for row in frames])))
    assert sum(found["walls"]["materials"].values()) == pytest.approx(1.0)
    assert sum(loss["share"] for loss in found["losses"].values()) == pytest.approx(1.0 - found["delivery_ratio"])
    gap = found["receptions"]["longest_gap_s"]
    if len(arrived) > 1:
        gaps = np.diff(sorted(arrived)) / 1e9
        assert gap == pytest.approx(gaps.max())
        assert found["delay_s"]["median"] == pytest.approx(0.15, abs=1e-9)
    else:
        assert gap is None
        assert found["delay_s"]["median"] is None


def test_walls_are_named_by_material(log: explain.Log) -> None:
    assert explain.link_report(log, ("car1", "car2"))["walls"]["materials"] == {"1 brick": 1.0}
    assert explain.link_report(log, ("car2", "car3"))["walls"]["materials"] == {"1 concrete": 1.0}
    assert set(explain.link_report(log, ("car1", "car3"))["walls"]["materials"]) == {"1 brick, 1 concrete"}


def test_an_expression_names_links(log: explain.Log) -> None:
    assert log.pairs("car2/*") == [("car2", "car1"), ("car2", "car3"), ("car2", "car4")]
    assert log.pairs("*/car1") == [("car2", "car1"), ("car3", "car1"), ("car4", "car1")]
    assert log.pairs() == LINKS


# --- the budget of a frame --------------------------------------------------------------------------------------------------


def test_budgets_add_up(log: explain.Log, folder: Path) -> None:
    power = {"car3": 20.0}
    gain = {"car3": 2.0}
    for pair in LINKS:
        for row in rows(folder, *pair)[::7]:
            budget = link_budget.frame_report(log, pair, str(row["frame"]))["budget"]
            assert budget["power_dbm"] == power.get(pair[0], 16.0206)  # the scenario's own; no remainder
            assert (budget["tx_gain_dbi"], budget["rx_gain_dbi"]) == (gain.get(pair[0], 0.0), gain.get(pair[1], 0.0))
            items = ("power_dbm", "tx_gain_dbi", "rx_gain_dbi", "path_loss_db", "walls_db", "shadowing_db", "fading_db")
            assert sum(budget[item] for item in items) == pytest.approx(row["rssi_dbm"], abs=1e-9)
            assert budget["changes_db"] == pytest.approx(0.0, abs=1e-9)
            assert budget["noise_dbm"] == pytest.approx(-93.965, abs=1e-3)
            assert budget["interference_dbm"] is None
            assert budget["floor_dbm"] == (-85.0 if pair[1] == "car4" else -82.0)
            assert budget["margin_db"] == row["rssi_dbm"] - budget["floor_dbm"]


def test_without_its_scenario_a_run_still_has_budgets(folder: Path, tmp_path: Path) -> None:
    for name in ("radio.parquet", "states.parquet"):
        shutil.copy(folder / name, tmp_path)
    report = link_budget.frame_report(explain.Log(tmp_path), ("car3", "car2"), "worst")
    assert report["budget"]["power_dbm"] == pytest.approx(22.0, abs=1e-9)  # includes both antenna gains
    assert report["budget"]["floor_dbm"] is None
    link_text.frame_text(report)


def test_a_loss_is_explained_by_its_cause(log: explain.Log, folder: Path) -> None:
    """Every text contains the level without the one item that caused the loss; it is above the threshold."""
    outcomes = set()
    for pair in LINKS:
        for row in rows(folder, *pair)[::3]:
            report = link_budget.frame_report(log, pair, str(row["frame"]))
            budget, explanation = report["budget"], report["why"]
            outcomes.add(report["outcome"])
            assert explanation.startswith((f"lost: {report['outcome']}: ", "received ", "under way"))
            if report["outcome"] in ("walls", "shadowing", "fading"):
                assert budget["margin_db"] < 0.0
                assert f"({-budget[report['outcome'] + '_db']:.1f} dB)" in explanation
                assert explanation.endswith("above the sensitivity")
            if report["outcome"] == "below sensitivity":
                assert explanation.endswith("below the sensitivity")
    assert {"received", "under way", "walls", "fading", "random loss", "below sensitivity"} <= outcomes


@pytest.mark.parametrize(
    ("outcome", "words"),
    [
        ("collision", "interference reduced its SNR of 20.0 dB to a SINR of 3.0 dB"),
        ("jammed", "interference reduced its SNR of 20.0 dB to a SINR of 3.0 dB"),
        ("packet error", "bit errors at a SINR of 3.0 dB, which 25.0 % of such frames survive"),
        ("receiver transmitting", "the receiver was transmitting; the level was -74.0 dBm, 8.0 dB above the sensitivity"),
        ("outage", "the operator had cut off its sender or receiver; the level was -74.0 dBm, 8.0 dB above the sensitivity"),
        ("traced loss", "lost behind the radio, which received it at -74.0 dBm, 8.0 dB above the sensitivity"),
    ],
)
def test_other_losses_in_words(log: explain.Log, outcome: str, words: str) -> None:
    report = link_budget.frame_report(log, ("car1", "car2"), "worst")
    budget = report["budget"] | {"rssi_dbm": -74.0, "snr_db": 20.0, "sinr_db": 3.0, "margin_db": 8.0}
    assert why({**report, "budget": budget, "outcome": outcome, "survival": 0.25}) == f"lost: {outcome}: {words}"
    never = why({**report, "outcome": "queue full", "air_time_s": 0.0, "queue_s": 0.5})
    assert never == "lost: queue full: it waited 500.000 ms and was not sent"


def test_interference_follows_from_snr_and_sinr(log: explain.Log) -> None:
    # SNR - SINR is 3.0103 dB if interference is as strong as noise.
    frames = log.frames(("car1", "car2"))
    log.column("sinr_db")[frames._rows[0]] -= 10.0 * math.log10(2.0)
    report = link_budget.frame_report(log, ("car1", "car2"), str(frames["frame"][0]))
    assert report["budget"]["interference_dbm"] == pytest.approx(report["budget"]["noise_dbm"], abs=1e-9)


def test_the_loss_of_a_script_is_in_the_budget(tmp_path: Path) -> None:
    script = {"script": {"changes": [{"from_s": 0.0, "attenuation_db": 12.5}]}}
    (tmp_path / "s.toml").write_text(ROOMS)
    api.run(tmp_path / "s.toml", set={f"radio.{key}": value for key, value in script.items()}, out=tmp_path / "run")
    report = link_budget.frame_report(explain.Log(tmp_path / "run"), ("car1", "car2"), "worst")
    assert report["budget"]["changes_db"] == pytest.approx(-12.5, abs=1e-9)
    assert "script or trace" in link_text.frame_text(report)


def test_worst_and_lost_frames(log: explain.Log, folder: Path) -> None:
    frames = rows(folder, "car1", "car2")
    worst = min(frames, key=lambda row: row["sinr_db"])["frame"]
    lost = next(row["frame"] for row in frames if row["received_ns"] is None)
    assert link_budget.frame_report(log, ("car1", "car2"), "worst")["frame"] == worst
    assert link_budget.frame_report(log, ("car1", "car2"), "lost")["frame"] == lost


# --- the command ------------------------------------------------------------------------------------------------------------


def test_without_a_sinr_no_frame_is_the_worst(folder: Path, tmp_path: Path) -> None:
    shutil.copy(folder / "states.parquet", tmp_path)
    table = pq.read_table(folder / "radio.parquet")
    unknown = pa.nulls(table.num_rows, pa.float64())
    pq.write_table(table.set_column(table.schema.get_field_index("sinr_db"), "sinr_db", unknown), tmp_path / "radio.parquet")
    with pytest.raises(UsageError, match="--frame worst: no frame on car1/car2 has a SINR"):
        link_budget.frame_report(explain.Log(tmp_path), ("car1", "car2"), "worst")
    pq.write_table(table.drop_columns(["snr_db"]), tmp_path / "radio.parquet")
    with pytest.raises(UsageError, match="has no snr_db"):
        explain.Log(tmp_path)


def test_text_and_json_of_a_run(folder: Path) -> None:
    code, out, err = vcmvsp_command("radio", str(folder))
    assert (code, err) == (0, "")
    assert "car1/car2" in out
    for arguments, links in (([], 12), (["--link", "car1/*"], 3), (["--link", "car?/car1"], 3), (["--link", "car1/car2"], 1)):
        code, out, err = vcmvsp_command("radio", str(folder), *arguments, "--json")
        assert (code, err) == (0, "")
        assert len(json.loads(out)["links"]) == links
        assert vcmvsp_command("radio", str(folder), *arguments)[0] == 0
    code, out, _ = vcmvsp_command("radio", str(folder), "--link", "car1/car3", "--frame", "lost")
    assert (code, "brick" in out, "sensitivity" in out) == (0, True, True)
    _, out, _ = vcmvsp_command("radio", str(folder), "--link", "car1/car3", "--frame", "lost", "--json")
    assert json.loads(out)["frame"]["why"].startswith("lost: ")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--link", "car9/car2"], "unknown vehicle 'car9'; did you mean"),
        (["--link", "car1"], "must be SENDER/RECEIVER"),
        (["--link", "car1/car1"], "no link to itself"),
        (["--link", "car1/car2", "--frame", "99999"], "no such frame"),
        (["--link", "car1/car2", "--frame", "1"], "sent it to car1, car3, car4"),
        (["--link", "car1/car2", "--frame", "best"], "must be a frame's number"),
        (["--link", "car1/*", "--frame", "0"], "needs one link"),
        (["--frame", "0"], "needs one link"),
        (["--resolution", "5"], "needs --coverage"),
        (["--coverage", "car9"], "unknown vehicle 'car9'"),
        (["--coverage", "car1", "--frame", "1"], "one or the other"),
        (["--coverage", "car1", "--resolution", "0"], "must be a positive number"),
        (["--coverage", "car1", "--resolution", "1e-4"], "at most"),
        (["--coverage", "car1", "--height", "nan"], "must be a finite number"),
        (["--coverage", "car1", "--at", "99"], "lasted from 0 to 4 s"),
        (["--coverage", "car1", "--set", "radio.path_loss.exponent=-1"], "radio.path_loss.exponent"),
        (["--coverage", "car1", "--resolution", "9", "--out", "/no/such/folder/map.png"], "No such file"),
    ],
)
def test_wrong_arguments_are_named(folder: Path, arguments: list[str], words: str) -> None:
    code, out, err = vcmvsp_command("radio", str(folder), *arguments)
    assert (code, out) == (2, "")
    assert words in err


def test_folders_without_a_run(folder: Path, tmp_path: Path) -> None:
    assert "not the folder of a run" in vcmvsp_command("radio", "formation-circle").err
    assert "no states.parquet here" in vcmvsp_command("radio", str(tmp_path)).err
    assert "no scenario.toml here" in vcmvsp_command("radio", str(tmp_path), "--coverage", "car1").err
    assert "a time needs a recorded run" in vcmvsp_command("radio", "formation-circle", "--coverage", "car1", "--at", "1").err
    for damage in (slice(-20, None), slice(1000, 3000)):
        for name in ("radio.parquet", "states.parquet"):
            content = bytearray((folder / name).read_bytes())
            content[damage] = bytes(len(content[damage]))
            (tmp_path / name).write_bytes(content)
        with pytest.raises(UsageError, match="cannot be read"):
            explain.Log(tmp_path)


def test_a_single_vehicle_has_no_links(tmp_path: Path) -> None:
    run = api.run("pillar-single", set={"duration_s": 0.2}, agents="inprocess", out=tmp_path / "run")
    assert run.folder is not None
    outcome = vcmvsp_command("radio", str(run.folder))
    assert (outcome.code, outcome.out) == (2, "")
    assert "has no links" in outcome.err
    assert "--link" not in outcome.err
