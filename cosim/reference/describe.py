"""What the code says of the keys of one class: types, units, ranges, defaults, meanings, in the words of the reference.

Types, ranges and defaults are those of its signature (`cosim.config.binding`), meanings those of its docstrings and comments
(`cosim.config.param_docs`).
"""

import functools
import json
import re
import typing
from collections import Counter
from collections.abc import Iterable
from decimal import Decimal
from typing import Any

import msgspec

from vcmvsp.cosim.config import binding, messages
from vcmvsp.cosim.config.param_docs import meanings, summary

OFFERED = ("sightline", "noise_dbm", "world", "outside")
"""Parameters that come from the rest of the scenario (`cosim.assembly.radio`, `cosim.assembly.federates`), not from a key."""

OFFERED_TO = {"physics": ("vehicles",), "hardware": ("start", "now", "vehicle", "folder")}
"""The same, of what is physics' or what a station builds (`cosim.assembly.real_vehicles`)."""

_UNITS = {
    "_per_s": "1/s",
    "_s": "s",
    "seconds": "s",
    "_us": "us",
    "_m": "m",
    "_kg": "kg",
    "_rad": "rad",
    "_hz": "Hz",
    "_bps": "bit/s",
    "_db": "dB",
    "_dbm": "dBm",
    "_dbi": "dBi",
}


def keys(target: Any, common: Any = None) -> dict[str, binding.Parameter]:
    """The parameters that a scenario can give, but for those that are as in a common base class."""
    known = keys(common) if common in getattr(target, "__mro__", ()) and common is not None else {}
    offered = {*OFFERED, *OFFERED_TO.get(target.__module__.removeprefix("vcmvsp.").partition(".")[0], ())}
    own = {name: each for name, each in binding.parameters(target).items() if name not in offered}
    return {name: each for name, each in own.items() if each != known.get(name)}


def common_of(classes: Iterable[Any]) -> Any:
    """The base class that most of these have."""
    bases = [base for each in classes for base in each.__mro__[1:] if "__annotations__" in vars(base)]
    ((common, _),) = Counter(bases).most_common(1)
    return common


def about(target: Any) -> str:
    """What a class is, in a line, without the name of its kind."""
    return markdown(re.sub(r" \(kind ``[^`]*``\)", "", summary(target)))


@functools.cache
def first_meanings(target: Any) -> dict[str, str]:
    """What the first of its base classes that speaks of a parameter says; what others add is of their own default."""
    found: dict[str, str] = {}
    for base in reversed(getattr(target, "__mro__", (target,))):
        found = {**meanings(base), **found}
    return found


def said(parameter: binding.Parameter, words: str) -> tuple[str, str]:
    """What a key means and, where its default is None, what holds without it: ``how long; None: for ever``."""
    if parameter.default is not None:
        return words.rstrip("; "), ""
    meaning, _, without = re.sub(r"\b(None|default): ", "\0", words).partition("\0")
    return meaning.rstrip("; "), without


def type_of(name: str, annotation: Any) -> str:
    """Unit, by the end of the name, and what values are allowed."""
    unit = unit_of(name)
    words = re.sub(r">= (\S+) and <= (\S+)", r"\1 to \2", messages.describe(annotation))
    listed = "list of tables" if typing.get_origin(annotation) is tuple else "table"
    words = f"{listed}: see below" if binding.structs(annotation) else _short(words)
    words = re.sub(r"^a number ?", "", words) if unit or words != "a number" else words
    return ", ".join(filter(None, [unit, words.removeprefix("a ")]))


def unit_of(name: str) -> str:
    """The unit of a key, by the end of its name; empty: it has none, or its meaning says it."""
    return next((unit for end, unit in _UNITS.items() if name.endswith(end)), "")


def default_of(parameter: binding.Parameter, without: str) -> str:
    """``required``, the default as TOML or, where that is None, what then holds; of a table what is unlike its own defaults."""
    if parameter.required:
        return "required"
    value = changed(parameter.default)
    return markdown(without or "none") if value is None else f"`{toml(binding.plain(value))}`"


def changed(value: Any) -> Any:
    """A default; of a table what is unlike the table's own defaults."""
    if isinstance(value, msgspec.Struct):
        known = binding.parameters(type(value))
        return {name: own for name in known if (own := getattr(value, name)) != known[name].default}
    return value


def toml(value: Any) -> str:
    """A value as it can be written in a scenario."""
    if isinstance(value, float):
        return _short(Decimal(repr(value)).normalize().to_eng_string() if abs(value) >= 1e5 else repr(value))
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{name} = {toml(each)}' for name, each in value.items())} }}" if value else "{}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml, value)) + "]"
    return json.dumps(value)


def markdown(text: str) -> str:
    """Text of a docstring: code has single quotes there."""
    return text.replace("``", "`")


def _short(numbers: str) -> str:
    """Numbers without what their exponents need not have: 1e+09 is 1e9; and whole numbers without the largest that there is."""
    return re.sub(r"(?<=\d)[eE]\+?(-?)0*(?=\d)", r"e\1", numbers).replace("0 to 9.22337e18", ">= 0")
