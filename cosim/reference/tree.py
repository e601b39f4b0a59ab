"""Every key of a scenario, table by table, from the code: what ``vcmvsp reference`` prints and completion completes.

A `Place` is somewhere in a scenario where a table may stand. Places are known without loading anything; the `Section`s of a
place are what the code says of it: one for the keys that count whatever its ``kind``, and one for each kind.
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
from vcmvsp.cosim.scenario.loader import Repeat
from vcmvsp.cosim.scenario.schema import AgentTable, SafetyTable, Scenario, VehicleTable

SCHEMA = "vcmvsp.reference/1"
OF_ALL = ("world", "sensor")  # groups whose kinds have much in common: it is said once
VEHICLE = "vehicle.NAME"
NOT_SHARED = (
    "name",
    "pose",
    "position",
    "agent",
    "driver",
    "localisation",
    "count",
    "columns",
    "spacing",
)  # [vehicles] has none
DOORS = (*builtin_kinds.KINDS["door"],)


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
        keys = tuple(key for each in own for key, _ in keys_of(each))
        about = _about(own[0])
        yield Section(path=place.path, kind="", listed=False, about=about, keys=(*extra_keys(place), *keys))
    for target, kind in known.items():
        yield Section(
            path=place.path,
            kind=kind,
            listed=False,
            about=_about(target),
            keys=tuple(key for key, _ in keys_of(target, common)),
        )
    yield from _within(place.path, [*own, *known], set())


def _within(path: str, targets: Sequence[Described], seen: set[tuple[str, Described]]) -> Iterator[Section]:
    """The tables that these hold, and those within them, each once."""
    for target in targets:
        for name, parameter in table_keys(target).items():
            below = f"{path}.{name}" if path else name
            held = [each for each in binding.structs(parameter.annotation) if (below, each) not in seen]
            if below == "vehicle" or below in {place.path for place in places()}:
                continue
            for each in held:
                seen.add((below, each))
                kind, listed = str(each.__struct_config__.tag or ""), typing.get_origin(parameter.annotation) is tuple
                yield Section(
                    path=below, kind=kind, listed=listed, about=_about(each), keys=tuple(key for key, _ in keys_of(each))
                )
            yield from _within(below, held, seen)


def _about(target: Described) -> str:
    """What a class is, without where it stands."""
    return re.sub(r"^(An? )?`\[+\w+\]+`[:;.] ?", "", describe.about(target))


def extra_keys(place: Place) -> Iterator[Key]:
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


@functools.cache
def whole() -> Reference:
    """All of it."""
    return Reference(sections=tuple(each for place in places() for each in of_place(place)))


def asked(section: str = "") -> Iterator[Section]:
    """The sections that a name stands for, as they are found out; all of them, if it is empty.

    ``radio`` is that table and all within it, ``radio.loss.bernoulli`` one kind, ``radio.loss.probability`` one key; the
    beginning may be left out, as in ``loss`` or ``leader_follower``.

    Raises:
        UsageError: there is nothing of that name; the nearest one is told.
    """
    if not section:
        return (each for place in places() for each in of_place(place))
    spellings = list(_spellings(steps_of(re.sub(r"\[\d+\]", "", section)) or (section,)))
    for wanted in spellings:
        if found := _found(wanted):
            return iter(found)
    raise UsageError(f"vcmvsp reference {section}: {_nearest(section, spellings[0])}")


def _spellings(wanted: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """A path as it is, and without the names of a vehicle and of a sensor that messages have in it: ``vehicle.car1.driver``."""
    yield wanted
    if wanted[0] == "vehicle" and len(wanted) > 2 and wanted[1] not in binding.parameters(VehicleTable):
        wanted = (wanted[0], *wanted[2:])
        yield wanted
    if wanted[:2] == ("vehicle", "sensors") and len(wanted) > 2:
        yield (*wanted[:2], *wanted[3:])
    if wanted[:2] == ("vehicle", "agent") and len(wanted) > 2:  # parameters of agents stand at [agents]
        yield ("agents", *wanted[2:])


def _found(wanted: tuple[str, ...]) -> list[Section]:
    """The sections, or parts of them, that a path without names of one's own stands for."""
    top, *others = places()
    named = [(place, 0) for place in others if _overlap(place.steps, wanted)]
    within = [(place, cut) for place in others for cut in range(1, len(place.steps)) if _overlap(place.steps[cut:], wanted)]
    kinds = [(place, len(place.steps)) for place in others if wanted[:1] and wanted[0] in place.kinds]
    for candidates in (named, [(top, 0)], [*within, *kinds]):
        chosen = [
            part
            for place, cut in candidates
            for each in of_place(place)
            if (part := _part(each, steps_of(each.path)[cut:], place, wanted)) is not None
        ]
        if chosen:
            return chosen
    return [part for each in whole().sections for part in _called(each, wanted)]


def _overlap(some: tuple[str, ...], others: tuple[str, ...]) -> bool:
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
    steps = steps_of(section.path)
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
        return binding.unknown(f"key or kind of {place.name}", ".".join(wanted[size:]), {*keys, *place.kinds})
    _, *others = places()
    kinds = {kind for place in others for kind in place.kinds}
    near = difflib.get_close_matches(section, kinds, n=1)
    return binding.unknown("section", section, {*binding.parameters(Scenario), *(place.name for place in others), *near})


NARROWEST = 30  # columns for a meaning; where there are fewer, it stands below its key
Style = Callable[[str], str]


def lines(section: Section, width: int | None = None, strong: Style = str) -> Iterator[str]:
    """The lines of a section.

    Args:
        width: of the window; None: there is none, and nothing is wrapped.
        strong: what makes a word stand out.
    """
    head = heading(section)
    yield from _wrapped(f"{strong(head)}: ", len(head) + 2, section.about, width, hanging=4)
    rows = [(key.name, key.type, default_of(key)) for key in section.keys]
    widths = [max(len(row[column]) for row in rows) if rows else 0 for column in range(3)]
    for key, row in zip(section.keys, rows, strict=True):
        name, *others = (cell.ljust(size) for cell, size in zip(row, widths, strict=True))
        begun = "  ".join(["", name.replace(key.name, strong(key.name)), *others, ""])
        yield from _wrapped(begun, sum(widths) + 8, key.meaning, width, hanging=sum(widths) + 8)


def heading(section: Section) -> str:
    """Where the keys stand, as ``--set`` names it, and of which kind they are."""
    where = f"[[{section.path}]]" if section.listed else section.path or "scenario"
    return f'{where}, kind = "{section.kind}"' if section.kind else where


def default_of(key: Key) -> str:
    """``required``, a value as TOML says it, or what holds without one."""
    return "required" if key.required else key.without or "none" if key.default is None else toml(key.default)


def _wrapped(begun: str, size: int, words: str, width: int | None, *, hanging: int) -> Iterator[str]:
    """A line that has begun, with ``size`` columns on the screen, and words that end it or go on below."""
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
