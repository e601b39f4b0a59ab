"""Writing ``run.mcap``: JSON messages under the keys of their events, each with its schema.

This is the only module that knows the MCAP library. Nothing of the host, the wall clock or a library version goes into the
file, so the same messages give the same bytes.
"""

from collections.abc import Mapping
from typing import Any, BinaryIO

import msgspec
from mcap.writer import CompressionType, Writer

from cosim.record.foxglove import schema_of, to_json

LIBRARY = "vcmvsp"
CHUNK_BYTES = 256 * 1024  # what a killed process loses at most; larger chunks compress and write no better (measured)


class McapLog:
    """An open recording. The stream stays its owner's: it is not closed here."""

    def __init__(self, stream: BinaryIO, about: Mapping[str, str]) -> None:
        self._writer: Any = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library=LIBRARY)
        self._writer.add_metadata("vcmvsp", dict(about))
        self._channels: dict[str, int] = {}
        self._schemas: dict[type, int] = {}
        self._encode = msgspec.json.Encoder(enc_hook=to_json).encode

    def write(self, topic: str, message: Any, time_ns: int) -> None:
        """Append a message (a msgspec Struct) in effect at ``time_ns``; a topic carries one type of message."""
        channel = self._channels.get(topic) or self._register(topic, type(message))
        self._writer.add_message(channel, time_ns, self._encode(message), time_ns)

    def finish(self) -> None:
        """Write index and summary; nothing can be appended afterwards."""
        self._writer.finish()

    def _register(self, topic: str, message_type: type) -> int:
        if message_type not in self._schemas:
            name, schema = schema_of(message_type)
            self._schemas[message_type] = self._writer.register_schema(name, "jsonschema", schema)
        channel: int = self._writer.register_channel(topic, "json", self._schemas[message_type])
        self._channels[topic] = channel
        return channel
