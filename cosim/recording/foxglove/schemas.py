"""JSON Schemas of the messages of a recording: simple enough for every reader, with words where names do not say it all."""

from typing import Any

import msgspec
import numpy as np

from vcmvsp.cosim.recording.foxglove.messages import FoxgloveMessage
from vcmvsp.cosim.types import FrameReport, Looks

FRAME = {
    "type": "always 'frame'",
    "frame": "number of the frame, unique in the run, in the order in which frames entered the channel",
    "sender": "name of the vehicle that sent it",
    "sent_ns": "when its sender handed it to the radio, ns since the start of the run",
    "size_bytes": "payload, bytes",
    "receivers": "names of the vehicles that it was meant for; every list below has an entry for each of them, in this order",
    "distance_m": "how far the receiver was from the sender, m",
    "rssi_dbm": "received power, dBm",
    "received_ns": "when it arrived, ns since the start of the run; -1: it was lost",
    "outcome": "'received', or the cause of the loss",
    "air_time_ns": "how long one transmission takes, ns; 0: it was never sent",
    "queue_ns": "how long it waited behind its sender's earlier frames, ns",
    "access_ns": "how long it waited for the air, earlier attempts included, ns",
    "copy_ns": "when a second copy arrived, ns since the start of the run; -1: none did; null: the channel makes none",
    "snr_db": "signal over noise alone, dB; null: the channel has no noise",
    "sinr_db": "signal over noise and interference, the least while it was on the air, dB; null: not known",
    "path_loss_db": "loss over the distance, without walls and fading, dB; null: the channel has no such layer",
    "walls": "how many walls are crossed; null: the channel has no such layer",
    "wall_materials": "of the walls, e.g. '2 brick, 1 wood'; null: the channel has no such layer",
    "wall_loss_db": "loss in walls, dB; null: the channel has no such layer",
    "shadowing_db": "loss by shadowing, dB; null: the channel has no such layer",
    "fading_db": "gain by fading, dB, mostly negative; null: the channel has no such layer",
}
"""What the fields of ``radio/frame`` mean, to those who read a recording without this program."""


def schema_of(message_type: type) -> tuple[str, bytes]:
    """Schema name and JSON Schema of a message type: ``foxglove.*`` for those above, ``vcmvsp.*`` for the platform's values."""
    name = message_type.__name__
    known = issubclass(message_type, FoxgloveMessage)
    title = f"foxglove.{name}" if known else f"vcmvsp.{name.removesuffix('Report')}"
    (root,), definitions = msgspec.json.schema_components([message_type], schema_hook=_array_schema)
    schema = _simple(root, definitions)
    if message_type is Looks:
        schema["properties"] |= {"cells": _listed(_listed({"type": "integer"})), "hits": _listed({"type": "boolean"})}
    if message_type is FrameReport:
        schema["description"] = "What became of one frame at every receiver that it was meant for."
        schema["properties"] = {field: {**node, "description": FRAME[field]} for field, node in schema["properties"].items()}
    schema["title"] = title
    return title, msgspec.json.encode(schema)


def _listed(items: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": items}


def _array_schema(annotation: object) -> dict[str, Any]:
    if annotation is np.ndarray:
        return _listed({"type": "number"})
    raise TypeError(f"no JSON Schema for {annotation}")


def _simple(node: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    """The same schema for a simple reader: every node has a ``type``, every object its ``properties``.

    Foxglove's and Lichtblick's readers follow no references, and know no unions and no tuples; they ask a schema for the names
    of fields only. So a field that may also be null, or of a second type, is described by its first type and not required.
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
