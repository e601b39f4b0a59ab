"""Where a scenario came from: its file, the lines of its keys, and what the command line has set instead."""

import re
from collections.abc import Container, Mapping
from pathlib import Path
from typing import Any


class Source:
    """Where a scenario was read from: a `cosim.config.binding.Origin` that knows lines and ``--set`` arguments."""

    def __init__(self, name: str, folder: Path, text: str = "") -> None:
        self.name, self.folder = name, folder
        self._lines = _lines_of(text)
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
        for prefix in _prefixes(key):
            if prefix in self._set:
                return self._set[prefix]
        inside = [argument for path, argument in self._set.items() if path.startswith(f"{key}.")]
        if key and inside:
            return inside[-1]
        of_all = re.sub(r"^(vehicle\.[^.]*?)\d+(?=\.|$)", r"\1", key)  # one of many that stand in one table
        line = next((self._lines[prefix] for prefix in (*_prefixes(key), *_prefixes(of_all)) if prefix in self._lines), None)
        return f"{self.name} line {line}" if line and key else self.name


_HEADER = re.compile(r"^\s*(\[\[?)\s*([^\[\]]+?)\s*\]\]?\s*(#.*)?$")
_KEY = re.compile(r"^\s*([A-Za-z0-9_.\"'-]+)\s*=\s*(.*)$")


def _lines_of(text: str) -> dict[str, int]:
    """Key path -> line, for messages: table headers and keys that begin a line, vehicles by name."""
    found: dict[str, int] = {}
    here, pending, vehicle = "", {}, "vehicle"
    for number, line in enumerate(text.splitlines(), 1):
        if header := _HEADER.match(line):
            here = header[2].replace("vehicle", vehicle, 1) if header[2].startswith("vehicle.") else header[2]
            pending = {here: number}
            if here != "vehicle":
                found.setdefault(here, number)
        elif key := _KEY.match(line):
            pending[f"{here}.{key[1]}".lstrip(".")] = number
            if here == "vehicle" and key[1] == "name":
                here = vehicle = f"vehicle.{key[2].split('#')[0].strip().strip(chr(34) + chr(39))}"
                pending = {path.replace("vehicle", here, 1): line_number for path, line_number in pending.items()}
        found.update({path: line_number for path, line_number in pending.items() if path != "vehicle"})
    return found


def _prefixes(key: str) -> list[str]:
    parts = re.sub(r"\[\d+\]", "", key).split(".")  # items of a list stand in its lines
    return [".".join(parts[:length]) for length in range(len(parts), 0, -1)]
