"""Writes MCAP files: messages under the keys of their events, each with its schema (https://mcap.dev/spec).

``run.mcap`` holds JSON, for viewers; files for exact replay have their own encoding. A file contains no host name, wall-clock
time or library version, so the same messages give the same bytes.

The library describes records. Messages and their index, thousands of them, are packed here, ten times as fast as by the
library's writer (0.4 instead of 3.7 us a message: half the cost of recording a run).
"""

import functools
import itertools
import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from typing import Any, BinaryIO, NamedTuple, Protocol

import msgspec
import numpy as np
import pyarrow as pa
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC
from numpy.lib.stride_tricks import sliding_window_view

from vcmvsp.cosim.recording.foxglove import FoxgloveMessage, to_json
from vcmvsp.cosim.tables.radio_frames import PATHS
from vcmvsp.cosim.types import Array, Datagrams, FrameReport, Looks, Message

LIBRARY = "vcmvsp"
CHUNK_BYTES, CHUNK_NS = 1 << 20, 5_000_000_000  # before compression; simulated; a killed process loses at most one chunk
_put_head = struct.Struct("<BQH4xQQ").pack_into  # of a message: opcode, length of the rest, channel, no sequence, two times
_HEAD = np.dtype([("op", "u1"), ("length", "<u8"), ("channel", "<u2"), ("seq", "<u4"), ("log_ns", "<u8"), ("sent_ns", "<u8")])
_HEAD_BYTES, _OPENING_BYTES = _HEAD.itemsize, 9  # the latter of any record: opcode and length
_IS_MESSAGE = int(Opcode.MESSAGE)  # looking up an enumeration member is slow
_MESSAGE_INDEX = struct.Struct("<BQHI")  # opcode, length of the rest, channel, bytes of entries
_ENTRY_BYTES = 16  # time and place of a message
FRAME = {
    "type": "always 'frame'",
    "frame": "number of the frame, unique in the run, in the order in which frames entered the channel",
    "sender": "name of the sending vehicle",
    "sent_ns": "time of its arrival at the sender's radio, ns since the start of the run",
    "size_bytes": "payload, bytes",
    "receivers": "names of the addressed vehicles; every list below has one entry for each, in this order",
    "distance_m": "distance between receiver and sender, m",
    "rssi_dbm": "received power, dBm",
    "received_ns": "time of reception, ns since the start of the run; -1: lost",
    "outcome": "'received', or the cause of the loss",
    "air_time_ns": "duration of one transmission, ns; 0: never sent",
    "queue_ns": "waiting time behind earlier frames of its sender, ns",
    "access_ns": "time of medium access, earlier attempts included, ns",
    "copy_ns": "time of reception of a second copy, ns since the start of the run; -1: none; null: the channel makes none",
    "snr_db": "signal-to-noise ratio, dB; null: the channel has no noise",
    "sinr_db": "least ratio of signal to noise and interference during the frame, dB; null: not known",
    "path_loss_db": "path loss without walls and fading, dB; null: the channel has no such layer",
    "walls": "number of crossed walls; null: the channel has no such layer",
    "wall_materials": "of the walls, e.g. '2 brick, 1 wood'; null: the channel has no such layer",
    "wall_loss_db": "loss in walls, dB; null: the channel has no such layer",
    "shadowing_db": "loss by shadowing, dB; null: the channel has no such layer",
    "fading_db": "gain by fading, dB, mostly negative; null: the channel has no such layer",
    "path_delay_ns": "travel time of the first path, ns; only where path_loss.kind is rays",
    "delay_spread_ns": "standard deviation of the travel times of all paths, by power, ns; only where path_loss.kind is rays",
}
"""Descriptions of the fields of ``radio/frame``, for readers without this program."""


class Schema(NamedTuple):
    """Schema of a message type."""

    name: str
    encoding: str  # of the text
    text: bytes


class MessageSink(Protocol):
    """A second receiver of the messages of a recording, e.g. viewers of a run in progress. It cannot change the file."""

    def add_channel(self, number: int, topic: str, encoding: str, schema: Schema) -> None:
        """Announce a channel: its number in the file, and MCAP's name of the encoding of its messages."""

    def put(self, number: int, time_ns: int, message: bytes) -> None:
        """Take an encoded message of a channel."""


class Form(NamedTuple):
    """Encoding of messages in a file."""

    encoding: str  # MCAP's name for it
    encode_into: Callable[[object, bytearray, int], None]  # message, buffer, offset; the buffer then ends with the message
    schema: Callable[[type], Schema]


@functools.cache  # a dozen types, 3 ms a run
def schema_of(message_type: type) -> Schema:
    """JSON Schema of a message type: ``foxglove.*`` for Foxglove's, ``vcmvsp.*`` for the platform's values."""
    name = message_type.__name__
    is_foxglove = issubclass(message_type, FoxgloveMessage)
    title = f"foxglove.{name}" if is_foxglove else f"vcmvsp.{name.removesuffix('Report')}"
    (root,), definitions = msgspec.json.schema_components([message_type], schema_hook=_array_schema)
    for each in (Message, FrameReport, Datagrams):
        for name in ("radio", *PATHS):  # only with several radios; only where rays are traced
            definitions.get(each.__name__, {"properties": {}})["properties"].pop(name, None)
    schema = _simple(root, definitions)
    if message_type is Looks:
        schema["properties"] |= {"cells": _listed(_listed({"type": "integer"})), "hits": _listed({"type": "boolean"})}
    if message_type is FrameReport:
        schema["description"] = "Outcome of one frame at each addressed receiver."
        schema["properties"] = {field: {**node, "description": FRAME[field]} for field, node in schema["properties"].items()}
    schema["title"] = title
    return Schema(title, "jsonschema", msgspec.json.encode(schema))


def _listed(items: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": items}


def _array_schema(annotation: object) -> dict[str, Any]:
    if annotation is np.ndarray:
        return _listed({"type": "number"})
    raise TypeError(f"no JSON Schema for {annotation}")


def _simple(node: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    """A JSON schema for simple readers: every node has a ``type``, every object its ``properties``.

    The readers of Foxglove and Lichtblick follow no references and know no unions and no tuples; they use a schema only for the
    names of fields. So a nullable field, or one of two types, is described by its first type and not required.
    """
    if "$ref" in node:
        return _simple(definitions[node["$ref"].rsplit("/", 1)[1]], definitions)
    if "anyOf" in node:
        first = next(option for option in node["anyOf"] if option.get("type") != "null")
        return _simple(first, definitions)
    if "enum" in node:
        return {"type": "string" if isinstance(node["enum"][0], str) else "integer", "enum": node["enum"]}
    if node["type"] == "object":
        fields = node.get("properties", {})
        simple = {name: _simple(field, definitions) for name, field in fields.items()}
        return {"type": "object", "properties": simple, "required": [name for name in fields if "anyOf" not in fields[name]]}
    if node["type"] == "array":
        return {
            "type": "array",
            "items": _simple(node["prefixItems"][0] if "prefixItems" in node else node["items"], definitions),
        }
    return {key: node[key] for key in ("type", "contentEncoding", "minimum", "maximum") if key in node}


JSON = Form("json", msgspec.json.Encoder(enc_hook=to_json).encode_into, schema_of)


class McapLog:
    """An open recording, each message also for a sink if there is one. The caller closes the stream."""

    def __init__(self, stream: BinaryIO, about: Mapping[str, str], form: Form = JSON, sink: MessageSink | None = None) -> None:
        self._stream, self._size, self._form, self._sink = stream, 0, form, sink
        self._numbers: dict[tuple[str, type], int] = {}  # channel numbers
        self._schemas: dict[type, records.Schema] = {}
        self._channels: list[records.Channel] = []
        self._chunk = bytearray()
        self._places = array("Q")  # offsets of the messages in the chunk; their heads contain the rest of an index entry
        self._chunks: list[records.ChunkIndex] = []
        self._counts: Counter[int] = Counter()  # messages by channel
        self._until_ns = CHUNK_NS  # end of the current chunk
        self._codec = pa.Codec("zstd", compression_level=1)  # level 3 takes 1.5 times as long, for 2 % less
        self._encode_into = form.encode_into
        self._put(MCAP0_MAGIC + _bytes(records.Header(profile="", library=LIBRARY)))
        metadata = _bytes(records.Metadata(name="vcmvsp", metadata=dict(about)))
        self._about = records.MetadataIndex(offset=self._size, length=len(metadata), name="vcmvsp")
        self._put(metadata)

    def write(self, topic: str, time_ns: int, message: object) -> None:
        """Append a message (a msgspec Struct) in effect at ``time_ns``; each type on a topic has a channel with its schema."""
        kind = type(message)
        channel = self._numbers.get((topic, kind)) or self._register(topic, kind)
        chunk = self._chunk
        place = len(chunk)
        try:
            self._encode_into(message, chunk, place + _HEAD_BYTES)
        except Exception:
            del chunk[place:]
            raise
        end = len(chunk)
        _put_head(chunk, place, _IS_MESSAGE, end - place - _OPENING_BYTES, channel, time_ns, time_ns)
        self._places.append(place)
        if self._sink is not None:
            self._sink.put(channel, time_ns, bytes(chunk[place + _HEAD_BYTES :]))
        if end > CHUNK_BYTES or time_ns > self._until_ns:
            self.flush()
            self._until_ns = time_ns + CHUNK_NS

    def flush(self) -> None:
        """Write everything so far to the file, where it survives a crash of this process."""
        self._end_chunk()
        self._stream.flush()

    def finish(self) -> None:
        """Write index and summary; no message can be appended afterwards."""
        self._end_chunk()
        self._put(_bytes(records.DataEnd(data_section_crc=0)))
        groups = (
            (Opcode.SCHEMA, list(self._schemas.values())),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.METADATA_INDEX, [self._about]),
        )
        start, summary, offsets = self._size, b"", b""
        for opcode, group in groups:
            part = b"".join(map(_bytes, group))
            offsets += _bytes(
                records.SummaryOffset(group_opcode=opcode, group_start=start + len(summary), group_length=len(part))
            )
            summary += part
        offset_start = start + len(summary)
        summary += offsets
        crc = zlib.crc32(summary + struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offset_start))
        footer = records.Footer(summary_start=start, summary_offset_start=offset_start, summary_crc=crc)
        self._put(summary + _bytes(footer) + MCAP0_MAGIC)

    def _register(self, topic: str, message_type: type) -> int:
        if message_type not in self._schemas:
            schema, number = self._form.schema(message_type), len(self._schemas) + 1
            self._schemas[message_type] = records.Schema(number, schema.text, schema.encoding, schema.name)
            self._chunk += _bytes(self._schemas[message_type])
        number, schema_id = len(self._channels) + 1, self._schemas[message_type].id
        self._channels.append(records.Channel(number, topic, self._form.encoding, {}, schema_id))
        self._chunk += _bytes(self._channels[-1])
        self._numbers[topic, message_type] = number
        if self._sink is not None:
            self._sink.add_channel(number, topic, self._form.encoding, self._form.schema(message_type))
        return number

    def _end_chunk(self) -> None:
        if not self._places:
            return
        compressed = self._codec.compress(self._chunk, asbytes=True)
        places = np.array(self._places)
        heads = sliding_window_view(np.frombuffer(self._chunk, np.uint8), _HEAD.itemsize)[places].view(_HEAD)[:, 0]
        times = heads["log_ns"]
        begin, end = times.min().item(), times.max().item()
        chunk = records.Chunk(
            compression="zstd",
            data=compressed,
            message_start_time=begin,
            message_end_time=end,
            uncompressed_crc=zlib.crc32(self._chunk),
            uncompressed_size=len(self._chunk),
        )
        start = self._size
        self._put(_bytes(chunk))
        index_start, offsets, blocks = self._size, {}, bytearray()
        for channel, block in _blocks(heads["channel"], np.column_stack((times, places))):
            offsets[channel] = index_start + len(blocks)
            blocks += _MESSAGE_INDEX.pack(Opcode.MESSAGE_INDEX, 6 + len(block), channel, len(block))
            blocks += block
            self._counts[channel] += len(block) // _ENTRY_BYTES
        self._put(blocks)
        self._chunks.append(
            records.ChunkIndex(
                chunk_start_offset=start,
                chunk_length=index_start - start,
                compression="zstd",
                compressed_size=len(compressed),
                uncompressed_size=len(self._chunk),
                message_start_time=begin,
                message_end_time=end,
                message_index_offsets=offsets,
                message_index_length=self._size - index_start,
            )
        )
        self._chunk.clear()
        del self._places[:]

    def _statistics(self) -> records.Statistics:
        begin = min((chunk.message_start_time for chunk in self._chunks), default=0)
        end = max((chunk.message_end_time for chunk in self._chunks), default=0)
        return records.Statistics(
            message_count=self._counts.total(),
            channel_message_counts=self._counts,
            message_start_time=begin,
            message_end_time=end,
            schema_count=len(self._schemas),
            channel_count=len(self._channels),
            chunk_count=len(self._chunks),
            metadata_count=1,
            attachment_count=0,
        )

    def _put(self, data: bytes | bytearray) -> None:
        self._stream.write(data)
        self._size += len(data)


def _bytes(record: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]  # the library has no annotation there


def _blocks(channel: Array, entries: Array) -> Iterator[tuple[int, bytes]]:
    """Channel number and index entries of each channel in a chunk, given channel (n,) and entry (n, 2) of each message."""
    order = np.argsort(channel, kind="stable")
    channels, first = np.unique(channel[order], return_index=True)
    packed = entries[order].astype("<u8").tobytes()
    edges = [*(first * _ENTRY_BYTES).tolist(), len(packed)]
    return zip(channels.tolist(), (packed[begin:end] for begin, end in itertools.pairwise(edges)), strict=True)
