"""``vcmvsp export``: tables, film and layout of a recording; bad input, overwriting, and truncated recordings."""

import csv
import json
import math
import re
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import vcmvsp
from tests.support.cosim import export_runs
from tests.support.cosim.command_line import vcmvsp_command
from tests.support.cosim.export_runs import topic_messages
from tests.support.cosim.full_disk import room_for
from tests.support.cosim.studies import two
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.export import csv_files, video
from vcmvsp.cosim.export.formats import NAMES, export
from vcmvsp.cosim.plots import run_plots
from vcmvsp.cosim.recording import recorded_run
from vcmvsp.cosim.recording.mcap_reader import Recorded, contents, messages
from vcmvsp.cosim.recording.recorded_run import Source, Values
from vcmvsp.cosim.tables import schema
from vcmvsp.cosim.tables.schema import RunFacts, load, radio_table, write_table
from vcmvsp.cosim.types import VehicleState

pytestmark = pytest.mark.slow


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export(export_runs.run_of("lab-patrol"), csv=tmp_path_factory.mktemp("csv") / "lab")[0]


def test_states_and_radio_equal_the_runs_own_tables(tables: Path) -> None:
    run = load(export_runs.run_of("lab-patrol"))
    names = {"x_m": "x", "qz": "qz", "vy_m_s": "vy", "wz_rad_s": "wz"}
    for csv_row, own_row in zip(rows(tables / "states.csv"), run.states.to_pylist(), strict=True):
        assert round(float(csv_row["time_s"]) * SECOND_NS) == own_row["time_ns"]
        assert csv_row["vehicle"] == own_row["vehicle"]
        assert {name: float(csv_row[name]) for name in names} == {name: own_row[own] for name, own in names.items()}
        assert float(csv_row["yaw_rad"]) == pytest.approx(own_row["yaw"], abs=1e-12)
    frames = rows(tables / "radio.csv")
    for csv_row, own_row in zip(frames, run.radio.to_pylist(), strict=True):
        assert {name: csv_row[name] for name in ("sender", "receiver", "outcome")}.items() <= own_row.items()
        assert float(csv_row["rssi_dbm"]) == own_row["rssi_dbm"]
        assert float(csv_row["sent_s"]) == pytest.approx(own_row["sent_ns"] / SECOND_NS)
        assert (csv_row["received_s"] == "") == (own_row["received_ns"] is None)
    assert len(frames) > 3


def test_the_radio_table_of_a_run_has_frames_of_programs_and_routes(tmp_path: Path) -> None:
    vehicles = ("car-1", "car-2")
    facts = RunFacts(scenario="cart", seed=1, end_ns=0, vehicles=vehicles)
    with (export_runs.run_of("a crossing cart") / "run.mcap").open("rb") as stream:
        reports = [Values().of(each) for each in contents(stream) if each.topic == "radio/frame"]
    of_programs = [msgspec.structs.replace(each, frame=each.frame + len(reports)) for each in reports]
    table = radio_table([*reports, *of_programs], facts)
    table = table.append_column("origin", pa.array(["car-2"] * table.num_rows))
    table = table.append_column("origin_sent_ns", pa.array([1_500_000_000] * table.num_rows))
    folder = export_runs.truncated_copy("a crossing cart", tmp_path / "run", 1.0)
    write_table(table, folder / "radio.parquet")
    lines: list[str] = []
    export(folder, csv=tmp_path / "csv", tell=lines.append)
    frames = rows(tmp_path / "csv/radio.csv")
    assert len({row["frame"] for row in frames}) == 2 * len(reports)
    assert {(row["origin"], float(row["origin_sent_s"])) for row in frames} == {("car-2", 1.5)}
    assert lines == []


@pytest.mark.parametrize("rows_at_once", [1, 7, 10**6])
def test_the_radio_is_equal_in_parts_of_any_size_and_from_the_recording(
    rows_at_once: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = export_runs.run_of("a crossing cart")
    export(run, csv=tmp_path / "whole")
    for module in (schema, csv_files):
        monkeypatch.setattr(module, "PART_ROWS", rows_at_once)
    export(run, csv=tmp_path / "parts")
    export(export_runs.truncated_copy("a crossing cart", tmp_path / "cut", 1.0), csv=tmp_path / "rebuilt")
    whole, parts, rebuilt = ((tmp_path / name / "radio.csv").read_bytes() for name in ("whole", "parts", "rebuilt"))
    assert whole == parts == rebuilt


def test_each_sensor_of_numbers_has_its_table_with_units(tables: Path) -> None:
    assert {path.stem for path in tables.iterdir()} == {"states", "radio", "commands", "bumper", "odometer", "odometry"}
    wheels, readings = rows(tables / "odometer.csv"), topic_messages("lab-patrol", "ugv3/odometer")
    ugv3_rows = [row for row in wheels if row["vehicle"] == "ugv3"]
    assert list(ugv3_rows[0]) == ["time_s", "vehicle", "x_m", "y_m", "yaw_rad", "v_m_s", "w_rad_s"]
    for row, (_, each) in zip(ugv3_rows, readings, strict=True):
        assert (float(row["x_m"]), float(row["v_m_s"])) == (each["pose"][0], each["v"])
    assert set(rows(tables / "bumper.csv")[0]) == {"time_s", "vehicle", "front", "left", "back", "right"}
    for columns in csv_files.COLUMNS.values():
        assert all(name.endswith(("_m", "_rad", "_s", "_s2")) or name in csv_files.TURN for name in columns)


def test_notes_have_a_column_for_each_name_and_empty_cells(tmp_path: Path) -> None:
    export(export_runs.run_of("a crossing cart"), csv=tmp_path / "tables")
    note_rows, notes = rows(tmp_path / "tables/notes.csv"), topic_messages("a crossing cart", "car-2/note")
    assert len(note_rows) == len(notes) > 5
    for row, (_, each) in zip(note_rows, notes, strict=True):
        cells = {name: value for name, value in row.items() if value and name not in ("time_s", "vehicle")}
        assert cells == {name: str(value) for name, value in each["values"].items()}


def test_missing_values_are_empty_cells(tmp_path: Path) -> None:
    export(export_runs.run_of("a tag and late sensors"), csv=tmp_path / "tables")
    for row in rows(tmp_path / "tables/fix.csv"):
        assert (row["yaw_rad"], row["sigma_rad"], row["sigma_m"]) == ("", "", "0.15")
    lost = csv_files._row(VehicleState(position=(math.nan, 1.0, 0.0)))
    assert lost is not None
    assert (lost["x_m"], lost["y_m"]) == (None, 1.0)


def test_a_frame_that_is_under_way_at_the_end_is_not_shown_as_lost(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    vcmvsp.run(two(duration_s=0.1005, radio={"preset": "wifi-b-1"}), out=folder)
    radio = load(folder).radio
    assert set(radio["outcome"].to_pylist()) == {"received", "under way"}
    film = video._Film(recorded_run.Source(folder, lambda _: None))
    assert film._lost == []
    assert len(film._received) == radio["outcome"].to_pylist().count("received")
    assert run_plots._lost_s(radio, "car2", "car1").size == 0


def test_a_sensor_named_like_a_table_has_a_table_of_its_own() -> None:
    assert csv_files._place("car1/state") == ("car1", "states")
    assert csv_files._place("car1/states") == ("car1", "states_sensor")
    assert csv_files._place("car1/radio") == ("car1", "radio_sensor")


def film_of(folder: Path, **more: Any) -> video._Film:
    """Film of a team that drives straight ahead, by default 14 m."""
    vcmvsp.run(two(**{"duration_s": 80.0, "radio": {"loss": {"probability": 0.5}}, **more}), out=folder)
    return video._Film(recorded_run.Source(folder, lambda _: None))


def test_the_film_follows_a_team_in_a_large_world(tmp_path: Path) -> None:
    film = film_of(tmp_path / "far")
    assert len(film._middles) == film.count
    for number in range(0, film.count, 40):
        picture = film._at(number * film.step_ns)
        for name in ("car1", "car2"):
            x, y = film._point(film._place(name, number * film.step_ns))
            assert 0 <= x < picture.shape[1]
            assert 0 <= y < video.FOLLOWING_PX + video.CAPTION_PX
    still = film_of(tmp_path / "near", duration_s=2.0)
    assert len(still._middles) == 1


def test_below_the_film_is_the_formation_error_so_far(tmp_path: Path) -> None:
    film = film_of(tmp_path / "run", duration_s=4.0)
    ((name, (time_ns, error_m)),) = film._errors.items()
    assert name == "car2"
    table = pq.read_table(tmp_path / "run" / "errors.parquet")
    assert error_m.tolist() == pytest.approx(table["error_m"].to_pylist(), rel=1e-6, abs=1e-9)
    assert time_ns[-1] == 4 * SECOND_NS
    curve = film._at(2 * SECOND_NS)[-video.CURVE_PX :].astype(int)
    blue = (curve[..., 0] - curve[..., 2] > 60).any(axis=0).nonzero()[0]  # the colour of the second vehicle
    middle = 0.5 * (video.AXIS_PX + film._width - video.MARGIN_PX // 2)
    assert blue.min() <= video.AXIS_PX + 3
    assert middle - 8 <= blue.max() <= middle + 3


def test_the_film_shows_walls_vehicles_and_lost_frames(tmp_path: Path) -> None:
    reports: list[tuple[str, float]] = []
    export(export_runs.run_of("a crossing cart"), mp4=tmp_path / "run.mp4", progress=lambda *each: reports.append(each))
    film = cv2.VideoCapture(str(tmp_path / "run.mp4"))
    pictures = []
    while (each := film.read())[0]:
        pictures.append(each[1].astype(int))
    film.release()
    assert len(pictures) == 41  # 2 s at 20 pictures a second, both ends
    assert reports[-1] == ("mp4", 1.0)
    assert np.abs(pictures[0] - pictures[-1]).max() > 100  # vehicles move
    red = [((picture[..., 2] - picture[..., 1] > 60) & (picture[..., 2] - picture[..., 0] > 60)).sum() for picture in pictures]
    lost = [time_ns for time_ns, each in topic_messages("a crossing cart", "radio/frame") if -1 in each["received_ns"]]
    ages_s = [min((0.05 * k - at / SECOND_NS for at in lost if at <= 0.05 * k * SECOND_NS), default=9.0) for k in range(41)]
    fresh = [count for count, age_s in zip(red, ages_s, strict=True) if age_s < 0.2]
    assert len(fresh) > 5
    assert min(fresh) > 10
    assert max([count for count, age_s in zip(red, ages_s, strict=True) if age_s > 0.5], default=0) == 0


def test_a_layout_names_existing_topics_and_numbers(tmp_path: Path) -> None:
    for name in ("lab-patrol", "recon-team", "a crossing cart"):
        export(export_runs.run_of(name), layout=tmp_path / f"{name}.json")
        layout = json.loads((tmp_path / f"{name}.json").read_text())
        newest: dict[str, Any] = {}
        with (export_runs.run_of(name) / "run.mcap").open("rb") as stream:
            for topic, _, data in messages(stream):
                message = json.loads(data)
                if topic.endswith("/note"):  # not every number is noted each time
                    message["values"] = {**newest.get(topic, {}).get("values", {}), **message["values"]}
                newest[topic] = message
        panels = layout["configById"]
        assert sorted(leaves(layout["layout"])) == sorted(panels)
        assert set(panels["3D!scene"]["topics"]) <= set(newest)
        assert ("world/solids" in newest) == ("world/solids" in panels["3D!scene"]["topics"])
        assert "world/scene" in panels["3D!scene"]["topics"]
        curves = [path["value"] for panel in panels.values() for path in panel.get("paths", ())]
        assert curves
        for curve in curves:
            place, _, fields = curve.replace("[:]", "[0]").partition(".")
            topic, _, condition = place.rstrip("}").partition("{")
            value: Any = newest[topic]
            assert not condition or condition.partition("==")[0] in value
            for field in fields.replace("]", "").replace("[", ".").split("."):
                value = value[int(field)] if isinstance(value, list) else value[field]
            assert isinstance(value, float | int | str), curve
        for panel in panels.values():
            assert panel.get("imageMode", {}).get("imageTopic") in (None, *newest)


def leaves(node: Any) -> list[str]:
    """The panels of a layout."""
    return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "nothing to export: add at least one of --rosbag2, --csv, --mp4 and --layout"),
        (("--csv", "--out", "full"), "full/csv: is not empty; choose another folder (--out), or add --force to overwrite"),
        (("--layout", "--out", "full"), "full/layout.json: already exists; choose another folder (--out), or add --force"),
        (("--csv", "--layout", "--out", "full/layout.json"), "full/layout.json/csv: "),
    ],
)
def test_unwritable_outputs_are_refused_before_any_is_written(
    arguments: tuple[str, ...], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full/csv").mkdir(parents=True)
    for name in ("csv/a.csv", "layout.json"):
        (tmp_path / "full" / name).write_text("mine")
    outcome = vcmvsp_command("export", str(export_runs.run_of("lab-patrol")), *arguments)
    assert (outcome.code, outcome.out) == (2, "")
    assert words in outcome.err
    assert [path.name for path in sorted(tmp_path.rglob("*"))] == ["full", "csv", "a.csv", "layout.json"]
    assert (tmp_path / "full/layout.json").read_text() == "mine"


@pytest.mark.parametrize(
    ("name", "path", "force", "words"),
    [
        ("mp4", "film.avi", False, "film.avi: the name must end in .mp4"),
        ("layout", "full", True, "full: is a folder, not a file"),
        ("csv", "full/a.json", True, "full/a.json: is a file, not a folder"),
    ],
)
def test_files_and_folders_are_distinguished(name: str, path: str, force: bool, words: str, tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full/a.json").write_text("mine")
    with pytest.raises(UsageError, match=words):
        export(export_runs.run_of("lab-patrol"), force=force, **{name: tmp_path / path})  # type: ignore[arg-type]  # one of four


def test_two_outputs_need_two_names(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="two exports have the same path"):
        export(export_runs.run_of("lab-patrol"), csv=tmp_path / "x", rosbag2=tmp_path / "x")


def test_a_folder_without_a_recording_is_named(tmp_path: Path) -> None:
    for folder, words in ((tmp_path, "no run.mcap here"), (tmp_path / "none", "there is no such folder")):
        outcome = vcmvsp_command("export", str(folder), "--csv", "--out", str(tmp_path / "out"))
        assert (outcome.code, outcome.out) == (2, "")
        assert words in outcome.err
    (tmp_path / "run.mcap").write_bytes(b"no recording")
    assert "not a recording of a run" in vcmvsp_command("export", str(tmp_path), "--csv", "--out", str(tmp_path / "out")).err
    assert not (tmp_path / "out").exists()


def test_the_recording_itself_is_never_overwritten(tmp_path: Path) -> None:
    folder = export_runs.truncated_copy("lab-patrol", tmp_path / "run", 1.0)
    before = (folder / "run.mcap").read_bytes()
    with pytest.raises(UsageError, match="is the recording itself"):
        export(folder, layout=folder / "run.mcap", force=True)
    with pytest.raises(UsageError, match="is the folder of the run"):
        export(folder, csv=folder, force=True)
    assert (folder / "run.mcap").read_bytes() == before


def test_force_replaces_old_files_and_keeps_others(tmp_path: Path) -> None:
    (tmp_path / "csv").mkdir()
    (tmp_path / "csv/states.csv").write_text("old")
    (tmp_path / "csv/mine.txt").write_text("mine")
    run = str(export_runs.run_of("lab-patrol"))
    outcome = vcmvsp_command("export", run, "--csv", "--out", str(tmp_path), "--force", "--quiet")
    assert outcome == (0, f"{tmp_path / 'csv'}\n", "")
    assert len(rows(tmp_path / "csv/states.csv")) == 63
    assert (tmp_path / "csv/mine.txt").read_text() == "mine"


@pytest.mark.parametrize("room", [0, 100])
@pytest.mark.parametrize("output", ["mp4", "csv", "layout", "rosbag2"])
def test_an_export_to_a_full_disk_leaves_nothing(output: str, room: int, tmp_path: Path) -> None:
    folder, out = export_runs.run_of("recon-team"), tmp_path / "out"
    with room_for(room):
        outcome = vcmvsp_command("export", str(folder), f"--{output}", "--out", str(out), "--quiet")
    assert (outcome.code, outcome.out) == (2, "")
    assert outcome.err == f"vcmvsp: {out / NAMES[output]}: cannot be written: File too large\n"
    assert list(out.iterdir()) == []


def test_an_export_to_a_full_disk_keeps_older_files(tmp_path: Path) -> None:
    (tmp_path / "run.mp4").write_bytes(b"an older film")
    folder = export_runs.run_of("a crossing cart")
    with room_for(1000), pytest.raises(UsageError, match=r"run\.mp4: cannot be written"):
        export(folder, mp4=tmp_path / "run.mp4", force=True)
    assert [path.name for path in tmp_path.iterdir()] == ["run.mp4"]
    assert (tmp_path / "run.mp4").read_bytes() == b"an older film"


@pytest.mark.parametrize("part", [0.4, 0.7, 0.999])
def test_a_killed_run_is_exported_as_far_as_recorded(part: float, tmp_path: Path) -> None:
    folder, out = export_runs.truncated_copy("lab-patrol", tmp_path / "killed", part), tmp_path / "out"
    outputs = {name: out / called for name, called in NAMES.items()}
    outcome = vcmvsp_command("export", str(folder), *(f"--{name}" for name in outputs), "--out", str(out))
    assert (outcome.code, outcome.out.split()) == (0, [str(path) for path in outputs.values()])
    left = rows(out / "csv/states.csv")
    whole = topic_messages("lab-patrol", "ugv1/state")
    assert 0 < len(left) // 3 <= len(whole)
    if part < 0.9:  # else only the index is missing, no message
        assert outcome.err.count("is damaged (it is truncated): the export ends at ") == 1
    assert outcome.err.count("no radio.parquet here: radio.csv lacks frames of programs, and routes") == 1
    assert left[3]["x_m"] == str(whole[1][1]["position"][0])
    assert all(path.exists() for path in outputs.values())


def test_a_damaged_radio_table_is_replaced_by_the_recording(tmp_path: Path) -> None:
    folder = export_runs.truncated_copy("a crossing cart", tmp_path / "killed", 1.0)
    whole = (export_runs.run_of("a crossing cart") / "radio.parquet").read_bytes()
    (folder / "radio.parquet").write_bytes(whole[: len(whole) // 2])
    lines: list[str] = []
    export(folder, csv=tmp_path / "csv", tell=lines.append)
    assert [line for line in lines if "radio.parquet cannot be read: radio.csv lacks frames of programs" in line]
    export(export_runs.run_of("a crossing cart"), csv=tmp_path / "whole")
    for row, known in zip(rows(tmp_path / "csv/radio.csv"), rows(tmp_path / "whole/radio.csv"), strict=True):
        assert row == known or row["outcome"] == "under way"  # at the end of the recording


@pytest.mark.parametrize("part", [0.2, 0.5])
def test_a_growing_recording_is_exported_as_it_was_at_first(
    part: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = export_runs.truncated_copy("recon-team", tmp_path / "run", part)
    export(folder, csv=tmp_path / "then")
    headers = csv_files._headers

    def read(source: Source) -> Any:
        found = headers(source)
        export_runs.truncated_copy("recon-team", folder, 1.0)
        return found

    monkeypatch.setattr(csv_files, "_headers", read)
    export(folder, csv=tmp_path / "now")
    left = {path.name: path.read_bytes() for path in (tmp_path / "then").iterdir()}
    assert {path.name: path.read_bytes() for path in (tmp_path / "now").iterdir()} == left


STATE = json.loads(msgspec.json.encode(VehicleState(position=(0.0, 0.0, 0.0))))
AT = {"timestamp": {"sec": 0, "nsec": 0}, "frame_id": "world"}
PIXEL = {**AT, "width": 1, "height": 1, "encoding": "rgb8", "step": 3, "data": "AAAA"}
CELL = {"pose": {}, "column_count": 1, "cell_size": {"x": 1.0, "y": 1.0}, "row_stride": 2, "cell_stride": 2, "data": "AAA="}
CELLS = {**AT, **CELL, "fields": [{"name": name, "offset": at} for at, name in enumerate(("probability", "seen"))]}
FRAME = {"type": "frame", "frame": 0, "sender": "car1", "sent_ns": 0, "size_bytes": 1, "receivers": ["car2"]}
HEARD = {**FRAME, "distance_m": [1.0], "rssi_dbm": [0.0], "received_ns": [1], "outcome": ["received"]}
TRIANGLE = {"pose": {}, "points": [{}, {}, {}], "color": {"r": 0.0, "g": 0.0, "b": 0.0, "a": 1.0}, "indices": [0, 1, 2]}


def drawn(**triangle: object) -> dict[str, object]:
    entity = {**AT, "id": "x", "lifetime": {}, "frame_locked": False, "triangles": [{**TRIANGLE, **triangle}]}
    return {"entities": [entity], "deletions": []}


def test_null_in_json_is_read_as_nan() -> None:
    values = Values()
    lost = json.dumps({**STATE, "position": [None, 1.0, 0.0]}).encode()
    position = values.of(Recorded("car1/state", "vcmvsp.VehicleState", 0, lost)).position
    assert math.isnan(position[0])
    assert position[1:] == (1.0, 0.0)
    assert values.of(Recorded("car1/else", "vcmvsp.Follows", 0, b"{}")) is None


@pytest.mark.parametrize(
    ("schema", "whole", "changes"),
    [
        ("vcmvsp.VehicleState", STATE, [{"position": [0.0, 1.0]}, {"type": "frame"}]),
        ("foxglove.RawImage", PIXEL, [{"height": 1 << 31}, {"width": -1, "height": -1, "step": -3}, {"step": 1}]),
        ("foxglove.Grid", CELLS, [{"column_count": 0, "data": ""}, {"column_count": 1 << 31}, {"fields": []}]),
        (
            "foxglove.SceneUpdate",
            drawn(),
            [drawn(indices=each) for each in ([0, 1, 2] * 200_001, [0, 1, 3], [0, -1, 2], [0, 1])],
        ),
        (
            "vcmvsp.Frame",
            HEARD,
            [{"receivers": ["a", "b"]}, {"received_ns": [1 << 63]}, {"sent_ns": 1 << 63}, {"snr_db": [[1]]}],
        ),
    ],
)
def test_invalid_messages_are_named(schema: str, whole: dict[str, Any], changes: list[dict[str, Any]]) -> None:
    values = Values()
    values.of(Recorded("car1/x", schema, 0, json.dumps(whole).encode()))
    for each in changes:
        with pytest.raises(UsageError, match=rf"a message of car1/x does not match {re.escape(schema)}: "):
            values.of(Recorded("car1/x", schema, 0, json.dumps({**whole, **each}).encode()))
