"""Description of the keys of one class, from the code: types, units, ranges, defaults, meanings.

Types, ranges and defaults come from the signature (`cosim.config.binding`), meanings from docstrings and comments.
"""

import ast
import functools
import inspect
import io
import json
import re
import textwrap
import tokenize
import typing
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from decimal import Decimal
from typing import Any

import msgspec

from vcmvsp.cosim.assembly.radio import GIVEN
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.scenario import schema
from vcmvsp.cosim.scenario.loader import Repeat


def meanings(target: Callable[..., object], *, joined: bool = False) -> Mapping[str, str]:
    """Documented meanings of the parameters of a class or function, without final period; base classes first.

    ::

        exponent: NonNegative = 3.0  # 2 in free space, about 3 among obstacles

    With ``joined``, a class's text of a parameter follows that of its base instead of replacing it.
    """
    texts: dict[str, str] = {}
    for base in reversed(getattr(target, "__mro__", (target,))):
        own = _comments(base) if isinstance(base, type) and inspect.get_annotations(base) else {}
        for name, text in {**own, **_arguments(base.__doc__ or "")}.items():
            words, before = text.strip().removesuffix("."), texts.get(name, "") if joined else ""
            if words:
                texts[name] = f"{before}; {words}" if before and before != words else words
    return texts


def summary(target: object) -> str:
    """The first line of a class's or function's docstring."""
    return (inspect.getdoc(target) or "").partition("\n")[0]


@functools.cache  # many classes share a base
def _comments(target: type[Any]) -> dict[str, str]:
    """Comments of a class's fields: comment lines above the field, then comments in its own lines."""
    source = textwrap.dedent(inspect.getsource(target))
    lines = source.splitlines()
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    comments = {token.start[0]: token.string.lstrip("# ") for token in tokens if token.type == tokenize.COMMENT}
    fields = next(node.body for node in ast.parse(source).body if isinstance(node, ast.ClassDef))
    comment_of = {}
    for field in fields:
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            first, last = field.lineno, field.end_lineno or field.lineno
            while lines[first - 2].lstrip().startswith("#"):
                first -= 1
            comment_of[field.target.id] = " ".join(comments[line] for line in range(first, last + 1) if line in comments)
    return comment_of


def _arguments(docstring: str) -> dict[str, str]:
    """Entries of a docstring's ``Args``: ``name: words`` or ``one, other: words``, with indented continuation lines."""
    section = re.search(r"^Args:\n(.*?)(?=^\S|\Z)", inspect.cleandoc(docstring), re.DOTALL | re.MULTILINE)
    if section is None:
        return {}
    entries = re.findall(r"^(\w[\w, ]*): (.*(?:\n .*)*)", textwrap.dedent(section[1]), re.MULTILINE)
    return {name: re.sub(r"\s+", " ", words) for names, words in entries for name in names.split(", ")}


Described = Callable[..., object]
"""A class with parameters, or the function of a kind."""

REST = ("defaults", "params", "doors", *GIVEN)
"""Parameters that are not keys of the table itself."""

OFFERED = ("sightline", "solids", "rays", "noise_dbm", "world", "outside", "firmware")
"""Parameters that come from the rest of the scenario (`cosim.assembly.radio`, `cosim.assembly.run`), not from a key."""

STACK = ("flying", "mounts", "deadline_s", "join_timeout_s", "tell")
OFFERED_TO = {"physics": ("vehicles",), "hardware": ("start", "now", "vehicle", "folder", "number", *STACK)}
"""Further such parameters of classes in `physics`, and in `hardware`, where stations give them, or the assembly of stacks."""

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
        "name": "name of the run and its folder",
        "duration_s": "simulated time; agents act at 0 <= t < duration",
        "seed": "seed of all random numbers",
        "physics": "engine that moves the vehicles; default: Bullet",
        "world": "surroundings of the vehicles; default: a floor",
        "radio": "radio channel between the vehicles, or several `[[radio]]`; default: the preset `ideal`",
        "routing": "forwarding of messages over other vehicles; default: none",
        "bridge": "unchanged network programs, in wall-clock time",
        "sockets": "network programs in simulated time",
        "stack": "programs that drive simulated vehicles in place of agents, a table for each kind",
        "agents": "place where agents run, and defaults of their parameters",
        "clock": "synchronisation of a run with the wall clock",
        "safety": "limits of real vehicles",
        "vehicles": "defaults for all vehicles, including parameters of their kinds",
        "record": "contents of the recording",
        "metrics": "time window of the metrics",
        "study": "keys that `vcmvsp study` varies",
        "intervention": "planned interventions of the operator during the run",
        "vehicle": "one table for each vehicle, or for many with a `count`",
        "station": "one table for each fixed place with a radio; default: none",
    },
    "AgentTable": {
        "runs": "place where this agent runs; default: agents.runs",
        "on_lost": "effect on its vehicle or the run if it fails or its host or robot is lost; default: agents.on_lost",
        "period_s": "time between two ticks; default: agents.period_s, else the agent's own",
        "latency_s": "time from an observation to the effect of the command; default: agents.latency_s",
    },
    "VehicleTable": {
        "name": "unique; letters, digits, _ and -",
        "kind": "kind of vehicle: one of the kinds below, module:Class or file.py:Class",
        "pose": "start as x m, y m, yaw rad, in place of `position` and `heading`; default: position and heading",
        "positioning": "positioning system for its `pose_source`; default: none",
        "agent": "agent that controls it; default: none, it stands still",
        "driver": "driver of the real vehicle that replaces it; default: it is simulated",
        "firmware": "autopilot firmware that flies the simulated quadrotor; default: its own autopilot",
        "localisation": "positioning of the real vehicle; default: its odometry",
    },
    "StationTable": {"name": "unique; letters, digits, _ and -", "agent": "its agent, which gives no command; default: none"},
    "RadioFederate": {
        "handover_s": (
            "where several vehicles send at one instant, and contend for the air, "
            "each message takes up to so long to reach the queue of its radio, uniformly"
        )
    },
    "SetTable": {"value": "new value"},
    "StudyTable": {"vary": "key path (in quotes) = list of its values; all combinations are run"},
    "MetricsTable": {
        "from_s": "start of the window for formation, ages, commands and connectivity",
        "to_s": "end of the window, both included; default: the end",
    },
}
"""Meanings of keys that their comments alone do not give, by class and key."""


def keys(target: Described, common: type | None = None) -> dict[str, binding.Parameter]:
    """Parameters that a scenario can give, except those inherited unchanged from a common base class."""
    inherited = keys(common) if common is not None and common in getattr(target, "__mro__", ()) else {}
    offered = {*OFFERED, *OFFERED_TO.get(target.__module__.removeprefix("vcmvsp.").partition(".")[0], ())}
    own = {name: each for name, each in binding.parameters(target).items() if name not in offered}
    return {name: each for name, each in own.items() if each != inherited.get(name)}


def common_of(classes: Iterable[type]) -> type:
    """The most frequent base class of these classes."""
    bases = [base for each in classes for base in each.__mro__[1:] if inspect.get_annotations(base)]
    ((common, _),) = Counter(bases).most_common(1)
    return common


def about(target: Described) -> str:
    """One-line description of a class, without the name of its kind."""
    return markdown(re.sub(r" \(kind ``[^`]*``\)", "", summary(target)))


@functools.cache
def first_meanings(target: Described) -> dict[str, str]:
    """Meaning of each parameter in its topmost documenting base class; subclasses only document their own default."""
    texts: dict[str, str] = {}
    for base in reversed(getattr(target, "__mro__", (target,))):
        texts = {**meanings(base), **texts}
    return texts


def split_default(parameter: binding.Parameter, words: str) -> tuple[str, str]:
    """Split ``how long; None: for ever`` into the meaning and, if the default is None, the effect without the key."""
    if parameter.default is not None:
        return words.rstrip("; "), ""
    meaning, _, without = re.sub(r"\b(None|default): ", "\0", words).partition("\0")
    return meaning.rstrip("; "), without


def type_of(name: str, annotation: object) -> str:
    """Unit, from the end of the name, and allowed values."""
    unit = unit_of(name)
    words = re.sub(r">= (\S+) and <= (\S+)", r"\1 to \2", binding.describe(annotation))
    listed = "list of tables" if typing.get_origin(annotation) is tuple else "table"
    words = f"{listed}: see below" if binding.structs(annotation) else _short(words)
    words = re.sub(r"^a number ?", "", words) if unit or words != "a number" else words
    return ", ".join(filter(None, [unit, words.removeprefix("a ")]))


def unit_of(name: str) -> str:
    """The unit of a key, from the end of its name; empty if it has none or its meaning states it."""
    return next((unit for end, unit in _UNITS.items() if name.endswith(end)), "")


def changed(value: object) -> object:
    """A default; of a table only values that differ from its own defaults."""
    if isinstance(value, msgspec.Struct):
        parameters = binding.parameters(type(value))
        return {name: own for name in parameters if (own := getattr(value, name)) != parameters[name].default}
    return value


def toml(value: object) -> str:
    """A value in TOML."""
    if isinstance(value, float):
        return _short(Decimal(repr(value)).normalize().to_eng_string() if abs(value) >= 1e5 else repr(value))
    if isinstance(value, dict):
        pairs = ", ".join(f"{name} = {toml(each)}" for name, each in value.items())
        return f"{{ {pairs} }}" if value else "{}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml, value)) + "]"
    return json.dumps(value)


def markdown(text: str) -> str:
    """Markdown of a docstring: code in single backquotes."""
    return text.replace("``", "`")


def _short(numbers: str) -> str:
    """Shorten numbers in a text: 1e+09 becomes 1e9, the range of whole numbers loses its upper end."""
    return re.sub(r"(?<=\d)[eE]\+?(-?)0*(?=\d)", r"e\1", numbers).replace("0 to 9.22337e18", ">= 0")


class Key(msgspec.Struct, frozen=True, kw_only=True):
    """One key of a table."""

    name: str
    type: str  # unit and allowed values: "s, 0 to 1e9"
    unit: str  # "s", "m", ...; empty: none, or stated in `meaning`
    schema: dict[str, Any]  # JSON Schema of its values; empty: only `type` is known
    required: bool
    default: object  # None: no default
    without: str  # effect of leaving it out, if it has no default: "no limit"
    meaning: str


def table_keys(target: Described, common: type | None = None) -> Mapping[str, binding.Parameter]:
    """Parameters of a class that are keys of a table."""
    ours = target.__module__ in (schema.__name__, Repeat.__module__)  # these classes have no offered parameters
    parameters = binding.parameters(target) if ours else keys(target, common)
    return {name: each for name, each in parameters.items() if name not in REST}


def keys_of(target: Described, common: type | None = None) -> Iterator[tuple[Key, binding.Parameter]]:
    """Keys of a class with their parameters, in order of definition."""
    means = {**first_meanings(target), **EXTRA_DOCS.get(target.__name__, {})}
    for name, parameter in table_keys(target, common).items():
        meaning, without = split_default(parameter, means.get(name, ""))
        key = Key(
            name=name,
            type=type_of(name, parameter.annotation).replace(": see below", ""),
            unit=unit_of(name),
            schema=schema_of(parameter.annotation),
            required=parameter.required,
            default=binding.plain(changed(parameter.default)),
            without=markdown(without),
            meaning=markdown(meaning),
        )
        yield key, parameter


def schema_of(annotation: object) -> dict[str, Any]:
    """JSON Schema of the values of an annotation; tables have their own sections."""
    if binding.structs(annotation):
        return {"type": "array" if typing.get_origin(annotation) is tuple else "object"}
    try:
        text = msgspec.json.encode(msgspec.json.schema(annotation))
    except TypeError:  # an annotation for Python objects only
        return {}
    node: dict[str, Any] = msgspec.json.decode(text.replace(rb"\\A", b"^").replace(rb"\\Z", b"$"))  # ECMAScript syntax
    choices = [each for each in node.get("anyOf", []) if each != {"type": "null"}]  # TOML has no null
    return _for_all_drafts(choices[0] if len(choices) == 1 else node)


def _for_all_drafts(node: Any) -> Any:
    """A schema that also allows tuples to readers of JSON Schema before 2020-12, as Taplo is: they know no ``prefixItems``."""
    if isinstance(node, list):
        return [_for_all_drafts(each) for each in node]
    if not isinstance(node, dict):
        return node
    converted = {name: _for_all_drafts(each) for name, each in node.items()}
    if converted.get("items") is False:
        places = converted["prefixItems"]
        same = all(each == places[0] for each in places)
        converted |= {"items": places[0] if same else {"anyOf": places}}
        converted = {name: each for name, each in converted.items() if name != "prefixItems" or not same}
    return converted
