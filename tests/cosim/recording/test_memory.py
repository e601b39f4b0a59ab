"""Memory per reception: little during the run, and limited while its metrics are computed."""

import gc
import io
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest

import vcmvsp
from tests.support.cosim.recordings import TENTH, follows, recorder_after, states
from vcmvsp.cosim.agent import AgentInfo
from vcmvsp.cosim.analysis.links import links_of
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.federate import Event, RunInfo
from vcmvsp.cosim.metrics import age
from vcmvsp.cosim.recording.recorder import Recorder
from vcmvsp.cosim.tables import radio_frames, schema
from vcmvsp.cosim.tables.spool import Spool
from vcmvsp.cosim.types import FrameReport

pytestmark = pytest.mark.slow

NAMES = tuple(f"car{number}" for number in range(20))
HELD_BYTES, PEAK_BYTES = 10, 40  # per reception: during the run, and until metrics are computed


def reports(rounds: int) -> Iterator[FrameReport]:
    """In each round every vehicle broadcasts to all others; values differ from reception to reception."""
    rng = np.random.default_rng(1)
    others = {name: tuple(other for other in NAMES if other != name) for name in NAMES}
    for number in range(rounds * len(NAMES)):
        sent_ns, noise = number * 10**6, rng.uniform(size=(4, len(NAMES) - 1))
        numbers = {name: -90.0 + noise[row] for row, name in enumerate(("rssi_dbm", "snr_db", "path_loss_db"))}
        name = NAMES[number % len(NAMES)]
        yield FrameReport(
            frame=number ^ 1, sender=name, sent_ns=sent_ns, size_bytes=60, receivers=others[name], outcome=("received",) * 19,
            distance_m=noise[3], received_ns=sent_ns + (1e6 * noise[3]).astype(np.int64), air_time_ns=900, **numbers,
        )  # fmt: skip


def memory(rounds: int, folder: Path) -> tuple[int, int, int]:
    """Receptions, bytes held at the end of the run, and peak bytes until metrics and files are written."""
    end_ns = rounds * len(NAMES) * 10**6 + SECOND_NS
    agents = [AgentInfo(vehicle=name, agent="x", ticks=TENTH, latency_ns=0, params={}, known=(), taken=()) for name in NAMES]
    run = RunInfo(scenario="test", seed=3, duration_ns=end_ns, vehicles=NAMES)
    gc.collect()
    before, _ = tracemalloc.get_traced_memory()
    recorder = Recorder(run, record_ticks=TENTH, mcap=None, agents=agents, radius_m={}, folder=folder)
    for report in reports(rounds):
        recorder.on(Event("radio/frame", report.sent_ns, report))
    recorder.close(end_ns)
    gc.collect()
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.reset_peak()
    recorder.metrics(window=(0.0, None))
    recorder.write_tables(folder)
    _, peak = tracemalloc.get_traced_memory()
    return recorder.tables[1].num_rows, held - before, peak - before


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """All tables in small portions: a long run has many."""
    monkeypatch.setattr(radio_frames, "CHUNK_ROWS", 1 << 11)
    monkeypatch.setattr(radio_frames, "SORTED_ROWS", 1 << 11)
    monkeypatch.setattr("vcmvsp.cosim.tables.spool.MEMORY_BYTES", 1 << 12)
    monkeypatch.setattr(schema, "PART_ROWS", 1 << 10)
    monkeypatch.setattr(schema, "ROW_GROUP", 1 << 12)
    monkeypatch.setattr(age, "AT_ONCE", 1 << 10)


@pytest.mark.usefixtures("small")
def test_receptions_stay_out_of_memory(tmp_path: Path) -> None:
    tracemalloc.start()
    try:
        memory(50, tmp_path)  # one-time allocations of the process
        few, many = memory(50, tmp_path), memory(150, tmp_path)
    finally:
        tracemalloc.stop()
    rows, held, peak = (more - less for more, less in zip(many, few, strict=True))
    assert rows == 100 * 20 * 19
    assert held <= HELD_BYTES * rows
    assert peak <= PEAK_BYTES * rows


def some_events() -> list[Event]:
    """Frames out of order and lost, and vehicles that drive and follow."""
    events = [follows("car1", "car0", (0.0, 0.0), 0.1), follows("car2", "car1", (0.0, 0.0), 0.1)]
    for number, report in enumerate(reports(5)):
        lost = np.arange(19) % 7 == number % 3
        outcome = tuple("fading" if each else "received" for each in lost)
        changed = {"outcome": outcome, "received_ns": np.where(lost, -1, report.received_ns + 10**8 * (number % 4))}
        events.append(Event("radio/frame", report.sent_ns, msgspec.structs.replace(report, **changed)))
    return events + [states(TENTH.at(k), {name: (0.1 * k, float(i), 0.0) for i, name in enumerate(NAMES)}) for k in range(4)]


@pytest.mark.parametrize("followed", [True, False])
def test_portions_change_no_number(followed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Metrics, digest, links and files, of tables in one piece and of tables in many."""
    events = some_events()[0 if followed else 2 :]
    found: list[dict[str, Any]] = []
    for rows in (1 << 17, 64, 8):
        monkeypatch.setattr(schema, "PART_ROWS", rows)
        monkeypatch.setattr(schema, "ROW_GROUP", 512)
        monkeypatch.setattr(age, "AT_ONCE", rows)
        monkeypatch.setattr(radio_frames, "CHUNK_ROWS", 8 * rows)
        monkeypatch.setattr(radio_frames, "SORTED_ROWS", rows)
        recorder = recorder_after(NAMES, events, SECOND_NS // 4)
        files = [io.BytesIO(), io.BytesIO()]
        tables: tuple[schema.Table, ...] = recorder.tables if rows < 512 else (recorder.states, recorder.radio)
        for table, file in zip(tables, files, strict=True):
            schema.write_table(table, file)
        metrics = recorder.metrics(window=(0.02, 0.2))
        assert recorder.radio.num_rows == pq.read_metadata(files[1]).num_rows == 1900
        links = links_of(tables[1], NAMES)
        counted = [links.sent, links.received, links.under_way, links.level_dbm, links.frames, *links.losses.values()]
        bits = [each.tobytes() for each in counted]
        found.append({"metrics": metrics, "links": bits, "files": [file.getvalue() for file in files]})
    assert found[0] == found[1] == found[2]
    assert found[0]["metrics"]["radio"]["under_way"] > 0
    assert found[0]["metrics"]["radio"]["age_s"]["mean"] is not None


@pytest.mark.processes
def test_a_disk_that_is_full_ends_the_run_with_one_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(radio_frames, "CHUNK_ROWS", 8)
    monkeypatch.setattr(Spool, "append", full)
    with pytest.raises(UsageError, match=r"cannot write into .*run: No space left on device"):
        vcmvsp.run("formation-circle", set={"duration_s": 2.0}, out=tmp_path / "run")
    assert (tmp_path / "run" / "run.mcap").stat().st_size > 0
