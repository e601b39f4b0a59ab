"""Files of a run: an MCAP file for viewers, Parquet tables and figures; equal bytes every time."""

import inspect
import io
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import matplotlib as mpl
import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mcap.reader import make_reader

from tests.support.cosim.recordings import follows, states
from tests.support.cosim.recordings import recorder_after as plainly
from vcmvsp.cosim import types
from vcmvsp.cosim.agent import AgentInfo
from vcmvsp.cosim.clock import SECOND_NS, Ticks
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.federate import Event, RunInfo
from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.plots import run_plots
from vcmvsp.cosim.plots.style import save_png
from vcmvsp.cosim.received import receptions_at
from vcmvsp.cosim.recording.mcap_writer import schema_of
from vcmvsp.cosim.recording.recorder import Recorder
from vcmvsp.cosim.tables.schema import RADIO_SCHEMA, STATES_SCHEMA, load, write_table
from vcmvsp.cosim.types import RECEPTIONS, Reception, frozen

pytestmark = pytest.mark.slow

NAMES = ("car1", "car2")
TENTH = Ticks.every(0.1)
BODY = {"x": 1.5, "seq": 7, "list": [1, 2], "words": "hello"}


def events(seconds: float = 1.0) -> Iterator[Event]:
    """Two vehicles on a straight line, with one event of every kind at every tick of 20 Hz."""
    for k in range(round(seconds * 20) + 1):
        t, x = k * SECOND_NS // 20, 0.3 * k / 20
        position = frozen([(x, 0.0, 0.0), (x - 1.0 - 0.5 * math.exp(-x), 0.5, 0.0)])
        velocity = frozen([(0.3, 0.0, 0.0)] * 2)
        attitude, rates = frozen([quaternion_from_yaw(0.1)] * 2), frozen([(0.0, 0.0, 0.01)] * 2)
        for name, row in zip(NAMES, position.tolist(), strict=True):
            believed = (row[0], row[1] + (0.02 if name == "car2" else 0.0), row[2])
            turn: dict[str, Any] = {"attitude": quaternion_from_yaw(0.1), "angular_velocity": (0.0, 0.0, 0.01)}
            yield Event(f"{name}/estimate", t, types.VehicleState(position=believed, velocity=(0.3, 0.0, 0.0), **turn))
            yield Event(f"{name}/odometry", t, types.Odometry(pose=(x, 0.0, 0.1), v=0.3, w=0.01))
            yield Event(f"{name}/fix", t, types.Fix(time_ns=t, position=believed, yaw=0.1, sigma_m=0.15, sigma_rad=0.05))
        truth = types.States(names=NAMES, position=position, velocity=velocity, attitude=attitude, angular_velocity=rates)
        yield Event("world/states", t, truth)
        yield Event("car1/imu", t, types.Imu(acceleration=(0.0, 0.0, 9.81), angular_velocity=(0.0, 0.0, 0.01)))
        ranges = frozen([1.0, math.inf, 2.0], np.float32)
        yield Event("car1/scan", t, types.Scan(ranges=ranges, angle_min=-1.0, angle_step=1.0, range_max=6.0))
        if k == 0:
            yield Event("car2/follows", t, types.Follows(leader="car1", slot=(-1.0, 0.5), handle_m=0.3))
            yield Event("car1/camera", t, types.Image(pixels=frozen(np.arange(24).reshape(2, 4, 3), np.uint8)))
        yield Event("car1/command", t, types.Velocity(linear=(0.3, 0.0, 0.0), yaw_rate=0.01))
        yield Event("car2/note", t, types.Note(values={"z1": np.float64(0.1 * k), "status": "ok"}))
        message = types.Message(sender="car1", body=BODY, size_bytes=60)
        yield Event("car1/send", t, message)
        yield Event("car2/send", t, types.Message(sender="car2", body=b"\x00\xff", size_bytes=2, to="car1"))
        lost = k % 4 == 3
        report = types.FrameReport(
            frame=k, sender="car1", sent_ns=t, size_bytes=60, receivers=("car2",),
            distance_m=frozen([1.1]), rssi_dbm=frozen([-50.0]), received_ns=frozen([-1 if lost else t + 1000], np.int64),
            outcome=("fading" if lost else "received",), air_time_ns=900, queue_ns=60, access_ns=40,
            snr_db=frozen([40.0]), sinr_db=frozen([39.0]), path_loss_db=frozen([50.0]), walls=frozen([2], np.int64),
            wall_materials=("2 brick",), wall_loss_db=frozen([7.0]), shadowing_db=frozen([1.5]), fading_db=frozen([-0.5]),
        )  # fmt: skip
        yield Event("radio/frame", t, report)
        if not lost:
            reception = Reception(message=message, rssi_dbm=-50.0, sent_ns=t, received_ns=t + 1000)
            yield Event(RECEPTIONS, t, receptions_at("car2", [reception], NAMES))
    yield Event("world/contact", t + 1000, types.Contact(vehicle="car1", other=None))


def closed_recorder(mcap: BinaryIO | None, seconds: float = 1.0) -> Recorder:
    """A closed recorder of ``events``."""
    run = RunInfo(scenario="files", seed=5, duration_ns=round(seconds * SECOND_NS), vehicles=NAMES)
    agents = [AgentInfo(vehicle=name, agent="x", ticks=TENTH, latency_ns=0, params={}, known=(), taken=()) for name in NAMES]
    recorder = Recorder(run, record_ticks=TENTH, mcap=mcap, agents=agents, radius_m={"car1": 0.25}, heard=True)
    for event in events(seconds):
        recorder.on(event)
    recorder.log("error", "car2 ran into the wall", run.duration_ns + 1000)
    recorder.close(run.duration_ns)
    return recorder


@pytest.fixture(scope="module")
def recording() -> dict[str, list[tuple[int, Any, Any, str]]]:
    stream = io.BytesIO()
    closed_recorder(stream)
    return json_recording(stream.getvalue())


def json_recording(content: bytes) -> dict[str, list[tuple[int, Any, Any, str]]]:
    """Time, message, schema and schema name of every message, by topic."""
    found: dict[str, list[tuple[int, Any, Any, str]]] = {}
    for schema, channel, message in make_reader(io.BytesIO(content), validate_crcs=True).iter_messages():
        assert schema is not None
        assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
        assert message.publish_time == message.log_time
        row = message.log_time, json.loads(message.data), json.loads(schema.data), schema.name
        found.setdefault(channel.topic, []).append(row)
    return found


def test_every_topic_has_its_schema(recording: dict[str, Any]) -> None:
    assert {topic: rows[0][3] for topic, rows in recording.items()} == {
        "/tf": "foxglove.FrameTransforms",
        "car1/camera": "foxglove.RawImage",
        "car1/command": "vcmvsp.Velocity",
        "car1/fix": "foxglove.PoseInFrame",
        "car1/imu": "vcmvsp.Imu",
        "car1/odometry": "vcmvsp.Odometry",
        "car1/scan": "foxglove.LaserScan",
        "car1/send": "vcmvsp.Message",
        "car1/state": "vcmvsp.VehicleState",
        "car2/estimate": "vcmvsp.VehicleState",  # car1's estimate is the truth and is left out
        "car2/fix": "foxglove.PoseInFrame",
        "car2/follows": "vcmvsp.Follows",
        "car2/heard": "vcmvsp.Heard",
        "car2/note": "vcmvsp.Note",
        "car2/odometry": "vcmvsp.Odometry",
        "car2/send": "vcmvsp.Message",
        "car2/state": "vcmvsp.VehicleState",
        "log": "foxglove.Log",
        "radio/frame": "vcmvsp.Frame",
        "world/contact": "vcmvsp.Contact",
        "world/scene": "foxglove.SceneUpdate",
    }


def check(value: Any, schema: dict[str, Any]) -> None:
    """Check types and required fields, as a reader of simple JSON Schemas does."""
    kinds: Any = {"object": dict, "array": list, "string": str, "boolean": bool, "integer": int, "number": (int, float)}
    assert isinstance(value, kinds[schema["type"]]), (value, schema)
    if schema["type"] == "object":
        assert set(schema["required"]) <= set(value)
        for name, part in schema["properties"].items():
            if name in schema["required"]:
                check(value[name], part)
    if schema["type"] == "array":
        for item in value:
            if item is not None:  # JSON has no infinity: a beam without return is null
                check(item, schema["items"])
    assert value in schema.get("enum", [value])


def test_messages_are_valid_against_their_schemas(recording: dict[str, Any]) -> None:
    for rows in recording.values():
        for _, message, schema, name in rows:
            assert schema["title"] == name
            check(message, schema)


VALUES: list[Any] = [value for value in list(vars(types).values()) if inspect.isclass(value) and issubclass(value, types.Value)]


def nodes(schema: dict[str, Any]) -> Iterator[dict[str, Any]]:
    yield schema
    for part in [*schema.get("properties", {}).values(), *([schema["items"]] if "items" in schema else [])]:
        yield from nodes(part)


@pytest.mark.parametrize("message_type", VALUES)
def test_schemas_suit_a_reader_without_references_unions_and_tuples(message_type: type) -> None:
    for node in nodes(json.loads(schema_of(message_type).text)):
        assert isinstance(node["type"], str)
        assert ("properties" in node) == (node["type"] == "object")
        assert ("items" in node) == (node["type"] == "array")
        assert not {"$ref", "anyOf", "oneOf", "prefixItems"} & set(node)


def test_true_states_appear_as_transforms_and_per_vehicle(recording: dict[str, Any]) -> None:
    ticks = [TENTH.at(k) for k in range(11)]
    assert [row[0] for row in recording["/tf"]] == [row[0] for row in recording["car2/state"]] == ticks
    for (_, tf, *_), (time, state, *_) in zip(recording["/tf"], recording["car2/state"], strict=True):
        transform = tf["transforms"][1]
        assert (transform["parent_frame_id"], transform["child_frame_id"]) == ("world", "car2")
        assert transform["timestamp"] == {"sec": time // SECOND_NS, "nsec": time % SECOND_NS}
        assert [transform["translation"][axis] for axis in "xyz"] == state["position"]
        assert [transform["rotation"][axis] for axis in "wxyz"] == state["attitude"]


def test_values_come_back_from_the_recording_as_they_were(recording: dict[str, Any]) -> None:
    sent: dict[str, list[Any]] = {}
    for event in events():
        sent.setdefault(event.key, []).append(event.value)
    topics = ("command", "odometry", "send"), ("send", "estimate", "follows")
    for key in (*(f"car1/{name}" for name in topics[0]), *(f"car2/{name}" for name in topics[1]), "world/contact"):
        back = [msgspec.convert(message, type(sent[key][0])) for _, message, *_ in recording[key]]
        assert back == sent[key]


def test_messages_are_recorded_at_the_tick_at_which_the_agent_gets_them(recording: dict[str, Any]) -> None:
    sent_ns = [event.time_ns for event in events() if event.key == RECEPTIONS]
    by_tick = {time_ns: [each["sent_ns"] for each in message["receptions"]] for time_ns, message, *_ in recording["car2/heard"]}
    assert [each for own in by_tick.values() for each in own] == [each for each in sent_ns if each + 1000 < SECOND_NS]
    assert all(0 < tick - each <= SECOND_NS // 10 for tick, own in by_tick.items() for each in own)
    assert all(tick % (SECOND_NS // 10) == 0 for tick in by_tick)


def test_scene_contains_each_vehicle_and_each_slot_once(recording: dict[str, Any]) -> None:
    ((time, scene, *_),) = recording["world/scene"]
    assert time == 0
    entities = {entity["id"]: entity for entity in scene["entities"]}
    assert set(entities) == {"car1", "car2", "car2/place"}
    assert all(e["frame_locked"] and e["lifetime"] == {"sec": 0, "nsec": 0} for e in entities.values())
    assert entities["car1"]["cylinders"][0]["size"]["x"] == pytest.approx(0.5)
    assert entities["car2/place"]["frame_id"] == "car1"
    assert entities["car2/place"]["lines"][0]["points"][1] == {"x": -1.0, "y": 0.5, "z": 0.0}
    assert scene["deletions"] == [{"timestamp": entities["car1"]["timestamp"], "type": 1, "id": ""}]  # of the earlier scene


def test_readings_are_drawn_by_viewers(recording: dict[str, Any]) -> None:
    scan = recording["car1/scan"][0][1]
    assert (scan["start_angle"], scan["end_angle"], scan["ranges"]) == (-1.0, 1.0, [1.0, None, 2.0])
    image = recording["car1/camera"][0][1]
    assert (image["width"], image["height"], image["step"], image["encoding"]) == (4, 2, 12, "rgb8")
    fix = recording["car2/fix"][1][1]
    assert fix["timestamp"] == {"sec": 0, "nsec": 50_000_000}
    assert fix["pose"]["orientation"]["w"] == pytest.approx(math.cos(0.05))


def test_log_names_the_cause_of_the_end(recording: dict[str, Any]) -> None:
    _, line, *_ = recording["log"][-1]
    assert (line["level"], line["message"]) == (4, "car2 ran into the wall")


def test_close_may_be_called_again() -> None:
    stream = io.BytesIO()
    recorder = closed_recorder(stream)
    size = len(stream.getvalue())
    recorder.close(0)
    assert len(stream.getvalue()) == size
    assert recorder.metrics(window=(0.0, None))["duration_s"] == 1.0


def test_equal_runs_leave_equal_bytes_and_no_library_version(tmp_path: Path) -> None:
    runs: list[dict[str, Any]] = []
    for name in ("one", "two"):
        folder, stream = tmp_path / name, io.BytesIO()
        folder.mkdir()
        recorder = closed_recorder(stream)
        recorder.write_tables(folder)
        states, placed = recorder.states, recorder.follows
        save_png(run_plots.trajectory(states, placed), folder / "t.png")
        save_png(run_plots.formation_error(states, recorder.radio, placed, window=(0.5, None)), folder / "e.png")
        files = {path.name: path.read_bytes() for path in folder.iterdir()}
        runs.append({**files, "run.mcap": stream.getvalue(), "metrics": recorder.metrics(window=(0.0, None))})
    assert runs[0] == runs[1]
    assert len(runs[0]) == 7
    assert make_reader(io.BytesIO(runs[0]["run.mcap"])).get_header().library == "vcmvsp"
    assert b"matplotlib" not in runs[0]["t.png"]


@pytest.mark.parametrize(("greatest_m", "scale"), [(1e-9, "linear"), (1e-5, "log"), (1.0, "log")])
def test_rounding_errors_have_a_linear_axis(greatest_m: float, scale: str) -> None:
    errors = np.geomspace(1e-6, 1.0, 50) * greatest_m
    events = [states(k * SECOND_NS // 10, {"a": (0.0, 0.0, 0.0), "b": (-1.0 - e, 0.0, 0.0)}) for k, e in enumerate(errors)]
    recorder = plainly("ab", [follows("b", "a", (-1.0, 0.0), 0.1), *events], 5 * SECOND_NS)
    axes = run_plots.formation_error(recorder.states, recorder.radio, recorder.follows).axes[0]
    low, high = axes.get_ylim()
    assert axes.get_yscale() == scale
    assert low < greatest_m < high


def test_recording_tables_alone_gives_the_same_tables() -> None:
    with_file, without = closed_recorder(io.BytesIO()), closed_recorder(None)
    assert with_file.states.equals(without.states)
    assert with_file.metrics(window=(0.0, None)) == without.metrics(window=(0.0, None))


def test_tables_have_their_schema_and_values() -> None:
    recorder = closed_recorder(None)
    assert recorder.states.schema.equals(STATES_SCHEMA)
    assert recorder.radio.schema.equals(RADIO_SCHEMA)
    assert recorder.states.num_rows == 11 * 2
    row = recorder.states.slice(3, 1).to_pylist()[0]
    w, _, _, z = quaternion_from_yaw(0.1)
    assert (row["time_ns"], row["vehicle"], row["y"], row["qw"], row["qz"]) == (10**8, "car2", 0.5, w, z)
    assert (row["x"], row["vx"], row["wz"]) == (0.03 - 1.0 - 0.5 * math.exp(-0.03), 0.3, 0.01)
    got, lost = recorder.radio.slice(2, 2).to_pylist()
    assert got == {
        "frame": 2, "sender": "car1", "receiver": "car2", "sent_ns": 10**8, "received_ns": 10**8 + 1000, "size_bytes": 60,
        "distance_m": 1.1, "rssi_dbm": -50.0, "outcome": "received", "delay_ns": 1000, "copy_ns": None,
        "snr_db": 40.0, "sinr_db": 39.0, "path_loss_db": 50.0, "walls": 2, "wall_materials": "2 brick", "wall_loss_db": 7.0,
        "shadowing_db": 1.5, "fading_db": -0.5, "air_time_ns": 900, "queue_ns": 60, "access_ns": 40,
    }  # fmt: skip
    assert (lost["received_ns"], lost["delay_ns"], lost["outcome"]) == (None, None, "fading")


def test_run_directory_comes_back_as_it_was(tmp_path: Path) -> None:
    recorder = closed_recorder(None)
    recorder.write_tables(tmp_path)
    metrics = recorder.metrics(window=(0.0, None))
    (tmp_path / "metrics.json").write_text(json.dumps(metrics))
    run = load(tmp_path)
    assert run.states.equals(recorder.states)
    assert run.radio.equals(recorder.radio)
    assert (run.follows, run.metrics) == (recorder.follows, metrics)
    assert (run.facts.scenario, run.facts.seed, run.facts.vehicles, run.facts.end_ns) == ("files", 5, NAMES, SECOND_NS)


def test_a_directory_that_is_no_run_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no states\.parquet"):
        load(tmp_path)
    closed_recorder(None).write_tables(tmp_path)
    write_table(pq.read_table(tmp_path / "states.parquet").replace_schema_metadata(None), tmp_path / "states.parquet")
    with pytest.raises(UsageError, match="not written by vcmvsp"):
        load(tmp_path)


def colours(figure: Figure) -> int:
    """Number of different pixel colours of a figure."""
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    return len(np.unique(np.asarray(canvas.buffer_rgba()).reshape(-1, 4), axis=0))


def test_trajectory_draws_the_recorded_positions() -> None:
    run = closed_recorder(None)
    axes = run_plots.trajectory(run.states, run.follows).axes[0]
    drawn = {line.get_label(): np.asarray(line.get_xydata()) for line in axes.lines}
    for i, name in enumerate(NAMES):
        np.testing.assert_array_equal(drawn[name], np.column_stack([run.states[axis].to_numpy()[i::2] for axis in "xy"]))
    assert axes.get_aspect() == 1.0


def test_figures_ignore_the_users_style(tmp_path: Path) -> None:
    run = closed_recorder(None)
    save_png(run_plots.trajectory(run.states, run.follows), tmp_path / "plain.png")
    with mpl.rc_context({"axes.facecolor": "red", "font.size": 20, "savefig.dpi": 30}):
        save_png(run_plots.trajectory(run.states, run.follows), tmp_path / "styled.png")
        assert mpl.rcParams["font.size"] == 20
    assert (tmp_path / "plain.png").read_bytes() == (tmp_path / "styled.png").read_bytes()


def test_figures_of_an_empty_run_do_not_fail() -> None:
    run = RunInfo(scenario="empty", seed=0, duration_ns=0, vehicles=NAMES)
    recorder = Recorder(run, record_ticks=TENTH, mcap=None, agents=[], radius_m={})
    recorder.close(0)
    error = run_plots.formation_error(recorder.states, recorder.radio, (), window=(0.0, None))
    assert min(map(colours, (run_plots.trajectory(recorder.states), error))) > 10
    assert recorder.metrics(window=(0.0, None))["formation"]["rms_m"] is None
