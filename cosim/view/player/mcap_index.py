"""Index of a recording's messages by topic and time; reads files of killed processes up to the last complete chunk.

A file is read once, chunk by chunk, and checked. Memory holds the position of each message (16 bytes) and the last few chunks;
messages themselves, such as pictures, are read on demand. The layout is that of the MCAP
specification (https://mcap.dev/spec), as `cosim.recording.mcap_writer` writes it.
"""

import os
import struct
from array import array
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa

from vcmvsp.cosim.recording import mcap_reader

MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 0x03, 0x04, 0x05, 0x06, 0x0F
KEPT_BYTES = 32 << 20  # chunks kept for repeated access
TOO_SOON = "it is truncated: its run continues, or was killed"
_RECORD = struct.Struct("<BQ")  # opcode, length of the rest
_CHUNK = struct.Struct("<QQQII")  # first and last time; size and checksum of the content; length of the codec's name
_MESSAGE = struct.Struct("<HIQ")  # channel, sequence, log time
_START = _RECORD.size
_HEAD_BYTES = _START + _MESSAGE.size + 8  # of a message, before its content
_DAMAGE = (ValueError, KeyError, struct.error, MemoryError, OverflowError, OSError, pa.ArrowException)
_OFFSET_BITS = 40  # bits for the offset of a message in its unpacked chunk

Taker = Callable[[int, bytes], None]
"""Receives time (ns) and content of a message."""


class _Part(NamedTuple):
    """Position and format of a chunk in the file."""

    start: int
    length: int
    compression: str
    size: int
    crc: int


class Topic:
    """The messages of one topic: their times and positions."""

    def __init__(self, name: str, schema: str) -> None:
        self.name, self.schema = name, schema
        self._times, self._places = array("q"), array("q")
        self.add_time, self.add_place = self._times.append, self._places.append

    def newest(self, time_ns: int, since_ns: int | None = None) -> int:
        """Number of the newest message at a time; -1 without one, or without one later than ``since_ns``."""
        number = bisect_right(self._times, time_ns) - 1
        return -1 if number >= 0 and since_ns is not None and self._times[number] <= since_ns else number

    def time_ns(self, number: int) -> int:
        """Time of a message."""
        return self._times[number]

    def place(self, number: int) -> tuple[int, int]:
        """Chunk of a message and its offset in it."""
        return divmod(self._places[number], 1 << _OFFSET_BITS)


class Messages:
    """Reader of the wanted messages of an open MCAP file, for one thread. Call `read` first.

    Attributes:
        topics: wanted topics with messages, by name.
        about: metadata of the run in the file.
        end_ns: time of the last message of any topic.

    Raises:
        OSError: the file is unreadable.
    """

    def __init__(self, path: Path) -> None:
        self.topics: dict[str, Topic] = {}
        self.end_ns = 0
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, tuple[Topic, Taker | None] | None] = {}  # None: skipped
        self._parts: list[_Part] = []
        self._chunks: OrderedDict[int, bytes] = OrderedDict()  # chunks, the newest last
        self._kept_bytes = 0
        self._stream = path.open("rb")
        self.about = mcap_reader.about(self._stream)

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def read(self, selects: Callable[[str, str], bool], taker: Callable[[str], Taker | None]) -> str:
        """Index all messages; returns the description of damage, beyond which the file is ignored, or an empty text.

        Args:
            selects: takes topic and schema name; whether messages of this topic are wanted.
            taker: takes a wanted topic; the function that receives all its messages during indexing, or None.
        """
        self._selects, self._taker = selects, taker
        stream, size = self._stream, os.fstat(self._stream.fileno()).st_size
        try:
            self._counts = mcap_reader.indexed(stream)
        except ValueError as error:
            return str(error)
        stream.seek(0)
        place = len(MAGIC)
        if stream.read(place) != MAGIC:
            return "it is not an MCAP file" if size >= place else TOO_SOON
        while len(head := stream.read(_START)) == _START:
            opcode, length = _RECORD.unpack(head)
            place += _START + length
            if place > size:
                break
            if opcode == DATA_END:
                return ""
            if opcode == CHUNK:
                try:
                    self._take(place - length, length)
                except _DAMAGE as error:
                    return f"it is damaged at byte {place - length} ({error})"
            stream.seek(place)
        return TOO_SOON

    def get(self, topic: Topic, number: int) -> bytes:
        """The content of a message.

        Raises:
            OSError, ValueError: the file has changed since it was opened.
        """
        chunk, start = topic.place(number)
        raw = self._chunk(chunk)
        _, length = _RECORD.unpack_from(raw, start)
        return raw[start + _HEAD_BYTES : start + _START + length]

    def _chunk(self, number: int) -> bytes:
        raw = self._chunks.get(number)
        if raw is None:
            raw = self._chunks[number] = self._unpacked(self._parts[number])
            self._kept_bytes += len(raw)
            while self._kept_bytes > KEPT_BYTES and len(self._chunks) > 1:
                self._kept_bytes -= len(self._chunks.popitem(last=False)[1])
        self._chunks.move_to_end(number)
        return raw

    def _unpacked(self, part: _Part) -> bytes:
        if part.length < 0:
            raise ValueError(f"a chunk of {part.size} bytes in {part.length}")
        self._stream.seek(part.start)
        return mcap_reader.unpacked(self._stream.read(part.length), part.compression, part.size, part.crc)

    def _take(self, start: int, length: int) -> None:
        head = self._stream.read(min(length, 256))
        _, _, size, crc, letters = _CHUNK.unpack_from(head)
        name_end = _CHUNK.size + letters
        compression = head[_CHUNK.size : name_end].decode()
        part = _Part(start + name_end + 8, length - name_end - 8, compression, size, crc)  # 8: the length, repeated
        raw = self._unpacked(part)
        self._parts.append(part)
        self._walk(raw, len(self._parts) - 1 << _OFFSET_BITS, sum(next(self._counts, {}).values()) or part.size)

    def _walk(self, raw: bytes, base: int, remaining: int) -> None:
        """Index the messages of a chunk, at most ``remaining``; ``base`` identifies the chunk in the index."""
        place, size, channels = 0, len(raw), self._channels
        record, head, time_ns = _RECORD.unpack_from, _MESSAGE.unpack_from, self.end_ns
        while place < size:
            opcode, length = record(raw, place)
            end = place + _START + length
            if opcode == MESSAGE:
                remaining -= 1
                if remaining < 0:
                    raise ValueError("a chunk contains more messages than its index")
                channel, _, time_ns = head(raw, place + _START)
                if (entry := channels[channel]) is not None:
                    topic, taker = entry
                    topic.add_time(time_ns)
                    topic.add_place(base | place)
                    if taker is not None:
                        taker(time_ns, raw[place + _HEAD_BYTES : end])
            elif opcode in (SCHEMA, CHANNEL):
                self._declare(opcode, mcap_reader.declared(raw[place:end]))
            place = end
        self.end_ns = max(self.end_ns, time_ns)

    def _declare(self, opcode: int, record: Any) -> None:
        if opcode == SCHEMA:
            self._schemas[record.id] = record.name
            return
        name, schema = record.topic, self._schemas[record.schema_id]
        self._channels[record.id] = None
        if self._selects(name, schema):
            topic = self.topics.setdefault(name, Topic(name, schema))  # one channel for each type of message
            self._channels[record.id] = topic, self._taker(name)
