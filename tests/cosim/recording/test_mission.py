"""Recording of a reconnaissance: grids and annotated pictures in ``run.mcap``, metrics, figures, film."""

import io
import json
import math
from typing import Any

import cv2
import matplotlib.pyplot as plt
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.cosim.recording.test_files import check, json_recording
from tests.support.cosim.reconnaissance_recording import CELL_M, CELLS, TARGETS, events, reconnaissance_recorder
from tests.support.cosim.recordings import note, states
from tests.support.cosim.recordings import recorder_after as plainly
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.metrics.mission import Mission, searched_ratio
from vcmvsp.cosim.metrics.motion import motion
from vcmvsp.cosim.plots import mission_plot, mission_video, style
from vcmvsp.cosim.recording.foxglove import corners_of
from vcmvsp.cosim.recording.mission_log import FRAMES, MissionLog, read_mission, surest_map
from vcmvsp.cosim.studies.rows import flat
from vcmvsp.cosim.types import Looks, Mosaic, Presence, ProbabilityMap, Sighting, Sightings, frozen
from vcmvsp.cosim.util.palette import color_of

pytestmark = pytest.mark.slow

NAMES = ("uav1", "uav2")
END_NS = 20 * SECOND_NS


@pytest.fixture(scope="module")
def run() -> Any:
    return reconnaissance_recorder(NAMES)


@pytest.fixture(scope="module")
def topics(run: Any) -> dict[str, list[tuple[int, Any, Any]]]:
    """Time, message and schema of each message, by topic."""
    recording = json_recording(run[1].getvalue())
    return {topic: [row[:3] for row in rows] for topic, rows in recording.items()}


def shown_by(kind: type, vehicle: str) -> list[Any]:
    return [each.value for each in events(NAMES, 20.0) if isinstance(each.value, kind) and each.key.startswith(vehicle)]


def of(message: dict[str, Any]) -> np.ndarray:
    """Cells of a grid by its declared fields, as a foreign reader decodes them: [row, column, field]."""
    data = np.frombuffer(msgspec.convert(message["data"], bytes), np.uint8)
    assert len(data) % message["row_stride"] == 0
    assert message["row_stride"] >= message["column_count"] * message["cell_stride"]
    assert all(field["type"] == 1 and field["offset"] < message["cell_stride"] for field in message["fields"])
    rows = data.reshape(-1, message["row_stride"])[:, : message["column_count"] * message["cell_stride"]]
    return rows.reshape(len(rows), -1, message["cell_stride"])[..., [field["offset"] for field in message["fields"]]]


def test_all_messages_have_foxgloves_schemas_and_fit_them(topics: Any) -> None:
    titles = {topic: rows[0][2]["title"] for topic, rows in topics.items() if topic.startswith("uav1")}
    assert titles == {
        "uav1/detector": "vcmvsp.Looks",
        "uav1/map": "foxglove.Grid",
        "uav1/mosaic": "foxglove.Grid",
        "uav1/note": "vcmvsp.Note",
        "uav1/sightings": "foxglove.ImageAnnotations",
        "uav1/sightings/picture": "foxglove.CompressedImage",
        "uav1/state": "vcmvsp.VehicleState",
    }
    for rows in topics.values():
        for _, message, schema in rows:
            check(message, schema)


@pytest.mark.parametrize(("topic", "kind"), [("map", ProbabilityMap), ("mosaic", Mosaic)])
def test_grids_describe_their_cells(topic: str, kind: type, topics: Any) -> None:
    """Mosaics are opaque where an area was seen."""
    for (_, message, _), value in zip(topics[f"uav1/{topic}"], shown_by(kind, "uav1"), strict=True):
        names, cells = [field["name"] for field in message["fields"]], of(message)
        if kind is ProbabilityMap:
            assert names == ["probability", "seen"]
            np.testing.assert_array_equal(cells, np.dstack((value.probability, value.seen)))
        else:
            assert names == ["red", "green", "blue", "alpha"]
            np.testing.assert_array_equal(cells[..., :3], value.pixels)
            np.testing.assert_array_equal(cells[..., 3], np.where((value.pixels == 0).all(axis=2), 0, 255))
        assert (message["frame_id"], message["cell_size"]) == ("world", {"x": CELL_M, "y": CELL_M})
        assert message["pose"]["position"] == {"x": 0.0, "y": 0.0, "z": 0.0}


def test_each_sighting_has_its_picture(topics: Any) -> None:
    sightings, pictures, sent = topics["uav1/sightings"], topics["uav1/sightings/picture"], shown_by(Sightings, "uav1")
    for (time_ns, message, _), (picture_ns, picture, _), value in zip(sightings, pictures, sent, strict=True):
        assert time_ns == picture_ns
        assert msgspec.convert(message["found"], tuple[Sighting, ...]) == value.found
        assert [each["text"] for each in message["texts"]] == [f"{each.target} 0.93" for each in value.found]
        assert {json.dumps(each["timestamp"]) for each in (*message["points"], picture)} == {json.dumps(picture["timestamp"])}
        assert (picture["format"], msgspec.convert(picture["data"], bytes)) == ("jpeg", value.jpeg)


@given(st.floats(-math.pi, math.pi), st.floats(5.0, 80.0))
def test_boxes_are_squares_turned_counter_clockwise_as_seen(angle: float, side: float) -> None:
    sighting = Sighting(target="a", place=(0.0, 0.0), centre_px=(50.0, 40.0), angle=angle, side_px=side, score=1.0)
    corners = np.array(corners_of(sighting))
    np.testing.assert_allclose(corners.mean(axis=0), (50.0, 40.0), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1), side)
    top = corners[:2].mean(axis=0) - (50.0, 40.0)  # angle 0 points up, to lower rows
    np.testing.assert_allclose(top, (-0.5 * side * math.sin(angle), -0.5 * side * math.cos(angle)), atol=1e-9)


def test_boxes_enclose_the_target_in_the_picture(topics: Any) -> None:
    """The yellow square of the synthetic picture lies within the box and fills it."""
    boxed = [row for row in zip(topics["uav1/sightings"], topics["uav1/sightings/picture"], strict=True) if row[0][1]["points"]]
    (_, message, _), (_, picture, _) = boxed[0]
    pixels: Any = cv2.imdecode(np.frombuffer(msgspec.convert(picture["data"], bytes), np.uint8), cv2.IMREAD_COLOR)
    yellow = (pixels[..., 2] > 190) & (pixels[..., 0] < 80)
    corners = np.array([(each["x"], each["y"]) for each in message["points"][0]["points"]]) - 0.5
    inside = cv2.fillConvexPoly(np.zeros(yellow.shape, np.uint8), corners.round().astype(np.int32), (1.0,)) > 0
    assert (yellow & inside).sum() > 0.9 * max(yellow.sum(), inside.sum()) > 1000


def test_detector_results_are_unchanged(topics: Any) -> None:
    for (_, message, _), value in zip(topics["uav1/detector"], shown_by(Looks, "uav1"), strict=True):
        assert (message["cells"], message["hits"]) == (value.cells.tolist(), value.hits.tolist())


def test_targets_move_in_the_scene_once_a_second(topics: Any) -> None:
    rows = topics["world/scene"]
    assert [time_ns for time_ns, *_ in rows] == [k * SECOND_NS for k in range(21)]
    for time_ns, scene, _ in rows:
        drawn = {entity["id"]: entity for entity in scene["entities"]}
        assert set(drawn) == {*NAMES, "target/alpha", "target/bravo"}
        for target in TARGETS:
            position = drawn[f"target/{target.name}"]["cubes"][0]["pose"]["position"]
            assert (position["x"], position["y"]) == target.place(time_ns / SECOND_NS)


CHANGES: list[Any] = [
    ("map", lambda v: msgspec.structs.replace(v, probability=frozen(v.probability ^ 1))),
    ("map", lambda v: msgspec.structs.replace(v, seen=frozen(~v.seen))),
    ("map", lambda v: msgspec.structs.replace(v, left=0.5)),
    ("mosaic", lambda v: msgspec.structs.replace(v, pixels=frozen(v.pixels ^ 1))),
    ("sightings", lambda v: msgspec.structs.replace(v, jpeg=v.jpeg + b"\x00")),
    ("sightings", lambda v: msgspec.structs.replace(v, width=v.width + 1)),
    ("detector", lambda v: msgspec.structs.replace(v, hits=frozen(~v.hits))),
    ("detector", lambda v: msgspec.structs.replace(v, cells=frozen(v.cells + 1))),
]


@pytest.mark.parametrize(("topic", "change"), CHANGES)
def test_digest_covers_every_bit(topic: str, change: Any) -> None:
    def digest(extra: Any) -> str:
        recorder, _ = reconnaissance_recorder(NAMES, 1.0, more=[] if extra is None else [extra])
        return str(recorder.metrics(window=(0.0, None))["digest"])

    event = next(each for each in events(NAMES, 1.0) if each.key == f"uav1/{topic}")
    same, other = event, msgspec.structs.replace(event, value=change(event.value))
    assert digest(same) == digest(same) != digest(other)


# Numbers


def mission_of(*notes: Any, seconds: float = 20.0) -> dict[str, Any]:
    return dict(reconnaissance_recorder(NAMES, seconds, more=notes)[0].metrics(window=(0.0, None))["mission"])


def test_finds_count_near_the_moving_target() -> None:
    """After 15 s alpha has moved on by 1.5 m: a find 2.9 m ahead of it counts, one 3.1 m behind it does not."""
    metrics = mission_of(
        note("uav2", 15 * SECOND_NS, found="alpha", found_x=9.0, found_y=20.0 + 1.5 + 2.9),
        note("uav2", 15 * SECOND_NS + 1, found="alpha", found_x=9.0, found_y=20.0 + 1.5 - 3.1),
        note("uav2", 15 * SECOND_NS + 2, found="bravo", found_x=9.0, found_y=21.5),
        note("uav2", 15 * SECOND_NS + 3, found="", found_x=31.5, found_y=30.0),
        note("uav2", 15 * SECOND_NS + 4, found=""),
        note("uav2", 15 * SECOND_NS + 5, found="", found_x="here", found_y=30.0),
    )
    base = mission_of()
    assert metrics["false_finds"] == base["false_finds"] + 4
    assert metrics["found_s"] == base["found_s"]
    assert base["targets_found"] == sum(time_s is not None for time_s in base["found_s"].values()) == 2


def tracked_targets(task: str, target: str, away_m: float, seconds: float) -> int:
    """``targets_tracked`` of a vehicle that stays ``away_m`` from alpha for ``seconds`` and then leaves."""
    mission = Mission()
    mission.take("uav1", 0, {"commander": "search", "task": "search", "target": ""})
    mission.take("uav1", SECOND_NS, {"task": task, "target": target})
    moves = []
    for k in range(200):
        x, y = TARGETS[0].place(k / 10)
        away = away_m if k / 10 <= 1.0 + seconds else 50.0
        moves.append(states(k * SECOND_NS // 10, {"uav1": (x + away, y, 0.0)}))
    found = mission.metrics(motion(plainly(["uav1"], moves, END_NS).states), TARGETS)
    assert found is not None
    return int(found["targets_tracked"])


@pytest.mark.parametrize(
    ("task", "target", "away_m", "seconds", "count"),
    [
        ("track", "alpha", 2.9, 10.0, 1),
        ("track", "", 2.9, 10.0, 1),  # target names unknown
        ("track", "alpha", 2.9, 9.8, 0),
        ("track", "alpha", 3.1, 10.0, 0),
        ("track", "bravo", 2.9, 10.0, 0),
        ("search", "alpha", 2.9, 10.0, 0),
    ],
)
def test_a_target_is_tracked_by_a_vehicle_near_it(task: str, target: str, away_m: float, seconds: float, count: int) -> None:
    assert tracked_targets(task, target, away_m, seconds) == count


def test_bytes_and_switches_add_up() -> None:
    base = mission_of()
    assert base["map_bytes_sent"] == 2 * 2100
    metrics = mission_of(note("uav1", END_NS, commander="avoid1", map_bytes=5000.0), note("uav2", 1, commander="search"))
    assert metrics["map_bytes_sent"] == 2100 + 5000
    assert metrics["switches"] - base["switches"] == 1


def test_bytes_of_a_replacing_agent_are_added() -> None:
    counts = [0.0, 500.0, 900.0, 0.0, 300.0, 400.0]
    metrics = mission_of(*(note("uav3", tick, map_bytes=count) for tick, count in enumerate(counts)))
    assert metrics["map_bytes_sent"] - mission_of()["map_bytes_sent"] == 900 + 400


def test_the_searched_area_is_the_union_of_all_maps() -> None:
    def shown(left: float, cell_m: float, seen: Any) -> ProbabilityMap:
        seen = frozen(seen, np.bool_)
        return ProbabilityMap(
            left=left, bottom=0.0, cell_m=cell_m, probability=frozen(np.zeros(seen.shape), np.uint8), seen=seen
        )

    assert searched_ratio([]) is None
    assert searched_ratio([shown(0.0, 2.0, [[1, 0], [0, 0]]), shown(0.0, 2.0, [[0, 0], [0, 1]])]) == 0.5
    # two grids of 4 m x 4 m with different cell sizes, side by side and then one over the other
    assert searched_ratio([shown(0.0, 2.0, [[1, 0], [0, 0]]), shown(4.0, 4.0, [[1]])]) == pytest.approx(20 / 32)
    assert searched_ratio([shown(0.0, 2.0, [[1, 0], [0, 0]]), shown(0.0, 4.0, [[1]])]) == pytest.approx(1.0)
    assert searched_ratio([shown(0.0, 2.0, [[1, 0], [0, 0]]), shown(0.0, 4.0, [[0]])]) == pytest.approx(4 / 16, abs=0.25)
    assert searched_ratio([shown(0.0, 2.0, np.zeros((0, 0)))]) is None


@settings(max_examples=30)
@given(st.lists(st.lists(st.booleans(), min_size=6, max_size=6), min_size=1, max_size=4))
def test_equal_grids_are_counted_exactly(maps: list[list[bool]]) -> None:
    masks = [np.array(each).reshape(2, 3) for each in maps]
    values = [ProbabilityMap(left=0.1, bottom=0.3, cell_m=0.7, probability=frozen(each, np.uint8), seen=each) for each in masks]
    assert searched_ratio(values) == pytest.approx(np.any(masks, axis=0).mean())


def test_paths_of_metrics_exist_without_finds() -> None:
    numbers = flat(mission_of(seconds=0.0), "mission.")
    assert {"mission.found_s.alpha", "mission.found_s.bravo", "mission.targets_found"} <= set(numbers)
    assert numbers["mission.found_s.alpha"] is None


def test_without_targets_and_notes_there_is_no_mission() -> None:
    mission = Mission()
    mission.take("uav1", 0, {"mode": "avoid"})
    moved = motion(plainly(NAMES, (), 0).states)
    assert mission.metrics(moved, ()) is None
    mission.take("uav1", 0, {"task": "search"})
    assert mission.metrics(moved, ()) is not None


@pytest.mark.parametrize("topic", ["map", "mosaic", "sightings"])
def test_a_map_or_picture_without_finds_is_a_mission(topic: str) -> None:
    """The set of metrics must not depend on search errors: in a world without targets, every find is false."""
    event = next(each for each in events(NAMES, 1.0) if each.key == f"uav1/{topic}")
    moved = motion(plainly(NAMES, (), 0).states)
    silent, mistaken = Mission(), Mission()
    for mission in (silent, mistaken):
        mission.see("uav1", event.value)  # type: ignore[arg-type]
    mistaken.take("uav1", SECOND_NS, {"found": "", "found_x": 1.0, "found_y": 2.0})
    first, second = silent.metrics(moved, ()), mistaken.metrics(moved, ())
    assert first is not None
    assert second is not None
    assert flat(first, "mission.").keys() == flat(second, "mission.").keys()
    assert (first["false_finds"], second["false_finds"]) == (0, 1)


@pytest.mark.parametrize("value", [True, 1.0, "track"])
def test_repeated_notes_are_kept_once(value: Any) -> None:
    """Also for values other than words; memory does not grow with the ticks."""
    mission = Mission()
    for tick in range(10):
        mission.take("uav1", tick, {"commander": value})
    assert mission.of("uav1", "commander") == [(0, str(value))]


def test_a_vehicle_without_its_agent_has_no_task() -> None:
    """It hovers above its target throughout; the agent's task before and after is one task, not a switch."""

    def mission(*, lost_s: float | None = None, back_s: float | None = None, failed_s: float | None = None) -> dict[str, Any]:
        noted = Mission()
        noted.take("uav1", 0, {"commander": "track", "task": "track", "target": "bravo"})
        if failed_s is not None:
            noted.take("uav1", round(failed_s * SECOND_NS), {"status": "failed"})
        if lost_s is not None:
            noted.leave("uav1", round(lost_s * SECOND_NS))
        if back_s is not None:
            noted.restore("uav1", round(back_s * SECOND_NS))
        assert noted.lost("uav1") == []
        moves = [states(k * SECOND_NS // 10, {"uav1": (31.0, 30.0, 0.0)}) for k in range(200)]
        return dict(noted.metrics(motion(plainly(["uav1"], moves, END_NS).states), TARGETS) or {})

    cases = [mission(), mission(failed_s=5.0), mission(lost_s=5.0), mission(lost_s=12.0)]
    cases += [mission(lost_s=5.0, back_s=9.0), mission(lost_s=5.0, back_s=16.0)]
    assert [each["targets_tracked"] for each in cases] == [1, 0, 0, 1, 1, 0]
    assert {each["switches"] for each in cases} == {0}


def test_a_returned_agent_may_change_its_task() -> None:
    mission = Mission()
    mission.take("uav1", 0, {"commander": "track", "task": "track", "target": ""})
    mission.leave("uav1", 5)
    mission.leave("uav1", 6)  # lost, then gone for good
    mission.take("uav1", 9, {"commander": "search", "task": "search", "target": ""})  # another agent in its place
    mission.restore("uav1", 9)
    assert mission.of("uav1", "commander") == [(0, "track"), (5, ""), (9, "search")]
    assert mission.of("uav1", "target") == [(0, "")]
    found = mission.metrics(motion(plainly(["uav1"], (), 0).states), ())
    assert found is not None
    assert found["switches"] == 1


def test_the_log_contains_lost_agents() -> None:
    away = Presence(state="lost", since_ns=0), Presence(state="back", since_ns=0)
    more = [Event("uav1/host", at_s * SECOND_NS, each) for at_s, each in zip((1, 2), away, strict=True)]
    recorder, stream = reconnaissance_recorder(NAMES, 3.0, more=[*more, note("uav2", SECOND_NS, status="failed")])
    log = read_mission(io.BytesIO(stream.getvalue()), NAMES, 3 * SECOND_NS)
    first, *others = log.noted.of("uav1", "commander")
    assert [name for _, name in (first, *others)] == ["search", "", "search"]
    assert log.noted.of("uav2", "commander")[1:] == [(SECOND_NS, "")]
    assert recorder.metrics(window=(0.0, None))["mission"]["switches"] == 0


# Pictures


@pytest.fixture(scope="module")
def log(run: Any) -> MissionLog:
    return read_mission(io.BytesIO(run[1].getvalue()), NAMES, END_NS)


def test_a_recording_has_all_maps_and_pictures(log: MissionLog) -> None:
    for name in NAMES:
        for (_, back), value in zip(log.maps[name], shown_by(ProbabilityMap, name), strict=True):
            np.testing.assert_array_equal(back.probability, value.probability)
            np.testing.assert_array_equal(back.seen, value.seen)
        np.testing.assert_array_equal(log.mosaics[name].pixels, shown_by(Mosaic, name)[-1].pixels)
        assert [value for _, value in log.sightings[name]] == shown_by(Sightings, name)


def test_a_long_recording_keeps_some_pictures() -> None:
    """At 5 Hz and with one part of the run per 2 s, one picture in ten; pictures with a target win."""
    _, stream = reconnaissance_recorder(NAMES, 20.0, looks=5.0)
    log = read_mission(io.BytesIO(stream.getvalue()), NAMES, 2 * FRAMES * SECOND_NS)
    for name in NAMES:
        pictures = [(time_ns, sightings) for time_ns, sightings in log.sightings[name] if sightings.jpeg]
        parts = [log.part(time_ns) for time_ns, _ in pictures]
        assert parts == sorted(set(parts)) == list(range(10))
        with_target = {log.part(time_ns) for time_ns, sightings in log.sightings[name] if sightings.found}
        assert {log.part(time_ns) for time_ns, sightings in pictures if sightings.found} == with_target
        shown = [each.value for each in events(NAMES, 20.0, 5.0) if each.key == f"{name}/sightings"]
        found = [each.found for each in shown if isinstance(each, Sightings) and each.found]
        assert [sightings.found for _, sightings in log.sightings[name] if sightings.found] == found


def test_a_cut_recording_gives_an_empty_log(run: Any) -> None:
    whole = run[1].getvalue()
    assert not read_mission(io.BytesIO(whole[: len(whole) // 50]), NAMES, END_NS)
    assert not read_mission(io.BytesIO(b"nothing of the kind"), NAMES, END_NS)


def test_the_surest_map_wins_in_each_cell() -> None:
    def shown(values: list[int]) -> ProbabilityMap:
        probability = frozen([values], np.uint8)
        return ProbabilityMap(left=0.0, bottom=0.0, cell_m=1.0, probability=probability, seen=frozen(probability > 0))

    log = MissionLog(NAMES, END_NS, maps={"uav1": [(0, shown([127, 3, 250]))], "uav2": [(0, shown([140, 120, 200]))]})
    assert surest_map(log, 0)[1].tolist() == [[140, 3, 250]]
    assert surest_map(log, -1)[0] is None


OUTLINES = [np.array([(5.0, 5.0), (12.0, 5.0), (12.0, 15.0)])]


def test_the_mission_figure_shows_commanders_maps_and_targets(run: Any, log: MissionLog) -> None:
    moved = motion(run[0].states)
    figure = mission_plot.mission(log, moved, TARGETS, OUTLINES)
    labels = {label.get_text(): label.get_color() for label in figure.axes[0].get_yticklabels()}
    assert labels == {name: color_of(index) for index, name in enumerate(NAMES)}  # colours of the tracks below
    titles = ["5 s: alpha found", "6 s: alpha given up", "12 s: bravo found", "20 s: the end"]
    assert [axes.get_title() for axes in figure.axes if axes.get_title()] == titles
    last = next(axes for axes in figure.axes if axes.get_title() == "20 s: the end")
    np.testing.assert_allclose(np.asarray(last.images[0].get_array()) * 255.0, surest_map(log, END_NS)[1])
    stars = [tuple(np.asarray(line.get_xydata()).ravel()) for line in last.lines if str(line.get_marker()) == "*"]
    assert stars == [target.place(20.0) for target in TARGETS]
    assert not plt.get_fignums()


def test_the_contact_sheet_shows_each_vehicles_detections(log: MissionLog) -> None:
    chosen = mission_plot.chosen_pictures(log)
    pairs = {(name, each.target) for name, shown in log.sightings.items() for _, sightings in shown for each in sightings.found}
    assert {(name, sightings.found[0].target) for _, name, sightings in chosen} == pairs
    assert [time_ns for time_ns, *_ in chosen] == sorted(time_ns for time_ns, *_ in chosen)
    everything = [sightings for shown in log.sightings.values() for _, sightings in shown]
    assert {each.time_ns for *_, each in chosen} <= {each.time_ns for each in everything if each.found and each.jpeg}
    figure = mission_plot.detections(log)
    assert sum(bool(axes.images) for axes in figure.axes) == len(chosen) <= 12


def test_the_film_has_four_times_the_pace_and_is_reproducible(run: Any, log: MissionLog, tmp_path: Any) -> None:
    """Equal pictures give equal files: see the tests of films."""
    moved = motion(run[0].states)
    mission_video.write_video(tmp_path / "film.mp4", log, moved, TARGETS, OUTLINES)
    film = cv2.VideoCapture(str(tmp_path / "film.mp4"))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) / film.get(cv2.CAP_PROP_FPS) == pytest.approx(20.0 / 4.0, abs=0.2)
    pictures, again = ([each.tobytes() for each in mission_video.frames(log, moved, TARGETS, OUTLINES)] for _ in range(2))
    assert pictures == again
    assert len(set(pictures)) > len(pictures) // 2


def test_vehicles_without_pictures_take_no_room_in_the_film(log: MissionLog) -> None:
    (_, sightings), *_ = log.sightings["uav1"]
    white = cv2.imencode(".jpg", np.full((60, 80, 3), 255, np.uint8))[1].tobytes()
    shown = msgspec.structs.replace(sightings, jpeg=white, found=(), width=80, height=60)
    cars = tuple(f"car{number}" for number in range(mission_video.MOST_PICTURES))
    team = MissionLog((*cars, "uav1"), SECOND_NS, sightings={"uav1": [(0, shown)]})
    moved = motion(plainly(team.vehicles, (), 0).states)
    beside = next(mission_video.frames(team, moved, (), ()))[:, mission_video.MAP_PX :]
    assert (beside.min(axis=2) > 200).mean() > 0.05


def test_a_mission_without_pictures_can_be_drawn(tmp_path: Any) -> None:
    moved = motion(plainly(NAMES, (), 0).states)
    for log in (MissionLog((), 0), MissionLog(NAMES, SECOND_NS)):
        style.save_png(mission_plot.mission(log, moved, (), ()), tmp_path / "mission.png")
        style.save_png(mission_plot.mosaic(log, moved, TARGETS), tmp_path / "mosaic.png")
        style.save_png(mission_plot.detections(log), tmp_path / "detections.png")
        mission_video.write_video(tmp_path / "mission.mp4", log, moved, TARGETS, ())


@pytest.mark.parametrize("seconds", [0.0, 0.1, 20.0, 180.0, 180.04, 3600.0])
def test_frames_of_a_film_are_limited(seconds: float) -> None:
    moved = motion(plainly(NAMES, (), 0).states)
    count = sum(1 for _ in mission_video.frames(MissionLog((), round(seconds * SECOND_NS)), moved, (), ()))
    assert 1 <= count <= FRAMES


def test_cells_of_the_map_have_their_place_in_the_film(run: Any) -> None:
    """One sure cell of an otherwise empty map is dark in the film at the cell's centre."""
    probability = np.zeros((CELLS, CELLS), np.uint8)
    probability[15, 4] = 255  # x 8 to 10, y 30 to 32
    seen = frozen(np.ones_like(probability), np.bool_)
    shown = ProbabilityMap(left=0.0, bottom=0.0, cell_m=CELL_M, probability=frozen(probability), seen=seen)
    log = MissionLog(NAMES, SECOND_NS, maps={"uav1": [(-10 * SECOND_NS, shown)]})
    moved = motion(plainly(NAMES, (), 0).states)
    picture = next(mission_video.frames(log, moved, (), ()))[:, : mission_video.MAP_PX].astype(int)
    dark = np.argwhere(picture.sum(axis=2) < 400)
    dark = dark[dark[:, 0] > 40]  # below the clock
    scale = (mission_video.MAP_PX - 2 * mission_video.MARGIN_PX) / (CELLS * CELL_M)
    row, column = dark.mean(axis=0)
    assert column == pytest.approx(mission_video.MARGIN_PX + 9.0 * scale, abs=1.5)
    assert row == pytest.approx(mission_video.MAP_PX - mission_video.MARGIN_PX - 31.0 * scale, abs=1.5)
