"""Frames kept by a recorder: packed on arrival, they give the table of row after row, in little memory."""

import gc
import tracemalloc
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vcmvsp.cosim.tables import radio_frames
from vcmvsp.cosim.tables.schema import RADIO_SCHEMA, RunFacts, radio_table
from vcmvsp.cosim.types import FrameReport

pytestmark = pytest.mark.slow

NAMES = ("a", "b", "c", "d")
FACTS = RunFacts(scenario="test", seed=1, end_ns=10**9, vehicles=NAMES)
VALUES: dict[str, tuple[Any, ...]] = {  # parts of a link budget
    "copy_ns": (-1, 9),
    "snr_db": (4.5, 8.0),
    "sinr_db": (3.0, np.inf),
    "path_loss_db": (0.0, -0.0),
    "walls": (0, 2),
    "fading_db": (np.nan,),
}


def report(number: int, receivers: tuple[str, ...] = NAMES[1:]) -> FrameReport:
    n = len(receivers)
    return FrameReport(
        frame=number, sender=NAMES[0], sent_ns=5 * number, size_bytes=60 + number % 2, receivers=receivers, queue_ns=number,
        distance_m=np.arange(n) + 0.5 * number, rssi_dbm=np.full(n, -60.0), received_ns=np.arange(n) + 5 * number,
        outcome=("received",) * n,
    )  # fmt: skip


@st.composite
def reports(draw: st.DrawFn) -> list[FrameReport]:
    """Frames with any receivers and outcomes, in any order, with or without parts of the link budget."""
    frames = []
    for number in draw(st.permutations(range(draw(st.integers(0, 12))))):
        receivers = tuple(draw(st.lists(st.sampled_from(NAMES), unique=True)))

        def each(values: tuple[Any, ...], n: int = len(receivers)) -> list[Any]:
            return draw(st.lists(st.sampled_from(values), min_size=n, max_size=n))

        parts = {
            name: np.array(each(values), np.int64 if isinstance(values[0], int) else np.float64)
            for name, values in VALUES.items()
            if draw(st.booleans())
        }
        fates: dict[str, Any] = {
            "sender": draw(st.sampled_from(NAMES)),
            "received_ns": np.array(each((-1, 70, 80)), np.int64),
            "outcome": tuple(each(("received", "random loss", "under way", "collision"))),
            "wall_materials": tuple(each(("", "1 brick", "2 wood"))) if draw(st.booleans()) else None,
        }
        frames.append(msgspec.structs.replace(report(number, receivers), **fates, **parts))
    return frames


def row_by_row(frames: list[FrameReport]) -> Iterator[dict[str, Any]]:
    for each in sorted(frames, key=lambda each: each.frame):
        for i, receiver in enumerate(each.receivers):
            row: dict[str, Any] = {name: getattr(each, name, None) for name in RADIO_SCHEMA.names}
            for name, value in row.items():
                own = value[i] if isinstance(value, np.ndarray | tuple) else value
                row[name] = own.item() if isinstance(own, np.generic) else own
            row |= {name: 0 if dtype is np.int64 else 0.0 for name, dtype in radio_frames.BUDGET.items() if row[name] is None}
            sent_ns, received_ns = row["sent_ns"], row["received_ns"]
            row |= {
                "receiver": receiver,
                "delay_ns": received_ns - sent_ns if received_ns >= 0 else None,
                "received_ns": received_ns if received_ns >= 0 else None,
            }
            row["copy_ns"] = row["copy_ns"] if row["copy_ns"] > 0 else None
            row["sinr_db"] = row["sinr_db"] if np.isfinite(row["sinr_db"]) else None
            yield {**row, "wall_materials": row["wall_materials"] or ""}


@settings(max_examples=50)
@given(reports())
def test_the_table_is_as_made_row_by_row(frames: list[FrameReport]) -> None:
    assert repr(radio_table(frames, FACTS).to_pylist()) == repr(list(row_by_row(frames)))


def test_paths_are_columns_if_a_channel_reports_them() -> None:
    delay_ns = np.array([3.5, 4.0, 1e3])
    known = msgspec.structs.replace(report(1), path_delay_ns=delay_ns, delay_spread_ns=0.1 * delay_ns)
    table = radio_table([report(0), known], FACTS)
    assert table.schema.names == [*RADIO_SCHEMA.names, *radio_frames.PATHS]
    assert table["path_delay_ns"].to_pylist() == [None, None, None, *delay_ns.tolist()]
    assert table["delay_spread_ns"].to_pylist()[3:] == (0.1 * delay_ns).tolist()


@settings(max_examples=40)
@given(reports(), st.sampled_from((1, 3, 7)))
def test_the_size_of_chunks_changes_no_byte(frames: list[FrameReport], rows: int) -> None:
    streams = []
    for size in (radio_frames.CHUNK_ROWS, rows):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(radio_frames, "CHUNK_ROWS", size)
            table, sink = radio_table(frames, FACTS), pa.BufferOutputStream()
            with pa.ipc.new_stream(sink, table.schema) as writer:
                writer.write_table(table)
            streams.append(sink.getvalue().to_pybytes())
    assert streams[0] == streams[1]


@pytest.mark.parametrize(("receivers", "most"), [(NAMES[1:], 60_000 * 50), ((), 20_000 * 100)])
def test_frames_are_kept_as_numbers_only(receivers: tuple[str, ...], most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 20,000 frames to three receivers each, or to none: the columns that differ from row to row, and no objects."""
    monkeypatch.setattr(radio_frames, "CHUNK_ROWS", 3000)
    frames = radio_frames.Frames(NAMES)
    tracemalloc.start()
    try:
        frames.extend(report(number, receivers) for number in range(20_000))
        gc.collect()
        memory_bytes, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(frames.columns()["frame"]) == 20_000 * len(receivers)
    assert memory_bytes < most
