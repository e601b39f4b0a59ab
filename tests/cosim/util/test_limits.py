"""A legitimate recording, scaled to ten million receptions, is within the limits of readers."""

from pathlib import Path

import pyarrow.parquet as pq
from mcap.reader import make_reader

import vcmvsp
from vcmvsp.cosim.tables.schema import load
from vcmvsp.cosim.util import limits

RECEPTIONS = 10_000_000
TEAM = {
    "name": "team",
    "duration_s": 1.0,
    "radio": {"preset": "ideal"},
    "physics": {"kind": "kinematic"},
    "agents": {
        "kind": "patrol",
        "runs": "inprocess",
        "period_s": 0.1,
        "report_s": 0.1,
        "way": [[5.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
    },
    "vehicles": {"kind": "p2dx"},
    "vehicle": [{"name": f"car{i}", "pose": [0.0, 5.0 * i, 0.0], "agent": {"relative": True}} for i in range(12)],
}


def test_a_recording_of_ten_million_receptions_is_within_the_limits(tmp_path: Path) -> None:
    vcmvsp.run(TEAM, out=tmp_path / "run")
    recording = load(tmp_path / "run")
    times = RECEPTIONS / recording.radio["outcome"].to_pylist().count("received")
    size = times * (tmp_path / "run" / "run.mcap").stat().st_size
    with (tmp_path / "run" / "run.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    unpacked = [chunk.uncompressed_size for chunk in summary.chunk_indexes]
    assert times * summary.statistics.message_count <= max(limits.MESSAGES, size)
    assert times * sum(unpacked) <= max(limits.UNPACKED_BYTES, limits.UNPACKED_RATIO * size)
    assert max(unpacked) <= limits.CHUNK_BYTES
    for name, table in (("states", recording.states), ("radio", recording.radio)):
        with pq.ParquetFile(tmp_path / "run" / f"{name}.parquet") as file:
            groups = [file.metadata.row_group(number) for number in range(file.metadata.num_row_groups)]
        columns = [group.column(number) for group in groups for number in range(group.num_columns)]
        texts = sum(each.total_uncompressed_size for each in columns if each.physical_type == "BYTE_ARRAY")
        assert times * table.num_rows <= limits.ROWS
        assert times * texts <= limits.TABLE_TEXT_BYTES
        assert table.num_columns <= limits.COLUMNS
