"""Reads MCAP files, also incomplete ones of killed processes."""

import contextlib
import io
import itertools
import os
import struct
import zlib
from collections.abc import Callable, Container, Iterable, Iterator
from typing import BinaryIO, NamedTuple

import pyarrow as pa
from mcap import records
from mcap.opcode import Opcode
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC

from vcmvsp.cosim.util import limits

_RECORD = struct.Struct("<BQ")  # opcode, length of the rest
_CHUNK = struct.Struct("<QQQI")  # first and last time; size and checksum of the content
_INDEX = struct.Struct("<HI")  # channel, bytes of entries
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence number, log time, publish time
_READ = (Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK, Opcode.METADATA)  # others are skipped
_LAST_NS = 2**63 - 1
_PASSED = -1  # channel of the placeholder for skipped messages
_ENTRY_BYTES, _LEAST_BYTES = 16, 31  # index entry of a message; smallest message


class Recorded(NamedTuple):
    """A message in a file."""

    topic: str
    schema: str  # its name
    time_ns: int
    data: bytes


def about(stream: BinaryIO) -> dict[str, str]:
    """Metadata at the head of a file; empty if there is none or it is damaged."""
    with contextlib.suppress(ValueError):
        for record in itertools.islice(_records(stream), 2):  # behind the header
            if isinstance(record, records.Metadata):
                return dict(record.metadata)
    return {}


def messages(stream: BinaryIO) -> Iterator[tuple[str, int, bytes]]:
    """Topic, time (ns) and content of each message, in file order; errors as of `contents`."""
    for topic, _, time_ns, data in contents(stream):
        yield topic, time_ns, data


def of_topic(stream: BinaryIO, topic: str) -> Iterator[tuple[int, bytes]]:
    """Time (ns) and content of each message of one topic; skips chunks whose index does not contain it.

    Yields the messages before the damage in an incomplete file; a damaged complete file is a ValueError.
    """
    is_whole = stream.seek(0, os.SEEK_END) >= len(MCAP0_MAGIC)
    if is_whole:
        stream.seek(-len(MCAP0_MAGIC), os.SEEK_END)
        is_whole = stream.read() == MCAP0_MAGIC
    stream.seek(0)
    with contextlib.nullcontext() if is_whole else contextlib.suppress(ValueError):
        entries = contents(stream, lambda each, _: each == topic, by_index=True)
        yield from ((each.time_ns, each.data) for each in entries if each.topic)


def contents(
    stream: BinaryIO, selects: Callable[[str, str], bool] = lambda *_: True, *, by_index: bool = False
) -> Iterator[Recorded]:
    """Each message of a file, in its order.

    Args:
        stream: the file.
        selects: takes topic and schema name; whether messages of this topic are wanted. The skipped messages of a chunk are
            replaced by one at its end, without topic and content, at the time of the last of them.
        by_index: skip chunks whose index contains no wanted topic, damaged or not.

    Raises:
        ValueError: the file is damaged from here on, ends early, or unpacks to too many bytes.
    """
    counts = indexed(stream)
    stream.seek(0)
    schemas: dict[int, str] = {}
    topics, passed = {_PASSED: ("", "")}, set[int]()
    for record in _records(stream):
        inside: Iterable[records.McapRecord] = (record,)
        if isinstance(record, records.Chunk):
            channels = _next(counts)
            if by_index and channels and passed.issuperset(channels):
                continue
            inside = _unpacked(record, sum(channels.values()), passed)
        for each in inside:
            if isinstance(each, records.Message):
                if each.channel_id not in topics or each.log_time > _LAST_NS:
                    raise ValueError(f"a message of channel {each.channel_id} at {each.log_time} ns: no such channel or time")
                if each.channel_id not in passed:
                    yield Recorded(*topics[each.channel_id], each.log_time, each.data)
            elif isinstance(each, records.Channel):
                topics[each.id] = each.topic, schemas.get(each.schema_id, "")
                (passed.discard if selects(*topics[each.id]) else passed.add)(each.id)
            elif isinstance(each, records.Schema):
                schemas[each.id] = each.name


def _next(counts: Iterator[dict[int, int]]) -> dict[int, int]:
    for each in counts:
        return each
    raise ValueError("a chunk that is missing in its index")


def indexed(stream: BinaryIO) -> Iterator[dict[int, int]]:
    """For each chunk, the number of messages per channel according to its index; empty without an index.

    Raises:
        ValueError: the file would unpack to more than `limits` allow; nothing has been unpacked yet.
    """
    chunks: list[tuple[int, dict[int, int]]] = []  # bytes, counts per channel
    stream.seek(0)
    if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        return iter(())  # the reader reports the damage; a search for chunks in zeros would take very long
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
            chunks[-1][1].clear()  # the file was cut, perhaps within this index
    messages = sum(sum(counts.values()) or unpacked // _LEAST_BYTES for unpacked, counts in chunks)
    limits.within(sum(unpacked for unpacked, _ in chunks), max(limits.UNPACKED_BYTES, limits.UNPACKED_RATIO * size), "bytes")
    limits.within(messages, max(limits.MESSAGES, size), "messages")
    return iter([counts for _, counts in chunks])


def unpacked(data: bytes, compression: str, size: int, crc: int) -> bytes:
    """The decompressed content of a chunk.

    Raises:
        ValueError: the content does not match its header, or is too large.
    """
    limits.within(size, limits.CHUNK_BYTES, "bytes in a chunk")
    if compression not in ("", "zstd"):
        raise ValueError(f"a chunk is compressed with {compression!r}, not zstd")
    if compression:
        data = pa.Codec("zstd").decompress(data, size, asbytes=True)
    if len(data) != size or (crc and zlib.crc32(data) != crc):
        raise ValueError("the checksum of a chunk is wrong")
    return data


def declared(record: bytes) -> records.McapRecord:
    """Decode a record; chunks stay packed.

    Raises:
        ValueError: the bytes are no such record.
    """
    try:
        return next(StreamReader(io.BytesIO(record), skip_magic=True, emit_chunks=True, record_size_limit=None).records)
    except Exception as error:  # the library raises many types
        raise ValueError(f"{type(error).__name__}: {error}") from error


def _unpacked(chunk: records.Chunk, most: int, passed: Container[int]) -> Iterator[records.McapRecord]:
    """Records of a chunk without some channels, whose messages its index counts; 0: no index."""
    try:
        data = unpacked(chunk.data, chunk.compression, chunk.uncompressed_size, chunk.uncompressed_crc)
        yield from _inside(data, most or len(data), passed)
    except ValueError:
        raise
    except Exception as error:  # the libraries raise many types
        raise ValueError(f"{type(error).__name__}: {error}") from error


def _inside(data: bytes, most: int, passed: Container[int]) -> Iterator[records.McapRecord]:
    """Schemas, channels and at most ``most`` messages of a chunk; ten times as fast as the library."""
    end, number, last_ns, message = 0, 0, -1, int(Opcode.MESSAGE)
    while end < len(data):
        opcode, length = _RECORD.unpack_from(data, end)
        start, end = end + _RECORD.size, end + _RECORD.size + length
        if end > len(data):
            raise ValueError("a chunk is truncated")
        if opcode == message:
            number += 1
            if number > most:
                raise ValueError("a chunk contains more messages than its index")
            channel, sequence, time_ns, published_ns = _MESSAGE.unpack_from(data, start)
            if channel in passed:
                last_ns = max(last_ns, time_ns)
            else:
                yield records.Message(channel, time_ns, data[start + _MESSAGE.size : end], published_ns, sequence)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            yield declared(data[start - _RECORD.size : end])
    if last_ns >= 0:
        yield records.Message(_PASSED, last_ns, b"", last_ns, 0)


def _records(stream: BinaryIO) -> Iterator[records.McapRecord]:
    """Header and data records of a file, without its indexes and its end; chunks stay packed."""
    end = stream.seek(0, os.SEEK_END)
    stream.seek(0)
    if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        raise ValueError("it does not begin as an MCAP file does")
    while len(head := stream.read(_RECORD.size)) == _RECORD.size:
        opcode, length = _RECORD.unpack(head)
        if opcode == Opcode.DATA_END:
            return
        if length > end - stream.tell():
            break
        if opcode in _READ:
            yield declared(head + stream.read(length))
        else:
            stream.seek(length, os.SEEK_CUR)
    raise ValueError("it is truncated")
