"""Reads MCAP files, whole ones and those of a process that was killed while it wrote."""

import contextlib
import io
import itertools
import os
import struct
import zlib
from collections.abc import Iterable, Iterator
from typing import BinaryIO, NamedTuple

import pyarrow as pa
from mcap import records
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC

from vcmvsp.cosim.util import limits

_RECORD = struct.Struct("<BQ")  # opcode, length of the rest
_CHUNK = struct.Struct("<QQQI")  # first and last time; size and checksum of what is in it
_INDEX = struct.Struct("<HI")  # channel, bytes of entries
_ENTRY_BYTES, _LEAST_BYTES = 16, 31  # of an index, for each message; of a message


class Recorded(NamedTuple):
    """A message of a file."""

    topic: str
    schema: str  # its name
    time_ns: int
    data: bytes


def about(stream: BinaryIO) -> dict[str, str]:
    """What the head of a file says of it; empty: nothing, or it is damaged."""
    with contextlib.suppress(ValueError):
        for record in itertools.islice(_records(stream), 2):  # behind the header
            if isinstance(record, records.Metadata):
                return dict(record.metadata)
    return {}


def messages(stream: BinaryIO) -> Iterator[tuple[str, int, bytes]]:
    """Topic, time (ns) and content of each message of a file, in its order.

    Raises:
        ValueError: from here on the file is damaged, or it ends too soon.
    """
    for topic, _, time_ns, data in contents(stream):
        yield topic, time_ns, data


def of_topic(stream: BinaryIO, topic: str) -> Iterator[tuple[int, bytes]]:
    """Time (ns) and content of each message of one topic; chunks whose index does not name it are passed over.

    Raises:
        ValueError: a whole file is damaged; one without an end is read up to there.
    """
    is_whole = stream.seek(0, os.SEEK_END) >= len(MCAP0_MAGIC)
    if is_whole:
        stream.seek(-len(MCAP0_MAGIC), os.SEEK_END)
        is_whole = stream.read() == MCAP0_MAGIC
    stream.seek(0)
    with contextlib.nullcontext() if is_whole else contextlib.suppress(ValueError):
        yield from ((each.time_ns, each.data) for each in contents(stream, topic))


def contents(stream: BinaryIO, only: str | None = None) -> Iterator[Recorded]:
    """Each message of a file, in its order; ``only``: of this topic.

    Raises:
        ValueError: from here on the file is damaged, or it ends too soon; or it unpacks to too much.
    """
    counts = indexed(stream)
    stream.seek(0)
    schemas: dict[int, str] = {}
    topics: dict[int, tuple[str, str]] = {}
    for record in _records(stream):
        inside: Iterable[records.McapRecord] = (record,)
        if isinstance(record, records.Chunk):
            channels = _next(counts)
            known = [topics[number][0] for number in channels if number in topics]
            if only is not None and 0 < len(channels) == len(known) and only not in known:
                continue
            inside = _unpacked(record, sum(channels.values()))
        for each in inside:
            if isinstance(each, records.Message):
                if each.channel_id not in topics:
                    raise ValueError(f"a message of channel {each.channel_id}, which there is not")
                topic, schema = topics[each.channel_id]
                if only in (None, topic):
                    yield Recorded(topic, schema, each.log_time, each.data)
            elif isinstance(each, records.Channel):
                topics[each.id] = each.topic, schemas.get(each.schema_id, "")
            elif isinstance(each, records.Schema):
                schemas[each.id] = each.name


def _next(counts: Iterator[dict[int, int]]) -> dict[int, int]:
    for each in counts:
        return each
    raise ValueError("a part of it that its index does not have")


def indexed(stream: BinaryIO) -> Iterator[dict[int, int]]:
    """Of each chunk of a file, the number of messages of its channels as its index says; empty: it has none.

    Raises:
        ValueError: the file unpacks to more than `limits` say; nothing has been unpacked yet.
    """
    chunks: list[tuple[int, dict[int, int]]] = []  # bytes, counts
    size, place = stream.seek(0, os.SEEK_END), len(MCAP0_MAGIC)
    while place < size and stream.seek(place) and len(head := stream.read(_RECORD.size)) == _RECORD.size:
        opcode, length = _RECORD.unpack(head)
        place += _RECORD.size + length
        if opcode == Opcode.DATA_END:
            break
        if opcode == Opcode.CHUNK and len(head := stream.read(_CHUNK.size)) == _CHUNK.size:
            chunks.append((_CHUNK.unpack(head)[2], {}))
            limits.within(chunks[-1][0], limits.CHUNK_BYTES, "bytes in a chunk")
        elif opcode == Opcode.MESSAGE_INDEX and chunks and len(head := stream.read(_INDEX.size)) == _INDEX.size:
            channel, entries = _INDEX.unpack(head)
            chunks[-1][1][channel] = entries // _ENTRY_BYTES
    else:
        if chunks:
            chunks[-1][1].clear()  # the file was cut, perhaps in this very index
    messages = sum(sum(counts.values()) or unpacked // _LEAST_BYTES for unpacked, counts in chunks)
    limits.within(sum(unpacked for unpacked, _ in chunks), max(limits.UNPACKED_BYTES, limits.UNPACKED_RATIO * size), "bytes")
    limits.within(messages, max(limits.MESSAGES, size), "messages")
    return iter([counts for _, counts in chunks])


def _unpacked(chunk: records.Chunk, most: int) -> Iterator[records.McapRecord]:
    """What is in a chunk, of which the index names so many messages; 0: there is none."""
    limits.within(chunk.uncompressed_size, limits.CHUNK_BYTES, "bytes in a chunk")
    if chunk.compression not in ("", "zstd"):
        raise ValueError(f"a chunk is packed with {chunk.compression!r}, not with zstd")
    data = chunk.data
    try:
        if chunk.compression:
            data = pa.Codec("zstd").decompress(data, chunk.uncompressed_size, asbytes=True)
        if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
            raise ValueError("a chunk has another checksum than it says")
        raw, number = io.BytesIO(data), 0
        found = StreamReader(raw, skip_magic=True).records
        while raw.tell() < len(data):
            record = next(found)
            number += isinstance(record, records.Message)
            if number > most > 0:
                raise ValueError("a chunk holds more messages than its index says")
            yield record
    except ValueError:
        raise
    except Exception as error:  # the libraries have many
        raise ValueError(f"{type(error).__name__}: {error}") from error


def _records(stream: BinaryIO) -> Iterator[records.McapRecord]:
    """Header and data of a file, without its end; chunks as they are."""
    found = StreamReader(stream, emit_chunks=True, record_size_limit=limits.FILE_BYTES).records
    while True:
        try:
            record = next(found)
        except (EndOfFile, struct.error) as error:
            raise ValueError("it ends too soon") from error
        except Exception as error:  # the library has many, and those of others show through
            raise ValueError(f"{type(error).__name__}: {error}") from error
        if isinstance(record, records.DataEnd):
            return
        yield record
