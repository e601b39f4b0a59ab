"""Of the reference what somebody asks for by a name: a table, one kind, one key, however much of its path is said."""

import difflib
import operator
import re
from collections.abc import Iterator

import msgspec

from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.reference.tree import Place, Section, of_place, places, steps_of, whole
from vcmvsp.cosim.scenario.schema import Scenario, VehicleTable


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
