"""JSON Schema (draft 2020-12) of a scenario, with the texts, units and ranges of the reference.

A table with a ``kind`` has the keys of that kind (``if``, ``then``); with a user class (``module:Class``) any key. Without a
kind, which another table may give, only the types of keys are checked.
"""

import types
import typing
from collections.abc import Iterable, Mapping
from typing import Any

import msgspec

from vcmvsp.cosim.config import binding, builtin_kinds, registry
from vcmvsp.cosim.reference import describe
from vcmvsp.cosim.reference.describe import Described, Key, keys_of
from vcmvsp.cosim.reference.tree import NOT_SHARED, VEHICLE, Place, extra_keys, places
from vcmvsp.cosim.scenario.loader import KEYS as REPEAT_KEYS

DRAFT = "https://json-schema.org/draft/2020-12/schema"
AGENTS = ("agents", f"{VEHICLE}.agent")
OPEN = (*AGENTS, VEHICLE)
"""Tables whose kind may be given in another table: without a kind they may have any key."""

Schema = dict[str, Any]


def scenario_schema() -> Schema:
    """The schema of a whole scenario in a TOML file."""
    tables = _Tables()
    root: Schema = {"$schema": DRAFT, "title": "VCMVSP scenario", **tables.of_place(places()[0])}
    for place in places()[1:]:
        *parents, last = place.path.split(".")
        parent = root
        for step in parents:
            parent = _inside(parent, step)
        _put(parent, last, tables.of_place(place))
    vehicle = _inside(_inside(root, "vehicle"), "NAME")
    shared = {name: each for name, each in vehicle["properties"].items() if name not in NOT_SHARED}
    root["properties"]["vehicles"] |= {"properties": shared}
    tables.definitions["radio"], reference = root["properties"]["radio"], {"$ref": "#/$defs/radio"}
    several = {"type": "array", "items": {**reference, "required": ["name"]}}
    root["properties"]["radio"] = {"if": {"type": "array"}, "then": several, "else": reference}
    return {**root, "$defs": tables.definitions}


def _inside(schema: Schema, step: str) -> Schema:
    """The schema of a table inside a table; a step in capitals stands for any name."""
    if not step.isupper():
        return schema["properties"][step]
    return schema["items" if step == "NAME" else "additionalProperties"]


def _put(schema: Schema, step: str, table: Schema) -> None:
    """Replace the placeholder of a table in a schema by its full schema."""
    if step == "NAME":
        schema["items"] = table
    elif step.isupper():
        schema["additionalProperties"] = table
    else:
        properties = schema.setdefault("properties", {})
        placeholder = properties.get(step, {})
        properties[step] = {**table, **{name: placeholder[name] for name in ("description", "default") if name in placeholder}}


class _Tables:
    """Schemas of tables; nested tables are shared definitions."""

    def __init__(self) -> None:
        self.definitions: dict[str, Schema] = {}

    def of_place(self, place: Place) -> Schema:
        """The schema of a place: keys of all kinds, and the keys of each kind."""
        table = self._object(place.own())
        table["properties"] |= {key.name: _described(key, key.schema) for key in extra_keys(place)}
        if place.path == VEHICLE:
            table["required"].remove("count")
            table["dependentRequired"] = {name: ["count"] for name in REPEAT_KEYS if name != "count"}
        if place.path == "bridge":
            table["additionalProperties"] = {"type": "object"}  # gateways by any name
        group = "agent" if place.path in AGENTS else place.group
        if place.path.startswith("bridge."):  # with a kind, the table's name is arbitrary
            return {"type": "object", "if": {"not": {"required": ["kind"]}}, "then": {**table, "additionalProperties": False}}
        if not group:
            return table if "additionalProperties" in table else {**table, "additionalProperties": False}
        is_whole = place.path not in AGENTS and not place.path.startswith("radio.")  # a preset may give the other keys
        kinds = {kind: self._kind(group, kind, is_whole=is_whole) for kind in builtin_kinds.KINDS[group]}
        table["properties"]["kind"] = {"anyOf": [{"enum": [*kinds]}, {"type": "string", "pattern": ":"}]}
        table["required"] = [name for name in table.get("required", []) if name != "kind"]
        branches = [{"if": _has_kind({"const": kind}), "then": {"$ref": f"#/$defs/{name}"}} for kind, name in kinds.items()]
        branches.append({"if": _has_kind({"not": {"enum": [*kinds]}}), "then": {"additionalProperties": True}})
        names = {name for each in kinds.values() for name in self.definitions[each]["properties"]}
        allowed_keys = {} if place.path in OPEN else {"propertyNames": {"enum": sorted({*names, *table["properties"]})}}
        branches.append({"if": {"not": {"required": ["kind"]}}, "then": {**allowed_keys, "additionalProperties": True}})
        rest = {} if place.path == "agents" else {"unevaluatedProperties": False}
        return {**table, "allOf": branches, **rest}

    def _kind(self, group: str, kind: str, *, is_whole: bool) -> str:
        """Define the keys of a kind and return the definition's name; ``is_whole``: no other table may give its keys."""
        name = f"{group}.{kind}"
        definition = self.definitions[name] = self._object([registry.find(group, kind)])
        if not is_whole:
            definition.pop("required", None)
        return name

    def _object(self, targets: Iterable[Described]) -> Schema:
        """The schema of one table with the keys of several classes."""
        table: Schema = {"type": "object", "properties": {}}
        required = []
        for target in targets:
            for key, parameter in keys_of(target):
                table["properties"][key.name] = _described(key, self._values(parameter.annotation))
                required += [key.name] if key.required else []
        return {**table, "required": required} if required else table

    def _values(self, annotation: object) -> Schema:
        if not binding.structs(annotation):
            return describe.schema_of(annotation)
        origin, inner = typing.get_origin(annotation), typing.get_args(annotation)
        if origin in (typing.Union, types.UnionType):
            choices = [each for each in inner if each is not type(None)]
            return self._values(choices[0]) if len(choices) == 1 else {"oneOf": [*map(self._choice, choices)]}
        if origin is tuple:
            return {"type": "array", "items": self._values(inner[0])}
        if isinstance(origin, type) and issubclass(origin, Mapping):
            return {"type": "object", "additionalProperties": self._values(inner[1])}
        return self._reference(annotation) if isinstance(annotation, type) else self._values(inner[0])

    def _choice(self, annotation: object) -> Schema:
        """The schema of one alternative; a table must give its kind."""
        tag = next((each.__struct_config__.tag_field for each in binding.structs(annotation)), None)
        return self._values(annotation) | ({"required": [tag]} if tag else {})

    def _reference(self, target: type[msgspec.Struct]) -> Schema:
        name, config = f"{target.__module__.removeprefix('vcmvsp.')}.{target.__name__}", target.__struct_config__
        if name not in self.definitions:
            table = self.definitions[name] = {}
            table |= {**self._object([target]), "description": describe.about(target)}
            if config.tag_field:
                table["properties"][config.tag_field] = {"const": config.tag}
            if config.forbid_unknown_fields:
                table["additionalProperties"] = False
        return {"$ref": f"#/$defs/{name}"}


def _described(key: Key, values: Schema) -> Schema:
    """The schema of a key's values, with meaning, unit and default."""
    words = key.meaning + (f"; default: {key.without}" if key.without else "")
    about = {"description": words, "unit": key.unit, "default": key.default}
    return {**values, **{name: value for name, value in about.items() if value not in ("", None)}}


def _has_kind(values: Schema) -> Schema:
    return {"required": ["kind"], "properties": {"kind": values}}
