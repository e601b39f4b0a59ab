"""Small files that unpack to gigabytes, or are nested a hundred thousand deep; each is written in a second or two."""

import io
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.writer import MCAP0_MAGIC

DEEP, ROWS, LARGE = 100_000, 100_000_000, 10_000_000_000
_STEP = 1 << 20


def rows(path: Path, like: Path, count: int = ROWS) -> None:
    """A run's table with at least this many equal rows: its footer lists the same row group again and again."""
    table = pq.read_table(like)
    pq.write_table(table.take(np.zeros(_STEP, np.int64)), path, compression="zstd")
    about, one = pq.read_metadata(path), pq.read_metadata(path)
    while about.num_rows < count:
        about.append_row_groups(one)
    end = io.BytesIO()
    about.write_metadata_file(end)
    path.write_bytes(path.read_bytes()[: -one.serialized_size - 8] + end.getvalue()[len(b"PAR1") :])


def long_text(path: Path, like: Path) -> None:
    """A run's table in which all rows contain the same word of a hundred megabytes."""
    table = pq.read_table(like)
    words = pa.array(["x" * 100_000_000]).take(np.zeros(1, np.int64))
    long = pa.DictionaryArray.from_arrays(np.zeros(table.num_rows, np.int32), words)
    table = table.set_column(table.column_names.index("sender"), "sender", long)
    pq.write_table(table, path, compression="zstd", store_schema=False)


def recording(path: Path, chunks: Iterator[bytes], vehicles: str, seed: str = "1") -> None:
    """A recording of these chunks, without an index."""
    codec = pa.Codec("zstd")
    metadata = {"scenario": "bomb", "seed": seed, "vehicles": vehicles}
    with path.open("wb") as stream:
        stream.write(MCAP0_MAGIC + _bytes(records.Header(profile="", library="")))
        stream.write(_bytes(records.Metadata(name="vcmvsp", metadata=metadata)))
        packed: dict[int, tuple[bytes, int]] = {}
        for data in chunks:
            if id(data) not in packed:
                packed = {id(data): (codec.compress(data, asbytes=True), zlib.crc32(data))}
            content, crc = packed[id(data)]
            times = {"message_start_time": 0, "message_end_time": 0}
            sizes = {"uncompressed_crc": crc, "uncompressed_size": len(data)}
            chunk = records.Chunk(compression="zstd", data=content, **times, **sizes)
            stream.write(_bytes(chunk))


def zeros(size: int = LARGE, part: int = 50_000_000) -> Iterator[bytes]:
    """Chunks of one long message each."""
    data = message(bytes(part))
    yield head("log", "x") + message(b"{}")
    for _ in range(size // part):
        yield data


def many(count: int = ROWS, part: int = 1_000_000) -> Iterator[bytes]:
    """Chunks of empty messages."""
    data = message(b"") * part
    yield head("car1/note", "x")
    for _ in range(count // part):
        yield data


def one(topic: str, schema: str, data: bytes) -> Iterator[bytes]:
    """A chunk with one message."""
    yield head(topic, schema) + message(data)


def head(topic: str, schema: str) -> bytes:
    """Declaration of channel 1."""
    kind = records.Schema(id=1, name=schema, encoding="jsonschema", data=b"{}")
    return _bytes(kind) + _bytes(records.Channel(id=1, topic=topic, message_encoding="json", metadata={}, schema_id=1))


def message(data: bytes, time_ns: int = 0) -> bytes:
    """A message of channel 1."""
    return _bytes(records.Message(channel_id=1, data=data, log_time=time_ns, publish_time=time_ns, sequence=0))


def png(path: Path, side: int = 40_000) -> None:
    """A picture of one colour."""
    packer = zlib.compressobj(1)
    lines = b"".join(packer.compress(bytes(1 + 3 * side)) for _ in range(side)) + packer.flush()
    parts = {b"IHDR": struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0), b"IDAT": lines, b"IEND": b""}
    body = b"".join(struct.pack(">I", len(d)) + t + d + struct.pack(">I", zlib.crc32(t + d)) for t, d in parts.items())
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + body)


def sparse(path: Path, size: int = LARGE) -> None:
    """A file of zeros that takes no disk space."""
    with path.open("wb") as stream:
        stream.truncate(size)


def _bytes(record: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
