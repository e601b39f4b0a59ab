"""``run.mcap`` for foreign readers: conforms to the format, and is readable up to any cut."""

import contextlib
import io
import json
import random
import shutil
from collections.abc import Iterable
from pathlib import Path

import pytest
from mcap import records
from mcap.reader import NonSeekingReader, make_reader

from tests.support.cosim import export_runs, mcap_checks
from tests.support.cosim.export_runs import rerun
from vcmvsp.cosim.assembly.worlds import world_of
from vcmvsp.cosim.recording import foxglove, scene
from vcmvsp.cosim.recording.mcap_reader import about, contents, messages, of_topic
from vcmvsp.cosim.recording.mcap_writer import FRAME, McapLog, schema_of
from vcmvsp.cosim.tables.radio_frames import PATHS
from vcmvsp.cosim.types import FrameReport, Note, Velocity, Waypoint

pytestmark = pytest.mark.processes


def recording(name: str) -> bytes:
    return (export_runs.run_of(name) / "run.mcap").read_bytes()


@pytest.mark.parametrize("name", export_runs.RUNS)
def test_a_recording_conforms_to_the_format(name: str) -> None:
    data = recording(name)
    count = mcap_checks.examine(data)
    through = list(NonSeekingReader(io.BytesIO(data), validate_crcs=True).iter_messages())
    by_index = list(make_reader(io.BytesIO(data), validate_crcs=True).iter_messages())
    assert len(through) == len(by_index) == count > 50
    entries = list(contents(io.BytesIO(data)))
    reference = [(c.topic, s.name, m.log_time, m.data) for s, c, m in through if s is not None]
    assert sorted(entries) == sorted(reference)


def test_damage_anywhere_is_found() -> None:
    """Except damage to the library version and to the header's length, which `mcap_checks` does not check."""
    data = recording("pillar-triangle")
    chance = random.Random(1)
    for place in chance.sample(range(30, len(data) - 8), 40):
        bad = bytearray(data)
        bad[place] ^= 0x10
        with pytest.raises(Exception):  # noqa: B017, PT011  any error of any check
            mcap_checks.examine(bytes(bad))


def test_a_message_that_cannot_be_written_leaves_no_trace() -> None:
    stream = io.BytesIO()
    log = McapLog(stream, {})
    log.write("a/note", 1, Note(values={"x": 1.0}))
    for topic in ("a/note", "b/note"):
        with pytest.raises(TypeError, match="cannot record"):
            log.write(topic, 2, Note(values={"x": 2.0, "y": object()}))  # type: ignore[dict-item]
    log.write("a/note", 3, Note(values={"x": 3.0}))
    log.finish()
    assert mcap_checks.examine(stream.getvalue()) == 2
    entries = [(topic, time_ns, json.loads(data)["values"]) for topic, time_ns, data in messages(io.BytesIO(stream.getvalue()))]
    assert entries == [("a/note", 1, {"x": 1.0}), ("a/note", 3, {"x": 3.0})]


def test_each_message_of_a_topic_has_the_schema_of_its_own_type() -> None:
    """In either order; viewers and exports decode each command by its own type."""
    one, other = Velocity(linear=(1.0, 0.0, 0.0)), Waypoint(position=(1.0, 2.0, 3.0))
    commands = [one, other, Velocity(), Waypoint(position=(0.0, 0.0, 1.0))]
    for sequence in (commands, commands[::-1]):
        stream = io.BytesIO()
        log = McapLog(stream, {})
        for time_ns, command in enumerate(sequence):
            log.write("a/command", time_ns, command)
        log.finish()
        data = stream.getvalue()
        assert mcap_checks.examine(data) == 4
        entries = list(contents(io.BytesIO(data)))
        assert [entry.schema for entry in entries] == [f"vcmvsp.{type(each).__name__}" for each in sequence]
        assert [json.loads(entry.data)["type"] for entry in entries] == [type(each).__name__.lower() for each in sequence]
        through = make_reader(io.BytesIO(data), validate_crcs=True).iter_messages()
        assert [(s and s.name, m.data) for s, _, m in through] == [(entry.schema, entry.data) for entry in entries]


def chunk_ends(data: bytes) -> list[tuple[int, int]]:
    """End of each chunk, byte offset, and number of messages up to it."""
    ends, count = [], 0
    for _, end, each in mcap_checks.read(data[:-8], 8):
        if isinstance(each, records.Chunk):
            ends.append((end, 0))
        elif isinstance(each, records.MessageIndex):
            count += len(each.records)
            ends[-1] = ends[-1][0], count
    return ends


@pytest.mark.parametrize("name", ["recon-team", "lab-patrol"])
def test_a_recording_cut_at_any_byte_is_readable_up_to_its_last_whole_chunk(name: str) -> None:
    data = recording(name)
    ends = chunk_ends(data)
    assert len(ends) >= 3
    whole = [each[1:] for each in messages(io.BytesIO(data))]
    near = [end + off for end, _ in ends for off in (-1, 0, 1)]
    for place in [*random.Random(2).sample(range(1, len(data)), 12), *near]:
        left = max((count for end, count in ends if end <= place), default=0)
        assert until_damage(each[1:] for each in messages(io.BytesIO(data[:place]))) == whole[:left]
        library = NonSeekingReader(io.BytesIO(data[:place]), validate_crcs=True).iter_messages(log_time_order=False)
        assert until_damage((message.log_time, message.data) for _, _, message in library) == whole[:left]


def until_damage(found: Iterable[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
    """Items before the first error; readers raise different exceptions."""
    items: list[tuple[int, bytes]] = []
    with contextlib.suppress(Exception):
        items.extend(found)
    return items


def test_one_topic_by_the_index_and_without_it() -> None:
    data = recording("lab-patrol")
    expected = [(time_ns, content) for topic, time_ns, content in messages(io.BytesIO(data)) if topic == "ugv2/scan"]
    assert len(expected) > 5
    assert list(of_topic(io.BytesIO(data), "ugv2/scan")) == expected
    part = list(of_topic(io.BytesIO(data[: len(data) // 2]), "ugv2/scan"))
    assert 0 < len(part) < len(expected)
    assert part == expected[: len(part)]
    assert about(io.BytesIO(data)) == {"scenario": "lab-patrol", "seed": "1", "vehicles": "ugv1 ugv2 ugv3"}


def test_frames_of_the_radio_are_described_in_the_file_itself() -> None:
    data = recording("pillar-triangle")
    schema = next(s for s, c, _ in make_reader(io.BytesIO(data)).iter_messages(topics=["radio/frame"]) if s is not None)
    published = json.loads(schema.data)
    assert schema.data == schema_of(FrameReport).text
    of_some = {"radio", *PATHS}  # only with several radios or rays
    assert set(published["properties"]) == {"type", *FrameReport.__struct_fields__} - of_some == set(FRAME) - of_some
    assert all(len(node["description"]) > 10 for node in published["properties"].values())
    units = {"_ns": " ns", "_dbm": " dBm", "_db": " dB", "_m": ", m", "_bytes": ", bytes"}
    for name, description in FRAME.items():
        for ending, unit in units.items():
            if name.endswith(ending):
                assert unit in description, name


def test_the_world_is_drawn_once_from_its_own_mesh() -> None:
    found = [json.loads(data) for _, data in of_topic(io.BytesIO(recording("lab-patrol")), "world/solids")]
    assert len(found) == 1
    (entity,) = found[0]["entities"]
    triangles = [part for part in entity["triangles"] if len(part["indices"]) % 3 == 0 and part["points"]]
    assert sum(len(part["indices"]) for part in triangles) == 3 * 3132  # the walls, 15 tables and 30 chairs of the laboratory
    highest = max(point["z"] for part in triangles for point in part["points"])
    assert 2.0 < highest < 4.0
    assert len({tuple(part["color"].values()) for part in triangles}) > 1


def test_a_world_of_too_many_triangles_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    world, _ = world_of("pillar", {})
    assert scene.solids(world) is not None
    monkeypatch.setattr(scene, "MOST_TRIANGLES", len(world.mesh()[1]) - 1)
    assert scene.solids(world) is None


def test_an_obstacle_with_a_time_table_moves_in_a_frame_of_its_own() -> None:
    data = recording("a crossing cart")
    frames = [json.loads(content)["transforms"] for _, content in of_topic(io.BytesIO(data), "world/moving")]
    assert len(frames) == 21
    assert {each["child_frame_id"] for (each,) in frames} == {"obstacle/cart"}
    assert [each["translation"]["y"] for (each,) in frames] == pytest.approx([-1.0 + 0.1 * k for k in range(21)])
    (drawn,) = [json.loads(content) for _, content in of_topic(io.BytesIO(data), "world/solids")]
    cart = drawn["entities"][1]
    assert (cart["frame_id"], cart["cubes"][0]["size"]) == ("obstacle/cart", {"x": 0.6, "y": 0.4, "z": 0.6})


def test_a_calibration_is_recorded_once() -> None:
    data = recording("recon-team")
    (calibration,) = [json.loads(content) for _, content in of_topic(io.BytesIO(data), "uav1/camera/calibration")]
    picture = json.loads(next(of_topic(io.BytesIO(data), "uav1/camera"))[1])
    assert (calibration["width"], calibration["height"]) == (picture["width"], picture["height"])
    focal, _, u, _, same, v, _, _, one = calibration["K"]
    assert focal == same > 100.0
    assert (u, v, one) == (0.5 * (calibration["width"] - 1), 0.5 * (calibration["height"] - 1), 1.0)
    assert schema_of(foxglove.CameraCalibration).name == "foxglove.CameraCalibration"


@pytest.mark.parametrize("name", export_runs.RUNS)
def test_rerun_reads_all_topics_without_errors(name: str, tmp_path: Path) -> None:
    """Rerun decodes Foxglove's schemas in Protobuf only: ours, in JSON, arrive as messages with their schemas."""
    path = tmp_path / "run.mcap"
    shutil.copyfile(export_runs.run_of(name) / "run.mcap", path)
    rows = [line for line in rerun("mcap", "check", "--full", str(path)).splitlines() if line.startswith(("ok", "warn", "err"))]
    summary = make_reader(io.BytesIO(path.read_bytes())).get_summary()
    assert summary is not None
    assert len(rows) == len(summary.channels)
    assert all(row.startswith("ok") for row in rows), rows
