"""The numbers of a run as tables: each with its unit and what it is."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from vcmvsp.cosim.report.glossary import GROUPS, meaning_of, unit_of
from vcmvsp.cosim.report.page import Part, Rows, Words

MANY = ("per_follower", "per_vehicle")  # tables of the same numbers, one for each vehicle


def number_tables(metrics: Mapping[str, Any]) -> Iterator[tuple[str, Sequence[Part]]]:
    """Title and content of each group of numbers that a run has, but for the faults of agents (`fault_table`)."""
    for group, (title, introduction) in GROUPS.items():
        if group not in metrics:
            continue
        found = metrics[group]
        parts: list[Part] = [Words(introduction)] if introduction else []
        if group == "hardware":
            parts += [_by_vehicle(group, found), *_explained(group, found)]
        else:
            parts += _table(group, found)
            parts += [_by_vehicle(group, found[name]) for name in MANY if found.get(name)]
        yield title, parts


def fault_table(agents: Mapping[str, Any]) -> Sequence[Part]:
    """Agents that missed something, and what; words where nobody did."""
    faulty = {vehicle: found for vehicle, found in agents.items() if any(found.values())}
    if not faulty:
        return [Words("No agent missed a tick, and none was late.")]
    return [_by_vehicle("agents", faulty), *_explained("agents", faulty)]


def _table(group: str, found: Mapping[str, Any]) -> Iterator[Part]:
    """The numbers that have a value, and the names of those that have none."""
    told = [(path, value) for path, value in flat(found) if value is not None]
    if told:
        rows = [[".".join(path), value, _unit((group, *path)), meaning_of((group, *path))] for path, value in told]
        yield Rows(["number", "value", "unit", "what it is"], rows)
    if untold := [".".join(path) for path, value in flat(found) if value is None]:
        yield Words(f"There was nothing to measure for {', '.join(untold)}.")


def flat(table: Mapping[str, Any], above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Path and value of each number, but for those of each vehicle."""
    for name, value in table.items():
        if name in MANY:
            continue
        if isinstance(value, Mapping):
            yield from flat(value, (*above, name))
        else:
            yield (*above, name), value


def _by_vehicle(group: str, of: Mapping[str, Mapping[str, Any]]) -> Rows:
    """A row for each vehicle; numbers that nobody has are left out."""
    rows = {vehicle: dict(flat(each)) for vehicle, each in of.items()}
    paths = list(dict.fromkeys(path for each in rows.values() for path in each))
    told = [path for path in paths if any(each.get(path) is not None for each in rows.values())]
    units = [_unit((group, *path)) for path in told]
    head = [".".join(path) + (f" [{unit}]" if unit else "") for path, unit in zip(told, units, strict=True)]
    return Rows(["vehicle", *head], [[vehicle, *(each.get(path) for path in told)] for vehicle, each in rows.items()])


def _explained(group: str, of: Mapping[str, Mapping[str, Any]]) -> Sequence[Part]:
    """What the columns of a table by vehicle are."""
    names = dict.fromkeys(name for each in of.values() for name in each)
    return [Words("; ".join(f"{name}: {meaning_of((group, '*', name))}" for name in names) + ".")]


def _unit(path: Sequence[str]) -> str:
    unit = unit_of(path)
    return "" if unit == "1" else unit
