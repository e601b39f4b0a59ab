"""Where a scenario came from: its file, the lines of its keys, and what the command line has set instead."""

import functools
import re
from collections.abc import Container, Iterator, Mapping
from pathlib import Path
from typing import Any

from vcmvsp.cosim.config.key_lines import lines_of, prefixes


class Source:
    """Where a scenario was read from: a `cosim.config.binding.Origin` that knows lines and ``--set`` arguments."""

    def __init__(self, name: str, folder: Path, text: str = "") -> None:
        self.name, self.folder = name, folder
        self._text = text
        self._set: dict[str, str] = {}

    def note_set(self, key: str, argument: str) -> None:
        """The value of ``key`` comes from a command-line argument."""
        self._set[key] = argument

    def kept(self, content: Mapping[str, Any], key: str, known: Container[str]) -> dict[str, Any]:
        """The parameters of a table: if another ``kind`` has been set, the file's count as far as that one knows them."""
        switched = f"{key}.kind" in self._set
        return {
            name: value
            for name, value in content.items()
            if name != "kind" and (not switched or name in known or f"{key}.{name}" in self._set)
        }

    def replaced(self, key: str) -> tuple[str, ...] | None:
        """The names in a table whose values have been set, where another ``kind`` has been; None: that has not."""
        if f"{key}.kind" not in self._set:
            return None
        return tuple(path.removeprefix(f"{key}.").partition(".")[0] for path in self._set if path.startswith(f"{key}."))

    def of(self, key: str) -> str:
        """The argument that set the key or something in it, or file and line."""
        for prefix in prefixes(key):
            if prefix in self._set:
                return self._set[prefix]
        inside = [argument for path, argument in self._set.items() if path.startswith(f"{key}.")]
        if key and inside:
            return inside[-1]
        for place in _places(key):
            if place in self._set:
                return self._set[place]
            if place in self._lines:
                return f"{self.name} line {self._lines[place]}"
        return self.name

    @functools.cached_property
    def _lines(self) -> dict[str, int]:
        return lines_of(self._text)


def _places(key: str) -> Iterator[str]:
    """Where a key may stand, the likeliest first; a copy of a vehicle stands in one table for many, and in that of all."""
    for prefix in prefixes(key):
        yield prefix
        if vehicle := re.fullmatch(r"vehicle\.([^.\[]*?)(\d*)((?:[.\[].*)?)", prefix):
            stem, number, rest = vehicle.groups()
            yield from (f"vehicle.{stem}{number[:length]}{rest}" for length in reversed(range(len(number))))
            if rest:
                yield f"vehicles{rest}"
