"""The tree of all scenario keys, table by table, from the code: for ``vcmvsp reference`` and completion.

A `Place` is a position in a scenario where a table may stand. Places are known without loading anything. A place has one
`Section` for the keys of all kinds, and one for each kind.
"""

import difflib
import functools
import operator
import re
import textwrap
import typing
from collections.abc import Callable, Iterator, Sequence

import msgspec

from vcmvsp.cosim.assembly.parts.presets import LAYERS, PRESETS
from vcmvsp.cosim.config import binding, builtin_kinds, registry
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.reference import describe
from vcmvsp.cosim.reference.describe import Described, Key, keys_of, table_keys, toml
from vcmvsp.cosim.scenario.loader import KEYS as REPEAT_KEYS
from vcmvsp.cosim.scenario.loader import TABLES, Repeat
from vcmvsp.cosim.scenario.schema import AgentTable, SafetyTable, Scenario, StationTable, VehicleTable

SCHEMA = "vcmvsp.reference/1"
OF_ALL = ("world", "sensor")  # groups whose common keys are listed once
VEHICLE, STATION = "vehicle.NAME", "station.NAME"
NOT_SHARED = (
    "name",
    "pose",
    "position",
    "agent",
    "driver",
    "firmware",
    "localisation",
    *REPEAT_KEYS,
)  # [vehicles] has none
DOORS = [f"bridge.{kind}" for kind in builtin_kinds.KINDS["door"]]
STACKS = [f"stack.{kind}" for kind in builtin_kinds.KINDS["stack"]]
EXTRA_ABOUT = {"routing": "Forwarding of messages over other vehicles."}
"""By place: description of a table whose common keys are no parameters of a class."""


class Section(msgspec.Struct, frozen=True, kw_only=True):
    """Keys of a table: common to all kinds, or of one kind."""

    path: str  # of the table, as in --set PATH.KEY=VALUE; NAME, SENSOR and METRIC stand for names of your own; empty: the top
    kind: str  # the only `kind` with these keys; empty: all kinds
    listed: bool  # a list of such tables, [[...]] or [{ ... }, ...], none of which --set reaches
    about: str
    keys: tuple[Key, ...]


class Reference(msgspec.Struct, frozen=True, kw_only=True):
    """Output of ``vcmvsp reference --json``."""

    schema: str = SCHEMA
    sections: tuple[Section, ...]


class Place(typing.NamedTuple):
    """A position in a scenario where a table may stand."""

    path: str
    group: str = ""  # of its kinds; empty: no kinds
    own: Callable[[], Sequence[type]] = tuple  # classes of the keys that all kinds have

    @property
    def steps(self) -> tuple[str, ...]:
        """Steps of the path without user-chosen names."""
        return steps_of(self.path)

    @property
    def name(self) -> str:
        """The steps joined by dots: ``vehicle.agent``."""
        return ".".join(self.steps)

    @property
    def kinds(self) -> Sequence[str]:
        """The possible kinds of the table."""
        return [*builtin_kinds.KINDS[self.group]] if self.group else []


def _radio() -> Sequence[type]:
    from vcmvsp.cosim.assembly.parts.radio import RadioFederate

    return [RadioFederate]


def _vehicle_radio() -> Sequence[type]:
    from vcmvsp.cosim.assembly.parts.radio import Radio

    return [Radio]


def _positioning() -> Sequence[type]:
    from vcmvsp.cosim.assembly.parts.vehicles import Positioning

    return [Positioning]


def _fusion() -> Sequence[type]:
    from vcmvsp.cosim.estimation.fusion import Fusion

    return [Fusion]


def _field(name: str) -> Callable[[], Sequence[type]]:
    return lambda: binding.structs(binding.parameters(Scenario)[name].annotation)


def _kind(group: str, path: str) -> Callable[[], Sequence[type]]:
    return lambda: [registry.find(group, path.partition(".")[2])]


@functools.cache
def places() -> Sequence[Place]:
    """All places, in display order."""
    layers = [Place(f"radio.{each}", each) for each in LAYERS]
    doors = [Place(path, own=_kind("door", path)) for path in DOORS]
    places_of = {
        "physics": [Place("physics", "physics")],
        "world": [Place("world", "world")],
        "radio": [Place("radio", own=_radio), *layers],
        "routing": [Place("routing", "routing")],
        "bridge": [Place("bridge", own=_field("bridge")), *doors],
        "stack": [Place(path, own=_kind("stack", path)) for path in STACKS],
        "agents": [Place("agents", "agent", _field("agents"))],
        "metrics": [Place("metrics", own=_field("metrics")), Place("metrics.own.METRIC", "metric")],
        "vehicle": [
            Place(VEHICLE, "vehicle", lambda: [VehicleTable, Repeat]),
            Place(f"{VEHICLE}.agent", own=lambda: [AgentTable]),
            Place(f"{VEHICLE}.positioning", own=_positioning),
            Place(f"{VEHICLE}.sensors.SENSOR", "sensor"),
            Place(f"{VEHICLE}.radio", own=_vehicle_radio),
            Place(f"{VEHICLE}.driver", "driver"),
            Place(f"{VEHICLE}.firmware", "firmware"),
            Place(f"{VEHICLE}.localisation", "localisation"),
            Place(f"{VEHICLE}.fusion", own=_fusion),
            Place(f"{VEHICLE}.safety", own=lambda: [SafetyTable]),
        ],
        "station": [Place(STATION, own=lambda: [StationTable])],
    }
    listed = [Place("", own=lambda: [Scenario])]
    for name in binding.parameters(Scenario):
        if name in places_of:
            listed += places_of[name]
        elif name in TABLES:
            listed.append(Place(name, own=_field(name)))
    return listed


def steps_of(path: str) -> tuple[str, ...]:
    """Steps of a path without user-chosen names."""
    return tuple(each for each in path.split(".") if each and not each.isupper())


def of_place(place: Place) -> Iterator[Section]:
    """Sections of a place: keys of all kinds, of each kind, and of nested tables."""
    classes = {kind: registry.find(place.group, kind) for kind in place.kinds}
    own, common = list(place.own()), None
    if place.group in OF_ALL:
        common = describe.common_of(classes.values())
        own.append(common)
    kind_of = {registry.find(place.group, kind): kind for kind in place.kinds}
    extra = tuple(extra_keys(place))
    if own or extra:
        keys = tuple(key for each in own for key, _ in keys_of(each))
        about = _about(own[0]) if own else EXTRA_ABOUT[place.path]
        yield Section(path=place.path, kind="", listed=False, about=about, keys=(*extra, *keys))
    for target, kind in kind_of.items():
        yield Section(
            path=place.path,
            kind=kind,
            listed=False,
            about=_about(target),
            keys=tuple(key for key, _ in keys_of(target, common)),
        )
    yield from _within(place.path, [*own, *kind_of], set())


def _within(path: str, targets: Sequence[Described], seen: set[tuple[str, Described]]) -> Iterator[Section]:
    """Sections of the tables that these classes hold, recursively, each once."""
    for target in targets:
        for name, parameter in table_keys(target).items():
            below = f"{path}.{name}" if path else name
            held = [each for each in binding.structs(parameter.annotation) if (below, each) not in seen]
            if below in ("vehicle", "station") or below in {place.path for place in places()}:
                continue
            for each in held:
                seen.add((below, each))
                kind, listed = str(each.__struct_config__.tag or ""), typing.get_origin(parameter.annotation) is tuple
                yield Section(
                    path=below, kind=kind, listed=listed, about=_about(each), keys=tuple(key for key, _ in keys_of(each))
                )
            yield from _within(below, held, seen)


def _about(target: Described) -> str:
    """One-line description of a class, without its table's name."""
    return re.sub(r"^(An? )?`\[+\w+\]+`[:;.] ?", "", describe.about(target))


def extra_keys(place: Place) -> Iterator[Key]:
    """Keys that are not parameters of a class: a radio's preset, which fills its layers, and names of radios."""
    if place.path == "radio":
        meaning = f"sets all layers; the table of a layer changes some of its keys: {', '.join(PRESETS)}"
        preset = _name("preset", meaning, "")
        yield msgspec.structs.replace(preset, schema={"enum": [*PRESETS]}, default="ideal")
        yield _name("name", "of one of several radios, each a table `[[radio]]`", "there is one radio")
        shared = "one of several radios with this channel share a medium and must agree in all keys"
        yield _name("channel", shared, "its own")
    elif place.path == "routing":
        yield _name("radio", "of several radios, the one over which messages are forwarded", "there is one radio")
    elif place.path == "bridge.ip":
        yield _name("radio", "of several radios, the only one with interfaces", "all have one")
    elif place.path.startswith("bridge."):
        yield _name("radio", "of several radios, the one that carries the datagrams", "the first")


def _name(name: str, meaning: str, without: str) -> Key:
    return Key(
        name=name,
        type="string",
        unit="",
        schema={"type": "string"},
        required=False,
        default=None,
        without=without,
        meaning=meaning,
    )


@functools.cache
def full_reference() -> Reference:
    """The whole reference."""
    return Reference(sections=tuple(each for place in places() for each in of_place(place)))


def sections_of(section: str = "") -> Iterator[Section]:
    """The sections that a name stands for, one by one; all sections if it is empty.

    ``radio`` is that table with all nested ones, ``radio.loss.bernoulli`` one kind, ``radio.loss.probability`` one key. The
    first steps may be left out, as in ``loss`` or ``leader_follower``.

    Raises:
        UsageError: the name is unknown; the message names the nearest one.
    """
    if not section:
        return (each for place in places() for each in of_place(place))
    spellings = list(_spellings(steps_of(re.sub(r"\[\d+\]", "", section)) or (section,)))
    for query in spellings:
        if sections := _match_path(query):
            return iter(sections)
    raise UsageError(f"vcmvsp reference {section}: {_nearest(section, spellings[0])}")


def _spellings(query: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """Variants of a path: as given, and without the vehicle and sensor names of messages, as in ``vehicle.car1.driver``."""
    yield query
    if query[0] in ("vehicle", "station") and len(query) > 2 and query[1] not in binding.parameters(VehicleTable):
        query = (query[0], *query[2:])
        yield query
    if query[:2] == ("vehicle", "sensors") and len(query) > 2:
        yield (*query[:2], *query[3:])
    if query[:2] == ("vehicle", "agent") and len(query) > 2:  # parameters of agents stand at [agents]
        yield ("agents", *query[2:])


def _match_path(query: tuple[str, ...]) -> list[Section]:
    """Sections, or parts of sections, for a path without user-chosen names."""
    top, *others = places()
    whole = [(place, 0) for place in others if _overlap(place.steps, query)]
    within = [(place, cut) for place in others for cut in range(1, len(place.steps)) if _overlap(place.steps[cut:], query)]
    kinds = [(place, len(place.steps)) for place in others if query[:1] and query[0] in place.kinds]
    for candidates in (whole, [(top, 0)], [*within, *kinds]):
        chosen = [
            part
            for place, cut in candidates
            for each in of_place(place)
            if (part := _part(each, steps_of(each.path)[cut:], place, query)) is not None
        ]
        if chosen:
            return chosen
    return [part for each in full_reference().sections for part in _called(each, query)]


def _overlap(some: tuple[str, ...], others: tuple[str, ...]) -> bool:
    return all(map(operator.eq, some, others))


def _part(section: Section, name: tuple[str, ...], place: Place, query: tuple[str, ...]) -> Section | None:
    """The wanted part of a section with this name: the whole section, one key, or None."""
    kinds = place.kinds if section.path == place.path else []
    if section.kind:
        kinds = [section.kind]
    with_kinds = [(*name, kind) for kind in kinds]
    if (name and name[: len(query)] == query) or query in with_kinds:
        return section
    begins = query[:-1] in [name, *with_kinds]
    keys = tuple(key for key in section.keys if begins and query[-1:] == (key.name,))
    return msgspec.structs.replace(section, keys=keys) if keys else None


def _called(section: Section, query: tuple[str, ...]) -> list[Section]:
    """The wanted part of a section if a nested table or a key has that name: ``formation``, ``probability``."""
    steps = steps_of(section.path)
    place = Place(section.path)
    parts = (_part(section, steps[cut:], place, query) for cut in range(1, len(steps) + 1))
    return [part for part in parts if part is not None][:1]


def _nearest(section: str, query: tuple[str, ...]) -> str:
    """Message for an unknown name: keys and kinds of the last table that it names, or all tables."""
    begun = [place for place in places() if place.steps and query[: len(place.steps)] == place.steps]
    if begun:
        place = max(begun, key=lambda each: len(each.steps))
        size = len(place.steps)
        keys = {key.name for each in of_place(place) if each.path == place.path for key in each.keys}
        keys |= {each.steps[size] for each in places() if each.steps[:size] == place.steps and len(each.steps) > size}
        return binding.unknown(f"key or kind of {place.name}", ".".join(query[size:]), {*keys, *place.kinds})
    _, *others = places()
    kinds = {kind for place in others for kind in place.kinds}
    near = difflib.get_close_matches(section, kinds, n=1)
    return binding.unknown("section", section, {*binding.parameters(Scenario), *(place.name for place in others), *near})


NARROWEST = 30  # columns for a meaning; with fewer, it is printed below its key
Style = Callable[[str], str]


def lines(section: Section, width: int | None = None, strong: Style = str) -> Iterator[str]:
    """Text lines of a section.

    Args:
        width: columns of the window; None: no wrapping.
        strong: highlights a word.
    """
    head = heading(section)
    yield from _wrapped(f"{strong(head)}: ", len(head) + 2, section.about, width, hanging=4)
    rows = [(key.name, key.type, default_of(key)) for key in section.keys]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for key, row in zip(section.keys, rows, strict=True):
        name, *others = (cell.ljust(size) for cell, size in zip(row, widths, strict=True))
        begun = "  ".join(["", name.replace(key.name, strong(key.name)), *others, ""])
        yield from _wrapped(begun, sum(widths) + 8, key.meaning, width, hanging=sum(widths) + 8)


def heading(section: Section) -> str:
    """Heading of a section: path for ``--set``, and kind."""
    where = f"[[{section.path}]]" if section.listed else section.path or "scenario"
    return f'{where}, kind = "{section.kind}"' if section.kind else where


def default_of(key: Key) -> str:
    """``required``, the default as TOML, or the effect without the key."""
    if key.required:
        return "required"
    return key.without or "none" if key.default is None else toml(key.default)


def _wrapped(begun: str, size: int, words: str, width: int | None, *, hanging: int) -> Iterator[str]:
    """Wrap words after the beginning of a line, which takes ``size`` columns on the screen."""
    if width is None:
        yield f"{begun}{words}".rstrip()
    elif width - size < NARROWEST:
        yield begun.rstrip()
        yield from _lines(words, max(NARROWEST, width), first=6, others=6)
    else:
        first, *others = _lines(words, width, first=size, others=hanging) or [""]
        yield f"{begun}{first[size:]}".rstrip()
        yield from others


def _lines(words: str, width: int, *, first: int, others: int) -> list[str]:
    return textwrap.wrap(
        words, width, initial_indent=" " * first, subsequent_indent=" " * others, break_long_words=False, break_on_hyphens=False
    )
