"""Traces: values per link and time, rejected files, and large files."""

from bisect import bisect_right
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pyarrow import parquet

from tests.support.netsim.channels import linked_frame
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.netsim.impairments.trace import Trace
from vcmvsp.netsim.interfaces.layers import Frame

MS = 1_000_000
NOISE = -94.0
ROWS = """time_s,sender,receiver,snr_db,loss,delay_s
1.0,car1,car2,20.0,0.0,0.010
1.0,car2,car1,15.0,1.0,0.020
2.0,car1,car3,5.0,0.5,0.030
3.0,car1,car2,10.0,1.0,0.050
3.5,car1,car2,-4.0,0.25,0.000
"""


def frame(at_s: float, sender: str = "car1", receivers: Sequence[str] = ("car2", "car3", "car4")) -> Frame:
    """A frame of 1 ms that begins at this time, sent 2 ms earlier."""
    sent = linked_frame(sender, *receivers, at_s=at_s)
    return msgspec.structs.replace(sent, sent_ns=sent.start_ns - 2 * MS)


def written(folder: Path, text: str = ROWS, name: str = "links.csv") -> str:
    (folder / name).write_text(text, encoding="utf-8")
    return str(folder / name)


def half(count: int = 3) -> Any:
    return lambda: np.full((count, 2), 0.5)


@pytest.mark.parametrize(
    ("at_s", "snr_db", "lost", "delay_ms"),
    [  # to car2 and car3; the file does not name the link to car4
        (0.0, [20.0, 5.0], [False, False], [10, 30]),  # before the first row: the first row
        (1.0, [20.0, 5.0], [False, False], [10, 30]),
        (2.999_999_999, [20.0, 5.0], [False, False], [10, 30]),
        (3.0, [10.0, 5.0], [True, False], [50, 30]),
        (3.5, [-4.0, 5.0], [False, False], [0, 30]),
        (1e9, [-4.0, 5.0], [False, False], [0, 30]),
    ],
)
def test_a_row_holds_until_the_next(
    tmp_path: Path, at_s: float, snr_db: list[float], lost: list[bool], delay_ms: list[int]
) -> None:
    trace, sent = Trace(written(tmp_path), noise_dbm=NOISE), frame(at_s)
    level = trace.level_dbm(sent)
    assert level[:2].tolist() == [snr + NOISE for snr in snr_db]
    assert np.isnan(level[2])
    assert trace.lost(sent, half()).tolist() == [*lost, False]
    assert trace.delay_ns(sent, half()).tolist() == [*(each * MS for each in delay_ms), 0]
    assert trace.traced(sent).tolist() == [True, True, False]


@pytest.mark.parametrize(
    ("at_s", "snr_db", "delay_ms"),
    [
        (0.0, 20.0, 10.0),
        (1.0, 20.0, 10.0),
        (1.5, 17.5, 20.0),
        (3.0, 10.0, 50.0),
        (3.25, 3.0, 25.0),
        (3.5, -4.0, 0.0),
        (7.0, -4.0, 0.0),
    ],
)
def test_straight_lines_between_rows(tmp_path: Path, at_s: float, snr_db: float, delay_ms: float) -> None:
    trace, sent = Trace(written(tmp_path), interpolate=True, noise_dbm=NOISE), frame(at_s)
    assert trace.level_dbm(sent)[:2] == pytest.approx([snr_db + NOISE, 5.0 + NOISE], abs=1e-12)
    assert trace.delay_ns(sent, half())[0] == round(delay_ms * MS)


def test_the_probability_is_that_of_the_row(tmp_path: Path) -> None:
    trace, sent, rng = Trace(written(tmp_path), noise_dbm=NOISE), frame(4.0), np.random.default_rng(1)
    rate = np.mean([trace.lost(sent, lambda: rng.random((3, 2))) for _ in range(20_000)], axis=0)
    assert rate == pytest.approx([0.25, 0.5, 0.0], abs=4.5 * 0.5 / np.sqrt(20_000))


def test_the_two_directions_of_a_link_are_separate(tmp_path: Path) -> None:
    trace = Trace(written(tmp_path), noise_dbm=NOISE)
    assert trace.level_dbm(frame(9.0, "car2", ("car1",))).tolist() == [15.0 + NOISE]
    assert np.isnan(trace.level_dbm(frame(9.0, "car3", ("car1",)))).all()
    assert np.isnan(trace.level_dbm(frame(9.0, "car9", ("car1", "car2")))).all()
    assert trace.level_dbm(frame(9.0, "car1", ())).shape == (0,)


def test_links_missing_in_the_file_are_unchanged(tmp_path: Path) -> None:
    only_loss = Trace(written(tmp_path, "time_s,sender,receiver,loss\n0,a,b,1\n"))
    sent = frame(1.0, "a", ("b", "c"))
    assert np.isnan(only_loss.level_dbm(sent)).all()
    assert only_loss.delay_ns(sent, half(2)).tolist() == [0, 0]
    assert only_loss.lost(sent, half(2)).tolist() == [True, False]
    assert only_loss.columns == ("loss",)
    only_level = Trace(written(tmp_path, "time_s,sender,receiver,rssi_dbm\n0,a,b,-61.5\n"))
    assert only_level.level_dbm(sent)[0] == -61.5  # needs no noise
    assert not only_level.lost(sent, half(2)).any()


def test_a_trace_lists_the_vehicles_it_names(tmp_path: Path) -> None:
    assert Trace(written(tmp_path), noise_dbm=NOISE).names() == ("car1", "car2", "car3")


def test_a_trace_in_parquet_is_that_in_csv(tmp_path: Path) -> None:
    lines = [line.split(",") for line in ROWS.split()]
    columns = {name: [row[k] for row in lines[1:]] for k, name in enumerate(lines[0])}
    typed = {
        name: pa.array(each).dictionary_encode() if name in {"sender", "receiver"} else pa.array([float(x) for x in each])
        for name, each in columns.items()
    }
    parquet.write_table(pa.table(typed), tmp_path / "links.parquet")
    one, other = Trace(written(tmp_path), noise_dbm=NOISE), Trace(str(tmp_path / "links.parquet"), noise_dbm=NOISE)
    for at_s in (0.0, 2.0, 3.2, 4.0):
        assert np.array_equal(one.level_dbm(frame(at_s)), other.level_dbm(frame(at_s)), equal_nan=True)
    assert one.names() == other.names()


rows = st.lists(st.tuples(st.integers(0, 12), st.sampled_from("abc"), st.sampled_from("abc"), st.integers(-50, 50)), min_size=1)


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(rows, st.lists(st.integers(-1, 14), min_size=1), st.booleans())
def test_a_trace_of_many_links_is_that_of_each_link_alone(
    tmp_path: Path, found: list[Any], ask_ms: list[int], interpolate: bool
) -> None:
    """Rows of all links in any order, with repeated times: equal to a list of pairs for each link, searched alone."""
    found.sort(key=lambda row: row[0])
    text = "".join(f"{t / 1000},{sender},{receiver},{level}\n" for t, sender, receiver, level in found)
    trace = Trace(written(tmp_path, "time_s,sender,receiver,rssi_dbm\n" + text), interpolate=interpolate)
    for sender in "abc":
        for at_ms in ask_ms:
            level = trace.level_dbm(frame(at_ms / 1000, sender, "abc"))
            for receiver, got in zip("abc", level.tolist(), strict=True):
                own = [(t, value) for t, a, b, value in found if (a, b) == (sender, receiver)]
                assert got == pytest.approx(by_hand(own, at_ms, interpolate), abs=1e-9, nan_ok=True)


def by_hand(own: list[tuple[int, int]], at: float, interpolate: bool) -> float:
    if not own:
        return float("nan")
    after = bisect_right([t for t, _ in own], at)
    if after == 0 or after == len(own) or not interpolate:
        return own[max(0, after - 1)][1]
    (t0, v0), (t1, v1) = own[after - 1 : after + 1]
    return v0 + (v1 - v0) * (at - t0) / (t1 - t0)


HEAD = "time_s,sender,receiver,loss\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"links.csv cannot be read: Empty CSV file"),
        (HEAD, r"links.csv has no rows"),
        ("time_s,sender,loss\n0,a,1\n", r"links.csv has no column receiver"),
        ("t,sender,receiver,loss\n0,a,b,1\n", r"links.csv has an unknown column 't'.* \(allowed: delay_s, loss, receiver,"),
        ("time_s,sender,receiver,los\n0,a,b,1\n", r"unknown column 'los'; did you mean 'loss'\?"),
        ("time_s,sender,receiver\n0,a,b\n", r"has no quantity of a link: add one or more of the columns snr_db, rssi_dbm"),
        ("time_s,sender,receiver,snr_db,rssi_dbm\n0,a,b,1,1\n", r"has both snr_db and rssi_dbm"),
        ("time_s,sender,receiver,loss,loss\n0,a,b,1,1\n", r"has two columns loss"),
        (HEAD + "0,a,b,0.5\n\n1,a,b,nan\n", r"links.csv line 4: loss must be a number from 0 to 1, not nan"),
        (HEAD + "0,a,b,0.5\n1,a,b,\n", r"links.csv line 3: loss must be a number from 0 to 1, not nan"),
        (HEAD + "0,a,b,0.5\n1,a,b,1.5\n", r"links.csv line 3: loss must be a number from 0 to 1, not 1.5"),
        (HEAD + "inf,a,b,0.5\n", r"links.csv line 2: time_s must be a number from -1e\+09 to 1e\+09, not inf"),
        ("time_s,sender,receiver,delay_s\n0,a,b,-0.1\n", r"line 2: delay_s must be a number from 0 to 1e\+09, not -0.1"),
        (HEAD + "5,a,b,1\n6,a,c,1\n\n5.5,c,a,1\n5.5,a,c,1\n", r"links.csv line 6: time_s goes back from a to c: 5.5 after 6"),
        (HEAD + "0,a,b,much\n", r"cannot be read: In CSV column #3: Row #2: .*invalid value 'much'"),
        (HEAD + "0,a,b\n", r"cannot be read: CSV parse error: Row #2: Expected 4 columns, got 3"),
    ],
)
def test_bad_traces_are_refused_with_their_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ScenarioError, match=message) as raised:
        binding.call(Trace, {"file": written(tmp_path, text)}, key="radio.trace", arguments={"noise_dbm": NOISE})
    assert raised.value.key == "radio.trace.file"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("gone.csv", r"file: there is no file .*gone.csv"),
        ("links.txt", r"file: must be a .csv or .parquet file, not links.txt"),
        ("broken.parquet", r"file: broken.parquet cannot be read"),
        ("links.csv", r"noise_dbm: must be set: the file"),
        ("sender.parquet", r"sender.parquet row 2: sender and receiver must be names"),
        ("receiver.parquet", r"receiver.parquet row 2: sender and receiver must be names"),
        ("loss.parquet", r"loss.parquet column loss must hold numbers"),
    ],
)
def test_errors_of_files(tmp_path: Path, name: str, message: str) -> None:
    rows: dict[str, Any] = {"time_s": [0.0, 0.0], "sender": ["a", "a"], "receiver": ["b", "b"], "loss": [0.0, 0.0]}
    for bad in ("sender", "receiver", "loss"):
        parquet.write_table(pa.table(rows | {bad: ["a", None]}), tmp_path / f"{bad}.parquet")
    for text in ("links.txt", "broken.parquet", "links.csv"):
        written(tmp_path, name=text)
    with pytest.raises(ScenarioError, match=message):
        Trace(str(tmp_path / name))
