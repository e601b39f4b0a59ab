"""Recorded frames have their recorded outcomes, for all draws; unrecorded frames are drawn as in a run without recording."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.support.netsim.channels import make_channel, play
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.tables.schema import RunFacts, radio_table, write_table
from vcmvsp.cosim.types import FrameReport, Message
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.channel.replayed import RecordedFrames

MS = 1_000_000
NAMES = ("a", "b", "c")
PLACES = np.array([(0.0, 0.0, 0.0), (20.0, 0.0, 0.0), (0.0, 84.0, 0.0)])
LAYERS: dict[str, Any] = {
    "loss": {"kind": "bernoulli", "probability": 0.3},
    "delay": {"kind": "uniform", "from_s": 0.01, "to_s": 0.05},
}
DCF = {"mac": {"kind": "dcf"}}
Sends = Sequence[tuple[int, str, str | None]]  # time, sender, to
SENDS: Sends = [(k * 7 * MS, "abcb"[k % 4], (None, None, "a", None)[k % 4]) for k in range(80)]


def lossy(seed: int = 1, **more: Any) -> Channel:
    return make_channel("wifi-b-1", seed=seed, **LAYERS, **more)


def reports(channel: Channel, sends: Sends, places: np.ndarray = PLACES) -> list[FrameReport]:
    return play(channel, NAMES, places, sends)


def table(found: Sequence[FrameReport]) -> pa.Table:
    return radio_table(found, RunFacts(scenario="test", seed=1, end_ns=10**12, vehicles=NAMES))


def saved(folder: Path, found: Sequence[FrameReport]) -> Path:
    path = folder / "radio.parquet"
    write_table(table(found), path)
    return path


def again(path: Path, seed: int = 2, **more: Any) -> Channel:
    channel = lossy(seed, **more)
    channel.recorded = RecordedFrames(path)
    channel.start(seed)
    return channel


def unknown(channel: Channel) -> int:
    assert channel.recorded is not None
    return channel.recorded.unknown


@pytest.mark.parametrize("mac", [{}, DCF], ids=["ideal", "dcf"])
def test_the_same_frames_fare_the_same_whatever_seed_draws(tmp_path: Path, mac: dict[str, Any]) -> None:
    then = reports(lossy(**mac), SENDS)
    assert {cause for each in then for cause in each.outcome} > {"received", "random loss"}
    drawn, recorded = reports(lossy(2, **mac), SENDS), reports(again(saved(tmp_path, then), **mac), SENDS)
    assert table(drawn) != table(then)
    assert table(recorded).equals(table(then))


COPIES: dict[str, Any] = {"delivery": {"duplicate": 0.5, "duplicate_delay_s": 0.004}}


@pytest.mark.parametrize("more", [{}, COPIES], ids=["plain", "copies"])
def test_a_report_is_the_recorded_one_to_the_last_bit(tmp_path: Path, more: dict[str, Any]) -> None:
    """Also what no table contains: the layers of the run. ``fading`` does not exist here."""
    then = reports(lossy(**more), SENDS)
    assert any(each.copy_ns is not None and each.copy_ns.max() > 0 for each in then) == bool(more)
    for now, before in zip(reports(again(saved(tmp_path, then), **more), SENDS), then, strict=True):
        for name in FrameReport.__struct_fields__:
            replayed, original = getattr(now, name), getattr(before, name)
            assert (replayed is None) == (original is None), name
            np.testing.assert_array_equal(replayed, original)
            assert getattr(replayed, "dtype", None) == getattr(original, "dtype", None), name


def test_the_recorded_delay_counts_from_when_the_frame_is_sent_now(tmp_path: Path) -> None:
    then = reports(lossy(), SENDS)
    later = [(time_ns + 1_234_567, sender, to) for time_ns, sender, to in SENDS]
    now = reports(again(saved(tmp_path, then)), later, PLACES + 1000.0)
    for replayed, original in zip(now, then, strict=True):
        assert replayed.sent_ns == original.sent_ns + 1_234_567
        assert replayed.received_ns.tolist() == [t + 1_234_567 if t >= 0 else -1 for t in original.received_ns.tolist()]
        assert replayed.outcome == original.outcome


def test_unrecorded_frames_are_drawn_as_without_a_recording(tmp_path: Path) -> None:
    """A truncated recording continues as the run would have: frames keep their numbers, and so their draws."""
    whole = reports(lossy(1), SENDS)
    channel = again(saved(tmp_path, whole[:30]), seed=1)
    assert table(reports(channel, SENDS)).equals(table(whole))
    assert unknown(channel) == 50


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(order=st.permutations(range(40)), recorded_count=st.integers(0, 40))
def test_a_frame_is_known_by_its_sender_and_number(tmp_path: Path, order: list[int], recorded_count: int) -> None:
    """The k-th broadcast of each sender has the outcome of its recorded k-th, in whatever order senders take turns."""
    sends = [(k * 50 * MS, "abcb"[k % 4], None) for k in range(40)]
    then = reports(lossy(), sends)[:recorded_count]
    turns = [sends[k][1] for k in order]
    now = reports(again(saved(tmp_path, then)), [(k * 50 * MS, sender, None) for k, sender in enumerate(turns)])
    assert [each.frame for each in now] == list(range(40))
    for name in NAMES:
        before = [each.outcome for each in then if each.sender == name]
        assert [each.outcome for each in now if each.sender == name][: len(before)] == before


def test_a_frame_to_another_receiver_is_drawn(tmp_path: Path) -> None:
    then = reports(lossy(), SENDS)
    path = saved(tmp_path, then)
    redirected = [(time_ns, sender, "b" if to else to) for time_ns, sender, to in SENDS]
    channel = again(path)
    now = reports(channel, redirected)
    assert unknown(channel) == 20  # every fourth
    assert [each.receivers for each in now if each.sender == "c"] == [("b",)] * 20
    assert [each.outcome for each in now if each.sender != "c"] == [each.outcome for each in then if each.sender != "c"]


def test_the_number_of_unrecorded_frames_is_reported_at_the_end(tmp_path: Path) -> None:
    path, lines = saved(tmp_path, reports(lossy(), SENDS)[:77]), list[str]()
    channel = lossy()
    channel.recorded = RecordedFrames(path, lines.append)
    reports(channel, SENDS)
    assert lines == []
    channel.close()
    channel.start(1)
    reports(channel, SENDS[:77])
    channel.close()
    assert lines == ["3 of 80 frames are not in the recording; the radio model decided their reception"]


def test_a_lone_vehicle_has_no_receivers(tmp_path: Path) -> None:
    """A lone vehicle's frames have no receivers, so no recording contains them; none is missing."""
    channel = again(saved(tmp_path, []))
    (report,) = channel.send(0, Message(sender="a", body={}, size_bytes=9), ("a",), PLACES[:1])
    assert (report.receivers, unknown(channel)) == ((), 0)


def test_files_that_are_no_recording_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text.parquet").write_bytes(b"PAR1 and nothing else")
    pq.write_table(pa.table({"frame": [1], "sender": ["a"]}), tmp_path / "other.parquet")  # names are written differently
    problems = {"radio": r"radio\.parquet", "text": "cannot be read", "other": "no column sender, receiver"}
    for name, message in problems.items():
        with pytest.raises(UsageError, match=message):
            RecordedFrames(tmp_path / f"{name}.parquet")
