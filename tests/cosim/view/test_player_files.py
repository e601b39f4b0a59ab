"""Recordings that are cut, damaged, incomplete, changed, or of gigabytes show their intact part."""

import math
import shutil
import tracemalloc
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.cosim import reconnaissance_recording
from tests.support.cosim.recorded_run import (
    END_NS,
    SENSORS,
    Run,
    assert_same,
    chunk_ends,
    observer_state,
    recording_state,
)
from tests.support.cosim.recordings import TENTH, note, states
from vcmvsp.cosim.agent import AgentInfo
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.federate import Event, RunInfo
from vcmvsp.cosim.recording import mcap_writer
from vcmvsp.cosim.recording.recorder import Recorder
from vcmvsp.cosim.types import Fix, Image, frozen
from vcmvsp.cosim.view.player import mcap_index
from vcmvsp.cosim.view.player.recording import Recording

pytestmark = pytest.mark.slow

NAMES = ("uav1", "uav2")
TIMES = st.integers(0, 5 * SECOND_NS)
SHARES = st.floats(0.0, 1.0, exclude_max=True)  # a place in a file


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A reconnaissance of five seconds; its file has many small chunks."""
    folder = tmp_path_factory.mktemp("mission")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mcap_writer, "CHUNK_BYTES", 4096)
        _, stream = reconnaissance_recording.reconnaissance_recorder(NAMES, 5.0)
    (folder / "run.mcap").write_bytes(stream.getvalue())
    return Run(folder, list(reconnaissance_recording.events(NAMES, 5.0)))


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("scratch")


@contextmanager
def reading(folder: Path, data: bytes) -> Iterator[Recording | None]:
    """A recording of this data; None: it is refused."""
    (folder / "run.mcap").write_bytes(data)
    try:
        recording = Recording(folder)
    except UsageError:
        yield None
        return
    with closing(recording):
        yield recording


def assert_true_contents(recording: Recording, mission: Run, time_ns: int) -> None:
    """The recording shows the true contents at this time; part of the last instant of a cut file may be missing."""
    time_ns = min(time_ns, recording.end_ns - 1)
    assert_same(recording_state(recording.at(time_ns)), observer_state(mission.events, NAMES, time_ns))


@settings(max_examples=30)
@given(TIMES)
def test_maps_and_pictures_are_shown(mission: Run, time_ns: int) -> None:
    with closing(Recording(mission.folder)) as recording:
        assert_true_contents(recording, mission, time_ns)


@settings(max_examples=60)
@given(SHARES, TIMES)
def test_a_cut_file_shows_all_up_to_its_last_whole_chunk(mission: Run, scratch: Path, share: float, time_ns: int) -> None:
    data = (mission.folder / "run.mcap").read_bytes()
    size, ends = int(share * len(data)), chunk_ends(data)
    whole = sum(end <= size for end in ends)
    with reading(scratch, data[:size]) as recording:
        assert (recording is None) == (whole == 0)
        if recording is not None:
            assert_true_contents(recording, mission, time_ns)
            assert recording.ending.startswith("it is truncated") or whole == len(ends)


def test_a_file_shows_more_with_each_chunk_and_reports_its_cut(mission: Run, scratch: Path) -> None:
    data = (mission.folder / "run.mcap").read_bytes()
    goes_to_ns = []
    for end in chunk_ends(data):
        with reading(scratch, data[:end]) as recording:
            assert recording is not None
            goes_to_ns.append(recording.end_ns)
            first, second, *notes = (line.text for line in recording.at(0).lines)
            assert first == f"run.mcap can be read up to {recording.end_ns / SECOND_NS:.3f} s: {recording.ending}"
            assert "scenario.toml is missing" in second
            assert all(text.startswith(tuple(f"{name}: " for name in NAMES)) for text in notes)
    assert goes_to_ns == sorted(goes_to_ns)
    assert goes_to_ns[-1] == 5 * SECOND_NS
    assert len(set(goes_to_ns)) > 5


@settings(max_examples=80)
@given(SHARES, st.integers(0, 7), TIMES)
def test_a_damaged_file_shows_the_truth_up_to_the_damage_or_is_refused(
    mission: Run, scratch: Path, share: float, bit: int, time_ns: int
) -> None:
    data = bytearray((mission.folder / "run.mcap").read_bytes())
    data[int(share * len(data))] ^= 1 << bit
    with reading(scratch, bytes(data)) as recording:
        if recording is not None and recording.end_ns and recording.vehicles == NAMES:  # names have no checksum
            assert_true_contents(recording, mission, time_ns)


@pytest.mark.parametrize("data", [b"", b"\x89MCAP0\r\n", b"PK\x03\x04 something else", bytes(5000)])
def test_foreign_files_are_refused_by_name(scratch: Path, data: bytes) -> None:
    (scratch / "run.mcap").write_bytes(data)
    with pytest.raises(UsageError, match=r"run\.mcap: cannot be read: it "):
        Recording(scratch)


def test_without_its_scenario_a_recording_shows_the_vehicles_alone(run: Run, tmp_path: Path) -> None:
    """Like the recording of a run that continues or was killed."""
    shutil.copy(run.folder / "run.mcap", tmp_path)
    with closing(Recording(tmp_path)) as bare, closing(Recording(run.folder)) as whole:
        assert len(bare.scenery.triangles) == 0
        assert bare.scenery.scenario == whole.scenery.scenario
        for one, other in zip(bare.scenery.vehicles, whole.scenery.vehicles, strict=True):
            assert (one.name, set(one.sensors)) == (other.name, set(other.sensors))
            assert 0.5 * max(other.size) < max(one.size) < 2.0 * max(other.size)  # drawn as its enclosing cylinder
        assert_same(recording_state(bare.at(END_NS, sensors=SENSORS)), recording_state(whole.at(END_NS, sensors=SENSORS)))


@pytest.mark.parametrize(
    "content", ['name = "x"\n[[vehicle]]\nname = "other"\nkind = "p2dx"\n', "name = ", "[world]\nkind = 3\n"]
)
def test_an_unfit_scenario_costs_only_the_world(run: Run, tmp_path: Path, content: str) -> None:
    shutil.copy(run.folder / "run.mcap", tmp_path)
    (tmp_path / "scenario.toml").write_text(content)
    with closing(Recording(tmp_path)) as bare:
        assert len(bare.scenery.triangles) == 0
        assert bare.troubles[0].startswith("the world is not shown: ")
        assert bare.at(0).lines[0].level == "warning"


def test_a_file_that_changes_while_it_is_shown_is_an_error_in_one_line(mission: Run, tmp_path: Path) -> None:
    path = Path(shutil.copy(mission.folder / "run.mcap", tmp_path))
    with closing(Recording(tmp_path)) as recording:
        path.write_bytes(bytes(path.stat().st_size))
        with pytest.raises(UsageError, match=r"run\.mcap: a message of .* is damaged or of another version"):
            recording.at(4 * SECOND_NS)


def recorder(folder: Path, end_ns: int) -> tuple[Recorder, BinaryIO]:
    """Recorder of a run of one vehicle into a folder, and its stream."""
    stream = (folder / "run.mcap").open("wb")
    run = RunInfo(scenario="test", seed=1, duration_ns=end_ns, vehicles=("uav1",))
    agent = AgentInfo(vehicle="uav1", agent="x", ticks=TENTH, latency_ns=0, params={}, known=(), taken=())
    return Recorder(run, record_ticks=TENTH, mcap=stream, agents=[agent], radius_m={}), stream


def test_numbers_without_a_json_form_are_nan(tmp_path: Path) -> None:
    """A vehicle's state, positioning and notes may be infinite."""
    writer, stream = recorder(tmp_path, 0)
    writer.on(states(0, {"uav1": (math.inf, 1.0, 0.0)}))
    writer.on(Event("uav1/fix", 0, Fix(time_ns=0, position=(math.inf, 1.0, 0.0), sigma_m=math.inf)))
    writer.on(note("uav1", 0, error=math.nan, status="lost"))
    writer.close(0)
    stream.close()
    with closing(Recording(tmp_path)) as recording:
        shown = recording.at(0)
    assert shown.states is not None
    np.testing.assert_array_equal(shown.states.position, [[math.nan, 1.0, 0.0]])
    np.testing.assert_array_equal([*shown.fixes["uav1"].position, shown.fixes["uav1"].sigma_m], [math.nan, 1.0, 0.0, math.nan])
    assert math.isnan(float(shown.notes["uav1"]["error"]))
    assert shown.notes["uav1"]["status"] == "lost"


def test_pictures_are_not_kept_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sixty pictures of 300 kB; two fit into the limit of kept bytes."""
    monkeypatch.setattr(mcap_index, "KEPT_BYTES", 1_000_000)
    rng = np.random.default_rng(1)
    pictures = [frozen(rng.integers(0, 255, (250, 400, 3), np.uint8)) for _ in range(60)]
    end_ns = 59 * SECOND_NS // 10
    writer, stream = recorder(tmp_path, end_ns)
    for k, pixels in enumerate(pictures):
        writer.on(Event("uav1/camera", k * SECOND_NS // 10, Image(pixels=pixels)))
    writer.close(end_ns)
    stream.close()
    assert (tmp_path / "run.mcap").stat().st_size > 15_000_000
    tracemalloc.start()
    try:
        with closing(Recording(tmp_path)) as recording:
            for k in (0, 59, *range(60)):
                image = recording.at(k * SECOND_NS // 10, sensors=("uav1/camera",)).images["uav1/camera"]
                assert image.pixels.tobytes() == pictures[k].tobytes()
        assert tracemalloc.get_traced_memory()[1] < 8_000_000
    finally:
        tracemalloc.stop()
