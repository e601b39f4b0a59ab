"""Every key of a scenario, table by table, from the code: what ``vcmvsp reference`` prints and completion completes.

A `Place` is somewhere in a scenario where a table may stand. Places are known without loading anything; the `Section`s of a
place are what the code says of it: one for the keys that count whatever its ``kind``, and one for each kind.
"""

import difflib
import functools
import operator
import re
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import msgspec

from cosim import reference, registry, scenario_tables, table
from cosim.errors import UsageError
from cosim.reference_unsaid import UNSAID
from cosim.repeat import Repeat
from cosim.scenario_tables import AgentTable, SafetyTable, Scenario, VehicleTable

SCHEMA = "vcmvsp.reference/1"
REST = ("defaults", "params", "doors", "channel", "router")  # what is no key of the table itself
OF_ALL = ("world", "sensor")  # groups whose kinds have much in common: it is said once
VEHICLE = "vehicle.NAME"
DOORS = (*registry.KINDS["door"],)


class Key(msgspec.Struct, frozen=True, kw_only=True):
    """One key of a table."""

    name: str
    type: str  # unit and allowed values in words: "s, 0 to 1e9"
    unit: str  # "s", "m", ...; empty: it has none, or `meaning` says it
    schema: dict[str, Any]  # JSON Schema of its values; empty: the code says no more than `type`
    required: bool
    default: Any  # None: there is none
    without: str  # what holds without it, where it has no default: "no limit"
    meaning: str


class Section(msgspec.Struct, frozen=True, kw_only=True):
    """The keys of a table, whatever its kind or of one kind."""

    path: str  # of the table, as in --set PATH.KEY=VALUE; NAME and SENSOR stand for names of your own; empty: the top
    kind: str  # its `kind` where these are keys of that kind alone; empty: of all
    listed: bool  # a list of such tables, [[...]] or [{ ... }, ...], none of which --set reaches
    about: str
    keys: tuple[Key, ...]


class Reference(msgspec.Struct, frozen=True, kw_only=True):
    """What ``vcmvsp reference --json`` prints."""

    schema: str = SCHEMA
    sections: tuple[Section, ...]


class Place(typing.NamedTuple):
    """Somewhere in a scenario where a table may stand."""

    path: str
    group: str = ""  # of its kinds; empty: it has none
    own: Callable[[], Sequence[Any]] = tuple  # what has the keys that count whatever its kind

    @property
    def steps(self) -> tuple[str, ...]:
        """Its path without names of one's own."""
        return _steps(self.path)

    @property
    def name(self) -> str:
        """The same in one word: ``vehicle.agent``."""
        return ".".join(self.steps)

    @property
    def kinds(self) -> Sequence[str]:
        """The kinds that it may be of."""
        return [*registry.KINDS[self.group]] if self.group else []


def _piece(name: str) -> Callable[[], Sequence[Any]]:
    return lambda: [registry.piece(name)]


def _field(name: str) -> Callable[[], Sequence[Any]]:
    return lambda: table.structs(table.parameters(Scenario)[name].annotation)


def _door(kind: str) -> Callable[[], Sequence[Any]]:
    return lambda: [registry.find("door", kind)]


@functools.cache
def places() -> Sequence[Place]:
    """All places, in the order in which they are shown."""
    layers = [Place(f"radio.{each}", each) for each in registry.piece("radio presets").LAYERS]
    known = {
        "physics": [Place("physics", "physics")],
        "world": [Place("world", "world")],
        "radio": [Place("radio", own=_piece("radio")), *layers],
        "routing": [Place("routing", "routing")],
        "bridge": [Place("bridge", own=_field("bridge")), *(Place(f"bridge.{kind}", own=_door(kind)) for kind in DOORS)],
        "agents": [Place("agents", "agent", _field("agents"))],
        "vehicles": [],
        "vehicle": [
            Place(VEHICLE, "vehicle", lambda: [VehicleTable, Repeat]),
            Place(f"{VEHICLE}.agent", own=lambda: [AgentTable]),
            Place(f"{VEHICLE}.positioning", own=_piece("positioning")),
            Place(f"{VEHICLE}.sensors.SENSOR", "sensor"),
            Place(f"{VEHICLE}.radio", own=_piece("vehicle radio")),
            Place(f"{VEHICLE}.driver", "driver"),
            Place(f"{VEHICLE}.localisation", "localisation"),
            Place(f"{VEHICLE}.fusion", own=_piece("fusion")),
            Place(f"{VEHICLE}.safety", own=lambda: [SafetyTable]),
        ],
    }
    found = [
        known.get(each) or ([Place(each, own=_field(each))] if _is_table(each) else []) for each in table.parameters(Scenario)
    ]
    return [Place("", own=lambda: [Scenario]), *(place for each in found for place in each)]


def _is_table(name: str) -> bool:
    """Whether a key of a scenario is one table, neither a list of them nor one of several kinds."""
    return len(_field(name)()) == 1 and _field(name)()[0] is table.parameters(Scenario)[name].annotation


# --- what is asked for --------------------------------------------------------------------------------------------------------


def asked(section: str = "") -> Iterator[Section]:
    """The sections that a name stands for, as they are found out; all of them, if it is empty.

    ``radio`` is that table and all within it, ``radio.loss.bernoulli`` one kind, ``radio.loss.probability`` one key; the
    beginning may be left out, as in ``loss`` or ``leader_follower``.

    Raises:
        UsageError: there is nothing of that name; the nearest one is told.
    """
    if not section:
        return (each for place in places() for each in of_place(place))
    wanted = _steps(section) or (section,)
    top, *others = places()
    named = [(place, 0) for place in others if _overlap(place.steps, wanted)]
    within = [(place, cut) for place in others for cut in range(1, len(place.steps)) if _overlap(place.steps[cut:], wanted)]
    kinds = [(place, len(place.steps)) for place in others if wanted[:1] and wanted[0] in place.kinds]
    for candidates in (named, [(top, 0)], [*within, *kinds]):
        chosen = [
            part
            for place, cut in candidates
            for each in of_place(place)
            if (part := _part(each, _steps(each.path)[cut:], place, wanted)) is not None
        ]
        if chosen:
            return iter(chosen)
    anywhere = [part for each in whole().sections for part in _called(each, wanted)]
    if anywhere:
        return iter(anywhere)
    raise UsageError(f"vcmvsp reference {section}: {_nearest(section, wanted)}")


def _steps(path: str) -> tuple[str, ...]:
    """A path without names of one's own."""
    return tuple(each for each in path.split(".") if each and not each.isupper())


def _overlap(some: tuple[str, ...], others: tuple[str, ...]) -> bool:
    """Whether one begins with the other."""
    return all(map(operator.eq, some, others))


def _part(section: Section, name: tuple[str, ...], place: Place, wanted: tuple[str, ...]) -> Section | None:
    """Of a section of this name what is wanted: all of it, one key, or nothing."""
    kinds = [section.kind] if section.kind else place.kinds if section.path == place.path else []
    if (name and name[: len(wanted)] == wanted) or wanted in [(*name, kind) for kind in kinds]:
        return section
    named = [name, *((*name, kind) for kind in kinds)]
    keys = tuple(key for key in section.keys if wanted in [(*each, key.name) for each in named])
    return msgspec.structs.replace(section, keys=keys) if keys else None


def _called(section: Section, wanted: tuple[str, ...]) -> list[Section]:
    """What is wanted, if a table within a table or a key has that name: ``formation``, ``probability``."""
    steps = _steps(section.path)
    place = Place(section.path)
    parts = (_part(section, steps[cut:], place, wanted) for cut in range(1, len(steps) + 1))
    return [part for part in parts if part is not None][:1]


def _nearest(section: str, wanted: tuple[str, ...]) -> str:
    """What there is instead: the keys and kinds of the last table that it names, or all tables."""
    begun = [place for place in places() if place.steps and wanted[: len(place.steps)] == place.steps]
    if begun:
        place = max(begun, key=lambda each: len(each.steps))
        size = len(place.steps)
        keys = {key.name for each in of_place(place) if each.path == place.path for key in each.keys}
        keys |= {each.steps[size] for each in places() if each.steps[:size] == place.steps and len(each.steps) > size}
        return table.unknown(f"key or kind of {place.name}", ".".join(wanted[size:]), {*keys, *place.kinds})
    _, *others = places()
    kinds = {kind for place in others for kind in place.kinds}
    near = difflib.get_close_matches(section, kinds, n=1)
    return table.unknown("section", section, {*table.parameters(Scenario), *(place.name for place in others), *near})


# --- what the code says -------------------------------------------------------------------------------------------------------


def of_place(place: Place) -> Iterator[Section]:
    """What the code says of a place: what all kinds have, each kind, and the tables within."""
    classes = {kind: registry.find(place.group, kind) for kind in place.kinds}
    own, common = list(place.own()), None
    if place.group in OF_ALL:
        common = reference.common_of(classes.values())
        own.append(common)
    known = {registry.find(place.group, kind): kind for kind in place.kinds}
    if own:
        keys = tuple(key for each in own for key in _keys(each))
        about = _about(own[0])
        yield Section(path=place.path, kind="", listed=False, about=about, keys=(*_more(place), *keys))
    for target, kind in known.items():
        yield Section(path=place.path, kind=kind, listed=False, about=_about(target), keys=(*_keys(target, common),))
    yield from _within(place.path, [*own, *known], set())


def _within(path: str, targets: Sequence[Any], seen: set[tuple[str, Any]]) -> Iterator[Section]:
    """The tables that these hold, and those within them, each once."""
    for target in targets:
        for name, parameter in _parameters(target).items():
            below = f"{path}.{name}" if path else name
            held = [each for each in table.structs(parameter.annotation) if (below, each) not in seen]
            if below == "vehicle" or below in {place.path for place in places()}:
                continue
            for each in held:
                seen.add((below, each))
                kind, listed = str(each.__struct_config__.tag or ""), typing.get_origin(parameter.annotation) is tuple
                yield Section(path=below, kind=kind, listed=listed, about=_about(each), keys=(*_keys(each),))
            yield from _within(below, held, seen)


def _about(target: Any) -> str:
    """What a class is, without where it stands."""
    return re.sub(r"^(An? )?`\[+\w+\]+`[:;.] ?", "", reference.about(target))


def _parameters(target: Any, common: Any = None) -> Mapping[str, table.Parameter]:
    ours = target.__module__ in (scenario_tables.__name__, Repeat.__module__)  # nothing else offers what these name
    known = table.parameters(target) if ours else reference.keys(target, common)
    return {name: each for name, each in known.items() if name not in REST}


def _keys(target: Any, common: Any = None) -> Iterator[Key]:
    """The keys of a class, in its order."""
    means = {**reference.first_meanings(target), **UNSAID.get(getattr(target, "__name__", ""), {})}
    for name, parameter in _parameters(target, common).items():
        meaning, without = reference.said(parameter, means.get(name, ""))
        yield Key(
            name=name,
            type=reference.type_of(name, parameter.annotation).replace(": see below", ""),
            unit=reference.unit_of(name),
            schema=_schema(parameter.annotation),
            required=parameter.required,
            default=None if parameter.required else table.plain(reference.changed(parameter.default)),
            without=reference.markdown(without),
            meaning=reference.markdown(meaning),
        )


def _more(place: Place) -> Iterator[Key]:
    """The keys that are no parameters of anything: a radio's preset, which fills its layers."""
    if place.path == "radio":
        presets = registry.piece("radio presets").PRESETS
        yield Key(
            name="preset",
            type="string",
            unit="",
            schema={"enum": [*presets]},
            required=False,
            default="ideal",
            without="",
            meaning=f"fills all layers; a table of a layer changes some of its keys: {', '.join(presets)}",
        )


def _schema(annotation: Any) -> dict[str, Any]:
    """JSON Schema of the values; tables have sections of their own."""
    if table.structs(annotation):
        return {"type": "array" if typing.get_origin(annotation) is tuple else "object"}
    try:
        schema = msgspec.json.schema(annotation)
    except TypeError:  # what only Python objects meet
        return {}
    choices = [each for each in schema.get("anyOf", []) if each != {"type": "null"}]  # TOML has no null
    return choices[0] if len(choices) == 1 else schema


@functools.cache
def whole() -> Reference:
    """All of it."""
    return Reference(sections=tuple(asked()))
