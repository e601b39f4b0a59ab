"""Origin of a scenario's values: file, lines of keys, and ``--set`` arguments."""

import functools
import re
from collections.abc import Container, Iterator, Mapping
from pathlib import Path
from typing import Any

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.util.documents import read_toml, toml_tokens

_VEHICLE = re.compile(r"^(vehicle|station|radio)\[\d+\]")


def lines_of(text: str) -> dict[str, int]:
    """Key path -> line in a valid document: ``radio.loss``, ``world.boxes[2].size``, ``vehicle.car1.kind``.

    A vehicle without a name is ``vehicle[0]``. The line of a table without a header is that of its first key.
    """
    document = _Document(text)
    document.read()
    names = document.vehicles
    return {_VEHICLE.sub(lambda match: names.get(match[0], match[0]), path, 1): n for path, n in document.lines.items()}


def prefixes(key: str) -> Iterator[str]:
    """The key path and its parent paths, innermost first."""
    ends = [match.start() for match in re.finditer(r"[.\[]", key)]
    return (key[:end] for end in (len(key), *reversed(ends)))


class _Document:
    """Maps key paths to lines in one pass over the tokens of a TOML document."""

    def __init__(self, text: str) -> None:
        self.lines: dict[str, int] = {}
        self.vehicles: dict[str, str] = {}  # ``vehicle[0]`` -> ``vehicle.car1``
        self._counts: dict[str, int] = {}  # tables in each array of tables
        self._tokens = toml_tokens(text)
        self._next, self._line = next(self._tokens, ("", 0))

    def read(self) -> None:
        table = ""
        while self._next:
            if self._next == "\n":
                self._take()
            elif self._next == "[":
                table = self._header()
            else:
                self._pair(table)

    def _take(self) -> str:
        token = self._next
        self._next, self._line = next(self._tokens, ("", 0))
        return token

    def _header(self) -> str:
        line = self._line
        self._take()
        if is_array := self._next == "[":
            self._take()
        path = self._key("", "]")
        if is_array:
            self._take()
            self._counts[path] = self._counts.get(path, 0) + 1
            path = self._last(path)
        self.lines[path] = line
        return path

    def _pair(self, table: str) -> None:
        self._value(self._key(table, "="))

    def _key(self, key: str, end: str) -> str:
        line = self._line
        while self._next and (part := self._take()) not in (end, "\n"):
            if part != ".":
                key = ".".join(filter(None, (self._last(key), _text(part))))
                self.lines.setdefault(key, line)
        return key

    def _last(self, path: str) -> str:
        """The path, with the last table of an array that it names."""
        return f"{path}[{self._counts[path] - 1}]" if path in self._counts else path

    def _value(self, path: str) -> None:
        if self._next in ("[", "{"):
            self._inside(path)
            return
        table, _, name = path.rpartition(".")
        if name == "name" and _VEHICLE.fullmatch(table) and self._next[:1] in ("'", '"'):
            self.vehicles[table] = f"{table.partition('[')[0]}.{_text(self._next)}"
        while self._next not in ("", "\n", ",", "]", "}"):
            self._take()

    def _inside(self, path: str) -> None:
        opening, number = self._take(), 0
        while self._next not in ("", "]", "}"):
            if self._next in (",", "\n"):
                self._take()
            elif opening == "{":
                self._pair(path)
            else:
                item, number = f"{path}[{number}]", number + 1
                self.lines[item] = self._line
                self._value(item)
        self._take()


def _text(token: str) -> str:
    try:
        return str(read_toml(f"text = {token}")["text"]) if token[0] in "'\"" else token
    except ValueError:
        return token


class Source:
    """Origin of a scenario, with the lines and ``--set`` arguments of its keys.

    Args:
        name: of the file; without a file, one name for all keys.
        folder: base of relative file names in the scenario.

    Attributes:
        stations: names of the stations; the keys of a station begin with ``station``, though a run has it as a vehicle.
    """

    stations: frozenset[str] = frozenset()

    def __init__(self, name: str = "", folder: Path = Path(), text: str = "") -> None:
        self.name, self.folder = name, folder
        self._text = text
        self._set: dict[str, str] = {}

    def note_set(self, key: str, argument: str) -> None:
        """Note that the value of ``key`` comes from a command-line argument."""
        self._set[key] = argument

    def parameters(self, content: Mapping[str, Any], key: str, known: Container[str]) -> dict[str, Any]:
        """The parameters of a table; if ``kind`` was set, without the file's parameters that the new kind does not know."""
        switched = f"{key}.kind" in self._set
        return {
            name: value
            for name, value in content.items()
            if name != "kind" and (not switched or name in known or f"{key}.{name}" in self._set)
        }

    def replaced(self, key: str) -> tuple[str, ...] | None:
        """The keys set in a table whose ``kind`` was set, or None if it was not."""
        if f"{key}.kind" not in self._set:
            return None
        return tuple(path.removeprefix(f"{key}.").partition(".")[0] for path in self._set if path.startswith(f"{key}."))

    def of(self, key: str) -> str:
        """The argument that set the key or a key inside it, else file and line."""
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

    def error(self, problem: str, key: str) -> ScenarioError:
        """The error for a problem of a key's value, which names the origin of the value."""
        if key.startswith("vehicle.") and key.split(".")[1] in self.stations:
            key = key.replace("vehicle", "station", 1)
        return ScenarioError(problem, key=key, source=self.of(key))

    @functools.cached_property
    def _lines(self) -> dict[str, int]:
        return lines_of(self._text)


NOWHERE = Source()
"""Origin of values that no scenario gives."""


def _places(key: str) -> Iterator[str]:
    """Places where a key may be defined, likeliest first; a copied vehicle also has its template's and ``[vehicles]``."""
    for prefix in prefixes(key):
        yield prefix
        if vehicle := re.fullmatch(r"vehicle\.([^.\[]*?)(\d*)((?:[.\[].*)?)", prefix):
            stem, number, rest = vehicle.groups()
            yield from (f"vehicle.{stem}{number[:length]}{rest}" for length in reversed(range(len(number))))
            if rest:
                yield f"vehicles{rest}"
