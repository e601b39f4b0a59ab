"""Line numbers of keys, for all ways to write a TOML document."""

import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.config.provenance import Source, lines_of
from vcmvsp.cosim.scenario.loader import BUILT_IN

pytestmark = pytest.mark.slow

GALLERY = sorted(BUILT_IN.glob("*.toml"))
WORDS = st.from_regex(r"[a-z][a-z0-9_-]{0,4}", fullmatch=True)


def keys_in(value: Any, path: str = "") -> Iterator[str]:
    """The paths of all keys and items of a parsed document."""
    items = value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, list) else ()
    for name, each in items:
        here = f"{path}[{name}]" if isinstance(name, int) else f"{path}.{name}".removeprefix(".")
        if path in ("vehicle", "station") and "name" in each:
            here = f"{path}.{each['name']}"
        yield here
        yield from keys_in(each, here)


@pytest.mark.parametrize("path", GALLERY, ids=lambda path: path.stem)
def test_every_key_of_the_gallery_has_a_line_with_it(path: Path) -> None:
    text = path.read_text("utf-8")
    found, lines = lines_of(text), text.splitlines()
    assert {*keys_in(tomllib.loads(text))} == {*found}
    for key, number in found.items():
        name = re.sub(r"(\[\d+\])+$", "", key).rpartition(".")[2]
        word = key.removeprefix("vehicle.") if key.count(".") == 1 and key.startswith("vehicle.") else name
        match = re.search(rf"\b{word}\b", lines[number - 1])
        assert match or key.endswith("]") or lines[number - 1] in ("[[vehicle]]", "[[station]]"), key


WAYS: list[list[tuple[str, list[str]]]] = [
    [("NAME = 1.5e3 # of NAME = 2", [""])],
    [('"NAME" = 1979-05-27T07:32:00Z', [""])],
    [("NAME = '[x = {\"'", [""])],
    [('NAME = """', [""]), ("[[vehicle]]", []), ("a = 1 ' # \\\"", []), ('q""""', [])],
    [("NAME = [", [""]), ("  0, # ], ", ["[0]"]), ("  1, '2'", ["[1]", "[2]"]), ("]", [])],
    [
        ("NAME = [{ a.b = 1, c = [2] },", ["", "[0]", "[0].a", "[0].a.b", "[0].c", "[0].c[0]"]),
        ("  { d = '},' }]", ["[1]", "[1].d"]),
    ],
    [("NAME . 'x' .y = true", ["", ".x", ".x.y"])],
    [("NAME = { a = 1, b = { c = [] } }", ["", ".a", ".b", ".b.c"])],
]
"""Ways to write a key: lines, each with the keys that begin there."""
FILLERS = ["", "# [[a]] b = 1", "\t"]


class Writer:
    """Writes a document line by line and records the line of each key."""

    def __init__(self, draw: st.DrawFn) -> None:
        self._draw, self.lines, self.keys = draw, list[str](), dict[str, int]()

    def put(self, text: str, *paths: str) -> None:
        self.lines += [*self._draw(st.lists(st.sampled_from(FILLERS), max_size=2)), text]
        self.keys |= {path.removeprefix("."): len(self.lines) for path in paths}

    def pairs(self, here: str) -> None:
        for name in self._draw(st.lists(WORDS, max_size=4, unique=True)):
            for text, suffixes in self._draw(st.sampled_from(WAYS)):
                self.put(text.replace("NAME", name), *(f"{here}.{name}{each}" for each in suffixes))

    def tables(self, path: str) -> None:
        for item in range(self._draw(st.integers(0, 3))):
            self.put(f"[[ {path.replace('.', ' . ')} ]]", *([path] if item == 0 else []), f"{path}[{item}]")
            self.pairs(f"{path}[{item}]")
            self.put(f"[{path}.Sub]", f"{path}[{item}].Sub")
            for inner in range(self._draw(st.integers(0, 2))):
                own = f"{path}[{item}].In"
                self.put(f"[[{path}.In]]", *([own] if inner == 0 else []), f"{own}[{inner}]")
                self.pairs(f"{own}[{inner}]")


@st.composite
def documents(draw: st.DrawFn) -> tuple[str, dict[str, int]]:
    """A document and the line of each key."""
    writer = Writer(draw)
    writer.pairs("")
    for name in draw(st.lists(WORDS.map(str.upper), max_size=3, unique=True)):
        writer.put(f"[{name}.S]", name, f"{name}.S")
        writer.pairs(f"{name}.S")
        writer.tables(f"{name}.L")
    return "\n".join(writer.lines), writer.keys


@given(documents())
def test_every_key_of_a_document_has_the_line_at_which_it_was_written(written: tuple[str, dict[str, int]]) -> None:
    text, keys = written
    tomllib.loads(text)
    assert lines_of(text) == keys


@pytest.mark.parametrize(
    ("key", "line"),  # 0: not in the file
    [
        ("intervention[0].kind", 8),
        ("intervention[1].at_s", 11),
        ("world.boxes[1].size", 5),
        ("world.boxes[1].size[2]", 5),
        ("world.boxes[1].material", 4),  # not in the file: line of its table
        ("vehicle.uav12.kind", 16),  # one of 20
        ("vehicle.uav1.pose", 14),
        ("vehicle.uav12.sensors.gps.rate_hz", 20),  # a default for all
        ("vehicle[1].kind", 22),
        ("metrics.from_s", 0),
    ],
)
def test_a_key_has_its_line_also_in_lists_and_in_one_table_for_many(key: str, line: int) -> None:
    text = """[world]
boxes = [
  { center = [0, 0, 0] },
  {
    size = [1, 2, 3] },
]
[[intervention]]
kind = "halt"
at_s = 1
[[intervention]]
at_s = 2
kind = "halt"

[[vehicle]]
name = "uav1"
kind = "point"
count = 20
[vehicles.sensors.gps]
kind = "gps"
rate_hz = 5
[[vehicle]]
kind = "point"
"""
    assert Source("s.toml", Path(), text).of(key) == (f"s.toml line {line}" if line else "s.toml")
