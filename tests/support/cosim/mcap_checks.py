"""Checks of ``mcap doctor`` from the specification (https://mcap.dev/spec): order, indexes, sums, counts, offsets.

The library decodes single records only; their places are computed here.
"""

import io
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from typing import Any

import pyarrow as pa
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode

MAGIC = b"\x89MCAP0\r\n"
_KINDS: dict[int, Any] = {
    Opcode.HEADER: records.Header,
    Opcode.FOOTER: records.Footer,
    Opcode.SCHEMA: records.Schema,
    Opcode.CHANNEL: records.Channel,
    Opcode.CHUNK: records.Chunk,
    Opcode.MESSAGE_INDEX: records.MessageIndex,
    Opcode.CHUNK_INDEX: records.ChunkIndex,
    Opcode.METADATA: records.Metadata,
    Opcode.METADATA_INDEX: records.MetadataIndex,
    Opcode.STATISTICS: records.Statistics,
    Opcode.SUMMARY_OFFSET: records.SummaryOffset,
    Opcode.DATA_END: records.DataEnd,
}


def read(data: bytes, start: int = 0) -> Iterator[tuple[int, int, Any]]:
    """Begin, end and content of each record."""
    while start < len(data):
        opcode, length = struct.unpack_from("<BQ", data, start)
        end = start + 9 + length
        assert end <= len(data), f"the record at {start} is longer than the file"
        stream = ReadDataStream(io.BytesIO(data[start + 9 : end]))
        yield start, end, records.Message.read(stream, length) if opcode == Opcode.MESSAGE else _KINDS[opcode].read(stream)
        start = end


def examine(data: bytes) -> int:
    """Assert that a file is complete and consistent; returns its number of messages."""
    assert data[:8] == data[-8:] == MAGIC
    listed = list(read(data[:-8], 8))
    assert isinstance(listed[0][2], records.Header)
    (end_of_data,) = [number for number, (_, _, each) in enumerate(listed) if isinstance(each, records.DataEnd)]
    body, summary = listed[1:end_of_data], listed[end_of_data + 1 :]
    chunks, counts, known, span = _examine_body(body)
    _examine_summary(data, summary, listed[end_of_data][1])
    (statistics,) = _of(summary, records.Statistics)
    assert statistics.message_count == sum(counts.values())
    assert statistics.channel_message_counts == counts
    assert (statistics.message_start_time, statistics.message_end_time) == span
    assert (statistics.chunk_count, statistics.attachment_count) == (len(chunks), 0)
    assert statistics.metadata_count == len(_of(body, records.Metadata)) == len(_of(summary, records.MetadataIndex))
    schemas, channels = ([each for each in known if isinstance(each, kind)] for kind in (records.Schema, records.Channel))
    assert _of(summary, records.Schema) == schemas
    assert _of(summary, records.Channel) == channels
    assert (statistics.schema_count, statistics.channel_count) == (len(schemas), len(channels))
    assert _of(summary, records.ChunkIndex) == chunks
    for index in _of(summary, records.MetadataIndex):
        assert (index.offset, index.offset + index.length) in [
            (a, b) for a, b, each in body if isinstance(each, records.Metadata)
        ]
    return int(statistics.message_count)


def _of(listed: list[tuple[int, int, Any]], kind: type) -> list[Any]:
    return [each for _, _, each in listed if isinstance(each, kind)]


def _examine_body(body: list[tuple[int, int, Any]]) -> tuple[list[Any], Counter[int], list[Any], tuple[int, int]]:
    """Expected chunk indexes, messages by channel, schemas and channels in order, first and last time."""
    chunks: list[Any] = []
    counts: Counter[int] = Counter()
    known: list[Any] = []
    times: list[int] = []
    for number, (start, end, chunk) in enumerate(body):
        if isinstance(chunk, records.MessageIndex | records.Metadata):
            continue
        assert isinstance(chunk, records.Chunk), chunk
        raw = pa.Codec("zstd").decompress(chunk.data, chunk.uncompressed_size, asbytes=True)
        assert len(raw) == chunk.uncompressed_size
        assert zlib.crc32(raw) == chunk.uncompressed_crc
        entries = _examine_chunk(raw, known)
        inside = [time for listed in entries.values() for time, _ in listed]
        assert (min(inside), max(inside)) == (chunk.message_start_time, chunk.message_end_time)
        assert not times or min(inside) >= times[-1]
        times += [min(inside), max(inside)]
        found, places, last = {}, {}, end
        for index_start, index_end, index in body[number + 1 :]:
            if not isinstance(index, records.MessageIndex):
                break
            assert index.channel_id not in found
            found[index.channel_id], places[index.channel_id], last = index.records, index_start, index_end
        assert found == entries  # each message by its time and place, in order
        counts.update({channel: len(listed) for channel, listed in entries.items()})
        chunks.append(
            records.ChunkIndex(
                chunk_start_offset=start,
                chunk_length=end - start,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                uncompressed_size=len(raw),
                message_start_time=min(inside),
                message_end_time=max(inside),
                message_index_offsets=places,
                message_index_length=last - end,
            )
        )
    return chunks, counts, known, (min(times, default=0), max(times, default=0))


def _examine_chunk(raw: bytes, known: list[Any]) -> dict[int, list[tuple[int, int]]]:
    """Time and place of each message, by channel. Schemas and channels come once, before their first use."""
    entries: dict[int, list[tuple[int, int]]] = {}
    last = 0
    for start, _, each in read(raw):
        if isinstance(each, records.Message):
            assert each.channel_id in [channel.id for channel in known if isinstance(channel, records.Channel)]
            assert each.log_time >= last
            last = each.log_time
            entries.setdefault(each.channel_id, []).append((each.log_time, start))
        else:
            assert each.id > 0
            assert each.id not in [other.id for other in known if type(other) is type(each)]
            if isinstance(each, records.Channel):
                assert each.schema_id in [schema.id for schema in known if isinstance(schema, records.Schema)]
                assert (each.topic, each.schema_id) not in [
                    (channel.topic, channel.schema_id) for channel in known if isinstance(channel, records.Channel)
                ]
            known.append(each)
    return entries


def _examine_summary(data: bytes, summary: list[tuple[int, int, Any]], start: int) -> None:
    """Check the summary's place and sum, and the places of its groups."""
    footer_start, _, footer = summary[-1]
    assert isinstance(footer, records.Footer)
    assert footer.summary_start == start
    assert footer.summary_crc == zlib.crc32(data[start : footer_start + 25])
    offsets = [(begin, each) for begin, _, each in summary if isinstance(each, records.SummaryOffset)]
    assert footer.summary_offset_start == offsets[0][0]
    groups: dict[int, list[int]] = {}
    for begin, end, _ in summary[: -1 - len(offsets)]:
        groups.setdefault(data[begin], [begin, end])[1] = end
    assert {
        offset.group_opcode: [offset.group_start, offset.group_start + offset.group_length] for _, offset in offsets
    } == groups
