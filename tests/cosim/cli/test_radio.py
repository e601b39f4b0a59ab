"""Channel commands without a run: output, written files, and refusals."""

import itertools
import json
import math
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

import vcmvsp
from tests.support.cosim.command_line import answer_of, assert_refused, vcmvsp_command
from vcmvsp.cosim.recording.recorded_run import tables_of
from vcmvsp.cosim.runs.replay import replay
from vcmvsp.cosim.tables.schema import RADIO_SCHEMA
from vcmvsp.netsim.channel.channel import Channel

TRIAL = ("channel", "--positions", "p.csv", "--rate", "10", "--size", "100", "--duration", "1")


@pytest.fixture(autouse=True)
def folder(here: Path) -> Path:
    """Current folder of each test, with positions."""
    (here / "p.csv").write_text("x,y,z\n0,0,0\n10,0,0\n0,20,0\n400,0,0\n")
    return here


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def sets(*settings: str) -> list[str]:
    return [argument for setting in settings for argument in ("--set", setting)]


def columns(*arguments: str) -> dict[str, Any]:
    """Columns printed by ``per`` or ``pathloss``."""
    return json.loads(answer_of(*arguments, "--json"))


def channel(preset: str, *arguments: str) -> dict[str, Any]:
    """The counts of a trial."""
    return columns(*TRIAL, "--quiet", "--preset", preset, *arguments)


def test_a_trial_counts_frames_and_receptions() -> None:
    """Three vehicles are in range of each other; the fourth, 400 m away, of none."""
    counts = channel("wifi-b-1", *sets("mac.kind=ideal"))
    assert list(counts) == ["frames", "receptions", "delivery_ratio", "delay_s", "losses", "cpu_s"]
    assert (counts["frames"], counts["receptions"], counts["losses"]) == (40, 60, {"below sensitivity": 60})
    assert counts["delivery_ratio"] == 0.5
    assert counts["delay_s"] == {name: pytest.approx(1280e-6) for name in ("mean", "p50", "p95", "p99")}  # time on the air
    assert counts["cpu_s"] > 0.0


def test_a_trial_in_words() -> None:
    out = answer_of(*TRIAL, "--quiet", "--preset", "wifi-b-1", *sets("mac.kind=ideal"))
    assert "wifi-b-1: 40 frames of 4 vehicles\n" in out
    assert "50.00 % of frame x receiver (60 below sensitivity)\n" in out
    assert "mean 1.28, p50 1.28, p95 1.28, p99 1.28 ms\n" in out


@pytest.mark.parametrize("preset", ["ideal", "wss", "wifi-b-1", "wifi-g-6", "wifi-a-54", "zigbee"])
def test_every_preset_adds_up_and_repeats_with_the_same_bytes(preset: str, folder: Path) -> None:
    first, second = (channel(preset, "--seed", "5", "--out", name) for name in ("a.parquet", "b.parquet"))
    del first["cpu_s"], second["cpu_s"]
    assert first == second
    assert first["receptions"] + sum(first["losses"].values()) == 40 * 3
    assert (folder / "a.parquet").read_bytes() == (folder / "b.parquet").read_bytes()
    rows = pq.read_table(folder / "a.parquet")
    assert rows.schema.equals(RADIO_SCHEMA)
    assert rows.num_rows == 40 * 3
    assert rows["outcome"].to_pylist().count("received") == first["receptions"]
    assert set(rows["sender"].to_pylist()) == {"v0", "v1", "v2", "v3"}
    assert files(folder) == ["a.parquet", "b.parquet", "p.csv"]


def test_periodic_broadcasts_are_the_default(folder: Path) -> None:
    plain = channel("wifi-g-6", "--out", "a.parquet")
    assert {**channel("wifi-g-6", "--traffic", "periodic", "--out", "b.parquet"), "cpu_s": 0} == {**plain, "cpu_s": 0}
    assert (folder / "a.parquet").read_bytes() == (folder / "b.parquet").read_bytes()


@pytest.mark.parametrize("traffic", ["jitter", "poisson", "saturated"])
def test_frames_of_vehicles_on_paths_to_one_of_them(traffic: str, folder: Path) -> None:
    (folder / "p.csv").write_text("t,name,x,y,z\n0,base,0,0,1\n0,car,0,0,1\n1,car,30,0,1\n")
    counts = channel("wifi-g-6", "--traffic", traffic, "--to", "base", "--out", "rows.parquet")
    rows = pq.read_table(folder / "rows.parquet")
    assert set(rows["sender"].to_pylist()) == {"car"}
    assert set(rows["receiver"].to_pylist()) == {"base"}
    assert rows.num_rows == counts["frames"] == counts["receptions"] > 0
    assert np.allclose(rows["distance_m"], 30.0 * np.array(rows["sent_ns"]) / 1e9)


def test_a_saturated_vehicle_needs_no_rate() -> None:
    arguments = [each for each in TRIAL if each not in ("--rate", "10")]
    assert columns(*arguments, "--quiet", "--preset", "wifi-g-6", "--traffic", "saturated")["frames"] > 0
    assert_refused(vcmvsp_command(*arguments, "--preset", "wifi-g-6"), "--traffic periodic needs --rate HZ")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--to", "v7"], ["--to", "'v7'", "v0, v1"]),
        (["--jitter", "0.2"], ["--jitter needs --traffic jitter"]),
        (["--traffic", "jitter", "--jitter", "1.5"], ["--jitter", "1.5"]),
    ],
)
def test_invalid_traffic_is_refused(arguments: list[str], words: list[str]) -> None:
    assert_refused(vcmvsp_command(*TRIAL, "--preset", "ideal", *arguments), *words)


def test_antennas_are_at_the_positions_of_the_file(folder: Path) -> None:
    (folder / "p.csv").write_text("0,0,1\n3,4,13\n")
    channel("ideal", "--out", "rows.parquet")
    assert set(pq.read_table(folder / "rows.parquet")["distance_m"].to_pylist()) == {13.0}


def test_layers_are_set_in_any_order() -> None:
    several = ["fading.kind=nakagami", "fading.m=1", "mac.kind=ideal", "path_loss.exponent=2"]
    found = [channel("wifi-b-1", *sets(*order)) for order in (several, several[::-1])]
    assert [counts.pop("cpu_s") > 0.0 for counts in found] == [True, True]
    assert found[0] == found[1]
    assert set(found[0]["losses"]) <= {"below sensitivity", "fading", "packet error"}


def test_parameters_unknown_to_another_kind_are_dropped(folder: Path) -> None:
    channel("wifi-b-1", "--out", "rows.parquet", *sets("path_loss.kind=friis", "mac.kind=ideal"))
    rows = pq.read_table(folder / "rows.parquet")
    expected = 20.0 * np.log10(4.0 * np.pi * np.array(rows["distance_m"].to_pylist()) * 2.4e9 / 299_792_458.0)
    assert rows["path_loss_db"].to_pylist() == pytest.approx(expected)


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("path_loss.exponent=-1", ("path_loss.exponent", ">= 0")),
        ("path_loss.exponent=nan", ("path_loss.exponent", "finite")),
        ("path_loss.exponent=inf", ("path_loss.exponent", "finite")),
        ("path_loss.exponent=two", ("path_loss.exponent", "a number")),
        ("path_loss.exponent.x=2", ("path_loss.exponent",)),
        ("path_loss.exponet=2", ("path_loss.exponet", "did you mean 'exponent'")),
        ("path_loss.kind=foo", ("path_loss.kind", "log_distance")),
        ("path_loss=2", ("path_loss: ", "LAYER.KEY=VALUE")),
        ("pathloss.exponent=2", ("'pathloss'", "did you mean 'path_loss'")),
        ("radio.path_loss.exponent=2", ("'radio'", "path_loss")),
        ("preset=ideal", ("'preset'",)),
        ("fading.m=1", ("fading.m",)),  # a parameter, but there is no fading layer
        ("phy.rate_bps=3", ("phy.rate_bps", "5.5e6")),
        ("phy.kind=constant_rate", ("mac.kind", "dcf")),
        ("mac.kind=csma154", ("mac.kind", "ieee802154")),
        ("path_loss.exponent", ("KEY=VALUE",)),
        ("=2", ("KEY=VALUE",)),
    ],
)
def test_an_invalid_setting_is_named(setting: str, words: tuple[str, ...]) -> None:
    assert_refused(vcmvsp_command(*TRIAL, "--preset", "wifi-b-1", "--set", setting), f"--set {setting}: ", *words)


def test_a_value_and_a_table_of_the_same_name_are_told_apart() -> None:
    settings = sets("path_loss.exponent=2", "path_loss.exponent.x=2")
    assert_refused(
        vcmvsp_command(*TRIAL, "--preset", "wifi-b-1", *settings), "--set path_loss.exponent.x=2", "is a value, not a table"
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--preset", "wifi"), ("--preset wifi", "zigbee")),
        (("--rate", "0"), ("--rate: must be a number >=",)),
        (("--rate", "-1"), ("--rate: ",)),
        (("--rate", "nan"), ("--rate: must be finite",)),
        (("--size", "0"), ("--size: ",)),
        (("--duration", "0"), ("--duration: ",)),
        (("--duration", "inf"), ("--duration: must be finite",)),
        (("--seed", "-1"), ("--seed: ",)),
        (("--positions", "none.csv"), ("none.csv: there is no such file",)),
        (("--out", "no/rows.parquet"), ("no/rows.parquet", "does not exist")),
        (("--out", "."), ("is a folder",)),
    ],
)
def test_an_invalid_option_is_named(arguments: tuple[str, ...], words: tuple[str, ...], folder: Path) -> None:
    assert_refused(vcmvsp_command(*TRIAL, "--preset", "ideal", *arguments), *words)
    assert files(folder) == ["p.csv"]


def test_wrong_positions_are_named_with_line_and_column(folder: Path) -> None:
    (folder / "p.csv").write_text("x,y,z\n0,0,0\n1,a,0\n")
    assert_refused(vcmvsp_command(*TRIAL, "--preset", "ideal"), "p.csv line 3, column y: must be a number, not 'a'")


def test_an_interrupted_trial_leaves_no_file(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    send, calls = Channel.send, itertools.count()

    def interrupted(self: Any, *arguments: Any) -> Any:
        if next(calls) == 20:
            raise KeyboardInterrupt
        return send(self, *arguments)

    monkeypatch.setattr(Channel, "send", interrupted)
    outcome = vcmvsp_command(*TRIAL, "--preset", "ideal", "--out", "rows.parquet")
    assert (outcome.code, outcome.out, outcome.err) == (130, "", "vcmvsp: interrupted\n")
    assert files(folder) == ["p.csv"]


def test_a_long_trial_reports_its_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vcmvsp.cosim.terminal.progress.LOG_EVERY_S", 0.0)
    outcome = vcmvsp_command(*TRIAL, "--preset", "ideal", "--json")
    assert " of 1 s simulated" in outcome.err
    assert json.loads(outcome.out)["frames"] == 40
    assert vcmvsp_command(*TRIAL, "--preset", "ideal", "--json", "--quiet").err == ""


def test_packet_errors_by_snr() -> None:
    """802.11b at 1 Mbit/s, x = SNR: pb = exp(-22 x) / 2; header of 48 bits, then 8 (100 + 36) bits."""
    found = columns("per", "--preset", "wifi-b-1", "--snr", "-6:-4:0.5", "--size", "100")
    assert list(found) == ["preset", "model", "size_bytes", "snr_db", "success", "per", "payload_success"]
    assert (found["preset"], found["model"], found["size_bytes"]) == ("wifi-b-1", "dsss", 100)
    assert found["snr_db"] == [-6.0, -5.5, -5.0, -4.5, -4.0]
    bit = 1.0 - 0.5 * np.exp(-22.0 * 10.0 ** (np.array(found["snr_db"]) / 10.0))
    assert found["payload_success"] == pytest.approx(bit**1088, abs=1e-5)
    assert found["success"] == pytest.approx(bit**1136, abs=1e-5)
    assert found["per"] == pytest.approx(1.0 - bit**1136, abs=1e-5)


def test_the_model_of_packet_errors_can_be_chosen() -> None:
    found = {
        m: columns("per", "--preset", "wifi-g-6", "--model", m, "--snr=1:1:1", "--size", "128") for m in ("default", "nist")
    }
    assert [each["model"] for each in found.values()] == ["table", "nist"]
    assert found["default"]["success"][0] > 0.9 > 0.1 > found["nist"]["success"][0]  # they differ by more than 3 dB


def test_packet_errors_as_a_table() -> None:
    outcome = vcmvsp_command("per", "--preset", "zigbee", "--snr", "0:2:1", "--size", "20")
    head, names, *rows = outcome.out.splitlines()
    assert (outcome.code, head) == (0, "# preset zigbee, model oqpsk, size_bytes 20")
    assert names.split() == ["snr_db", "success", "per", "payload_success"]
    assert [row.split()[0] for row in rows] == ["0", "1", "2"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--preset", "ideal", "--snr", "0:1:1"), ("no packet-error model",)),
        (("--preset", "zigbee", "--snr", "0:1:1", "--model", "nist"), ("--model nist", "oqpsk")),
        (("--preset", "none", "--snr", "0:1:1"), ("--preset none",)),
        (("--preset", "wifi-b-1", "--snr", "0:1"), ("--snr 0:1: write START:STOP:STEP",)),
        (("--preset", "wifi-b-1", "--snr", "0:1:0"), ("--snr 0:1:0: STEP",)),
        (("--preset", "wifi-b-1", "--snr", "0:1:1", "--size", "-1"), ("--size: ",)),
    ],
)
def test_packet_errors_with_invalid_options(arguments: tuple[str, ...], words: tuple[str, ...]) -> None:
    assert_refused(vcmvsp_command("per", "--size", "100", *arguments), *words)


def test_levels_by_distance() -> None:
    found = columns("pathloss", "--preset", "wifi-b-1", *sets("path_loss.exponent=2"), "--distance", "10:1000:495")
    assert list(found) == ["preset", "distance_m", "path_loss_db", "rssi_dbm", "snr_db"]
    assert found["distance_m"] == [10.0, 505.0, 1000.0]
    loss_db = 40.052 + 20.0 * np.log10(found["distance_m"])
    assert found["path_loss_db"] == pytest.approx(loss_db)
    assert found["rssi_dbm"] == pytest.approx(16.0206 - loss_db)
    assert found["snr_db"] == pytest.approx(16.0206 - loss_db + 93.965, abs=1e-3)


def test_levels_are_means_by_the_path_loss_alone() -> None:
    alone = columns("pathloss", "--preset", "wifi-b-1", "--distance", "1:50:7")
    settings = sets("shadowing.sigma_db=8", "fading.kind=rayleigh", "loss.probability=0.5")
    assert columns("pathloss", "--preset", "wifi-b-1", "--distance", "1:50:7", *settings) == alone


def test_antennas_over_ground_have_the_height_of_the_law() -> None:
    """Beyond the crossover: 40 log10 d - 20 log10 (h h)."""
    settings = sets("path_loss.kind=two_ray_ground", "path_loss.antenna_height_m=1.5")
    found = columns("pathloss", "--preset", "wifi-b-1", "--distance", "500:500:1", *settings)
    assert found["path_loss_db"] == pytest.approx([40.0 * np.log10(500.0) - 40.0 * np.log10(1.5)])


def test_no_distance_is_negative() -> None:
    assert_refused(vcmvsp_command("pathloss", "--preset", "wss", "--distance", "-1:1:1"), "--distance -1:1:1", "negative")
    assert_refused(vcmvsp_command("pathloss", "--preset", "wss", "--distance", "1:5"), "--distance 1:5", "START:STOP:STEP")


CORNER = """
name = "corner"
duration_s = 1.0
[world]
kind = "boxes"
boxes = [{ center = [10.0, 10.0, 5.0], size = [10.0, 10.0, 10.0], material = "concrete" }]
[radio]
preset = "wifi-g-6"
path_loss = { kind = "rays" }
[[vehicle]]
name = "car1"
kind = "p2dx"
agent = { kind = "trajectory", path = "straight" }
"""


PATHS = ("radio", "corner.toml", "--paths", "points.csv")


@pytest.fixture
def corner(here: Path) -> Path:
    """The current folder, with a scenario and points."""
    (here / "corner.toml").write_text(CORNER)
    (here / "points.csv").write_text("x,y,z\n0,0,1\n20,4,1\n2,22,1\n")
    return here


def test_rays_are_fitted_to_a_measured_log(corner: Path) -> None:
    """Levels 3 dB below free space, over open ground: the offset is 3 dB, and the written table is one of [radio]."""
    header, rows = "time,ax,ay,az,bx,by,bz,rssi_dbm", list[str]()
    for number in range(12):
        distance = 2.0 + number
        level = -20.0 * math.log10(4.0 * math.pi * distance * 2.4e9 / 299792458.0) - 3.0
        rows.append(f"{number},0,-20,{5 + number},{distance},-20,{5 + number},{level + 0.1 * (-1) ** number}")
    (corner / "links.csv").write_text("\n".join([header, *rows]))
    (corner / "open.toml").write_text(CORNER.replace('kind = "rays"', 'kind = "rays", ground = "none"'))
    fit = ("calibrate", "links.csv", "--rays")
    outcome = vcmvsp_command(*fit, "--world", "open.toml", "--out", "fit")
    assert outcome.code == 0, outcome.err
    assert "offset from the rays" in outcome.out
    table = tomllib.loads((corner / "fit" / "radio.toml").read_text("utf-8"))["radio"]["path_loss"]
    assert table["kind"] == "rays"
    assert table["offset_db"] == pytest.approx(3.0, abs=0.3)
    assert not (corner / "fit" / "calibration.png").exists()
    assert_refused(vcmvsp_command(*fit), "--rays needs the scenario", "--world SCENARIO")
    (corner / "plain.toml").write_text(CORNER.replace('kind = "rays"', 'kind = "friis"'))
    assert_refused(vcmvsp_command(*fit, "--world", "plain.toml"), "path_loss.kind", "--rays needs path_loss.kind = 'rays'")


SECOND = """
[[vehicle]]
name = "car2"
kind = "p2dx"
pose = [-3.0, 4.0, 0.0]
agent = { kind = "leader_follower", leader = "car1", slot = [-2.0, 2.0] }
"""


def test_delays_of_paths_are_recorded_and_replayed(corner: Path) -> None:
    (corner / "two.toml").write_text(CORNER + SECOND)
    run = vcmvsp.run(corner / "two.toml", out=corner / "run", set={"radio.delay.propagation": True})
    again = replay(corner / "run", radio="recorded", out=corner / "again")
    rows = run.radio.to_pylist()
    assert all(row["path_delay_ns"] == pytest.approx(row["distance_m"] / 0.299792458) for row in rows)
    assert all(row["delay_spread_ns"] > 0.0 for row in rows)
    assert all(row["delay_ns"] == row["access_ns"] + row["air_time_ns"] + round(row["path_delay_ns"]) for row in rows)
    assert run.metrics["digest"] == again.metrics["digest"]
    assert tables_of(corner / "run").radio.equals(pq.read_table(corner / "run" / "radio.parquet"))
    (corner / "run" / "radio.parquet").unlink()
    assert tables_of(corner / "run").radio.column("path_delay_ns").to_pylist() == [row["path_delay_ns"] for row in rows]


def test_antennas_that_drive_into_a_solid_are_counted_at_the_end(corner: Path) -> None:
    """A vehicle without a body drives east through the building's west face."""
    into = CORNER.replace("duration_s = 1.0", 'duration_s = 3.0\nphysics = { kind = "kinematic" }')
    into = into.replace("agent = {", "pose = [4.5, 8.0, 0.0]\nagent = {") + SECOND
    lines: list[str] = []
    (corner / "into.toml").write_text(into)
    vcmvsp.run(corner / "into.toml", out=corner / "into", tell=lines.append)
    (line,) = [each for each in lines if "inside a solid" in each]
    assert line.startswith("radio.path_loss: 1 antennas were inside a solid, reached over the roofs only: car1 in the box at")


def test_paths_of_rays_between_points(corner: Path) -> None:
    out = corner / "paths.parquet"
    outcome = vcmvsp_command(*PATHS)
    assert outcome.code == 0, outcome.err
    table = pq.read_table(out)
    assert table.column_names == ["a", "b", "kinds", "gain_db", "phase_rad", "delay_ns", "points"]
    rows = table.to_pylist()
    assert {(row["a"], row["b"]) for row in rows} == {(0, 1), (0, 2), (1, 2)}
    direct = [row for row in rows if row["kinds"] == "direct"]
    assert [(row["a"], row["b"], row["points"]) for row in direct] == [(0, 1, []), (0, 2, [])]
    assert direct[0]["delay_ns"] == pytest.approx(math.hypot(20.0, 4.0) / 0.299792458)
    assert all(len(row["points"]) == row["kinds"].count("+") + 1 for row in rows if row["kinds"] != "direct")
    first = out.read_bytes()
    vcmvsp_command(*PATHS)
    assert out.read_bytes() == first


@pytest.mark.parametrize(
    ("change", "points", "words"),
    [
        ((), "10,10,1\n0,0,1\n", r"point 0 \(row 1 of the points\) is inside the box at \(10.0, 10.0, 5.0\)"),
        ((), "0,0,1\n0,0,-1\n", r"point 1 .* is below the ground"),
        (("radio.path_loss.kind=friis",), "0,0,1\n", r"radio.path_loss.kind: paths need path_loss.kind = 'rays'"),
        (("radio.walls.kind=itu",), "0,0,1\n", r"radio.walls: walls have no place beside path_loss.kind = 'rays'"),
        (("radio.path_loss.ground=cheese",), "0,0,1\n", r"radio.path_loss.ground: must be none or one of concrete"),
        (("radio.path_loss.facet_limit=3",), "0,0,1\n", r"radio.path_loss.facet_limit: the world has 5 facets"),
        (("world.boxes=[{center=[0,0,9],size=[1,1,1],material='cheese'}]",), "0,0,1\n", r"is of 'cheese'"),
        (("radio.path_loss={}", "radio.fading.kind=geometric"), "0,0,1\n", r"needs path_loss.kind = 'rays'"),
    ],
)
def test_invalid_use_of_rays_is_one_error(corner: Path, change: tuple[str, ...], points: str, words: str) -> None:
    (corner / "points.csv").write_text(points)
    outcome = vcmvsp_command(*PATHS, *sets(*change))
    assert_refused(outcome)
    assert re.search(words, outcome.err), outcome.err


def test_the_paths_of_a_frame_sum_to_its_level(corner: Path) -> None:
    second = '[[vehicle]]\nname = "car2"\nkind = "p2dx"\npose = [22.0, 16.0, 0.0]\nagent = { kind = "trajectory" }\n'
    (corner / "two.toml").write_text(f"{CORNER}{second}")
    vcmvsp.run(corner / "two.toml", set={"duration_s": 0.3, "physics.kind": "kinematic"}, out=corner / "run")
    frame = columns("radio", "run", "--link", "car1/car2", "--frame", "2")["frame"]
    levels = [path["level_dbm"] for path in frame["paths"]]
    assert levels == sorted(levels, reverse=True)
    total = 10.0 * math.log10(sum(10.0 ** (level / 10.0) for level in levels))
    assert total == pytest.approx(frame["budget"]["rssi_dbm"], abs=1e-6)
    text = vcmvsp_command("radio", "run", "--link", "car2/car1", "--frame", "lost").out
    assert "all paths over" in text
    assert "diffraction" in text


def test_antennas_are_at_the_vehicles_plus_their_heights(corner: Path) -> None:
    vcmvsp.run(corner / "corner.toml", set={"duration_s": 0.2, "physics.kind": "kinematic"}, out=corner / "run")
    assert vcmvsp_command("radio", "run", "--positions", "places.csv").code == 0
    head, first, *_ = (corner / "places.csv").read_text().splitlines()
    assert head == "t,name,x,y,z"
    assert first.startswith("0.0,car1,0.0,0.0,0.5")
    both = vcmvsp_command("radio", "run", "--positions", "places.csv", "--frame", "1")
    assert_refused(both, "--positions excludes --link")
    assert_refused(vcmvsp_command("radio", "corner.toml", "--positions", "places.csv"), "needs the folder of a run")


@pytest.mark.usefixtures("corner")
def test_antennas_that_start_inside_a_solid_are_counted() -> None:
    low = "world.boxes=[{center=[0,0,0.65],size=[2,2,0.5]}]"
    outcome = vcmvsp_command("check", "corner.toml", "--set", low)
    assert outcome.code == 0, outcome.err
    assert "radio.path_loss: 1 antennas start inside a solid, reached over the roofs only: car1 in the box at" in outcome.err
    assert "inside a solid" not in vcmvsp_command("check", "corner.toml").err


def test_paths_exclude_other_outputs() -> None:
    assert_refused(vcmvsp_command(*PATHS, "--coverage", "car1"), "--paths and --coverage exclude each other")
