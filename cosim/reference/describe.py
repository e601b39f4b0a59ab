"""What the code says of the keys of one class: types, units, ranges, defaults, meanings, in the words of the reference.

Types, ranges and defaults are those of its signature (`cosim.config.binding`), meanings those of its docstrings and comments
(`cosim.reference.describe`).
"""

import functools
import json
import re
import typing
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from decimal import Decimal

import msgspec

from vcmvsp.cosim.config import binding
from vcmvsp.cosim.reference.describe import meanings, summary

Described = Callable[..., object]
"""A class with parameters, or the function that stands for a kind."""

OFFERED = ("sightline", "noise_dbm", "world", "outside")
"""Parameters that come from the rest of the scenario (`cosim.assembly.radio`, `cosim.assembly.run`), not from a key."""

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

EXTRA_DOCS: Mapping[str, Mapping[str, str]] = {
    "Scenario": {
        "name": "names the run and its folder",
        "duration_s": "simulated time; agents act at 0 <= t < duration",
        "seed": "all that is random depends on it, and on nothing else",
        "physics": "what moves the vehicles; Bullet, unless it says otherwise",
        "world": "what surrounds the vehicles; a floor, unless it says otherwise",
        "radio": "what carries their messages; the preset ideal, unless it says otherwise",
        "routing": "who passes on what others have sent; nobody, unless it says otherwise",
        "bridge": "programs as they are, at wall pace",
        "sockets": "programs that keep the run's own time",
        "agents": "where agents run, and defaults of their parameters",
        "clock": "how a run keeps to the wall clock",
        "safety": "what real vehicles keep to",
        "vehicles": "defaults for all vehicles, also of the parameters of their kinds",
        "record": "what is recorded",
        "metrics": "what is evaluated",
        "study": "what `vcmvsp study` varies",
        "intervention": "what an operator does during the run, planned beforehand",
        "vehicle": "one table for each vehicle, or for many with a `count`",
    },
    "AgentTable": {
        "runs": "where this one runs; default: agents.runs",
        "on_lost": "of its vehicle, or of the run, when it fails, or its host or robot is lost; default: agents.on_lost",
        "period_s": "between two ticks; default: agents.period_s, else the agent's own",
        "latency_s": "from an observation to the effect of the command; default: agents.latency_s",
    },
    "VehicleTable": {
        "name": "unique; letters, digits, _ and -",
        "kind": "what it is: one of those below, module:Class or file.py:Class",
        "pose": "x m, y m, yaw rad: where it starts, in place of `position` and `heading`; default: position and heading",
        "positioning": "the positioning system that its `pose_source` means; default: it has none",
        "agent": "what controls it; default: it stands still",
        "driver": "how the real vehicle is reached that takes its place; default: it is simulated",
        "localisation": "what tells where the real vehicle is; default: its odometry",
    },
    "RadioFederate": {
        "handover_s": (
            "where several vehicles send at one instant, and contend for the air, "
            "each message takes up to so long to reach the queue of its radio, uniformly"
        ),
    },
    "SetTable": {"value": "what it is then"},
    "StudyTable": {"vary": "key path (in quotes) = list of its values; all combinations are run"},
    "MetricsTable": {
        "from_s": "formation, ages, commands and connectivity are evaluated from here",
        "to_s": "to here, both included; default: the end",
    },
}
"""Meanings of keys that their comments alone do not give, by class and key."""


def keys(target: Described, common: type | None = None) -> dict[str, binding.Parameter]:
    """The parameters that a scenario can give, but for those that are as in a common base class."""
    known = keys(common) if common is not None and common in getattr(target, "__mro__", ()) else {}
    offered = {*OFFERED, *OFFERED_TO.get(target.__module__.removeprefix("vcmvsp.").partition(".")[0], ())}
    own = {name: each for name, each in binding.parameters(target).items() if name not in offered}
    return {name: each for name, each in own.items() if each != known.get(name)}


def common_of(classes: Iterable[type]) -> type:
    """The base class that most of these have."""
    bases = [base for each in classes for base in each.__mro__[1:] if "__annotations__" in vars(base)]
    ((common, _),) = Counter(bases).most_common(1)
    return common


def about(target: Described) -> str:
    """What a class is, in a line, without the name of its kind."""
    return markdown(re.sub(r" \(kind ``[^`]*``\)", "", summary(target)))


@functools.cache
def first_meanings(target: Described) -> dict[str, str]:
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


def type_of(name: str, annotation: object) -> str:
    """Unit, by the end of the name, and what values are allowed."""
    unit = unit_of(name)
    words = re.sub(r">= (\S+) and <= (\S+)", r"\1 to \2", binding.describe(annotation))
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


def changed(value: object) -> object:
    """A default; of a table what is unlike the table's own defaults."""
    if isinstance(value, msgspec.Struct):
        known = binding.parameters(type(value))
        return {name: own for name in known if (own := getattr(value, name)) != known[name].default}
    return value


def toml(value: object) -> str:
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
