"""Every key of a scenario, table by table, from the code: what ``vcmvsp reference`` prints and completion completes.

A `Place` is somewhere in a scenario where a table may stand. Places are known without loading anything; the `Section`s of a
place are what the code says of it: one for the keys that count whatever its ``kind``, and one for each kind.
"""

import functools
import re
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import msgspec

from vcmvsp.cosim.assembly.parts.presets import LAYERS, PRESETS
from vcmvsp.cosim.config import binding, builtin_kinds, registry
from vcmvsp.cosim.reference import describe
from vcmvsp.cosim.reference.describe import Described
from vcmvsp.cosim.scenario import schema as scenario_tables
from vcmvsp.cosim.scenario.loader import Repeat
from vcmvsp.cosim.scenario.schema import AgentTable, SafetyTable, Scenario, VehicleTable

SCHEMA = "vcmvsp.reference/1"
REST = ("defaults", "params", "doors", "channel", "router", "programs")  # what is no key of the table itself
OF_ALL = ("world", "sensor")  # groups whose kinds have much in common: it is said once
VEHICLE = "vehicle.NAME"
DOORS = (*builtin_kinds.KINDS["door"],)


class Key(msgspec.Struct, frozen=True, kw_only=True):
    """One key of a table."""

    name: str
    type: str  # unit and allowed values in words: "s, 0 to 1e9"
    unit: str  # "s", "m", ...; empty: it has none, or `meaning` says it
    schema: dict[str, Any]  # JSON Schema of its values; empty: the code says no more than `type`
    required: bool
    default: object  # None: there is none
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
    own: Callable[[], Sequence[type]] = tuple  # what has the keys that count whatever its kind

    @property
    def steps(self) -> tuple[str, ...]:
        """Its path without names of one's own."""
        return steps_of(self.path)

    @property
    def name(self) -> str:
        """The same in one word: ``vehicle.agent``."""
        return ".".join(self.steps)

    @property
    def kinds(self) -> Sequence[str]:
        """The kinds that it may be of."""
        return [*builtin_kinds.KINDS[self.group]] if self.group else []


def radio() -> Sequence[type]:
    """The class that ``[radio]`` describes, but for its layers."""
    from vcmvsp.cosim.assembly.parts.radio import RadioFederate

    return [RadioFederate]


def vehicle_radio() -> Sequence[type]:
    """The class that ``[vehicle.radio]`` describes."""
    from vcmvsp.cosim.assembly.parts.radio import Radio

    return [Radio]


def positioning() -> Sequence[type]:
    """The class that ``[vehicle.positioning]`` describes."""
    from vcmvsp.cosim.assembly.parts.vehicles import Positioning

    return [Positioning]


def fusion() -> Sequence[type]:
    """The class that ``[vehicle.fusion]`` describes."""
    from vcmvsp.cosim.estimation.fusion import Fusion

    return [Fusion]


def _field(name: str) -> Callable[[], Sequence[type]]:
    return lambda: binding.structs(binding.parameters(Scenario)[name].annotation)


def _door(kind: str) -> Callable[[], Sequence[type]]:
    return lambda: [registry.find("door", kind)]


@functools.cache
def places() -> Sequence[Place]:
    """All places, in the order in which they are shown."""
    layers = [Place(f"radio.{each}", each) for each in LAYERS]
    known = {
        "physics": [Place("physics", "physics")],
        "world": [Place("world", "world")],
        "radio": [Place("radio", own=radio), *layers],
        "routing": [Place("routing", "routing")],
        "bridge": [Place("bridge", own=_field("bridge")), *(Place(f"bridge.{kind}", own=_door(kind)) for kind in DOORS)],
        "agents": [Place("agents", "agent", _field("agents"))],
        "vehicles": [],
        "vehicle": [
            Place(VEHICLE, "vehicle", lambda: [VehicleTable, Repeat]),
            Place(f"{VEHICLE}.agent", own=lambda: [AgentTable]),
            Place(f"{VEHICLE}.positioning", own=positioning),
            Place(f"{VEHICLE}.sensors.SENSOR", "sensor"),
            Place(f"{VEHICLE}.radio", own=vehicle_radio),
            Place(f"{VEHICLE}.driver", "driver"),
            Place(f"{VEHICLE}.localisation", "localisation"),
            Place(f"{VEHICLE}.fusion", own=fusion),
            Place(f"{VEHICLE}.safety", own=lambda: [SafetyTable]),
        ],
    }
    found = [
        known.get(each) or ([Place(each, own=_field(each))] if _is_table(each) else []) for each in binding.parameters(Scenario)
    ]
    return [Place("", own=lambda: [Scenario]), *(place for each in found for place in each)]


def _is_table(name: str) -> bool:
    """Whether a key of a scenario is one table, neither a list of them nor one of several kinds."""
    return len(_field(name)()) == 1 and _field(name)()[0] is binding.parameters(Scenario)[name].annotation


def steps_of(path: str) -> tuple[str, ...]:
    """A path without names of one's own."""
    return tuple(each for each in path.split(".") if each and not each.isupper())


def of_place(place: Place) -> Iterator[Section]:
    """What the code says of a place: what all kinds have, each kind, and the tables within."""
    classes = {kind: registry.find(place.group, kind) for kind in place.kinds}
    own, common = list(place.own()), None
    if place.group in OF_ALL:
        common = describe.common_of(classes.values())
        own.append(common)
    known = {registry.find(place.group, kind): kind for kind in place.kinds}
    if own:
        keys = tuple(key for each in own for key in _keys(each))
        about = _about(own[0])
        yield Section(path=place.path, kind="", listed=False, about=about, keys=(*_more(place), *keys))
    for target, kind in known.items():
        yield Section(path=place.path, kind=kind, listed=False, about=_about(target), keys=(*_keys(target, common),))
    yield from _within(place.path, [*own, *known], set())


def _within(path: str, targets: Sequence[Described], seen: set[tuple[str, Described]]) -> Iterator[Section]:
    """The tables that these hold, and those within them, each once."""
    for target in targets:
        for name, parameter in _parameters(target).items():
            below = f"{path}.{name}" if path else name
            held = [each for each in binding.structs(parameter.annotation) if (below, each) not in seen]
            if below == "vehicle" or below in {place.path for place in places()}:
                continue
            for each in held:
                seen.add((below, each))
                kind, listed = str(each.__struct_config__.tag or ""), typing.get_origin(parameter.annotation) is tuple
                yield Section(path=below, kind=kind, listed=listed, about=_about(each), keys=(*_keys(each),))
            yield from _within(below, held, seen)


def _about(target: Described) -> str:
    """What a class is, without where it stands."""
    return re.sub(r"^(An? )?`\[+\w+\]+`[:;.] ?", "", describe.about(target))


def _parameters(target: Described, common: type | None = None) -> Mapping[str, binding.Parameter]:
    ours = target.__module__ in (scenario_tables.__name__, Repeat.__module__)  # nothing else offers what these name
    known = binding.parameters(target) if ours else describe.keys(target, common)
    return {name: each for name, each in known.items() if name not in REST}


def _keys(target: Described, common: type | None = None) -> Iterator[Key]:
    """The keys of a class, in its order."""
    means = {**describe.first_meanings(target), **describe.EXTRA_DOCS.get(target.__name__, {})}
    for name, parameter in _parameters(target, common).items():
        meaning, without = describe.said(parameter, means.get(name, ""))
        yield Key(
            name=name,
            type=describe.type_of(name, parameter.annotation).replace(": see below", ""),
            unit=describe.unit_of(name),
            schema=_schema(parameter.annotation),
            required=parameter.required,
            default=None if parameter.required else binding.plain(describe.changed(parameter.default)),
            without=describe.markdown(without),
            meaning=describe.markdown(meaning),
        )


def _more(place: Place) -> Iterator[Key]:
    """The keys that are no parameters of anything: a radio's preset, which fills its layers."""
    if place.path == "radio":
        yield Key(
            name="preset",
            type="string",
            unit="",
            schema={"enum": [*PRESETS]},
            required=False,
            default="ideal",
            without="",
            meaning=f"fills all layers; a table of a layer changes some of its keys: {', '.join(PRESETS)}",
        )


def _schema(annotation: object) -> dict[str, Any]:
    """JSON Schema of the values; tables have sections of their own."""
    if binding.structs(annotation):
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
    return Reference(sections=tuple(each for place in places() for each in of_place(place)))
