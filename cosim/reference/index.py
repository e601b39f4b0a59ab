"""The keys that ``--set`` can give, for completion, which has no time to look through the code: ``reference_keys.tsv``.

A line for each: its path, with NAME and SENSOR for names of one's own, and values that it may have, divided by tabs.
``python -m vcmvsp.cosim.reference.markdown --write`` brings it up to date.
"""

import functools
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from vcmvsp.cosim.reference.describe import toml
from vcmvsp.cosim.reference.tree import VEHICLE, Key, Section, places, whole

INDEX = Path(__file__).resolve().with_name("reference_keys.tsv")
UPDATE = "python -m vcmvsp.cosim.reference.markdown --write"
OWN = ("name", "pose", "position", "agent", "driver", "localisation", "count", "columns", "spacing")  # no defaults for all


def main(arguments: Sequence[str] | None = None, index: Path = INDEX) -> None:
    """Bring the index up to date, or say that it is not."""
    old = index.read_text("utf-8") if index.exists() else ""
    if "--write" in (sys.argv[1:] if arguments is None else arguments):
        index.write_text(text(), "utf-8")
    elif text() != old:
        sys.exit(f"{index} is not what the code says; update it: {UPDATE}")


@functools.cache
def text() -> str:
    """The index as it should be."""
    found: dict[str, dict[str, None]] = {}
    for path, values in _entries():
        found.setdefault(path, {}).update(dict.fromkeys(values))
    tables = {path.rpartition(".")[0] for path in found} | {each.path for each in whole().sections if each.listed} | {"vehicle"}
    return "".join("\t".join([path, *values]) + "\n" for path, values in found.items() if path not in tables)


def _entries() -> Iterator[tuple[str, list[str]]]:
    """All keys, some of them several times."""
    kinds = [(place.path, list(place.kinds)) for place in places() if place.kinds]
    kinds += [(each.path, [each.kind]) for each in whole().sections if each.kind and _is_set(each)]
    for path, names in kinds:
        yield from ((f"{where}.kind", names) for where in _paths(path, "kind"))
    for section in whole().sections:
        if _is_set(section):
            for key in section.keys:
                yield from ((_join(where, key.name), _values(key)) for where in _paths(section.path, key.name))


def _paths(path: str, key: str) -> list[str]:
    """The tables in which a key of this table may stand: agents and vehicles have theirs, and defaults for all."""
    first, _, rest = path.partition(".")
    if first == "agents":
        return [path, _join(f"{VEHICLE}.agent", rest)]
    if path == VEHICLE:
        return [path] if key in OWN else [path, "vehicles"]
    return [path]


def _is_set(section: Section) -> bool:
    """Whether ``--set`` reaches it: it is no table of a list, nor within one, as the solid of an obstacle is."""
    return not any(each.listed and f"{section.path}.".startswith(f"{each.path}.") for each in whole().sections)


def _values(key: Key) -> list[str]:
    """Values that can be completed: the choice that there is, or the default."""
    choice: list[Any] = key.schema.get("enum", [True, False] if key.schema.get("type") == "boolean" else [])
    words = [each if isinstance(each, str) else toml(each) for each in choice]
    if not words and isinstance(key.default, str | float | int):
        words = [key.default if isinstance(key.default, str) else toml(key.default)]
    return [word for word in words if word and not set(word) & set(" \t\n'\"")]


def _join(*parts: str) -> str:
    return ".".join(each for each in parts if each)


if __name__ == "__main__":
    main()
