"""How the messages of a recording are written: as JSON, for viewers, unless a file is to be read back to the last bit."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec

from vcmvsp.cosim.recording.foxglove.messages import to_json
from vcmvsp.cosim.recording.foxglove.schemas import schema_of


class Schema(NamedTuple):
    """What a type of message looks like."""

    name: str
    encoding: str  # of the text
    text: bytes


class Form(NamedTuple):
    """How messages are written."""

    encoding: str  # as MCAP calls it
    encode_into: Callable[[Any, bytearray, int], None]  # has a buffer end with a message that begins there, behind its end
    schema: Callable[[type], Schema]


@functools.cache  # a dozen types, 3 ms a run
def _json_schema(message_type: type) -> Schema:
    name, text = schema_of(message_type)
    return Schema(name, "jsonschema", text)


JSON = Form("json", msgspec.json.Encoder(enc_hook=to_json).encode_into, _json_schema)
