"""Words of error messages about configured values: what is allowed, what is nearly it, how values and key paths are shown."""

import collections.abc
import difflib
import types
import typing
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec


def unknown(what: str, name: str, allowed: Iterable[str]) -> str:
    """``unknown key 'probabilty'; did you mean 'probability'? (allowed: ...)``."""
    names = sorted(set(allowed))
    near = difflib.get_close_matches(name, names, n=1)
    guess = f"; did you mean '{near[0]}'?" if near else ""
    return f"unknown {what} '{name}'{guess} (allowed: {', '.join(names) or 'none'})"


def unlike(value: object, annotation: object) -> str:
    """What is allowed instead of this value, and which of a choice is nearly it."""
    problem = f"must be {describe(annotation)}, not {show(value)}"
    choices = [each for each in typing.get_args(annotation) if isinstance(each, str)]
    near = difflib.get_close_matches(value, choices, n=1) if isinstance(value, str) else []
    return f"{problem}; did you mean '{near[0]}'?" if near else problem


def describe(annotation: object) -> str:
    """What values an annotation allows, in words."""
    origin, inner = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        limits = [(sign, getattr(meta, name)) for meta in inner[1:] for name, sign in _SIGNS]
        bounds = [
            f"{sign} {limit if isinstance(limit, str) else format(limit, 'g')}" for sign, limit in limits if limit is not None
        ]
        return f"{describe(inner[0])} {' and '.join(bounds)}".rstrip()
    if origin is typing.Literal:
        return f"one of {', '.join(map(repr, inner))}"
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(describe(each) for each in inner if each is not type(None)))
    if origin is tuple and inner[-1] is not Ellipsis:
        return f"a list of {len(inner)} values, each {' / '.join(dict.fromkeys(map(describe, inner)))}"
    if origin in (tuple, list, collections.abc.Sequence):
        return f"a list, each item {describe(inner[0])}"
    if origin in (dict, collections.abc.Mapping) or annotation is dict:
        return "a table"
    if isinstance(annotation, type) and issubclass(annotation, msgspec.Struct):
        tag = annotation.__struct_config__.tag_field
        return f"a table with its {tag}" if tag else "a table"
    return _WORDS.get(annotation, f"a {getattr(annotation, '__name__', annotation)}")


def join(*parts: str) -> str:
    """A key path of the parts that are not empty."""
    return ".".join(part for part in parts if part)


def show(value: object) -> str:
    """The value for a message, cut where it is long; what fails to show itself, as integers of 4301 digits do, by its type."""
    try:
        text = repr(value)
    except Exception:
        text = f"a {type(value).__name__} that cannot be shown"
    return text if len(text) <= 60 else text[:57] + "..."


_SIGNS = (("gt", ">"), ("ge", ">="), ("lt", "<"), ("le", "<="), ("pattern", "matching"))
_WORDS: dict[object, str] = {
    Any: "any value",
    float: "a number",
    int: "a whole number",
    str: "a string",
    Path: "the name of a file",
    bool: "true or false",
}
